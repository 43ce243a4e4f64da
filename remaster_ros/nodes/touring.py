"""Which poses a planner visits, and in which joint solutions: its cell and parameters decide."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InsufficientDataError
from remaster_ros.core.inverse import InverseKinematics
from remaster_ros.core.planning import Plan, candidate_poses, plan_poses
from remaster_ros.core.tour import REGISTRATION, Tour, registration_tour
from remaster_ros.core.types import FloatArray
from remaster_ros.storage.cell import Cell

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
        cell: Cell,
        chain: SerialChain,
        counts: Mapping[str, int],
        seed: int,
        limit_margin: float,
    ) -> None:
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
        tour = Tour(self._chain, plans, model=self.model)
        if not plans['optimization'].poses:
            raise InsufficientDataError(f'{tour.describe()}: no pose is left to fit on')
        return tour

    def _plan(self, split: str, aim: FloatArray, sensors_R: dict[str, FloatArray]) -> Plan:
        """Plan poses that face `aim` and that every sensor sees; positions in R, m, (3,)."""
        # Each split has its own draws: the same plan, whatever was planned before a restart.
        rng = np.random.default_rng([self._seed, *split.encode()])
        sights = self._cell.lines_of_sight(sensors_R)
        count = self._counts[split]
        candidates = candidate_poses(count, self._cell.poses.ranges(), aim, rng)
        return plan_poses(self._inverse, self.model, candidates, sights, self._margin)


class Background:
    """Does one thing at a time beside the callbacks: a stop must not wait for the planning."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._q: FloatArray = np.empty(0)
        self._what: object = None
        self._outcome: list[Callable[[], Any]] = []

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return what a job found, in a tuple; None while it works.

        Parameters
        ----------
        what
            Tells jobs apart: what another job, or an arm that has moved since, was asked for is
            forgotten.
        q
            Where the arm stands, rad, (k,).
        job
            Called in a thread of its own; what it raises is raised here.
        """
        if self._thread is None:
            self._start(what, q, job)
            return None
        if self._thread.is_alive():
            return None
        self._thread = None
        if self._what != what or np.max(np.abs(self._q - q)) > MOVED_RAD:
            self._start(what, q, job)
            return None
        return (self._outcome.pop()(),)

    def _start(self, what: object, q: FloatArray, job: Callable[[], Any]) -> None:
        self._what, self._q, self._outcome = what, q, []
        outcome = self._outcome

        def work() -> None:
            try:
                found = job()
                outcome.append(lambda: found)
            except Exception as error:
                # Raised where it is asked for; the name is gone after this block.
                problem = error
                outcome.append(lambda: _raise(problem))

        # A daemon: the node need not wait for it at its end.
        self._thread = threading.Thread(target=work, name='planning', daemon=True)
        self._thread.start()


def _raise(error: Exception) -> None:
    raise error
