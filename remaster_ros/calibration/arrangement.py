# SPDX-License-Identifier: Apache-2.0
"""Arrangements of a table that fit the robot: signs, order, zeros, units and rows, by trial.

A foreign table may have a joint that counts in the other direction, columns in another order, a
zero position 90 degrees off, other units, or points next to the joints of another row. Each such
arrangement is tried in closed form: with any 3×3 matrix G in the place of the sensor's rotation
and scale (as in `initial_guess`),

    T_R_T(q) · marker = G p + t

is linear in marker, G and t. The nearest arrangements are fitted as any session is. Changes from a
row on, or of the tool, are tried in `mistakes`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain as chain_of
from itertools import combinations, product
from typing import Any

import numpy as np

from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.initial_guess import closest_start, robust_spread
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.noise import MEDIAN_LENGTH
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.calibration.priors import LARGEST_OFFSET, UNCALIBRATED_ERROR_M, Prior, prior_rows
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import LIMIT_TOLERANCE_RAD, SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Session

# Least number of rows: fewer fit to one of the arrangements by chance, as a point has 3
# coordinates and the linear problem 15 unknowns.
FEWEST_ROWS = 12
# Largest numbers of rows, evenly spread, in the fit and in the linear problem of 15 unknowns.
MOST_ROWS = 200
_MOST_LINEAR = 40
# Share of rows that the fit keeps; and the length, in standard deviations, that this share of
# three-dimensional Gaussian errors does not exceed.
_MOST = 1.0 - LARGEST_SHARE
_MOST_CHI3 = 2.5003
# Factor by which an arrangement must fit better than the given one to be proposed.
CONVINCING = 5.0
# Fits with errors below this factor times those of the closest one are proposed too: the offsets
# of an arm leave a larger error with one of any two.
ALIKE = 2.0
# Number of the best linear solutions that are fitted, and the largest error of these as a share of
# the points' extent: zero-offsets of some degrees leave less.
_FITTED = 6
_LARGEST_LINEAR = 0.15
# Rows that are computed at once, to bound the memory.
_BATCH_FRAMES = 20_000
_QUARTER = np.pi / 2.0
# Columns that belong to the joints of a row, not to its point.
_OF_JOINTS = (
    *('pose', 'configuration', 'is_validation', 'is_reference'),
    *('q', 'from_q', 'effort', 'wanted', 'correction', 'velocity', 'acceleration'),
)
# Scales of angles: right, degrees taken for radians, radians taken for degrees.
_SCALES = (1.0, np.pi / 180.0, 180.0 / np.pi)


@dataclass(frozen=True)
class Arrangement:
    """Relation of the robot's joints and points to the columns of a table."""

    order: tuple[int, ...]  # Column of each joint, base to tip
    signs: tuple[int, ...]  # 1 or -1 for each joint
    quarters: tuple[int, ...]  # Quarter turns added to each joint
    angle_scale: float = 1.0  # Factor of the angles
    # Factor of joint 2 that is added to joint 3: 1 or -1 on arms that count joint 3 from the
    # horizontal (FANUC, and arms with a parallelogram), else 0
    coupled: int = 0
    mirrored: bool = False  # Whether X and Y of the points are exchanged
    length_scale: float = 1.0  # Factor of the points
    # Number of rows, of the same sensor and marker, by which points come after their joints
    shift: int = 0
    # Indices of two markers whose labels are exchanged; () for none
    exchanged: tuple[int, ...] = ()
    # Observations from which (inclusive) and until which (exclusive) rows are shifted or labels
    # exchanged; None for the first and behind the last
    since: int | None = None
    until: int | None = None
    # Axis, and quarter turns by which the markers are turned about it in the tool frame
    turned: tuple[int, int] = (0, 0)
    tip_link: str = ''  # Tool frame; '' for the given one

    @classmethod
    def given(cls, joints: int) -> Arrangement:
        """Arrangement of a table of this number of joints that needs no change."""
        return cls(tuple(range(joints)), (1,) * joints, (0,) * joints)

    @property
    def changes(self) -> int:
        """Number of changes from a table that needs none (`given`), which has 0.

        Two exchanged columns count as one change, each reversed or quarter-turned joint as one;
        mirrored points and a turned tool count as two, as they are rare.
        """
        # Two that are exchanged are one thing, and so are all of them tip to base.
        moved = sum(column != joint for joint, column in enumerate(self.order)) // 2
        return (
            moved
            + sum(sign < 0 for sign in self.signs)
            + sum(turn != 0 for turn in self.quarters)
            + (self.angle_scale != 1.0)
            + abs(self.coupled)
            # Rarer than one reversed joint.
            + 2 * self.mirrored
            + (self.length_scale != 1.0)
            + abs(self.shift)
            + bool(self.exchanged)
            + (self.since is not None)
            + (self.until is not None)
            # Rarer than another link.
            + 2 * (self.turned[1] != 0)
            + bool(self.tip_link)
        )

    def joints(self, columns: FloatArray) -> FloatArray:
        """Joint positions of the robot, rad, (n, k), from the table's columns (n, k), as a copy.

        In this order: columns reordered, times ``angle_scale``, joint 2 added to joint 3 if
        coupled, signs, quarter turns.
        """
        turned = columns[:, list(self.order)] * self.angle_scale
        if self.coupled:
            turned[:, 2] += self.coupled * turned[:, 1]
        return turned * np.array(self.signs) + _QUARTER * np.array(self.quarters)

    def rates(self, columns: FloatArray | None, scale: float = 1.0) -> FloatArray | None:
        """Joint speeds or torques of the robot, (n, k), times a scale; None without columns.

        Order and signs are applied, but neither the coupling of joint 3 nor quarter turns.
        """
        if columns is None:
            return None
        return scale * columns[:, list(self.order)] * np.array(self.signs)

    def points(self, points: FloatArray) -> FloatArray:
        """Points for the robot, m, from the points of a table, (n, 3), as a copy.

        X and Y are exchanged if ``mirrored``, then all are multiplied by ``length_scale``.
        """
        return (points[:, [1, 0, 2]] if self.mirrored else points) * self.length_scale


