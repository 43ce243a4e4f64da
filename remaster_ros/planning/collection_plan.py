# SPDX-License-Identifier: Apache-2.0
"""A whole collection before anything moves: every visit with its way, times, what is expected."""

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
from remaster_ros.planning.planned_design import NO_FREE_PATH, Designed
from remaster_ros.planning.separating_design import SeparatingDesign
from remaster_ros.planning.tour_order import FITTED, PoseVisit, Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import FloatArray

REGISTERING = 3
"""Poses that register the sensors; the others of their plan are visited where one is not seen."""
FEW_MISSED, MOST_MISSED = 4, 12
"""A way that is not there takes seconds to look for: so many tell that others have none."""


@dataclass(frozen=True, eq=False)
class PlannedVisit:
    """A configuration that is measured."""

    split: str  # ``optimization``, ``validation``, ``reference`` or ``registration``
    pose: int  # Which of the poses of its split
    trajectory: Trajectory  # The way, from the configuration before to this one
    tool_speed_m_s: float  # Largest speed of the fastest point of arm and tool on it, m/s

    @property
    def points(self) -> FloatArray:
        """The way's polyline, rad, (n + 1, k) for n lines."""
        return self.trajectory.points

    @property
    def q(self) -> FloatArray:
        """The configuration, rad, (k,)."""
        return self.trajectory.end


class Expected(NamedTuple):
    """What a fit is expected to state; see `CollectionPlan`."""

    joint_std: Mapping[str, float | None]
    joint_rms: float
    tool_rms: float


