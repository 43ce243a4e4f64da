# SPDX-License-Identifier: Apache-2.0
"""Parameters of `pose_planner`, and the tour planner that they configure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.limits import SLOWEST_M_S
from remaster_ros.nodes.parameters import parameter
from remaster_ros.nodes.planner.inspections import InspectionParameters
from remaster_ros.nodes.planner.prepared_tours import PreparedTours
from remaster_ros.planning.moving_design import (
    LONGEST_MOVING_S,
    SHORTEST_MOVING_S,
    check_sensors,
)
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.tour_order import REGISTRATION
from remaster_ros.planning.tour_planner import REGISTRATION_CANDIDATES, TourPlanner
from remaster_ros.planning.travel_time import SPEED_SHARE, TravelTime
from remaster_ros.session.cells.workcell import Workcell


@dataclass(frozen=True)
class Parameters(InspectionParameters):
    """ROS parameters of the pose planner."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    optimization_candidates: int = parameter(
        60, 'candidate poses that the offsets are fitted on', low=1, high=10000
    )
    validation_candidates: int = parameter(
        60, 'candidate poses that the gain is proved on', low=0, high=10000
    )
    registration_candidates: int = parameter(
        REGISTRATION_CANDIDATES,
        'candidate poses for the three-point registration',
        low=3,
        high=1000,
    )
    seed: int = parameter(0, 'seed of the Latin hypercube', low=0)
    reference_every: int = parameter(
        25,
        'how many configurations lie between two visits to the reference configurations, by which '
        'a moved sensor or base, a slipped marker or encoder and drift are seen; 0 for none',
        low=0,
        high=100000,
    )
    session: str = parameter(
        'session', "folder of the recorder's session, where the plan is kept (plan.jsonl)"
    )
    separate: str = parameter(
        '',
        'discovery.json: configurations that separate its causes from their look-alikes are '
        'added; empty for none',
    )
    discovery: str = parameter(
        'discovery',
        "folder of the optimizer's discovery: after a complete collection remaster/collect "
        'measures further what separates its causes from their look-alikes; empty for nothing',
    )
    resume_within_s: float = parameter(
        30.0,
        'a planner killed while collecting that is started again within this time goes on by '
        'itself; later it waits for /remaster/collect',
        unit='s',
        low=0.0,
        high=3600.0,
    )
    limit_margin_deg: float = parameter(
        1.0,
        'distance kept from the joint limits; of a joint that slides 4.36 mm for each degree',
        unit='deg',
        low=0.0,
        high=45.0,
    )
    moving_s: float = parameter(
        0.0,
        'seconds of motion along curves that are measured while the arm moves, between poses that '
        'are measured at standstill and never fitted; 0 for stop and go',
        unit='s',
        low=SHORTEST_MOVING_S,
        high=LONGEST_MOVING_S,
        off=0.0,
    )
    speed_share: float = parameter(
        SPEED_SHARE,
        'as of robot_bridge: what `poses.design: optimal` and `poses.order: fastest` of a cell '
        'file reckon with; commands nothing',
        low=0.01,
        high=1.0,
    )
    cartesian_speed_limit_m_s: float = parameter(
        0.25,
        'as of robot_bridge, likewise; 0 means no such limit',
        unit='m/s',
        low=SLOWEST_M_S,
        high=10.0,
        off=0.0,
    )

    def tour_planner(
        self, cell: Workcell, chain: SerialChain, causes: Sequence[FoundCause]
    ) -> TourPlanner:
        """Return the tour planner of a cell by these parameters.

        ``causes``: to be separated from their look-alikes. Raises InputError if measuring in
        motion is asked for (`moving_s`), and the sensors or the arm do not allow it.
        """
        scene = cell.planning_scene(chain, np.deg2rad(self.limit_margin_deg))
        counts = {
            'optimization': self.optimization_candidates,
            'validation': self.validation_candidates,
            REGISTRATION: self.registration_candidates,
        }
        travel = TravelTime.of(
            scene.model,
            self.speed_share,
            self.cartesian_speed_limit_m_s or np.inf,
            cell.acceleration_limits(chain),
        )
        design = cell.design_settings()
        if self.moving_s:
            # At the start, and not when the arm has been moved to register the sensors.
            check_sensors(scene, design.sensors)
        return PreparedTours(
            scene,
            counts,
            self.seed,
            self.reference_every,
            design,
            travel,
            causes,
            moving_s=self.moving_s,
        )

    def causes(self, joint_names: Sequence[str]) -> tuple[FoundCause, ...]:
        """Return the causes that the plan has to separate from look-alikes; () if none are given.

        Read from the file of the parameter `separate`. Raises InputError as `read_causes`.
        """
        if not self.separate:
            return ()
        # Imported when needed, since the import is slow.
        from remaster_ros.reports.found_causes import read_causes

        return read_causes(self.separate, joint_names)

    def plan_settings(self, cell: Workcell, causes: Sequence[FoundCause]) -> dict[str, Any]:
        """Return everything that the plan depends on, as plain data by name.

        The plan in a session's journal is of other parameters or another cell if its settings
        differ from these. Speeds are left out if the plan does not depend on them.
        """
        design = cell.design_settings()
        speeds = {
            'speed_share': self.speed_share,
            'cartesian_speed_limit_m_s': self.cartesian_speed_limit_m_s,
        }
        return {
            'cell': cell.fingerprint(),
            'optimization_candidates': self.optimization_candidates,
            'validation_candidates': self.validation_candidates,
            'registration_candidates': self.registration_candidates,
            'seed': self.seed,
            'reference_every': self.reference_every,
            'limit_margin_deg': self.limit_margin_deg,
            # Only these plans depend on them.
            **(speeds if design.optimal or design.fastest or self.moving_s else {}),
            **({'moving_s': self.moving_s} if self.moving_s else {}),
            **({'separate': repr(causes)} if causes else {}),
        }
