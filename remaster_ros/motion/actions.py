# SPDX-License-Identifier: Apache-2.0
"""The actions that the arm supervisor returns, and the rules that it keeps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.motion_gate import Admitted
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleRules
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class CheckPath:
    """Action: check whether the arm's way to a target is free of collisions.

    The answer goes to `ArmSupervisor.path_found`.
    """

    number: int  # Names the request
    # rad or m, (k,)
    start: FloatArray
    target: FloatArray
    waypoints: FloatArray  # What the planner would go through, (n, k)
    # Of a curve through the waypoints, which begins at the first: their shares, (n,); else (0,)
    shares: FloatArray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class PathAnswer:
    """The answer to a `CheckPath`."""

    path: FreePath | None  # A free path; None if there is none
    why: str = ''  # What is in the way
    at_start: bool = False  # The arm stands in contact or within a margin already
    way_out: FreePath | None = None  # The slow way out of that; None if none is known


@dataclass(frozen=True)
class Drive:
    """Action: publish this move at once, as it was decided for the time `wall_s`."""

    solution: int
    admitted: Admitted
    wall_s: float
    begins_s: float = 0.0  # The stamp of the trajectory, robot time, s; 0 for at once


@dataclass(frozen=True)
class Renew:
    """Action: publish the next piece of the move under way at once; it was decided at `wall_s`."""

    admitted: Admitted
    wall_s: float
    begins_s: float  # As of a `Drive`


@dataclass(frozen=True)
class Stop:
    """Action: publish this stop at once, as it is for where the arm is at `wall_s`."""

    admitted: Admitted
    reason: str
    wall_s: float
    begins_s: float = 0.0  # As of a `Drive`


@dataclass(frozen=True)
class Settled:
    """Action: report that the arm stands still at a configuration."""

    solution: int
    stamp_s: float  # Stamp of the report that completed the settling, s
    q: FloatArray  # Mean reported joint positions since it stands still, rad or m, (k,)
    # How long it moved and how long it stood, s
    motion_s: float
    settle_s: float


@dataclass(frozen=True)
class Failed:
    """Action: report that a configuration is given up."""

    solution: int
    reason: str


@dataclass(frozen=True)
class Halted:
    """Action: report that the arm is halted until a person clears the halt."""

    reason: str


Action = CheckPath | Drive | Renew | Stop | Settled | Failed | Halted


@dataclass(frozen=True)
class SupervisorRules:
    """Rules of the arm supervisor: when it waits, gives up or halts. Times in s."""

    settle: SettleRules = field(default_factory=SettleRules)  # What counts as arrived and still
    # Beyond the expected motion and the settling: not arrived (robot time)
    arrive_timeout_s: float = 10.0
    # Longest wait for the recorder's answer on a settled configuration (robot time)
    answer_timeout_s: float = 180.0
    heartbeat_s: float = 3.0  # Longest silence of planner, recorder or robot (wall time)
    # An arm that stands for so long and not at its target will not get there (robot time)
    stall_s: float = 1.0
    # A command may take so long to reach the robot and be seen in its reports (wall time)
    reaction_s: float = 0.5
    lag_s: float = 0.35  # An arm may be so far behind its trajectory (robot time)
    # So many configurations that the robot did not reach, and it is halted
    failures_in_a_row: int = 3
    # After a longer interruption only a person goes on, unless the robot's safety circuit was
    # known to be released all the time (wall time)
    resume_alone_s: float = 5.0
    # The controller has a move in pieces that are over after so long (robot time); 0 for whole
    # moves
    horizon_s: float = 0.0
    keeps_stamps: bool = True  # Whether the controller keeps the stamps of trajectories

    @property
    def units(self) -> JointUnits:
        """Units of the arm's joints."""
        return self.settle.units
