# SPDX-License-Identifier: Apache-2.0
"""What may happen to messages on their way, and what the bridge showed of itself."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from remaster_ros.collection.events import Event
from remaster_ros.types import FloatArray

COMMANDS = '/joint_trajectory_controller/joint_trajectory'
EMERGENCY = '/robot/emergency_stop'
RELIABLE = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
# Publishers that move the arm may be asked for a lease by which they are known to live.
LEASED = QoSProfile(
    depth=200,
    reliability=ReliabilityPolicy.RELIABLE,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=2.0),
)
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
STATUS_PERIOD_S = 0.3
INTRUDER = 'intruder'


@dataclass(frozen=True)
class Lines:
    """What happens to messages on their way, from now on; nothing by default.

    Attributes
    ----------
    delay_s, jitter_s
        joint_states come so much later, and by a random part of `jitter_s` more: out of order.
    loss, double
        Share of joint_states that is lost, or comes twice.
    clock_s
        The robot's clock is so much ahead.
    stamp_noise_s
        Standard deviation of its stamps about the time of the sample.
    wrap
        Added to the reported positions, rad, (k,).
    nan
        Index of a joint that is not a number.
    frozen
        The values of the first message from now on come again and again, with new stamps.
    stopped_stamps
        The stamp of the first message from now on comes again and again.
    silent
        Nothing is published.
    twice
        Each joint is named twice in joint_states.
    prefix
        Before the names of the joints.
    command_delay_s, command_loss, command_double
        The same for commands.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    double: float = 0.0
    clock_s: float = 0.0
    stamp_noise_s: float = 0.0
    wrap: FloatArray | None = None
    nan: int | None = None
    frozen: bool = False
    stopped_stamps: bool = False
    silent: bool = False
    twice: bool = False
    prefix: str = ''
    command_delay_s: float = 0.0
    command_loss: float = 0.0
    command_double: bool = False


@dataclass
class Seen:
    """What the bridge showed of itself: its summaries and events with their monotonic times."""

    summaries: list[tuple[float, str, dict[str, str]]] = field(default_factory=list)
    events: list[tuple[float, Event]] = field(default_factory=list)
    settled: list[tuple[float, FloatArray]] = field(default_factory=list)

    def halted(self, since_s: float = 0.0) -> str:
        """Return the reason that the newest summary gives for a halt; '' for none."""
        newest = self.summaries[-1] if self.summaries else (-np.inf, '', {})
        return newest[2].get('halted', '') if newest[0] >= since_s else ''

    def halt_time(self, since_s: float) -> float:
        """When a halt was first shown after `since_s`, s; infinite if never."""
        times = (t for t, _, values in self.summaries if t >= since_s and values.get('halted'))
        return next(times, np.inf)