@dataclass(frozen=True, eq=False)
class Fitted:
    """Robust fit of a session with its table arranged in one way: errors and zero-offsets."""

    arrangement: Arrangement
    error_m: float  # Median distance of the points from the fit, m
    # rad, m for prismatic joints, (k,); 0 for offsets that the data do not determine, such as
    # those of the outer two joints
    joint_offsets: FloatArray
    marker_shift_m: float  # Largest distance of a marker from its stated position, m
    # 90 % quantile of the distances, scaled to the median of Gaussian errors, m: larger than the
    # median if a part of the points is off
    most_error_m: float
    per_radian: FloatArray  # Offset of each joint that counts as a radian, (k,)

    @property
    def gross(self) -> bool:
        """Whether the table is unlikely to be that of this robot.

        True if `worst_error_m` exceeds 5 mm (`UNCALIBRATED_ERROR_M`) or an offset 5 degrees
        (`LARGEST_OFFSET`; for a joint that slides times ``per_radian``).
        """
        turned = np.abs(self.joint_offsets) > LARGEST_OFFSET * self.per_radian
        return bool(self.worst_error_m > UNCALIBRATED_ERROR_M or turned.any())

    @property
    def worst_error_m(self) -> float:
        """Error of the fit, m: the larger of the median and the 90 % quantile of the distances.

        The quantile is scaled so that it equals the median if the errors are Gaussian.
        """
        return max(self.error_m, self.most_error_m)


def arranged(session: Session, arrangement: Arrangement) -> Session:
    """Copy of a session with joints, points, labels, marker positions and tool rearranged.

    Joints and points get the order, signs, quarter turns and scales of the `Arrangement`,
    marker positions its turn in the tool frame, and its ``tip_link`` replaces the session's
    unless it is ''. Its shift and exchanged labels apply only to observations from its
    ``since`` (inclusive) to its ``until`` (exclusive). Rows that a shift leaves without joints
    are dropped. The checksum of the observations is ''.
    """
    m = session.measurements
    moved = replace(
        m,
        q=arrangement.joints(m.q),
        from_q=arrangement.joints(m.from_q),
        effort=arrangement.rates(m.effort),
        velocity=arrangement.rates(m.velocity, arrangement.angle_scale),
        acceleration=arrangement.rates(m.acceleration, arrangement.angle_scale),
        wanted=None if m.wanted is None else arrangement.joints(m.wanted),
        position=arrangement.points(m.position),
    )
    concerned = between(m, arrangement.since, arrangement.until)
    if arrangement.exchanged:
        a, b = arrangement.exchanged
        moved = exchanged(moved, a, b, concerned)
    if arrangement.shift:
        moved = shifted(moved, arrangement.shift, concerned)
    R = rotation_vector_to_matrix(
        _QUARTER * arrangement.turned[1] * np.eye(3)[arrangement.turned[0]]
    )
    return replace(
        session,
        measurements=moved,
        markers={name: R @ place for name, place in session.markers.items()},
        tip_link=arrangement.tip_link or session.tip_link,
        observations_sha256='',
    )


