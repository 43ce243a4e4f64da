"""A whole collection before anything moves: every visit with its way, times, what is expected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.planned_design import Designed
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.types import FloatArray

NO_FREE_PATH = 'no free path'


@dataclass(frozen=True)
class PlannedVisit:
    """A configuration that is measured.

    Attributes
    ----------
    split
        ``optimization``, ``validation`` or ``reference``.
    pose
        Which of the poses of its split.
    points
        The way, from the configuration before to this one, rad, (n, k).
    """

    split: str
    pose: int
    points: FloatArray

    @property
    def q(self) -> FloatArray:
        """The configuration, rad, (k,)."""
        end: FloatArray = self.points[-1]
        return end


@dataclass(frozen=True, eq=False)
class CollectionPlan:
    """What a collection will do, and what its fit is expected to state.

    Attributes
    ----------
    tour
        As planned.
    visits
        All configurations in the order of their visits, references each time.
    unreached
        Configurations that no free path leads to.
    robot_time_s
        Motion, settling and dwell, s.
    max_tool_speed_m_s
        Of the fastest point of arm and tool, m/s.
    joint_std
        Expected standard deviation of each joint's offset, rad; None where not identifiable.
    joint_rms
        Root mean square of them, rad.
    tool_rms
        Root mean square of the 3-D error of the predicted markers, m.
    designed
        Of an optimal design; None without one.
    """

    tour: Tour
    visits: tuple[PlannedVisit, ...]
    unreached: int
    robot_time_s: float
    max_tool_speed_m_s: float
    joint_std: Mapping[str, float | None]
    joint_rms: float
    tool_rms: float
    designed: Designed | None

    @property
    def dropped(self) -> dict[str, int]:
        """Reason -> number of joint solutions that are not visited."""
        lost = {NO_FREE_PATH: self.unreached} if self.unreached else {}
        return {**self.tour.dropped_solutions, **lost}


def plan_collection(
    planner: TourPlanner, T_R_N: Mapping[str, FloatArray], start: FloatArray
) -> CollectionPlan:
    """Go through a collection from beginning to end, as the planner's node does it.

    Parameters
    ----------
    planner
        Plans the tour.
    T_R_N
        Registration of each sensor, (4, 4).
    start
        Where the arm stands, rad, (k,).

    Raises
    ------
    InsufficientDataError
        No pose is left to fit on.
    """
    tour, travel = planner.collection(T_R_N), planner.travel
    planned = Tour(
        planner.model.chain,
        tour.plans,
        model=planner.model,
        reference_every=tour.reference_every,
        order=tour.order,
    )
    visits: list[PlannedVisit] = []
    unreached, duration_s, fastest, here = 0, 0.0, 0.0, start
    while (stop := tour.next(here)) is not None:
        unreached += len(stop.unreached)
        for q, way in zip(stop.solutions, stop.paths, strict=True):
            points = np.vstack((here, way, q))
            trajectory, speed = travel.trajectory(points)
            duration_s += trajectory.duration_s + travel.measuring_s
            fastest = max(fastest, speed)
            visits.append(PlannedVisit(stop.split, stop.index, points))
            here = q
    by_pose: dict[int, list[FloatArray]] = {}
    for visit in visits:
        if visit.split == 'optimization':
            by_pose.setdefault(visit.pose, []).append(visit.q)
    fitted = planned.plans['optimization'].poses
    poses = [PlannedPose(fitted[i].T_R_T, np.array(q)) for i, q in by_pose.items()]
    sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
    information = planner.design.before(sensors_R).information(planner.scene, poses)
    chosen = range(len(information))
    return CollectionPlan(
        planned,
        tuple(visits),
        unreached,
        duration_s,
        fastest,
        information.joint_std(chosen),
        information.joint_rms(chosen),
        information.tool_rms(chosen),
        planner.designed,
    )
