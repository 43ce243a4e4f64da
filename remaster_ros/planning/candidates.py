# SPDX-License-Identifier: Apache-2.0
"""Candidate poses: spread over the workspace, facing the sensor, reachable and visible.

Candidates follow Van Wyk et al., section III-A, equations (2) to (5): a Latin hypercube over
azimuth, radius, height and roll, with the tool's Z axis towards the sensor; for an arm with fewer
than six joints, reachable poses near these. Each pose has all its joint solutions except those
outside limits, in collision or out of sight; every dropped one is counted with the reason.
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
NO_LINE_OF_SIGHT = 'no line of sight to '  # Followed by the sensor's name

LIMIT_MARGIN_RAD = np.deg2rad(1.0)
"""Default distance to keep from the joint limits, rad."""

# Joint positions drawn at a time for an arm of few joints, and most such draws: one in thirty to
# one in several hundred has the tool in the ranges and within 25 degrees of a sensor. `ENOUGH`
# poses are found for each candidate, so that also the last candidate gets a pose near it.
PLACES = 10_000
PLACES_TIMES = 20
ENOUGH = 3

_FULL_TURN = (0.0, 2 * np.pi)


@dataclass(frozen=True)
class PoseRanges:
    """Ranges from which candidate poses are drawn; the defaults are the paper's."""

    # Cylinder coordinates of the tool about the Z axis of R, (lower, upper)
    azimuth_rad: tuple[float, float] = _FULL_TURN
    radius_m: tuple[float, float] = (0.2, 0.5)
    height_m: tuple[float, float] = (0.4, 0.8)
    roll_rad: tuple[float, float] = _FULL_TURN  # About the tool's Z axis, (lower, upper)

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
        """Whether points (n, 3), m in R, lie in the ranges of cylinder coordinates, (n,).

        These are azimuth, radius and height about the Z axis of the robot base frame R; bounds
        are inside, azimuths count modulo whole turns. The range of the roll is not used.
        """
        x, y, height = places.T
        # Angle from the lower azimuth, modulo whole turns.
        angle = (np.arctan2(y, x) - self.azimuth_rad[0]) % (2 * np.pi)
        inside = angle <= self.azimuth_rad[1] - self.azimuth_rad[0]
        for values, (low, high) in ((np.hypot(x, y), self.radius_m), (height, self.height_m)):
            inside &= (values >= low) & (values <= high)
        return np.asarray(inside)


@dataclass(frozen=True)
class LineOfSight:
    """A sensor that has to see a marker at every configuration; positions of both."""

    sensor: str  # Name of the sensor
    sensor_R: FloatArray  # Position of the sensor in R, m, (3,)
    marker_T: FloatArray  # Position of its marker in the tool frame, m, (3,)
    # Largest angle between the tool's Z axis and the line to the sensor at which the marker is
    # visible; at 90 degrees the sensor is in front of the tool plate
    max_angle_rad: float = np.pi / 2
    marker: str = ''  # The marker's name


@dataclass(frozen=True)
class CurvedWay:
    """A curve to a configuration (`motion.spline`), measured while the arm moves along it."""

    # Where it begins, and what it goes through before its end, rad or m, (n, k), n >= 2
    points: FloatArray
    shares: FloatArray  # Of the curve, at these points, (n,), ascending from 0; the end has 1


@dataclass(frozen=True)
class PlannedPose:
    """A tool pose and its usable joint solutions."""

    T_R_T: FloatArray  # (4, 4)
    solutions: FloatArray  # rad, (m, k), m >= 1
    # State that the bridge's correction must have at this pose; '' for either
    correction: Literal['', 'on', 'off'] = ''
    # By which the arm comes to the only solution; None if any free path will do
    way: CurvedWay | None = None


@dataclass(frozen=True)
class Plan:
    """The poses to visit, and counts of dropped candidates by reason."""

    poses: tuple[PlannedPose, ...]  # In the order of the candidates
    # Reason -> number of poses without usable solutions; each counts for its commonest reason
    dropped: Mapping[str, int] = field(default_factory=dict)
    # Reason -> number of dropped joint solutions, those of kept poses included
    dropped_solutions: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class PlanningScene:
    """An arm, its obstacles and its sensors: everything from which poses are planned."""

    inverse_kinematics: InverseKinematics  # With the values of held joints
    model: CollisionModel  # The arm with its obstacles
    ranges: PoseRanges  # Of the candidates
    sights: Sequence[LineOfSight]  # Every sensor, at its rough position
    aim_at: str  # Name of the sensor that the tool faces
    limit_margin_rad: float = LIMIT_MARGIN_RAD  # Distance to keep from the joint limits, rad

    @property
    def rough_R(self) -> dict[str, FloatArray]:
        """Rough position of each sensor in the robot base frame R, name -> m, (3,)."""
        return {sight.sensor: sight.sensor_R for sight in self.sights}

    def plan(
        self, count: int, sensors_R: Mapping[str, FloatArray], rng: np.random.Generator
    ) -> Plan:
        """Draw candidate poses that face one sensor; return the usable ones.

        ``count``: number of candidates; ``sensors_R``: position in R of each sensor that has
        to see its marker, m, (3,); ``rng``: source of randomness. The tool faces the scene's
        sensor `aim_at`: at its position in ``sensors_R``, or at its rough position if it is
        not there. An arm with fewer than six joints gets reachable poses near the candidates.
        Raises InputError as `candidate_poses`.
        """
        # A sensor that is not required may be unregistered.
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
            candidates = reachable_poses(chain, candidates, self.ranges, aim, angle, rng)
        return plan_poses(
            self.inverse_kinematics, self.model, candidates, sights, self.limit_margin_rad
        )