def between(m: Measurements, since: int | None, until: int | None) -> BoolArray:
    """Mask (n,) of the rows from observation ``since`` (inclusive) to ``until`` (exclusive).

    None stands for the first row, or behind the last. Rows are in file order; an observation
    without a row counts as behind the last row.
    """
    row = np.arange(len(m))
    first = 0 if since is None else _row_of(m, since)
    last = len(m) if until is None else _row_of(m, until)
    return (row >= first) & (row < last)


def _row_of(m: Measurements, observation: int) -> int:
    """Index, from 0, of an observation's first row; the number of rows without one."""
    found = np.flatnonzero(m.observation == observation)
    return int(found[0]) if len(found) else len(m)


def exchanged(m: Measurements, a: int, b: int, concerned: BoolArray) -> Measurements:
    """Copy of the measurements with the labels of markers a and b (indices) exchanged.

    ``concerned``: mask of the rows in which labels are exchanged, (n,).
    """
    marker = m.marker.copy()
    marker[concerned & (m.marker == a)] = b
    marker[concerned & (m.marker == b)] = a
    return replace(m, marker=marker)


def shifted(m: Measurements, shift: int, concerned: BoolArray) -> Measurements:
    """Measurements with each concerned point next to the joints of the row ``shift`` rows before.

    ``concerned``: mask, (n,); a negative shift takes joints of rows behind. The concerned rows of
    each sensor and marker are shifted among themselves; those left without joints are dropped.
    """
    joint_rows, kept = joint_rows_of_points(m, shift, concerned)
    joints: dict[str, Any] = {
        name: None if (column := getattr(m, name)) is None else column[joint_rows]
        for name in _OF_JOINTS
    }
    return replace(m, **joints).select(kept)


def joint_rows_of_points(
    m: Measurements, shift: int, concerned: BoolArray
) -> tuple[IntArray, BoolArray]:
    """Row whose joints belong to each point, (n,), and mask of the points that have one, (n,).

    Points of rows that are not ``concerned`` (mask) keep their own joints. The other points
    take the joints ``shift`` rows before, among such rows of the same sensor and marker. The
    first ``shift`` of these have none (the last, if negative): their row has no meaning.
    """
    joint_rows, kept = np.arange(len(m)), np.ones(len(m), bool)
    for rows in streams(m):
        shifted_rows = rows[concerned[rows]]
        joint_rows[shifted_rows] = np.roll(shifted_rows, shift)
        kept[shifted_rows[:shift] if shift > 0 else shifted_rows[shift:]] = False
    return joint_rows, kept


def streams(m: Measurements) -> Iterator[IntArray]:
    """Yield the indices of the rows of each pair of sensor and marker, ascending.

    Pairs come in ascending order of sensor, then marker; only pairs with rows.
    """
    _, which = np.unique(np.stack((m.sensor, m.marker)), axis=1, return_inverse=True)
    for index in np.unique(which):
        yield np.flatnonzero(which.ravel() == index)


def some_rows(session: Session) -> Session:
    """Session with only its optimization rows, at most 200 (`MOST_ROWS`), evenly spread."""
    rows = np.flatnonzero(~session.measurements.is_validation)
    if len(rows) > MOST_ROWS:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_ROWS).astype(np.int64)]
    return session.select(rows)


def closest_fit(problem: Problem) -> tuple[Model, FloatArray, Rows]:
    """Model, pinned parameters (size,) and sorted rows of the better of two robust fits.

    The fits are those of `closest_start`; however large the errors are, no MisfitError is
    raised. Raises InsufficientDataError if there are too few rows or poses to register a
    sensor.
    """
    model = problem.empty_model()
    start, z = closest_start(
        model,
        problem.measurements,
        problem.fitted,
        problem.markers,
        float(np.max(problem.marker_std_m)),
        problem.marker_priors(model),
    )
    return start, z, Rows.of(problem.measurements, problem.fitted, start.reference)


