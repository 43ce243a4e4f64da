# SPDX-License-Identifier: Apache-2.0
"""A whole collection before anything moves: its visits, paths, times and expected precision."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.errors import InsufficientDataError, RemasterError
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.motion.trajectory import Trajectory
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.moving_design import MovingDesign
from remaster_ros.planning.planned_design import NO_FREE_PATH, DesignResult
from remaster_ros.planning.separating_design import SeparatingDesign
from remaster_ros.planning.tour_order import FITTED, PoseVisit, Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import FloatArray

REGISTERING = 3
"""Poses that register the sensors; further ones are visited only if a sensor misses one."""
FEW_MISSED, MOST_MISSED = 4, 12
"""Poses without a path after which a count ends, since each takes seconds of search."""


@dataclass(frozen=True, eq=False)
class PlannedVisit:
    """A configuration to be measured, and the motion to it."""

    split: str  # ``optimization``, ``validation``, ``reference`` or ``registration``
    pose: int  # Index of the pose in the plan of its split
    trajectory: Trajectory  # From the previous configuration to this one
    tool_speed_m_s: float  # Largest speed of the fastest point of arm and tool, m/s

    @property
    def points(self) -> FloatArray:
        """Corners of the path from the previous configuration, rad, (n + 1, k) for n lines."""
        return self.trajectory.points

    @property
    def q(self) -> FloatArray:
        """The configuration that is measured, at the end of the path, rad, (k,)."""
        return self.trajectory.end


class Expected(NamedTuple):
    """Expected precision of a fit; the fields are those of `CollectionPlan`."""

    joint_std: Mapping[str, float | None]
    joint_rms: float
    tool_rms: float


NOTHING_EXPECTED = Expected({}, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class CollectionPlan:
    """The visits of a collection, and the expected precision of its fit."""

    tour: Tour  # As planned
    # All visits in their order: registration, poses to fit and to validate, references each time
    visits: tuple[PlannedVisit, ...]
    unreached: int  # Configurations without a free path
    measuring_s: float  # Settling and dwell of each visit, s
    # Motion, settling and dwell of all visits, s; of the whole session if none of it is done
    robot_time_s: float
    max_tool_speed_m_s: float  # Of the fastest point of arm and tool, m/s
    # Expected standard deviation of each joint's offset, rad or m; None if not identifiable
    joint_std: Mapping[str, float | None]
    joint_rms: float  # Root mean square of them, rad; see `DesignInformation.joint_rms`
    tool_rms: float  # Root mean square 3-D error of the predicted markers, m
    design_result: DesignResult | None  # Optimal design; None without one
    # Why there are no standard deviations (none and NaN above), such as parameters that the
    # configurations do not determine; ''
    undetermined: str = ''
    # Configurations added to separate causes; None without causes
    separating_design: SeparatingDesign | None = None
    # Whether the reachable part of an optimal design reaches its goal and floors
    goal_reached: bool = False
    # Curves that are measured in motion; None for stop and go
    moving_design: MovingDesign | None = None

    @property
    def poses(self) -> dict[str, int]:
        """Split -> number of poses with at least one visit."""
        return dict(Counter(split for split, _ in {(v.split, v.pose) for v in self.visits}))

    @property
    def dropped(self) -> dict[str, int]:
        """Reason -> number of joint solutions that are not visited."""
        lost = {NO_FREE_PATH: self.unreached} if self.unreached else {}
        return dict(self.tour.dropped_solutions + Counter(lost))


def plan_collection(
    planner: TourPlanner,
    T_R_N: Mapping[str, FloatArray],
    start: FloatArray,
    progress: Callable[[float], None] = lambda share: None,
) -> CollectionPlan:
    """Plan a session from its registration to its end, in the same way as the planner's node.

    ``planner``: plans the tours; ``T_R_N``: registration of each sensor, (4, 4); ``start``:
    configuration of the arm, rad, (k,); ``progress``: called with the share that is done.
    Raises InsufficientDataError if no pose is left to fit, no configuration can be reached, or
    the reachable ones do not determine the offsets.
    """
    tour = planner.collection(T_R_N)
    tours = [tour]
    if planner.registers:
        tours.insert(0, planner.registration().first_poses(REGISTERING))
    plan = look_ahead(planner, T_R_N, tours, start, progress=progress)
    if plan.undetermined:
        raise InsufficientDataError(
            f'{len(tour.plans[FITTED].poses)} poses to fit can be visited, too few or too alike: '
            f'{plan.undetermined}; plan more candidates, or widen their ranges in the cell file'
        )
    return plan


def look_ahead(
    planner: TourPlanner,
    T_R_N: Mapping[str, FloatArray],
    tours: Sequence[Tour],
    start: FloatArray,
    visit: PoseVisit | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> CollectionPlan:
    """Plan the remaining visits of a session's tours, without changing the tours.

    ``planner``: plans the tours, and has the design that the plan states; ``tours``: one after
    the other, that of the collection last; ``visit``: remaining visit of the pose under way,
    which comes first; ``start``: configuration of the arm, rad or m, (k,); other arguments as
    of `plan_collection`. If the poses do not determine the offsets, the plan's `undetermined`
    says why.

    Raises InsufficientDataError if no configuration can be reached.
    """
    configurations = sum(sum(tour.configurations.values()) for tour in tours)
    steps = _Steps(start, planner.travel, lambda n: progress(min(n / configurations, 1.0)))
    for tour in tours:
        remaining = tour.fork()
        if visit is not None:
            steps.go(remaining.reroute(visit, steps.here))
            visit = None
        while (following := remaining.next(steps.here)) is not None:
            steps.go(following)
    if not steps.visits:
        standing = planner.model.trouble(start) or 'no free way leads from there'
        raise InsufficientDataError(
            f'no configuration can be reached from where the arm stands: {standing}'
        )
    fitted = tours[-1].plans[FITTED].poses
    unreached = {(index, number) for split, index, number in steps.unreached if split == FITTED}
    reachable = [
        PlannedPose(
            pose.T_R_T,
            np.array([q for i, q in enumerate(pose.solutions) if (at, i) not in unreached]),
        )
        for at, pose in enumerate(fitted)
    ]
    reachable = [pose for pose in reachable if len(pose.solutions)]
    purpose = (
        f'they are for /remaster/{tours[-1].inspection}'
        if tours[-1].inspection
        else 'none is left'
    )
    expected, undetermined = NOTHING_EXPECTED, '' if reachable else f'none is fitted, {purpose}'
    try:
        if reachable:
            expected = expected_precision(planner, T_R_N, reachable)
    except InsufficientDataError as error:
        undetermined = str(error)
    design_result = planner.design_result
    goal_reached = design_result is not None and design_result.reached
    if design_result is not None and goal_reached and unreached:
        number = np.repeat(np.arange(len(reachable)), [len(pose.solutions) for pose in reachable])
        goal_reached = design_result.floors.hold(number) and design_result.goal.is_met(
            expected.joint_rms, expected.tool_rms
        )
    visits = tuple(steps.visits)
    measuring_s = planner.travel.measuring_s
    return CollectionPlan(
        tours[-1],
        visits,
        len(steps.unreached),
        measuring_s,
        sum(visit.trajectory.duration_s + measuring_s for visit in visits),
        max((visit.tool_speed_m_s for visit in visits), default=0.0),
        *expected,
        design_result,
        undetermined,
        planner.separating_design,
        goal_reached,
        planner.moving_design,
    )


def session_time_s(planner: TourPlanner, tour: Tour, start: FloatArray) -> float:
    """Return the approximate robot time of a whole session, s, without a search for paths.

    Of registration, poses to fit and to validate, and references, with settling and dwell. Every
    path counts as straight: the search takes nearly all the time of `plan_collection`.

    ``planner``: plans the tours; ``tour``: of the collection, in any state; ``start``:
    configuration of the arm, rad, (k,).
    """
    tours = [tour]
    if planner.registers:
        tours.insert(0, planner.registration().first_poses(REGISTERING))
    position, total = start, 0.0
    for each in tours:
        straight = each.restarted_straight()
        while (visit := straight.next(position)) is not None:
            for q, through, shares in zip(visit.solutions, visit.paths, visit.shares, strict=True):
                if len(shares):
                    points = np.vstack((position, through[1:], q))
                    total += planner.travel.curve(points, shares)[0].duration_s
                else:
                    total += float(planner.travel.straight(position, q[None])[0])
                total += planner.travel.measuring_s
                position = q
    return total


def rough_collection(planner: TourPlanner) -> tuple[Tour, Expected]:
    """Return the tour of a collection, with sensors at their rough positions, and its precision.

    No paths are searched, which takes nearly all the time of `plan_collection`; so it is unknown
    which configurations can be reached (`count_with_free_path` counts the poses that can), and
    how long the robot takes. Raises InsufficientDataError if no pose is left to fit, or the poses
    do not determine the offsets.
    """
    tour = planner.collection(planner.rough_places)
    return tour, expected_precision(planner, planner.rough_places, tour.plans[FITTED].poses)


def count_with_free_path(
    tour: Tour, model: CollisionModel, start: FloatArray, enough: int
) -> tuple[int, int]:
    """Return the numbers of poses to fit with a free path from the start, and of those tried.

    At first one joint solution of each pose is tried, which takes a small part of the time of
    all paths. If that finds fewer than `enough`, the whole tour is searched as in a
    collection, up to `MOST_MISSED` poses without a path. The tour is not changed.

    ``tour``: of reachable poses; ``model``: obstacles; ``start``: rad, (k,); ``enough``:
    number of poses at which the count ends.
    """
    fitted = {FITTED: tour.plans[FITTED]}
    quick = Tour(tour.chain, fitted, one_solution=True, model=model)
    found = _reached(quick, start, enough, FEW_MISSED)
    return found if found[0] >= enough else _reached(tour.fork(), start, enough, MOST_MISSED)


def _reached(tour: Tour, q: FloatArray, enough: int, most_missed: int) -> tuple[int, int]:
    """Count poses to fit with a free path, and poses tried, along a tour from q, rad, (k,).

    Until `enough` are found, `most_missed` have no path, or the tour ends. The tour is changed.
    """
    count = tried = missed = 0
    while count < enough and missed < most_missed and (visit := tour.next(q)) is not None:
        tried += visit.split == FITTED
        if not len(visit.solutions):
            missed += 1
            continue
        q, count = visit.solutions[-1], count + (visit.split == FITTED)
    return count, tried


def expected_collection(
    planner: TourPlanner, T_R_N: Mapping[str, FloatArray]
) -> tuple[Tour, Expected | None]:
    """Return a collection tour with its expected precision (None if it cannot be computed).

    Raises InsufficientDataError if no pose is left to fit.
    """
    tour = planner.collection(T_R_N)
    try:
        expected = expected_precision(planner, T_R_N, tour.plans[FITTED].poses)
    except (RemasterError, np.linalg.LinAlgError):
        # The collection does not depend on the expected precision.
        return tour, None
    return tour, expected if np.isfinite(expected.tool_rms) else None


class _Steps:
    """The motions of an arm from visit to visit, as they are planned.

    ``here``: the arm's configuration, rad, (k,); ``travel``: travel times; ``progress``:
    called with the number of visited configurations so far.
    Attributes: ``visits``; ``unreached``: split, pose and solution of each one without a path.
    """

    def __init__(
        self, here: FloatArray, travel: TravelTime, progress: Callable[[int], None]
    ) -> None:
        self.here, self._travel, self._progress = here, travel, progress
        self.visits: list[PlannedVisit] = []
        self.unreached: list[tuple[str, int, int]] = []

    def go(self, visit: PoseVisit) -> None:
        """Add the motions to all solutions of a visit, the first from `here`.

        The last solution is `here` afterwards. Solutions without a path are added to
        `unreached`.
        """
        self.unreached += [(visit.split, visit.index, number) for number in visit.unreached]
        for q, through, shares in zip(visit.solutions, visit.paths, visit.shares, strict=True):
            if len(shares):
                points = np.vstack((self.here, through[1:], q))
                curve, speed = self._travel.curve(points, shares)
                trajectory = Trajectory((curve,))
            else:
                trajectory, speed = self._travel.trajectory(np.vstack((self.here, through, q)))
            self.visits.append(PlannedVisit(visit.split, visit.index, trajectory, speed))
            self.here = q
        self._progress(len(self.visits))


def expected_precision(
    planner: TourPlanner, T_R_N: Mapping[str, FloatArray], poses: Sequence[PlannedPose]
) -> Expected:
    """Return the expected precision of a fit of these poses in all their solutions.

    If the planner has chosen curves to measure in motion, theirs, whatever the poses are.
    ``T_R_N``: registration of each sensor, (4, 4); other sensors are left out. Raises as
    `DesignInformation.of`.
    """
    if planner.moving_design is not None:
        moving = planner.moving_design.expected
        return Expected(moving.joint_std, moving.joint_rms, moving.tool_rms)
    sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
    information = planner.design.with_sensors_at(sensors_R).information(planner.scene, poses)
    chosen = range(len(information))
    return Expected(
        information.joint_std(chosen),
        information.joint_rms(chosen),
        information.tool_rms(chosen),
    )