def candidate_poses(
    n: int, ranges: PoseRanges, sensor_R: ArrayLike, rng: np.random.Generator
) -> FloatArray:
    """Draw n tool poses that face a sensor, T_R_T (n, 4, 4): eq. (2) to (5) of Van Wyk et al.

    ``ranges``: where to draw from; ``sensor_R``: the sensor's position in R, m, (3,).
    Raises InputError if n is below 1, or the sensor position is not finite or among the poses.
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


def reachable_poses(
    chain: SerialChain,
    poses: FloatArray,
    ranges: PoseRanges,
    sensor_R: FloatArray,
    max_angle_rad: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return for each pose one near it that an arm with fewer than six joints can reach.

    Such an arm reaches few of all poses: with five axes it brings its tool to a position, but the
    tool's axis there only into directions of a plane. So joint positions are drawn within the
    limits, and each pose is replaced by the nearest unused tool pose of them that lies in the
    ranges and faces the sensor. A rotation by a radian counts as a distance of `LEVER_M`.

    ``poses``: T_R_T, (n, 4, 4); ``sensor_R``: m, (3,); ``max_angle_rad``: largest angle between
    the tool's Z axis and the line to the sensor.
    Returns T_R_T, (n, 4, 4). If fewer than n poses are found, the last ones are unchanged, and out
    of the arm's reach.
    """
    low, high = chain.usual_range
    reachable = np.empty((0, 4, 4))
    for _ in range(PLACES_TIMES):
        places = chain.forward(rng.uniform(low, high, (PLACES, len(chain))))
        to_sensor = sensor_R - places[:, :3, 3]
        facing = np.sum(places[:, :3, 2] * to_sensor, axis=1)
        seen = facing >= np.cos(max_angle_rad) * np.linalg.norm(to_sensor, axis=1)
        reachable = np.concatenate((reachable, places[seen & ranges.contain(places[:, :3, 3])]))
        if len(reachable) >= ENOUGH * len(poses):
            break
    # The Frobenius norm of the difference of two rotations is sqrt(2) times a small angle.
    weights = np.array([LEVER_M / np.sqrt(2.0)] * 3 + [1.0])
    unused, replaced = (weights * reachable[:, :3]).reshape(-1, 12), poses.copy()
    for i in range(min(len(poses), len(reachable))):
        off = np.sum((unused - (weights * poses[i, :3]).ravel()) ** 2, axis=1)
        nearest = int(np.argmin(off))
        replaced[i], unused[nearest] = reachable[nearest], np.inf
    return replaced


def plan_poses(
    inverse_kinematics: InverseKinematics,
    arm: CollisionModel,
    candidates: FloatArray,
    lines_of_sight: Sequence[LineOfSight] = (),
    limit_margin_rad: float = 0.0,
) -> Plan:
    """Return the candidates with their collision-free joint solutions in sight of all sensors.

    ``inverse_kinematics``: of the arm; its held values decide how many solutions there are;
    ``arm``: the same arm with its obstacles; ``candidates``: T_R_T, (n, 4, 4); ``lines_of_sight``:
    markers that have to be visible; ``limit_margin_rad``: distance to keep from the joint limits,
    rad; of a prismatic joint `SerialChain.per_radian` times as much, m. The numbers of poses and
    of dropped poses add up to n; poses are in the order of the candidates. No pose is no error.
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
        of_pose = owner == i
        usable = of_pose & (reasons == '')
        # Of equal counts the first entered wins, which is the latest check that failed.
        lost = Counter(reasons[of_pose & ~usable].tolist())
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
    """Return the first reason to drop each joint solution, '' if it is usable, (m,).

    Collisions (nearer than the clearance and `RESERVE_M`) come first, then a marker out of
    sight of each of `lines_of_sight` in order. ``q``: the solutions, rad or m, (m, k).
    """
    # More clearance than the bridge requires: an arm slightly off its path may still move.
    collisions = arm.reasons(q, RESERVE_M)
    bad = [collisions != '', *(is_hidden(arm, q, sight) for sight in lines_of_sight)]
    names = [NO_LINE_OF_SIGHT + sight.sensor for sight in lines_of_sight]
    return np.select(bad, [collisions, *names], default='')


def is_hidden(arm: CollisionModel, q: FloatArray, sight: LineOfSight) -> BoolArray:
    """Whether a marker is hidden from a sensor at configurations q, (m,).

    It is if the tool's Z axis is turned from the line to the sensor by more than
    `max_angle_rad` of ``sight``, or a link or obstacle is in the way (`CollisionModel.hides`).
    ``q``: rad or m, (m, k).
    """
    T = arm.chain.forward(q)
    to_sensor = sight.sensor_R - arm.chain.positions(q, sight.marker_T)
    facing = np.sum(T[:, :3, 2] * to_sensor, axis=-1) / np.linalg.norm(to_sensor, axis=-1)
    turned_away = facing < np.cos(sight.max_angle_rad)
    return turned_away | arm.hides(q, sight.marker_T, sight.sensor_R)


def order_solutions(
    solutions: ArrayLike, q_current: ArrayLike, velocity_limits: ArrayLike = 1.0
) -> IntArray:
    """Return indices of joint solutions by travel time from q_current, the shortest first, (m,).

    The travel time is that of the slowest joint: its travel over its velocity limit.

    ``solutions``: rad, (m, k); ``q_current``: rad, (k,); ``velocity_limits``: rad/s, (k,); an
    infinite (unknown) one counts as 1 rad/s, or 1 m/s.
    """
    limits = np.asarray(velocity_limits, dtype=float)
    speeds = np.where(np.isfinite(limits), limits, 1.0)
    travel = np.abs(np.asarray(solutions, dtype=float) - q_current) / speeds
    return np.argsort(np.max(travel, axis=-1), kind='stable')
