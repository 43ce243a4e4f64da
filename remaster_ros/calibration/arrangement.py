"""Are a table's joints those of the robot? Signs, order, zero positions and units, tried on data.

Tables of others have a joint that counts the other way round, columns in another order, a zero
position 90 degrees off, other units. Every such arrangement is tried in closed form: with any 3×3
matrix G in the place of the sensor's rotation and scale (as in `initial_guess`),

    T_R_T(q) · marker = G p + t

is linear in marker, G and t. What comes nearest is fitted as any session is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.initial_guess import MEDIAN_CHI3, closest_start, robust_spread
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, Session

# Fewer rows fit to one of so many arrangements by chance: each point has 3 coordinates, the linear
# problem 15 unknowns.
FEWEST_ROWS = 12
# Rows that are tried at most, evenly spread.
MOST_ROWS = 200
# A fit is gross from this distance on: an uncalibrated robot's own offsets leave less.
GROSS_M = 5e-3
# And from such a zero-offset on: a robot that is mastered at all has less.
GROSS_OFFSET_RAD = np.deg2rad(5.0)
# An arrangement is proposed if it fits so many times as well.
CONVINCING = 5.0
# So many of the best linear ones are fitted, those whose error is no larger share of the points'
# extent: zero-offsets of some degrees leave less.
_FITTED = 6
_LARGEST_LINEAR = 0.15
# Frames of so many rows at a time, to bound the memory.
_BATCH_FRAMES = 20_000
_QUARTER = np.pi / 2.0
# Of angles that are degrees taken for radians, and the other way round.
_SCALES = (1.0, np.pi / 180.0, 180.0 / np.pi)


@dataclass(frozen=True)
class Arrangement:
    """How the robot's joints come from the k columns of a table.

    Attributes
    ----------
    order
        Column of each joint, base to tip.
    signs
        1 or -1 for each joint.
    quarters
        What is added to each joint, in quarters of a turn.
    angle_scale
        What the angles are multiplied by.
    coupled
        What joint 3 takes of joint 2: 1 or -1 on arms that count it from the horizontal (FANUC,
        and arms with a parallelogram), else 0.
    mirrored
        True where X and Y of the points are exchanged.
    length_scale
        What the points are multiplied by.
    shift
        A row's point belongs to the joints so many rows before.
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    quarters: tuple[int, ...]
    angle_scale: float = 1.0
    coupled: int = 0
    mirrored: bool = False
    length_scale: float = 1.0
    shift: int = 0

    @classmethod
    def given(cls, joints: int) -> Arrangement:
        """Return the arrangement of a table that is right as it is."""
        return cls(tuple(range(joints)), (1,) * joints, (0,) * joints)

    @property
    def changes(self) -> int:
        """How many things are other than given."""
        moved = sum(column != joint for joint, column in enumerate(self.order))
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
        )

    def joints(self, columns: FloatArray) -> FloatArray:
        """Return the robot's joint angles, rad, (n, k), of the columns (n, k)."""
        turned = columns[:, list(self.order)] * self.angle_scale
        if self.coupled:
            turned[:, 2] += self.coupled * turned[:, 1]
        return turned * np.array(self.signs) + _QUARTER * np.array(self.quarters)

    def points(self, points: FloatArray) -> FloatArray:
        """Return the points, m, (n, 3), of the table's."""
        return (points[:, [1, 0, 2]] if self.mirrored else points) * self.length_scale


@dataclass(frozen=True, eq=False)
class Fitted:
    """A robust fit of one arrangement.

    Attributes
    ----------
    arrangement
        The arrangement.
    error_m
        Median distance of the points from the fit, m.
    joint_offsets
        rad, (k,); the outer two are 0.
    marker_shift_m
        Largest distance of a marker from where it was said to be, m.
    """

    arrangement: Arrangement
    error_m: float
    joint_offsets: FloatArray
    marker_shift_m: float

    @property
    def gross(self) -> bool:
        """Whether the table is hardly that of this robot."""
        turned = np.abs(self.joint_offsets) > GROSS_OFFSET_RAD
        return bool(self.error_m > GROSS_M or turned.any())