def fit_arrangement(session: Session, arrangement: Arrangement) -> Fitted:
    """Fit one arrangement robustly to at most 200 rows of a session, however badly it fits.

    ``session``: the table as it is, which is rearranged first. Raises InsufficientDataError if
    there are too few rows or poses to register a sensor, InputError as `Problem.of`.
    """
    problem = Problem.of(some_rows(arranged(session, arrangement)))
    start, z, rows = closest_fit(problem)
    errors = rows.target - start.predict(z, rows)
    spread = robust_spread(errors, rows)
    most = max(
        float(np.quantile(np.linalg.norm(errors[span], axis=1), _MOST)) for _, span in rows.spans
    )
    shift = np.linalg.norm(start.markers(z) - problem.markers, axis=1)
    return Fitted(
        arrangement,
        MEDIAN_LENGTH * float(spread.max()),
        determined_offsets(start, z, rows, problem.marker_priors(start), float(spread.max())),
        float(shift.max()),
        most * MEDIAN_LENGTH / _MOST_CHI3,
        start.chain.per_radian,
    )


def determined_offsets(
    model: Model, z: FloatArray, rows: Rows, priors: Sequence[Prior], sigma: float
) -> FloatArray:
    """Zero-offsets of a fit, rad or m, (k,); 0 for offsets that the data do not determine.

    Not determined is an offset with a standard deviation of 5 degrees (`LARGEST_OFFSET` times
    ``per_radian``) or more, such as that of the joint before one that never moves. ``z``:
    pinned parameters, (size,); ``sigma``: standard deviation of the errors per axis, m.
    """
    derivative = model.jacobian(z, rows).reshape(3 * len(rows), -1) / sigma
    _, by_z = prior_rows(model, priors, z)
    # A weak prior of 10 rad and 10 m, so that the matrix can be inverted.
    H = derivative.T @ derivative + by_z.T @ by_z + 1e-2 * np.eye(len(z))
    std = np.sqrt(np.diag(np.linalg.inv(H)))
    offsets = model.offsets(z)
    known = std[: len(offsets)] < LARGEST_OFFSET * model.chain.per_radian
    return np.where(known, offsets, 0.0)