NOTHING_EXPECTED = Expected({}, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class CollectionPlan:
    """What a collection will do, and what its fit is expected to state."""

    tour: Tour  # As planned
    # All configurations in the order of their visits: registration, fit, held out, and references
    # each time
    visits: tuple[PlannedVisit, ...]
    unreached: int  # Configurations that no free path leads to
    measuring_s: float  # Settling and dwell at each of them, s
    # Motion, settling and dwell of all visits, s: of the whole session where all of it is ahead
    robot_time_s: float
    max_tool_speed_m_s: float  # Of the fastest point of arm and tool, m/s
    # Expected standard deviation of each joint's offset, rad or m; None where not identifiable
    joint_std: Mapping[str, float | None]
    joint_rms: float  # Root mean square of them, rad; see `DesignInformation.joint_rms`
    tool_rms: float  # Root mean square of the 3-D error of the predicted markers, m
    designed: Designed | None  # Of an optimal design; None without one
    # What these configurations do not determine at all, so that there are no standard deviations
    # (None and NaN above); ''
    undetermined: str = ''
    # What was added to separate causes; None without causes
    separated: SeparatingDesign | None = None
    # Whether an optimal design reaches its goal and its floors, with what can be visited of it
    goal_reached: bool = False

    @property
    def poses(self) -> dict[str, int]:
        """Split -> number of poses with at least one configuration that is visited."""
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
    """Go through a session from its registration to its end, as the planner's node does it.

    Parameters
    ----------
    planner
        Plans the tour.
    T_R_N
        Registration of each sensor, (4, 4).
    start
        Where the arm stands, rad, (k,).
    progress
        Is told which share is done.

    Raises
    ------
    InsufficientDataError
        No pose is left to fit on, no configuration can be reached, or those that can do not
        determine the offsets.
    """
    tour = planner.collection(T_R_N)
    tours = [tour]
    if planner.registers:
        tours.insert(0, planner.registration().only_first(REGISTERING))
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
    stop: PoseVisit | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> CollectionPlan:
    """Go through what is left of tours, the collection's last, without changing them.

    Parameters
    ----------
    planner, T_R_N, start, progress
        See `plan_collection`.
    tours
        One after the other.
    stop
        What is left of the pose under way, visited first.

    Raises
    ------
    InsufficientDataError
        No configuration can be reached.
    """
    configurations = sum(sum(tour.configurations.values()) for tour in tours)
    steps = _Steps(start, planner.travel, lambda n: progress(min(n / configurations, 1.0)))
    for tour in tours:
        left = tour.fork()
        if stop is not None:
            steps.go(left.reroute(stop, steps.here))
            stop = None
        while (following := left.next(steps.here)) is not None:
            steps.go(following)
    if not steps.visits:
        standing = planner.model.trouble(start) or 'no free way leads from there'
        raise InsufficientDataError(
            f'no configuration can be reached from where the arm stands: {standing}'
        )
    fitted = tours[-1].plans[FITTED].poses
    lost = {(index, number) for split, index, number in steps.unreached if split == FITTED}
    reached = [
        PlannedPose(
            pose.T_R_T, np.array([q for i, q in enumerate(pose.solutions) if (at, i) not in lost])
        )
        for at, pose in enumerate(fitted)
    ]
    reached = [pose for pose in reached if len(pose.solutions)]
    judges = f'they are for /remaster/{tours[-1].judges}' if tours[-1].judges else 'none is left'
    expected, undetermined = NOTHING_EXPECTED, '' if reached else f'none is fitted, {judges}'
    try:
        if reached:
            expected = expected_precision(planner, T_R_N, reached)
    except InsufficientDataError as error:
        # What the arm does is known all the same.
        undetermined = str(error)
    designed = planner.designed
    goal_reached = designed is not None and designed.reached
    if designed is not None and goal_reached and lost:
        number = np.repeat(np.arange(len(reached)), [len(pose.solutions) for pose in reached])
        goal_reached = designed.floors.hold(number) and designed.goal.is_met(
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
        designed,
        undetermined,
        planner.separated,
        goal_reached,
    )


def session_time_s(planner: TourPlanner, tour: Tour, start: FloatArray) -> float:
    """Return about how long the robot takes for a whole session, s, without looking for ways.

    For the registration, what is fitted, what is held out and the references, with settling and
    dwell. Every way counts as straight: looking for those around something takes nearly all of the
    time that `plan_collection` takes.

    Parameters
    ----------
    planner
        Plans the tour.
    tour
        Of the collection, however far it is.
    start
        Where the arm stands, rad, (k,).
    """
    tours = [tour]
    if planner.registers:
        tours.insert(0, planner.registration().only_first(REGISTERING))
    here, total = start, 0.0
    for part in tours:
        straight = part.afresh()
        while (stop := straight.next(here)) is not None:
            for q in stop.solutions:
                total += float(planner.travel.straight(here, q[None])[0])
                total += planner.travel.measuring_s
                here = q
    return total


def outlook(planner: TourPlanner) -> tuple[Tour, Expected]:
    """Return a collection with the sensors at their rough places, without its ways.

    These take nearly all of the time that `plan_collection` takes; without them it is not known
    which configurations no free way leads to (`with_free_way` counts poses), nor how long it all
    takes.

    Raises
    ------
    InsufficientDataError
        No pose is left to fit on, or the poses do not determine the offsets.
    """
    tour = planner.collection(planner.rough_places)
    return tour, expected_precision(planner, planner.rough_places, tour.plans[FITTED].poses)


def with_free_way(
    tour: Tour, model: CollisionModel, start: FloatArray, enough: int
) -> tuple[int, int]:
    """Return how many poses to fit the arm gets to from where it stands, and of how many tried.

    One joint solution of a pose is enough, so this takes a small part of what all ways take, but
    where few are found so: then the whole tour is gone through, as a collection does it, up to
    `MOST_MISSED` poses without a way.

    Parameters
    ----------
    tour
        Of poses that the arm can take.
    model
        The arm and all it can hit.
    start
        Where it stands, rad, (k,).
    enough
        So many that are reached are enough.
    """
    fitted = {FITTED: tour.plans[FITTED]}
    quick = Tour(tour.chain, fitted, one_solution=True, model=model)
    found = _reached(quick, start, enough, FEW_MISSED)
    return found if found[0] >= enough else _reached(tour.fork(), start, enough, MOST_MISSED)


def _reached(tour: Tour, here: FloatArray, enough: int, most_missed: int) -> tuple[int, int]:
    """Go through a tour until so many poses to fit are reached, or so many poses are not."""
    count = tried = missed = 0
    while count < enough and missed < most_missed and (stop := tour.next(here)) is not None:
        tried += stop.split == FITTED
        if not len(stop.solutions):
            missed += 1
            continue
        here, count = stop.solutions[-1], count + (stop.split == FITTED)
    return count, tried


def with_expected(
    planner: TourPlanner, T_R_N: Mapping[str, FloatArray]
) -> tuple[Tour, Expected | None]:
    """Return a collection, and what it is expected to state; None where that is not known.

    Raises
    ------
    InsufficientDataError
        No pose is left to fit on.
    """
    tour = planner.collection(T_R_N)
    try:
        expected = expected_precision(planner, T_R_N, tour.plans[FITTED].poses)
    except (RemasterError, np.linalg.LinAlgError):
        # A figure for people: the collection does not depend on it.
        return tour, None
    return tour, expected if np.isfinite(expected.tool_rms) else None


class _Steps:
    """Go from stop to stop.

    ``here``: where the arm stands, rad, (k,); ``travel``: how long the robot takes; ``progress``:
    is told how many configurations are done.
    """

    def __init__(
        self, here: FloatArray, travel: TravelTime, progress: Callable[[int], None]
    ) -> None:
        self.here, self._travel, self._progress = here, travel, progress
        self.visits: list[PlannedVisit] = []
        self.unreached: list[tuple[str, int, int]] = []

    def go(self, stop: PoseVisit) -> None:
        """Visit the solutions of a stop."""
        self.unreached += [(stop.split, stop.index, number) for number in stop.unreached]
        for q, way in zip(stop.solutions, stop.paths, strict=True):
            trajectory, speed = self._travel.trajectory(np.vstack((self.here, way, q)))
            self.visits.append(PlannedVisit(stop.split, stop.index, trajectory, speed))
            self.here = q
        self._progress(len(self.visits))


def expected_precision(
    planner: TourPlanner, T_R_N: Mapping[str, FloatArray], poses: Sequence[PlannedPose]
) -> Expected:
    """Return what a fit of these poses, in all their solutions, is expected to state."""
    sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
    information = planner.design.before(sensors_R).information(planner.scene, poses)
    chosen = range(len(information))
    return Expected(
        information.joint_std(chosen),
        information.joint_rms(chosen),
        information.tool_rms(chosen),
    )
