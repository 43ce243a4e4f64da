# SPDX-License-Identifier: Apache-2.0
"""Choice of the reference configurations, at which changes during a collection show best.

Each possible change (of a sensor, the base, a marker, a joint) moves the measured markers linearly
in few parameters; all displacements are in the robot base frame R.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

MOST_EXCHANGES = 3
"""Most rounds of exchanges."""


@dataclass(frozen=True)
class Place:
    """A marker that a sensor follows, at a reference configuration."""

    q: FloatArray  # rad, (k,)
    sensor: str  # Its name
    marker: str  # Its name
    marker_T: FloatArray  # Position of the marker in the tool frame, m, (3,)


@dataclass(frozen=True)
class Cause:
    """A possible change during a collection: of a sensor, the base, a marker, tool or joint."""

    kind: str  # ``sensor``, ``base``, ``marker``, ``tool`` or ``joint``
    subject: str  # The change as a sentence
    # Displacement of the measured markers per unit of each parameter, m, (places, 3, p): first
    # translations (per m), then rotations (per rad)
    jacobian: FloatArray
    shifts: int  # Number of translations among the p parameters


def rigid(points: FloatArray, center: FloatArray) -> FloatArray:
    """Return the Jacobian of points (n, 3) by a rigid motion about `center`, (n, 3, 6).

    Columns: translation along x, y, z, then rotation about them, per rad. ``center``: (3,).
    """
    shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    # Column i: the velocity at a turn about axis i, e_i × (point - center).
    turn = np.cross(np.eye(3), (points - center)[:, None]).swapaxes(-1, -2)
    return np.concatenate((shift, turn), axis=-1)


def causes(chain: SerialChain, places: Sequence[Place]) -> list[Cause]:
    """Return every single change that can happen during a collection.

    A sensor is moved; the base (or all sensors on one stand) is moved; one marker slips; the tool
    with all markers slips (only with several markers); the encoder of a joint slips. In this
    order. With one sensor its motion and that of the base cannot be distinguished, and are one
    cause. ``places``: markers at the references; the Jacobians are in their order.
    """
    q = np.array([place.q for place in places])
    markers_T = np.array([place.marker_T for place in places])
    points = chain.positions(q, markers_T)
    turned = chain.forward(q)[:, :3, :3]
    sensors = list(dict.fromkeys(place.sensor for place in places))
    markers = list(dict.fromkeys(place.marker for place in places))

    def of(names: Sequence[str], name: str) -> FloatArray:
        return np.array([each == name for each in names], float)[:, None, None]

    motion = rigid(points, points.mean(axis=0))
    changes = []
    if len(sensors) == 1:
        changes.append(Cause('sensor', f'{sensors[0]} or the base was moved', motion, 3))
    else:
        for name in sensors:
            mine = of([place.sensor for place in places], name)
            center = points[mine[:, 0, 0] > 0].mean(axis=0)
            changes.append(Cause('sensor', f'{name} was moved', mine * rigid(points, center), 3))
        changes.append(Cause('base', 'the base, or all sensors together, were moved', motion, 3))
    for name in markers:
        mine = of([place.marker for place in places], name)
        changes.append(Cause('marker', f'marker {name} slipped on the tool', mine * turned, 3))
    if len(markers) > 1:
        on_tool = np.array(list({p.marker: p.marker_T for p in places}.values()))
        tool = turned @ rigid(markers_T, on_tool.mean(axis=0))
        changes.append(Cause('tool', 'the tool slipped on the flange', tool, 3))
    jacobian = chain.position_jacobian(q, markers_T)
    # The slip of a prismatic joint is a translation.
    changes += [
        Cause('joint', f'the encoder of {name} slipped', jacobian[:, :, i : i + 1], int(slides))
        for i, (name, slides) in enumerate(zip(chain.joint_names, chain.slides, strict=True))
    ]
    return changes


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
    """Choose the configurations that are measured repeatedly during a collection.

    Few are enough: three marker positions that are not collinear determine the six parameters of a
    rigid motion, so a shift or rotation of sensor or base in any direction shows, as does the slip
    of a marker at any one configuration. More configurations tell the causes apart: a marker's
    slip rotates with the tool, that of a joint is another curve in each joint solution. They are
    chosen one by one, each to increase the log determinant of the information on all parameters
    most (D-optimal), until the smallest singular value of the rigid motions is `wanted` standard
    deviations for a shift of `shift_m` and a rotation of `turn_rad`; before one more is added,
    chosen ones are exchanged for others that show rigid motions better.

    ``chain``: the arm; ``candidates``: configurations in sight of every sensor, rad, (n, k);
    ``seen``: sensor -> name of its marker and position in the tool frame, m, (3,); ``fewest,
    most``: number to choose; ``noise_m``: of one reading, with the arm's repeatability, per axis;
    ``shift_m, turn_rad``: the change that has to show; 1 mrad moves a point half a metre away by
    0.5 mm; ``wanted``: in standard deviations.
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
    """Exchange chosen references, one by one, for candidates that show rigid motions better.

    Returns the new references and their smallest singular value, the least of all rigid
    motions (`_smallest`). Ends as soon as that is `wanted`, as the first choice distinguishes
    the causes best, after `MOST_EXCHANGES` rounds, or a round without an exchange. ``chosen``:
    indices of the references among n candidates; ``moves``: for each rigid motion the
    displacements of the S markers at the candidates in standard deviations, (n, 3 S, 6).
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
    """Smallest singular value of the displacements by a rigid motion at m references.

    In standard deviations, for the unit shift or rotation; rotations count about the centre of
    the references. ``signals``: displacements by 3 translations and 3 rotations, (m, 3 S, 6);
    rows of zeros, of markers that do not move, are left out.
    """
    flat = signals.reshape(-1, signals.shape[-1])
    flat = flat[np.any(flat != 0.0, axis=1)]
    shifts, rotations = flat[:, :3], flat[:, 3:]
    # Rotations about the centre of the references: the part that is a shift is removed.
    mean, *_ = np.linalg.lstsq(shifts, rotations, rcond=None)
    centred = np.concatenate((shifts, rotations - shifts @ mean), axis=1)
    return float(np.linalg.svd(centred, compute_uv=False)[-1])


@dataclass(frozen=True)
class Choice:
    """The chosen reference configurations, and how well they show a rigid motion."""

    indices: tuple[int, ...]  # Into the candidates, in the order chosen
    # Size of the least visible shift (0.5 mm) or rotation (1 mrad) of a sensor or the base, in
    # standard deviations of one round
    smallest: float