def linear_errors(
    chain: SerialChain, session: Session, arrangements: Sequence[Arrangement]
) -> tuple[FloatArray, FloatArray]:
    """Errors of arrangements in a linear problem, as shares of the points' extent.

    The problem is T_R_T(q) · marker = G p + t (see the module), with a free 3×3 matrix G. Only
    the sensor and marker with most rows are used, at most 40 rows. Returns errors: median
    distance over the extent of the points, (arrangements,); and scales: metres of the robot for
    one unit of the points, negative if G mirrors them.
    """
    m = session.measurements
    rows = max(streams(m), key=len)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _MOST_LINEAR)).astype(np.int64)]
    n, q = len(rows), m.q[rows]
    errors, scales = np.empty(len(arrangements)), np.empty(len(arrangements))
    step = max(1, _BATCH_FRAMES // n)
    for first in range(0, len(arrangements), step):
        part = arrangements[first : first + step]
        at = slice(first, first + step)
        errors[at], scales[at] = linear_fit(
            chain, np.array([a.joints(q) for a in part]), m.position[rows]
        )
    return errors, scales


def linear_fit(
    chain: SerialChain, q: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Errors of joints against points in the linear problem, whatever the points' unit.

    The problem is T_R_T(q) · marker = G p + t (see the module), with a free 3×3 matrix G.

    Parameters
    ----------
    q
        m alternatives for the joints of n rows, rad, (m, n, k).
    points
        (n, 3).

    Returns
    -------
    errors, scales
        As in `linear_errors`, (m,).
    """
    n = len(points)
    centred = points - points.mean(axis=0)
    extent = np.median(np.linalg.norm(centred, axis=1))
    # The columns of G and t are projected out; they are the same for all alternatives.
    base = np.linalg.svd(np.column_stack((centred, np.ones(n))), full_matrices=False)[0]
    tools = chain.forward(q)
    flat = tools[..., :3, :].reshape(len(q), n, 12)
    complement = (flat - base @ (base.T @ flat)).reshape(len(q), n, 3, 4)
    design = complement[..., :3].reshape(len(q), 3 * n, 3)
    target = -complement[..., 3].reshape(len(q), 3 * n, 1)
    by_marker = np.swapaxes(design, 1, 2)
    normal = by_marker @ design
    # If the tool hardly turns, the marker is not determined, and stays near the tool.
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-15
    marker = np.linalg.solve(normal + ridge * np.eye(3), by_marker @ target)
    residual = (design @ marker - target).reshape(len(q), n, 3)
    modelled = (tools[..., :3, :3] @ marker[:, None])[..., 0] + tools[..., :3, 3]
    modelled -= modelled.mean(axis=1, keepdims=True)
    G = np.linalg.lstsq(centred, np.concatenate(list(modelled), axis=1), rcond=None)[0]
    det = np.linalg.det(G.T.reshape(len(q), 3, 3))
    scale = np.sign(det) * np.cbrt(np.abs(det))
    # Not in metres: wrong joints that hardly move would win by a G near zero.
    size = np.median(np.linalg.norm(residual, axis=2), axis=1)
    return size / np.maximum(np.abs(scale) * extent, 1e-12), scale


def search(session: Session, given: Fitted, lengths: Sequence[float] = ()) -> list[Fitted]:
    """Fits of arrangements that are not gross, if the given one is wrong, the simplest first.

    [] with fewer than 12 rows, if the given fit is right, or if nothing fits. Units, column
    orders, zero positions by quarter turns, a coupling of joint 3 to joint 2, and rows shifted
    by one are tried, with any signs. If the given fit is off by over 5 mm, the error must fall
    to a fifth (`CONVINCING`); if only offsets are whole quarter turns, any fit that is not
    gross counts. Several can fit equally well: a mirrored symmetric arm is itself with some
    joints reversed. ``session``: with free markers, since fixed ones at wrong positions would
    bend the fit; ``given``: fit of the table as it is; ``lengths``: factors on the points to
    try if their unit is wrong, such as 0.001.
    """
    if len(session.measurements) < FEWEST_ROWS:
        return []
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    if given.worst_error_m <= UNCALIBRATED_ERROR_M:
        turns = np.round(given.joint_offsets / _QUARTER).astype(int)
        if not np.any(turns % 4):
            return []
        # The fit itself found the zero positions. Where they are outside the limits it is another
        # mistake: a shoulder that counts the other way is one with its neighbours turned round.
        found_zeros = replace(given.arrangement, quarters=tuple(turns.tolist()))
        candidates: Iterable[Arrangement] = chain_of(
            [found_zeros], _nearest(chain, session, lengths)
        )
    else:
        candidates = _nearest(chain, session, lengths)
    found, seen = [], {given.arrangement}
    for candidate in candidates:
        arrangement = within_limits(candidate, chain, session.measurements.q)
        if arrangement is None or arrangement in seen:
            continue
        seen.add(arrangement)
        try:
            fit = fit_arrangement(session, arrangement)
        except (InsufficientDataError, np.linalg.LinAlgError):
            continue
        convincing = fit.worst_error_m * CONVINCING < given.worst_error_m
        if not fit.gross and (given.worst_error_m <= UNCALIBRATED_ERROR_M or convincing):
            found.append(fit)
    return closest(found)


def closest(found: Sequence[Fitted]) -> list[Fitted]:
    """Fits with errors below twice the smallest (`ALIKE`), by number of changes, then error.

    The error is `Fitted.worst_error_m`; [] for no fits.
    """
    best = min((fit.worst_error_m for fit in found), default=0.0)
    alike = [fit for fit in found if fit.worst_error_m < ALIKE * best]
    return sorted(alike, key=lambda fit: (fit.arrangement.changes, fit.worst_error_m))


def within_limits(
    arrangement: Arrangement, chain: SerialChain, columns: FloatArray
) -> Arrangement | None:
    """Arrangement with whole turns added to quarter turns, so that joints are within their limits.

    A whole turn is added to or taken off a joint with quarter turns, in all rows. A joint for
    which that does not suffice, but up to two turns chosen row by row do
    (`SerialChain.within_turns`), is left unchanged; None if neither suffices for some joint.
    ``columns``: the table's joints, (n, k); 1 degree beyond a limit is allowed.
    """
    q = arrangement.joints(columns)
    low, high = q.min(axis=0) + LIMIT_TOLERANCE_RAD, q.max(axis=0) - LIMIT_TOLERANCE_RAD
    quarters = list(arrangement.quarters)
    for joint, turn in enumerate(quarters):
        whole_turns = [
            turns
            for turns in ((0, -4, 4) if turn else (0,))
            if low[joint] + turns * _QUARTER >= chain.lower[joint]
            and high[joint] + turns * _QUARTER <= chain.upper[joint]
        ]
        if whole_turns:
            quarters[joint] += whole_turns[0]
        # Angles from 0 to 360 degrees take a turn off some rows alone.
        elif not keeps_limits(chain, chain.within_turns(q)[:, joint], joint):
            return None
    return replace(arrangement, quarters=tuple(quarters))


def keeps_limits(chain: SerialChain, q: FloatArray, joint: int) -> bool:
    """Whether all positions of joint ``joint`` (index from 0) are within its limits.

    ``q``: rad or m, (n,); up to `LIMIT_TOLERANCE_RAD` (1 degree; for a slide that number in m)
    beyond a limit is allowed.
    """
    low, high = chain.lower[joint] - LIMIT_TOLERANCE_RAD, chain.upper[joint] + LIMIT_TOLERANCE_RAD
    return bool(np.all((q >= low) & (q <= high)))


def _nearest(
    chain: SerialChain, session: Session, lengths: Sequence[float]
) -> Iterator[Arrangement]:
    """Yield up to six arrangements of each kind (`_stages`), best in the linear problem first.

    Those with errors above 15 % of the points' extent (`_LARGEST_LINEAR`) are left out; of
    equal errors (three digits) the simplest comes first. The length scale of each is that of 1
    and ``lengths`` which is nearest to the scale of the linear problem. If this has mirrored
    points, the same arrangement with ``mirrored`` follows.
    """
    everywhere = np.ones(len(session.measurements), bool)
    for shift, candidates in _stages(len(chain)):
        m = session.measurements
        moved = replace(session, measurements=shifted(m, shift, everywhere) if shift else m)
        errors, scales = linear_errors(chain, some_rows(moved), candidates)
        # Of an arm with symmetries several are the same to the last digits: the simplest first.
        changes = [candidate.changes for candidate in candidates]
        for i in np.lexsort((changes, [float(f'{error:.3g}') for error in errors]))[:_FITTED]:
            if errors[i] > _LARGEST_LINEAR:
                break
            scale = min((1.0, *lengths), key=lambda length: abs(np.log(length / abs(scales[i]))))
            plain = replace(candidates[i], length_scale=scale, shift=shift)
            yield plain
            if scales[i] < 0.0:
                yield replace(plain, mirrored=True)


def _stages(joints: int) -> Iterator[tuple[int, list[Arrangement]]]:
    """Yield (row shift, arrangements with all 2^k signs) of each kind, for k joints.

    Kinds in order: angle units, column orders, quarter turns, joint 3 coupled to joint 2, and rows
    shifted by -1 and by 1.
    """
    plain = Arrangement.given(joints)
    signs = list(product((1, -1), repeat=joints))
    yield 0, [replace(plain, signs=pattern, angle_scale=by) for by in _SCALES for pattern in signs]
    yield (
        0,
        [replace(plain, order=way, signs=pattern) for way in _orders(joints) for pattern in signs],
    )
    yield (
        0,
        [replace(plain, signs=pattern, quarters=by) for by in _turns(joints) for pattern in signs],
    )
    if joints > 2:
        yield (
            0,
            [
                replace(plain, signs=pattern, coupled=share)
                for share in (1, -1)
                for pattern in signs
            ],
        )
    for shift in (-1, 1):
        yield shift, [replace(plain, signs=pattern) for pattern in signs]


def _orders(joints: int) -> Iterable[tuple[int, ...]]:
    """Likely column orders, sorted: reversed, shifted by one cyclically, any two exchanged.

    Each is a permutation of 0 to joints - 1; shifts are in both directions, and the order as
    it is is not among them.
    """
    plain = list(range(joints))
    orders = {tuple(plain[::-1]), (*plain[1:], 0), (joints - 1, *plain[:-1])}
    for a, b in combinations(plain, 2):
        order = plain.copy()
        order[a], order[b] = b, a
        orders.add(tuple(order))
    return sorted(orders)


def _turns(joints: int) -> Iterable[tuple[int, ...]]:
    """Quarter turns of each joint, k numbers, sorted: -1 to 2 of up to two inner joints.

    Those of the outer two joints are 0: the registration and the marker absorb them.
    """
    turns = set()
    for pair in combinations(range(1, joints - 1), min(2, max(joints - 2, 0))):
        for values in product((-1, 0, 1, 2), repeat=len(pair)):
            turn = [0] * joints
            for joint, value in zip(pair, values):
                turn[joint] = value
            turns.add(tuple(turn))
    return sorted(turns)