def arranged(session: Session, arrangement: Arrangement) -> Session:
    """Return a session with its joints and points rearranged."""
    m = session.measurements
    q = arrangement.joints(m.q)
    points = arrangement.points(m.position)
    keep = slice(max(0, arrangement.shift), len(m) + min(0, arrangement.shift))
    came = slice(max(0, -arrangement.shift), len(m) + min(0, -arrangement.shift))
    rows = np.arange(len(m))[keep]
    return replace(
        session,
        measurements=replace(m.select(rows), q=q[came], position=points[keep]),
    )


def some_rows(session: Session) -> Session:
    """Return the optimization rows of a session, or evenly spread ones where there are many."""
    rows = np.flatnonzero(~session.measurements.is_validation)
    if len(rows) > MOST_ROWS:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_ROWS).astype(np.int64)]
    return session.select(rows)


def fit_arrangement(session: Session, arrangement: Arrangement) -> Fitted:
    """Fit one arrangement robustly, however badly it fits.

    Raises
    ------
    InsufficientDataError
        Too few rows or poses to register a sensor.
    """
    problem = Problem.of(arranged(session, arrangement))
    model = problem.empty_model()
    start, z = closest_start(
        model,
        problem.measurements,
        problem.fitted,
        problem.markers,
        float(np.max(problem.marker_std_m)),
        problem.marker_priors(model),
    )
    rows = Rows.of(problem.measurements, problem.fitted, start.reference)
    spread = robust_spread(rows.target - start.predict(z, rows), rows)
    shift = np.linalg.norm(start.markers(z) - problem.markers, axis=1)
    return Fitted(
        arrangement,
        MEDIAN_CHI3 * float(spread.max()),
        start.offsets(z),
        float(shift.max()),
    )


