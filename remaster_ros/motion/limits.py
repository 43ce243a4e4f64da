# SPDX-License-Identifier: Apache-2.0
"""What limits motion: joint limits, speeds of joints and of the fastest point, accelerations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.types import FloatArray

UNKNOWN_VELOCITY = 1.0
"""Where a robot model has no velocity limit, rad/s: slow for any arm. Here and below a joint that
slides has `SerialChain.per_radian` (0.25 m) times as much, in metres."""
SLOWEST_M_S = 1e-3
"""Least limit of the speed of the fastest point, m/s: at it an arm of a metre takes an hour for
half a turn. A smaller one is a slip of the keyboard: no time that it leads to fits a message."""
LONGEST_S = 86_400.0
"""No motion of the bridge takes longer, s: a day. The slowest probe of an arm with seven joints,
at `SLOWEST_M_S` from anywhere within its limits, takes some ten hours. A message holds decades."""
ACCELERATION = 5.0
"""Largest joint acceleration where a cell file gives none, rad/s².

URDFs have none. Makers of arms of this size state 7.5 (joint 2 of the Franka Panda) and more.
"""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of commanded joint positions, speeds and accelerations."""

    names: Sequence[str]  # Joint names, base to tip
    # Position limits as reported, rad or m, (k,)
    lower: FloatArray
    upper: FloatArray
    # Largest commanded joint velocities (the share of the robot's limits), rad/s or m/s, (k,)
    velocity: FloatArray
    # Largest commanded joint accelerations, rad/s² or m/s², (k,)
    acceleration: FloatArray
    # Largest speed of the fastest point of arm and tool, m/s; infinite for none
    tool_speed: float = np.inf
    # Distance kept from the position limits, rad; `JointUnits` has what it is where a joint slides
    margin: float = 0.0
    units: JointUnits = TURNING

    @classmethod
    def of(
        cls,
        chain: SerialChain,
        speed_share: float,
        offsets: FloatArray | None = None,
        acceleration: FloatArray | float | None = None,
        tool_speed: float = np.inf,
        margin: float = 0.0,
    ) -> MotionLimits:
        """Motion limits of a chain, in reported joint positions.

        A joint's stops are at true angles, which are the reported ones plus the offset: in
        reported angles the limits are shifted by minus the offset. The robot's own controller
        watches the limits in reported angles, so the shifted ones never reach beyond them.

        Parameters
        ----------
        chain
            The arm.
        speed_share
            Share (0 to 1) of its velocity limits that is used.
        offsets
            What true angles have on top of reported ones, rad or m: zero-offsets in use, (k,), or
            the least and the largest of what is in use, (2, k); None for none.
        acceleration
            rad/s² or m/s², one number for all joints or (k,); None for `ACCELERATION`.
        tool_speed, margin
            See the attributes.
        """
        shift = np.zeros(len(chain)) if offsets is None else offsets
        least, largest = np.broadcast_to(shift, (2, len(chain)))
        known = np.isfinite(chain.velocity_limits)
        velocity = np.where(known, chain.velocity_limits, UNKNOWN_VELOCITY * chain.per_radian)
        return cls(
            chain.joint_names,
            np.maximum(chain.lower, chain.lower - least),
            np.minimum(chain.upper, chain.upper - largest),
            speed_share * velocity,
            np.broadcast_to(
                ACCELERATION * chain.per_radian if acceleration is None else acceleration,
                velocity.shape,
            ),
            tool_speed,
            margin,
            JointUnits.of(chain),
        )

    @property
    def margins(self) -> FloatArray:
        """Margin to the limits of each joint: `margin` times `units.per_radian`, rad or m.

        (k,), or (1,) if all joints turn.
        """
        return self.margin * self.units.per_radian

    def shown(self, joint: int, low: float, high: float) -> str:
        """Return two limits of a joint as text: ``[low, high] deg``, or mm if it slides.

        ``joint``: its index from 0; ``low, high``: rad or m.
        """
        first, last = (self.units.in_degrees(joint, value) for value in (low, high))
        return f'[{first.split()[0]}, {last.split()[0]}] {last.split()[1]}'

    def outside(self, q: FloatArray) -> str:
        """Return as text which joint of `q`, rad or m, (k,), is outside its limits; or ''.

        The limits are those less the margin; the first such joint is named. NaN is outside.
        """
        bad = ~((self.lower + self.margins <= q) & (q <= self.upper - self.margins))
        if not np.any(bad):
            return ''
        joint, units = int(np.argmax(bad)), self.units
        margin = float(np.broadcast_to(self.margins, bad.shape)[joint])
        kept = f' less {units.in_degrees(joint, margin)}' if margin else ''
        return (
            f'{self.names[joint]} at {units.in_degrees(joint, q[joint])} is outside its limits '
            f'{self.shown(joint, self.lower[joint], self.upper[joint])}{kept}'
        )
