"""Parameters of the robot bridge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.settling import SettleRules
from remaster_ros.nodes.parameters import parameter
from remaster_ros.parameters import SimulationParameters
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.compensation.in_use import CorrectionInUse


@dataclass(frozen=True)
class Parameters(SimulationParameters):
    """Parameters of the bridge."""

    REPLACED: ClassVar[Mapping[str, str]] = {
        'offsets': 'give compensation the apply/compensation.json that fit has written beside '
        'fit.json: limits and paths are checked by it as before, and what is commanded is '
        'corrected'
    }
    cell: str = parameter('', 'cell file: a path, or the name of a shipped one; must be given')
    speed_share: float = parameter(
        0.3,
        'share of each joint velocity limit that is used; while a collection runs it can be '
        'lowered: the arm is stopped and goes on with the new one',
        low=0.01,
        high=1.0,
        live=True,
    )
    cartesian_speed_limit_m_s: float = parameter(
        0.25,
        'largest speed of the fastest point of arm and tool; 0.25 is customary in manual mode, '
        '0 means no such limit; while a collection runs it can be lowered',
        unit='m/s',
        low=0.0,
        high=10.0,
        live=True,
    )
    limit_margin_deg: float = parameter(
        0.5, 'distance kept from the joint limits', unit='deg', low=0.0, high=45.0
    )
    compensation: str = parameter(
        '',
        'compensation.json by which every configuration is corrected before it is checked and '
        'commanded; read once, at the start; empty for none',
    )
    settle_s: float = parameter(
        3.0, 'how long the arm must stand still before a reading', unit='s', low=0.1, high=60.0
    )
    arrive_tolerance: float = parameter(
        2e-3, 'largest distance of a joint from its target', unit='rad', low=1e-6, high=0.1
    )
    still_tolerance: float = parameter(
        2e-4, 'largest spread of a joint position while still', unit='rad', low=1e-7, high=0.01
    )
    arrive_timeout_s: float = parameter(
        10.0, 'beyond the expected motion and settle: not arrived', unit='s', low=1.0, high=600.0
    )
    answer_timeout_s: float = parameter(
        180.0,
        "longest wait for the recorder's answer on a settled configuration",
        unit='s',
        low=1.0,
        high=3600.0,
    )
    heartbeat_s: float = parameter(
        3.0,
        'longest silence of planner, recorder or robot, wall time',
        unit='s',
        low=0.5,
        high=60.0,
    )
    stall_s: float = parameter(
        1.0,
        'an arm that stands for so long after its move, and not at its target, will not get there',
        unit='s',
        low=0.2,
        high=60.0,
    )
    reaction_s: float = parameter(
        2.0,
        'how long a command may take to be seen in joint_states, wall time',
        unit='s',
        low=0.1,
        high=60.0,
    )
    lag_s: float = parameter(
        0.35,
        'how far the arm may be behind its trajectory; beyond it the arm is halted',
        unit='s',
        low=0.05,
        high=2.0,
    )
    command_interface: str = parameter(
        'topic',
        'how the controller is commanded: by its topic …/joint_trajectory, or by its action '
        '…/follow_joint_trajectory (needs control_msgs)',
        choices=('topic', 'action'),
    )
    emergency_stop_topic: str = parameter(
        '', "std_msgs/Bool, true while the robot's own safety stops it; empty where there is none"
    )
    resume_alone_s: float = parameter(
        5.0,
        'after a longer interruption of a collection /remaster/collect is needed, unless '
        'emergency_stop_topic was false all the time, wall time',
        unit='s',
        low=0.0,
        high=60.0,
    )

    def rules(self) -> SupervisorRules:
        """Return what of them the supervisor keeps."""
        return SupervisorRules(
            settle=SettleRules(self.settle_s, self.arrive_tolerance, self.still_tolerance),
            arrive_timeout_s=self.arrive_timeout_s,
            answer_timeout_s=self.answer_timeout_s,
            heartbeat_s=self.heartbeat_s,
            stall_s=self.stall_s,
            reaction_s=self.reaction_s,
            lag_s=self.lag_s,
            resume_alone_s=self.resume_alone_s,
        )

    def raised_from(self, before: Parameters) -> str:
        """Return which limit is higher than it was before; ''. No limit is higher than any."""
        if self.speed_share > before.speed_share:
            return 'speed_share'
        now, then = (p.cartesian_speed_limit_m_s or np.inf for p in (self, before))
        return 'cartesian_speed_limit_m_s' if now > then else ''

    def correction(self, cell: Workcell, chain: SerialChain) -> CorrectionInUse | None:
        """Return the correction in use; `InputError` where it is not of this arm, or too large."""
        if not self.compensation:
            return None
        # It loads SciPy, which a bridge without a correction needs not.
        from remaster_ros.compensation.in_use import CorrectionInUse

        return CorrectionInUse(self.compensation, chain, cell.urdf_text, cell.robot.urdf)

    def limits(
        self, chain: SerialChain, shifts: FloatArray | None, acceleration: FloatArray | float
    ) -> MotionLimits:
        """Return the limits of every motion.

        Parameters
        ----------
        chain
            The arm as drawn.
        shifts
            Least and largest that a correction adds to reported angles, rad, (2, k); None without.
        acceleration
            rad/s², (k,) or for all.
        """
        return MotionLimits.of(
            chain,
            self.speed_share,
            shifts,
            acceleration,
            self.cartesian_speed_limit_m_s or np.inf,
            float(np.deg2rad(self.limit_margin_deg)),
        )
