# SPDX-License-Identifier: Apache-2.0
"""The units of joints: rad of those that turn, m of those that slide.

Tolerances and steps of motion are stated as angles. An angle moves what is at a distance from its
axis by the angle times the distance; a slide moves all that it carries by its own way. So a joint
that slides has `LEVER_M` (0.25 m) times as much in m, `SerialChain.per_radian`. That distance is
on the short side of an arm's reach: a slide is held nearer to where it should be than a joint that
turns holds the end of the arm, and is looked at more often on a way of the same length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from remaster_ros.kinematics.serial_chain import LEVER_M, SerialChain
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class JointUnits:
    """Units of an arm's joints, rad or, of those that slide, m; and comparison of motions."""

    slides: tuple[bool, ...] = ()  # Base to tip; empty where all joints turn

    @classmethod
    def of(cls, chain: SerialChain) -> JointUnits:
        """Return the joint units of an arm."""
        return cls(tuple(chain.slides.tolist()) if chain.slides.any() else ())

    @cached_property
    def per_radian(self) -> FloatArray:
        """Amount in each joint's unit that counts as a radian, (k,); (1,) if all joints turn."""
        return np.where(self.slides, LEVER_M, 1.0) if self.slides else np.ones(1)

    def slide(self, joint: int) -> bool:
        """Whether a joint slides; ``joint``: its index from 0."""
        return bool(self.slides) and self.slides[joint]

    def largest(self, ways: FloatArray) -> float:
        """Return the largest absolute entry of joint motions (..., k), rad or m, as rad.

        A slide counts 1 / `LEVER_M` rad per m. Raises ValueError if there are no entries.
        """
        return float(np.max(np.abs(ways) / self.per_radian))

    def farthest(self, way: FloatArray) -> int:
        """Return the index, from 0, of the joint that moves most in a way, (k,), rad or m.

        A slide counts 1 / `LEVER_M` rad per m.
        """
        return int(np.argmax(np.abs(way) / self.per_radian))

    # As people read them

    def in_degrees(self, joint: int, value: float, digits: int = 2, sign: str = '') -> str:
        """Return a joint's position or way, rad or m, as text in degrees or, if it slides, mm.

        ``joint``: its index from 0; ``digits``: decimals; ``sign``: '+' to show that of positive
        values.
        """
        shown, unit = (1e3 * value, 'mm') if self.slide(joint) else (np.rad2deg(value), 'deg')
        return f'{shown:{sign}.{digits}f} {unit}'

    def in_radians(self, way: FloatArray, digits: int) -> str:
        """Return the motion of the joint that moves most in a way, (k,), as text, in rad or mm.

        Without sign. ``digits``: decimals of rad; mm have two fewer.
        """
        joint = self.farthest(way)
        value = abs(float(way[joint]))
        if self.slide(joint):
            # A tenth of a millirad is a fortieth of a millimetre.
            return f'{1e3 * value:.{digits - 2}f} mm'
        return f'{value:.{digits}f} rad'

    def rate(self, joint: int, value: float, per: str) -> tuple[str, str]:
        """Return a joint's speed or acceleration as a number, and its unit, as text.

        ``value``: rad or m per time; ``per``: 's' or 's2'. A slide has mm, one decimal; others
        rad, three.
        """
        if self.slide(joint):
            return f'{1e3 * value:.1f}', f'mm/{per}'
        return f'{value:.3f}', f'rad/{per}'


TURNING = JointUnits()
"""Those of an arm whose joints all turn."""
