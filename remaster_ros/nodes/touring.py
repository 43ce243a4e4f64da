"""Which poses a planner visits, and in which joint solutions: its cell and parameters decide."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InsufficientDataError
from remaster_ros.core.inverse import InverseKinematics
from remaster_ros.core.planning import Plan, candidate_poses, plan_poses
from remaster_ros.core.tour import REGISTRATION, Tour, registration_tour
from remaster_ros.core.types import FloatArray
from remaster_ros.storage.cell import Cell


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
        self._arm = cell.collision_model(chain)

    def registration(self) -> Tour:
        """Plan poses for the three-point registration, before sensors that stand somewhere."""
        cell = self._cell
        rough = {name: np.array(s.rough_position_m) for name, s in cell.sensors.items()}
        plan = self._plan(REGISTRATION, rough[cell.aim_at], rough)
        markers = [np.array(cell.markers[s.marker]) for s in cell.sensors.values()]
        return registration_tour(self._chain, plan, markers)

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
        tour = Tour(self._chain, plans)
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
        return plan_poses(self._inverse, self._arm, candidates, sights, self._margin)
