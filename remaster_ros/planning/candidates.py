# SPDX-License-Identifier: Apache-2.0
"""Which poses to measure: spread over the workspace, facing the sensor, reachable and visible.

Candidates follow Van Wyk et al., section III-A, equations (2) to (5): a Latin hypercube over
azimuth, radius, height and roll, the tool's Z axis at the sensor; for an arm with fewer than six
joints, poses near these that it takes. Each is then reached in all its joint solutions, less those
that the arm, its limits or the line of sight forbid; every one that is dropped is counted with the
reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS, InverseKinematics
from remaster_ros.kinematics.serial_chain import LEVER_M, SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform
from remaster_ros.types import BoolArray, FloatArray, IntArray

OUT_OF_REACH = 'out of reach'
JOINT_LIMITS = 'outside the joint limits'
NO_LINE_OF_SIGHT = 'no line of sight to '  # the sensor's name follows

LIMIT_MARGIN_RAD = np.deg2rad(1.0)
"""Distance kept from the joint limits by default, rad."""

# Joint positions drawn at a time for an arm of few joints, and how many times at most: one in
# thirty to one in several hundred turns the tool within 25 degrees to a sensor, in the ranges.
# With so many as there are poses the last pose would have to take what is left, wherever it is.
PLACES = 10_000
PLACES_TIMES = 20
ENOUGH = 3

_FULL_TURN = (0.0, 2 * np.pi)


@dataclass(frozen=True)
class PoseRanges:
    """The box the candidates are drawn from; the defaults are the paper's."""

    # Cylinder coordinates of the tool about the Z axis of R, (lower, upper)
    azimuth_rad: tuple[float, float] = _FULL_TURN
    radius_m: tuple[float, float] = (0.2, 0.5)
    height_m: tuple[float, float] = (0.4, 0.8)
    roll_rad: tuple[float, float] = _FULL_TURN  # Turn about the tool's Z axis, (lower, upper)

    def __post_init__(self) -> None:
        for spec in fields(self):
            lower, upper = getattr(self, spec.name)
            if not -np.inf < lower <= upper < np.inf:
                raise InputError(
                    f'planning: {spec.name} is {lower} to {upper}; write the lower value first'
                )
        if self.radius_m[0] < 0.0:
            raise InputError(f'planning: radius_m starts at {self.radius_m[0]}; it must be >= 0')

    def contain(self, places: FloatArray) -> BoolArray:
        """Return whether places (n, 3), m in R, lie in them, (n,)."""
        x, y, height = places.T
        # How far beyond the lower azimuth, less whole turns.
        beyond = (np.arctan2(y, x) - self.azimuth_rad[0]) % (2 * np.pi)
        inside = beyond <= self.azimuth_rad[1] - self.azimuth_rad[0]
        for values, (low, high) in ((np.hypot(x, y), self.radius_m), (height, self.height_m)):
            inside &= (values >= low) & (values <= high)
        return np.asarray(inside)


@dataclass(frozen=True)
class LineOfSight:
    """A sensor that has to see a marker at every configuration."""

    sensor: str  # Its name, for the counts
    sensor_R: FloatArray  # Its origin in R, m, (3,)
    marker_T: FloatArray  # The marker it follows, in the tool frame, m, (3,)
    # Largest angle between the tool's Z axis and the line to the sensor at which the marker is
    # still seen; a quarter turn keeps the sensor in front of the tool plate
    max_angle_rad: float = np.pi / 2
    marker: str = ''  # The marker's name


@dataclass(frozen=True)
class PlannedPose:
    """A tool pose T_R_T, (4, 4), and its usable joint solutions, rad, (m, k), m >= 1.

    `correction`: whether the bridge's correction has to be on or off at it; '' where that is not
    asked.
    """

    T_R_T: FloatArray
    solutions: FloatArray
    correction: Literal['', 'on', 'off'] = ''