def linear_errors(
    chain: SerialChain, session: Session, arrangements: Sequence[Arrangement]
) -> tuple[FloatArray, FloatArray]:
    """Return how near each arrangement comes to the points in the linear problem.

    Only the sensor and marker with most rows are looked at.

    Returns
    -------
    errors
        Median distance over the extent of the points, (arrangements,).
    scales
        Signed: metres of the robot for one of the points, negative where G mirrors them.
    """
    m = session.measurements
    _, which, count = np.unique(
        np.stack((m.sensor, m.marker)), axis=1, return_inverse=True, return_counts=True
    )
    rows = np.flatnonzero(which.ravel() == np.argmax(count))
    q, points = m.q[rows], m.position[rows]
    n = len(rows)
    centred = points - points.mean(axis=0)
    extent = np.median(np.linalg.norm(centred, axis=1))
    # What G and t can do is projected out; it is the same for all arrangements.
    base = np.linalg.svd(np.column_stack((centred, np.ones(n))), full_matrices=False)[0]
    errors, scales = np.empty(len(arrangements)), np.empty(len(arrangements))
    step = max(1, _BATCH_FRAMES // n)
    for first in range(0, len(arrangements), step):
        part = arrangements[first : first + step]
        tools = chain.forward(np.array([np.roll(a.joints(q), a.shift, axis=0) for a in part]))
        flat = tools[..., :3, :].reshape(len(part), n, 12)
        left = (flat - base @ (base.T @ flat)).reshape(len(part), n, 3, 4)
        design = left[..., :3].reshape(len(part), 3 * n, 3)
        target = -left[..., 3].reshape(len(part), 3 * n, 1)
        by_marker = np.swapaxes(design, 1, 2)
        normal = by_marker @ design
        # Where the tool hardly turns, the marker is not determined, and stays near the tool.
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-15
        marker = np.linalg.solve(normal + ridge * np.eye(3), by_marker @ target)
        residual = (design @ marker - target).reshape(len(part), n, 3)
        modelled = (tools[..., :3, :3] @ marker[:, None])[..., 0] + tools[..., :3, 3]
        modelled -= modelled.mean(axis=1, keepdims=True)
        G = np.linalg.lstsq(centred, np.concatenate(list(modelled), axis=1), rcond=None)[0]
        det = np.linalg.det(G.T.reshape(len(part), 3, 3))
        scale = np.sign(det) * np.cbrt(np.abs(det))
        scales[first : first + step] = scale
        # Not in metres: wrong joints that hardly move would win by a G near zero.
        size = np.median(np.linalg.norm(residual, axis=2), axis=1)
        errors[first : first + step] = size / np.maximum(np.abs(scale) * extent, 1e-12)
    return errors, scales


def search(session: Session, given: Fitted, lengths: Sequence[float] = ()) -> list[Fitted]:
    """Find the arrangements that fit where the given one is gross, the simplest first.

    Several of them can fit equally well: an arm with a plane of symmetry, mirrored, is the same
    arm with some joints reversed.

    Simpler changes come first: units and signs, then the order, then zero positions by quarters of
    a turn, then joint 3 coupled to joint 2, then rows shifted by one; all of them with any signs.

    Parameters
    ----------
    session
        From `some_rows`.
    given
        The fit of the table as it is.
    lengths
        Length scales that are likely: metres of other units over those of the given one.
    """
    if len(session.measurements) < FEWEST_ROWS:
        return []
    if given.error_m <= GROSS_M:
        # The fit itself found the zero positions.
        turns = np.round(given.joint_offsets / _QUARTER).astype(int).tolist()
        fit = fit_arrangement(session, replace(given.arrangement, quarters=tuple(turns)))
        return [] if fit.gross else [fit]
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    for candidates in _stages(len(chain)):
        errors, scales = linear_errors(chain, session, candidates)
        found = []
        for i in np.argsort(errors, kind='stable')[:_FITTED]:
            if errors[i] > _LARGEST_LINEAR:
                break
            scale = min((1.0, *lengths), key=lambda length: abs(np.log(length / abs(scales[i]))))
            arrangement = replace(
                candidates[i], mirrored=bool(scales[i] < 0.0), length_scale=scale
            )
            for tried in {arrangement, replace(arrangement, mirrored=False)}:
                try:
                    fit = fit_arrangement(session, tried)
                except (InsufficientDataError, np.linalg.LinAlgError):
                    continue
                if not fit.gross and fit.error_m * CONVINCING < given.error_m:
                    found.append(fit)
        if found:
            closest = min(fit.error_m for fit in found)
            alike = [fit for fit in found if fit.error_m < 2.0 * closest]
            return sorted(alike, key=lambda fit: (fit.arrangement.changes, fit.error_m))
    return []


def _stages(joints: int) -> Iterator[list[Arrangement]]:
    plain = Arrangement.given(joints)
    signs = list(product((1, -1), repeat=joints))
    yield [replace(plain, signs=some, angle_scale=scale) for scale in _SCALES for some in signs]
    yield [replace(plain, order=order, signs=some) for order in _orders(joints) for some in signs]
    yield [
        replace(plain, signs=some, quarters=turns) for turns in _turns(joints) for some in signs
    ]
    if joints > 2:
        yield [replace(plain, signs=some, coupled=share) for share in (1, -1) for some in signs]
    yield [replace(plain, signs=some, shift=shift) for shift in (-1, 1) for some in signs]


def _orders(joints: int) -> Iterable[tuple[int, ...]]:
    """Give the likely orders: tip to base, any two exchanged, all moved along by one."""
    plain = list(range(joints))
    orders = {tuple(plain[::-1]), (*plain[1:], 0), (joints - 1, *plain[:-1])}
    for a, b in combinations(plain, 2):
        order = plain.copy()
        order[a], order[b] = b, a
        orders.add(tuple(order))
    return sorted(orders)


def _turns(joints: int) -> Iterable[tuple[int, ...]]:
    """Give zero positions of up to two inner joints that are off by quarters of a turn.

    Those of the outer two are taken up by the registration and by the marker.
    """
    turns = set()
    for pair in combinations(range(1, joints - 1), min(2, max(joints - 2, 0))):
        for values in product((-1, 0, 1, 2), repeat=len(pair)):
            turn = [0] * joints
            for joint, value in zip(pair, values):
                turn[joint] = value
            turns.add(tuple(turn))
    return sorted(turns)
