"""Which poses a planner visits, and in which joint solutions: its cell and parameters decide."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, TypeVar

import numpy as np

from remaster_ros.collection.reference_causes import choose_references
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import (
    Plan,
    PlannedPose,
    candidate_poses,
    order_solutions,
    plan_poses,
)
from remaster_ros.planning.free_order import free_way
from remaster_ros.planning.tour_order import (
    REFERENCE,
    REGISTRATION,
    Tour,
    registration_tour,
)
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray

MOST_TRIES = 5
"""So often references are chosen anew where one has no free way to it."""
MOVED_RAD = 0.005
"""An arm this far from where a way begins, in any joint, gets another one."""

Result = TypeVar('Result')


class TourPlanner:
    """Plans tours before the sensors of a cell.

    Parameters
    ----------
    cell, chain
        The cell and its arm.
    counts
        Candidate poses of each split, the registration's among them.
    seed
        Of the Latin hypercube.
    limit_margin
        Distance kept from the joint limits, rad.
    reference_every
        How many configurations lie between two rounds of the references; 0 for no references.

    Attributes
    ----------
    model
        The arm and all that it must not hit.

    Raises
    ------
    InputError
        Collision geometry that cannot be found or read.
    """

    def __init__(
        self,
        cell: Workcell,
        chain: SerialChain,
        counts: Mapping[str, int],
        seed: int,
        limit_margin: float,
        reference_every: int = 0,
    ) -> None:
        self._every = reference_every
        self._cell, self._chain = cell, chain
        self._counts, self._seed, self._margin = counts, seed, limit_margin
        self._inverse = InverseKinematics(chain, cell.held(chain))
        self.model = cell.collision_model(chain)

    def registration(self) -> Tour:
        """Plan poses for the three-point registration, before sensors that stand somewhere."""
        cell = self._cell
        rough = {name: np.array(s.rough_position_m) for name, s in cell.sensors.items()}
        plan = self._plan(REGISTRATION, rough[cell.aim_at], rough)
        markers = [np.array(cell.markers[s.marker]) for s in cell.sensors.values()]
        return registration_tour(self._chain, plan, markers, self.model)

    def collection(self, T_R_N: Mapping[str, FloatArray]) -> Tour:
        """Plan the poses to fit and to validate, before sensors with these registrations.

        Raises
        ------
        InsufficientDataError
            No pose is left to fit on.
        """
        positions = {name: T[:3, 3] for name, T in T_R_N.items()}
        # A sensor that is not required may have no registration.
        rough = np.array(self._cell.sensors[self._cell.aim_at].rough_position_m)
        aim = positions.get(self._cell.aim_at, rough)
        plans = {
            split: self._plan(split, aim, positions)
            for split, count in self._counts.items()
            if count and split != REGISTRATION
        }
        if self._every and plans['optimization'].poses:
            plans[REFERENCE] = self._references(plans)
        tour = Tour(self._chain, plans, model=self.model, reference_every=self._every)
        if not plans['optimization'].poses:
            raise InsufficientDataError(f'{tour.describe()}: no pose is left to fit on')
        return tour

    def standing_trouble(self, q: FloatArray) -> str:
        """Return what an arm at joint positions `q` (rad, (k,)) stands too near to; ''."""
        return self.model.trouble(q)

    def _references(self, plans: Mapping[str, Plan]) -> Plan:
        """Choose references among the planned configurations, each with a way from the last."""
        poses = [
            PlannedPose(pose.T_R_T, q[None])
            for plan in plans.values()
            for pose in plan.poses
            for q in pose.solutions
        ]
        seen = {
            name: (sensor.marker, np.array(self._cell.markers[sensor.marker]))
            for name, sensor in self._cell.sensors.items()
        }
        chosen: list[PlannedPose] = []
        for _ in range(MOST_TRIES):
            q = np.array([pose.solutions[0] for pose in poses])
            picked = choose_references(self._chain, q, seen).indices
            chosen = [poses[i] for i in self._in_turn(q, list(picked))]
            lost = self._without_way(chosen)
            if not lost:
                break
            poses = [pose for pose in poses if all(pose is not other for other in lost)]
        return Plan(tuple(chosen))

    def _in_turn(self, q: FloatArray, left: list[int]) -> list[int]:
        """Order the indices so that each is the nearest of those left to the one before."""
        order = left[:1]
        while rest := [i for i in left if i not in order]:
            limits = self._chain.velocity_limits
            order.append(rest[int(order_solutions(q[rest], q[order[-1]], limits)[0])])
        return order

    def _without_way(self, poses: Sequence[PlannedPose]) -> list[PlannedPose]:
        """Return the references that no free way leads to from the one before."""
        limits = self._chain.velocity_limits
        return [
            pose
            for i, pose in enumerate(poses)
            if free_way(self.model, poses[i - 1].solutions[0], pose.solutions[0], limits, i)
            is None
        ]

    def _plan(self, split: str, aim: FloatArray, sensors_R: dict[str, FloatArray]) -> Plan:
        """Plan poses that face `aim` and that every sensor sees; positions in R, m, (3,)."""
        # Each split has its own draws: the same plan, whatever was planned before a restart.
        rng = np.random.default_rng([self._seed, *split.encode()])
        sights = self._cell.lines_of_sight(sensors_R)
        count = self._counts[split]
        candidates = candidate_poses(count, self._cell.poses.ranges(), aim, rng)
        return plan_poses(self._inverse, self.model, candidates, sights, self._margin)


class PlanningThread:
    """Does one thing at a time beside the callbacks: a stop must not wait for the planning."""

    def __init__(self) -> None:
        self._q: FloatArray = np.empty(0)
        self._what: object = None
        self._future: Future[Any] | None = None

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return what a job found, in a tuple; None while it works.

        Parameters
        ----------
        what
            Identifies the job: the result of another job, or for an arm that has moved since, is
            forgotten.
        q
            Where the arm stands, rad, (k,).
        job
            Called in a thread of its own; what it raises is raised here.
        """
        future = self._future
        if future is not None and not future.done():
            return None
        is_same = self._what == what and np.max(np.abs(self._q - q)) <= MOVED_RAD
        if future is None or not is_same:
            self._start(what, q, job)
            return None
        self._future = None
        return (future.result(),)

    def _start(self, what: object, q: FloatArray, job: Callable[[], Any]) -> None:
        self._what, self._q = what, q
        future: Future[Any] = Future()
        self._future = future

        def work() -> None:
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)

        # A daemon, which no executor's thread is: the node need not wait for it at its end.
        threading.Thread(target=work, name='planning', daemon=True).start()