@dataclass(frozen=True)
class Plan:
    """The poses to visit, and why the other candidates were dropped."""

    poses: tuple[PlannedPose, ...]  # In the order of the candidates
    # Reason -> number of poses that lost all their solutions, most of them for this reason
    dropped: Mapping[str, int] = field(default_factory=dict)
    # Reason -> number of joint solutions dropped, of kept poses too; the first reason counts
    dropped_solutions: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class PlanningScene:
    """All that poses are planned from: an arm, what it can hit, and the sensors before it."""

    # Of the arm; its held values decide how many solutions a pose has
    inverse_kinematics: InverseKinematics
    model: CollisionModel  # The arm with everything that it can hit
    ranges: PoseRanges  # What the candidates are drawn from
    sights: Sequence[LineOfSight]  # Every sensor, at its rough place
    aim_at: str  # The sensor that the tool faces
    limit_margin_rad: float = LIMIT_MARGIN_RAD  # Distance to keep from the joint limits, rad

    @property
    def rough_R(self) -> dict[str, FloatArray]:
        """Rough origin of each sensor in R, m, (3,)."""
        return {sight.sensor: sight.sensor_R for sight in self.sights}

    def plan(
        self, count: int, sensors_R: Mapping[str, FloatArray], rng: np.random.Generator
    ) -> Plan:
        """Plan poses that face one sensor and that all of these sensors see.

        Parameters
        ----------
        count
            How many candidates are drawn.
        sensors_R
            Origin in R of each sensor that has to see its marker, m, (3,).
        rng
            Source of randomness.
        """
        # A sensor that is not required may have no registration.
        aim = {**self.rough_R, **sensors_R}[self.aim_at]
        sights = [
            replace(sight, sensor_R=sensors_R[sight.sensor])
            for sight in self.sights
            if sight.sensor in sensors_R
        ]
        candidates = candidate_poses(count, self.ranges, aim, rng)
        if len(self.inverse_kinematics.chain) < FREE_JOINTS:
            (angle,) = (s.max_angle_rad for s in self.sights if s.sensor == self.aim_at)
            chain = self.inverse_kinematics.chain
            candidates = taken_poses(chain, candidates, self.ranges, aim, angle, rng)
        return plan_poses(
            self.inverse_kinematics, self.model, candidates, sights, self.limit_margin_rad
        )


def candidate_poses(
    n: int, ranges: PoseRanges, sensor_R: ArrayLike, rng: np.random.Generator
) -> FloatArray:
    """Draw tool poses that face a sensor: equations (2) to (5) of Van Wyk et al.

    Parameters
    ----------
    n
        How many.
    ranges
        Where from.
    sensor_R
        The sensor's origin in R, m, (3,).
    rng
        Source of randomness.

    Returns
    -------
    ndarray
        T_R_T, (n, 4, 4).

    Raises
    ------
    InputError
        ``n`` below 1, or a sensor position that is not finite or is itself a candidate's.
    """
    sensor_R = np.asarray(sensor_R, dtype=float)
    if n < 1:
        raise InputError(f'planning: {n} candidate poses; at least 1 is needed')
    if sensor_R.shape != (3,) or not np.all(np.isfinite(sensor_R)):
        raise InputError(f'planning: the sensor position {sensor_R} is not three finite numbers')
    lower, upper = np.transpose([getattr(ranges, spec.name) for spec in fields(ranges)])
    # `seed` takes a Generator in every SciPy since 1.7; its new name `rng` only since 1.15.
    unit = scipy.stats.qmc.LatinHypercube(d=len(lower), seed=rng).random(n)
    azimuth, radius, height, roll = (lower + unit * (upper - lower)).T
    positions = np.column_stack((radius * np.cos(azimuth), radius * np.sin(azimuth), height))

    to_sensor = sensor_R - positions
    distance = np.linalg.norm(to_sensor, axis=1, keepdims=True)
    if np.any(distance < 1e-3):
        raise InputError(f'planning: the sensor at {sensor_R} m stands among the poses')
    z = to_sensor / distance  # (2)
    x = np.cross(z, (0.0, 0.0, 1.0))  # (3)
    # Below an overhead sensor Z of R is parallel to z; the paper then takes another vector.
    overhead = np.linalg.norm(x, axis=1) < 1e-6
    x[overhead] = np.cross(z[overhead], (0.0, 1.0, 0.0))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)  # (4)
    about_z = rotation_vector_to_matrix(roll[:, None] * np.array([0.0, 0.0, 1.0]))
    return transform(np.stack((x, y, z), axis=-1) @ about_z, positions)  # (5)


