"""What limits motion: joint limits and the share of the joint velocity limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.types import FloatArray

# The peak velocity of a quintic from rest to rest, over its mean velocity.
QUINTIC_PEAK = 1.875


@dataclass(frozen=True)
class MotionLimits:
    """Limits of commanded joint positions and velocities.

    Attributes
    ----------
    names
        Joint names, base to tip.
    lower, upper
        Position limits, rad, (k,).
    velocity
        Largest allowed joint velocities (the share of the limits), rad/s, (k,).
    """

    names: Sequence[str]
    lower: FloatArray
    upper: FloatArray
    velocity: FloatArray

    @classmethod
    def of(cls, chain: SerialChain, speed_share: float) -> MotionLimits:
        """Take the limits of a chain, with a share (0 to 1) of its velocity limits."""
        return cls(chain.joint_names, chain.lower, chain.upper, speed_share * chain.velocity_limits)

    def outside(self, q: FloatArray) -> str:
        """Return which joint of `q` (rad, (k,)) lies outside, in words; '' if none does."""
        for name, value, low, high in zip(self.names, q, self.lower, self.upper):
            if not low <= value <= high:
                return (
                    f'{name} at {np.rad2deg(value):.2f} deg is outside its limits '
                    f'[{np.rad2deg(low):.2f}, {np.rad2deg(high):.2f}] deg'
                )
        return ''

    def duration(self, start: FloatArray, end: FloatArray) -> float:
        """Return the time (s) in which no joint exceeds its velocity, going as a quintic."""
        return max(0.3, float(np.max(QUINTIC_PEAK * np.abs(end - start) / self.velocity)))
