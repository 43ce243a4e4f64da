# SPDX-License-Identifier: Apache-2.0
"""Reference configurations: what can change beside an arm in mid-run, and where it shows best.

Each cause moves the measured markers linearly in few parameters; all displacements are in the
robot base frame R.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

MOST_EXCHANGES = 3
"""So often at most each reference is exchanged for a better one."""


@dataclass(frozen=True)
class Place:
    """A marker that a sensor follows at a reference configuration."""

    q: FloatArray  # rad, (k,)
    # Their names
    sensor: str
    marker: str
    marker_T: FloatArray  # The marker in the tool frame, m, (3,)


@dataclass(frozen=True)
class Cause:
    """One thing that can change."""

    kind: str  # ``sensor``, ``base``, ``marker``, ``tool`` or ``joint``
    subject: str  # For people: what has changed
    # Displacement of the measured markers by the parameters, m per unit, (places, 3, p): shifts in
    # m come first, then turns in rad
    jacobian: FloatArray
    shifts: int  # How many of the p parameters are shifts


def rigid(points: FloatArray, center: FloatArray) -> FloatArray:
    """Return how points (n, 3) move by a shift and a turn about `center`, (n, 3, 6)."""
    shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    # Column i: the velocity at a turn about axis i, e_i × (point - center).
    turn = np.cross(np.eye(3), (points - center)[:, None]).swapaxes(-1, -2)
    return np.concatenate((shift, turn), axis=-1)


def causes(chain: SerialChain, places: Sequence[Place]) -> list[Cause]:
    """Return everything that one change alone can be.

    A sensor is moved; the base (or all sensors on one stand) is moved; one marker slips; the tool
    with all markers slips; the encoder of a joint slips. With one sensor its own move and that of
    the base are the same thing, and are returned as one.
    """
    q = np.array([place.q for place in places])
    markers_T = np.array([place.marker_T for place in places])
    points = chain.positions(q, markers_T)
    turned = chain.forward(q)[:, :3, :3]
    sensors = list(dict.fromkeys(place.sensor for place in places))
    markers = list(dict.fromkeys(place.marker for place in places))

    def of(names: Sequence[str], name: str) -> FloatArray:
        return np.array([own == name for own in names], float)[:, None, None]

    whole = rigid(points, points.mean(axis=0))
    found = []
    if len(sensors) == 1:
        found.append(Cause('sensor', f'{sensors[0]} or the base was moved', whole, 3))
    else:
        for name in sensors:
            mine = of([place.sensor for place in places], name)
            center = points[mine[:, 0, 0] > 0].mean(axis=0)
            found.append(Cause('sensor', f'{name} was moved', mine * rigid(points, center), 3))
        found.append(Cause('base', 'the base, or all sensors together, were moved', whole, 3))
    for name in markers:
        mine = of([place.marker for place in places], name)
        found.append(Cause('marker', f'marker {name} slipped on the tool', mine * turned, 3))
    if len(markers) > 1:
        on_tool = np.array(list({p.marker: p.marker_T for p in places}.values()))
        tool = turned @ rigid(markers_T, on_tool.mean(axis=0))
        found.append(Cause('tool', 'the tool slipped on the flange', tool, 3))
    jacobian = chain.position_jacobian(q, markers_T)
    # A joint that slides slips by a shift.
    found += [
        Cause('joint', f'the encoder of {name} slipped', jacobian[:, :, i : i + 1], int(slides))
        for i, (name, slides) in enumerate(zip(chain.joint_names, chain.slides, strict=True))
    ]
    return found


def choose_references(
    chain: SerialChain,
    candidates: FloatArray,
    seen: Mapping[str, tuple[str, FloatArray]],
    *,
    fewest: int = 4,
    most: int = 6,
    noise_m: float = 1e-4,
    shift_m: float = 5e-4,
    turn_rad: float = 1e-3,
    wanted: float = 5.0,
) -> Choice:
    """Choose the configurations that are measured again and again.

    Why few are enough: three marker positions off one line fix the six freedoms of a rigid move,
    so the smallest singular value of their stacked Jacobian is above zero, and a shift or turn of
    sensor or base in any direction shows. A marker's slip shows at any one configuration, in any
    direction, since it is only turned with the tool. The further ones serve to tell the
    causes apart: a marker's slip turns with the tool, the slip of a joint is another curve in each
    joint solution. They are chosen one by one, each to add the most to the log determinant of the
    information on all these freedoms together (D-optimal), until the smallest singular value of
    the rigid moves is `wanted` times the noise for a shift of `shift_m` and a turn of `turn_rad`;
    before one more is added, those chosen are exchanged for others that show these moves better.

    ``chain``: the arm; ``candidates``: configurations that every sensor sees, rad, (n, k);
    ``seen``: sensor -> the marker that it follows, by name and in the tool frame, m, (3,);
    ``fewest, most``: how many are chosen; ``noise_m``: of one reading, with the arm's
    repeatability, per axis; ``shift_m, turn_rad``: the change that is to show; a turn of 1 mrad
    moves what is half a metre away by 0.5 mm; ``wanted``: by how many standard deviations.
    """
    places = [
        Place(q, sensor, marker, marker_T)
        for q in candidates
        for sensor, (marker, marker_T) in seen.items()
    ]
    if not places:
        return Choice((), 0.0)
    per, signals, moves = len(seen), [], []
    for cause in causes(chain, places):
        scale = np.full(cause.jacobian.shape[-1], turn_rad)
        scale[: cause.shifts] = shift_m
        signals.append(cause.jacobian * scale / noise_m)
        if cause.kind == 'sensor':
            moves.append(signals[-1].reshape(len(candidates), per * 3, 6))
    stacked = np.concatenate(signals, axis=-1).reshape(len(candidates), per * 3, -1)
    information = np.eye(stacked.shape[-1])
    chosen: list[int] = []
    smallest = 0.0
    while len(chosen) < min(most, len(candidates)):
        # det(M + A'A) = det(M) det(I + A M⁻¹ A').
        inner = stacked @ np.linalg.solve(information, np.swapaxes(stacked, -1, -2))
        gain = np.linalg.slogdet(np.eye(per * 3) + inner)[1]
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        information = information + stacked[chosen[-1]].T @ stacked[chosen[-1]]
        if len(chosen) >= min(fewest, len(candidates)):
            chosen, smallest = _exchanged(chosen, moves, wanted)
            if smallest >= wanted:
                break
    return Choice(tuple(chosen), smallest)


def _exchanged(
    chosen: Sequence[int], moves: Sequence[FloatArray], wanted: float
) -> tuple[list[int], float]:
    """Exchange one reference after the other while that shows rigid moves better.

    Returns chosen, smallest: What was chosen last, and its smallest singular value; as soon as
    that is `wanted`, no more is exchanged, since the first choice distinguishes the causes best.
    """
    best, smallest = list(chosen), min(_smallest(move[list(chosen)]) for move in moves)
    for _ in range(MOST_EXCHANGES):
        before = smallest
        for place in range(len(best)):
            for other in range(len(moves[0])):
                if smallest >= wanted:
                    return best, smallest
                tried = [*best[:place], other, *best[place + 1 :]]
                value = min(_smallest(move[tried]) for move in moves)
                if value > smallest and other not in best:
                    best, smallest = tried, value
        if smallest <= before:
            break
    return best, smallest


def _smallest(signals: FloatArray) -> float:
    """Return the smallest singular value of a rigid move, at its own center; (m, 3 S, 6)."""
    flat = signals.reshape(-1, signals.shape[-1])
    flat = flat[np.any(flat != 0.0, axis=1)]
    shifts, turns = flat[:, :3], flat[:, 3:]
    # A turn about the references' own middle: what a shift explains of it is no turn.
    mean, *_ = np.linalg.lstsq(shifts, turns, rcond=None)
    both = np.concatenate((shifts, turns - shifts @ mean), axis=1)
    return float(np.linalg.svd(both, compute_uv=False)[-1])


@dataclass(frozen=True)
class Choice:
    """References that were chosen."""

    indices: tuple[int, ...]  # Into the candidates, in the order chosen
    # How many standard deviations the least visible shift (0.5 mm) or turn (1 mrad) of a sensor or
    # the base shows by, over one round
    smallest: float