def taken_poses(
    chain: SerialChain,
    poses: FloatArray,
    ranges: PoseRanges,
    sensor_R: FloatArray,
    max_angle_rad: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return for each drawn pose one near it that an arm with fewer than six joints takes.

    Such an arm takes few of all poses: one of five axes brings its tool to a place, but the
    tool's axis there only into directions of a plane. So joint positions are drawn all over their
    limits, and each pose gets the nearest tool pose of them that lies in the ranges, faces the
    sensor and is no other one's. A turn by a radian counts as a way of `LEVER_M`.

    ``poses``: T_R_T, (n, 4, 4); ``sensor_R``: m, (3,); ``max_angle_rad``: between the tool's Z
    axis and the line to the sensor.
    Returns T_R_T, (n, 4, 4). Where so few were found that none is left, a pose stays as it is
    drawn, out of the arm's reach.
    """
    low, high = chain.usual_range
    there = np.empty((0, 4, 4))
    for _ in range(PLACES_TIMES):
        places = chain.forward(rng.uniform(low, high, (PLACES, len(chain))))
        to_sensor = sensor_R - places[:, :3, 3]
        facing = np.sum(places[:, :3, 2] * to_sensor, axis=1)
        seen = facing >= np.cos(max_angle_rad) * np.linalg.norm(to_sensor, axis=1)
        there = np.concatenate((there, places[seen & ranges.contain(places[:, :3, 3])]))
        if len(there) >= ENOUGH * len(poses):
            break
    # The Frobenius norm of a difference of small turns is sqrt(2) of the angle.
    weights = np.array([LEVER_M / np.sqrt(2.0)] * 3 + [1.0])
    left, found = (weights * there[:, :3]).reshape(-1, 12), poses.copy()
    for i in range(min(len(poses), len(there))):
        off = np.sum((left - (weights * poses[i, :3]).ravel()) ** 2, axis=1)
        nearest = int(np.argmin(off))
        found[i], left[nearest] = there[nearest], np.inf
    return found


def plan_poses(
    inverse_kinematics: InverseKinematics,
    arm: CollisionModel,
    candidates: FloatArray,
    lines_of_sight: Sequence[LineOfSight] = (),
    limit_margin_rad: float = 0.0,
) -> Plan:
    """Keep the candidates' joint solutions that the arm can take and every sensor can see.

    ``inverse_kinematics``: of the arm; its held values decide how many solutions there are;
    ``arm``: the same arm with everything it can hit; ``candidates``: T_R_T, (n, 4, 4);
    ``lines_of_sight``: what has to be visible; ``limit_margin_rad``: distance to keep from the
    joint limits, rad; of one that slides `SerialChain.per_radian` times as much, m.
    Returns with `dropped` and `len(poses)` adding up to n.
    """
    chain = inverse_kinematics.chain
    reachable = inverse_kinematics.solutions_of_each(candidates)
    within = [inverse_kinematics.usable(q) for q in reachable]
    margin = limit_margin_rad * chain.per_radian
    within = [q[chain.within_limits(q, -margin)] for q in within]
    owner = np.repeat(np.arange(len(within)), [len(q) for q in within])
    q = np.concatenate([np.empty((0, len(chain))), *within])
    reasons = _reasons(arm, q, lines_of_sight)

    poses: list[PlannedPose] = []
    dropped: Counter[str] = Counter()
    dropped_solutions: Counter[str] = Counter()
    for i, T in enumerate(candidates):
        mine = owner == i
        usable = mine & (reasons == '')
        # Of equal counts the first entered wins: the reason that came nearest to success.
        lost = Counter(reasons[mine & ~usable].tolist())
        if len(within[i]) < len(reachable[i]):
            lost[JOINT_LIMITS] = len(reachable[i]) - len(within[i])
        dropped_solutions.update(lost)
        if usable.any():
            poses.append(PlannedPose(T, q[usable]))
        else:
            dropped[lost.most_common(1)[0][0] if lost else OUT_OF_REACH] += 1
    return Plan(tuple(poses), dict(dropped), dict(dropped_solutions))


def _reasons(
    arm: CollisionModel, q: FloatArray, lines_of_sight: Sequence[LineOfSight]
) -> np.ndarray[tuple[int], np.dtype[np.str_]]:
    """Return why each solution (m, k) is no good, or '', (m,); the first reason wins."""
    # More than the bridge requires: an arm that stands a little off a planned way may still move.
    collisions = arm.reasons(q, RESERVE_M)
    bad = [collisions != '', *(_unseen(arm, q, sight) for sight in lines_of_sight)]
    names = [NO_LINE_OF_SIGHT + sight.sensor for sight in lines_of_sight]
    return np.select(bad, [collisions, *names], default='')


def _unseen(arm: CollisionModel, q: FloatArray, sight: LineOfSight) -> BoolArray:
    """Return where the marker faces away from the sensor, or the arm is in between, (m,)."""
    T = arm.chain.forward(q)
    to_sensor = sight.sensor_R - arm.chain.positions(q, sight.marker_T)
    facing = np.sum(T[:, :3, 2] * to_sensor, axis=-1) / np.linalg.norm(to_sensor, axis=-1)
    turned_away = facing < np.cos(sight.max_angle_rad)
    return turned_away | arm.hides(q, sight.marker_T, sight.sensor_R)


def order_solutions(
    solutions: ArrayLike, q_current: ArrayLike, velocity_limits: ArrayLike = 1.0
) -> IntArray:
    """Order joint solutions by how soon the arm can be there from where it is, nearest first.

    All distances are from ``q_current``, not from one solution to the next: the slowest joint's
    travel, divided by its velocity limit.

    ``solutions``: rad, (m, k); ``q_current``: rad, (k,); ``velocity_limits``: rad/s, (k,); where a
    limit is unknown (infinite) it counts as 1 rad/s, or 1 m/s.
    Returns indices into solutions, (m,).
    """
    limits = np.asarray(velocity_limits, dtype=float)
    speeds = np.where(np.isfinite(limits), limits, 1.0)
    travel = np.abs(np.asarray(solutions, dtype=float) - q_current) / speeds
    return np.argsort(np.max(travel, axis=-1), kind='stable')
