"""The actions that the arm supervisor returns, and the rules that it keeps."""

from __future__ import annotations

from dataclasses import dataclass, field

from remaster_ros.motion.motion_gate import Admitted
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleRules
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class CheckPath:
    """Find out whether the way to a target is free; answer with `ArmSupervisor.path_found`.

    Attributes
    ----------
    number
        Names the request.
    start, target
        rad, (k,).
    waypoints
        What the planner would go through, rad, (n, k).
    """

    number: int
    start: FloatArray
    target: FloatArray
    waypoints: FloatArray


@dataclass(frozen=True)
class PathAnswer:
    """The answer to a `CheckPath`.

    Attributes
    ----------
    path
        A free path; None where there is none.
    why
        What is in the way.
    at_start
        The arm stands in contact or within a margin already.
    way_out
        The slow way out of that; None where none is known.
    """

    path: FreePath | None
    why: str = ''
    at_start: bool = False
    way_out: FreePath | None = None


@dataclass(frozen=True)
class Drive:
    """Publish this move, at once: it was decided at `wall_s`."""

    solution: int
    admitted: Admitted
    wall_s: float


@dataclass(frozen=True)
class Stop:
    """Publish this stop, at once: it is for where the arm is at `wall_s`."""

    admitted: Admitted
    reason: str
    wall_s: float


@dataclass(frozen=True)
class Settled:
    """The arm stands still at a configuration.

    Attributes
    ----------
    solution
        Its number.
    stamp_s
        Stamp of the report that completed the settling, s.
    q
        Mean reported joint positions since it stands still, rad, (k,).
    motion_s, settle_s
        How long it moved and how long it stood, s.
    """

    solution: int
    stamp_s: float
    q: FloatArray
    motion_s: float
    settle_s: float


@dataclass(frozen=True)
class Failed:
    """A configuration is given up."""

    solution: int
    reason: str


@dataclass(frozen=True)
class Halted:
    """The arm stays where it is until a person clears the halt."""

    reason: str


Action = CheckPath | Drive | Stop | Settled | Failed | Halted


@dataclass(frozen=True)
class SupervisorRules:
    """When to wait, to give up and to halt. Times in s.

    Attributes
    ----------
    settle
        What counts as arrived and still.
    arrive_timeout_s
        Beyond the expected motion and the settling: not arrived (robot time).
    answer_timeout_s
        Longest wait for the recorder's answer on a settled configuration (robot time).
    heartbeat_s
        Longest silence of planner, recorder or robot (wall time).
    stall_s
        An arm that stands for so long and not at its target will not get there (robot time).
    reaction_s
        A command may take so long to reach the robot and be seen in its reports (wall time).
    lag_s
        An arm may be so far behind its trajectory (robot time).
    failures_in_a_row
        So many configurations that the robot did not reach, and it is halted.
    resume_alone_s
        After a longer interruption only a person goes on, unless the robot's safety circuit was
        known to be released all the time (wall time).
    """

    settle: SettleRules = field(default_factory=SettleRules)
    arrive_timeout_s: float = 10.0
    answer_timeout_s: float = 180.0
    heartbeat_s: float = 3.0
    stall_s: float = 1.0
    reaction_s: float = 0.5
    lag_s: float = 0.35
    failures_in_a_row: int = 3
    resume_alone_s: float = 5.0
