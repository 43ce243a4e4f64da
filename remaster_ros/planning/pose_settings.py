# SPDX-License-Identifier: Apache-2.0
"""Settings of candidate poses, their design and their order: ``poses:`` of a cell file."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees, pi, radians
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np

from remaster_ros.bounds import Bounds, Triple
from remaster_ros.planning.candidates import PoseRanges
from remaster_ros.planning.expected_sensors import ExpectedSensor, ToolBox

if TYPE_CHECKING:
    from remaster_ros.planning.planned_design import DesignSettings

Range = tuple[float, float]
# Heights of poses: beyond the reach of any supported arm.
REACH = Bounds(-10.0, 10.0, 'm')
LATIN_HYPERCUBE, OPTIMAL = 'latin_hypercube', 'optimal'
NEAREST, FASTEST = 'nearest', 'fastest'
ALL, CHOSEN = 'all', 'chosen'
RANGES = ('azimuth_deg', 'radius_m', 'height_m', 'roll_deg')


class ToolBoxSettings(msgspec.Struct, forbid_unknown_fields=True):
    """Box in base_link in which the tool has to be accurate."""

    center_m: Triple
    size_m: Annotated[Triple, Bounds(0.0, 20.0, 'm', above=True)]


class PoseSettings(msgspec.Struct, forbid_unknown_fields=True):
    """Ranges of the candidate poses, design of the visits, and their order."""

    azimuth_deg: Range = (0.0, 360.0)
    radius_m: Annotated[Range, Bounds(0.0, 10.0, 'm')] = (0.2, 0.5)
    height_m: Annotated[Range, REACH] = (0.4, 0.8)
    roll_deg: Range = (0.0, 360.0)
    # `OPTIMAL` for an optimal design, `LATIN_HYPERCUBE` for all of its poses.
    design: str = OPTIMAL
    # `ALL` for each pose in all its free joint solutions; `CHOSEN` for the configurations that
    # take the least time, and may return to a pose.
    solutions: str = ALL
    # `NEAREST` for the nearest pose next, `FASTEST` for the least travel time.
    order: str = NEAREST
    # Weight of the tool's error in the design: 0 for joint offsets only, 1 for the tool only.
    tool_share: Annotated[float, Bounds(0.0, 1.0)] = 0.0
    # Precision to reach: an optimal design is made for it (by default for that of the Latin
    # hypercube, of the joints at least 0.005 degrees), and a collection ends when it is reached.
    joint_std_deg: Annotated[float | None, Bounds(0.0, 5.0, 'degrees', above=True)] = None
    tool_std_m: Annotated[float | None, Bounds(0.0, 0.1, 'm', above=True)] = None
    # Where the tool's error counts; by default at all candidate poses.
    tool_box: ToolBoxSettings | None = None

    def ranges(self) -> PoseRanges:
        """Return the ranges of candidate poses in SI units. Raises InputError as `PoseRanges`."""
        return PoseRanges(
            azimuth_rad=(radians(self.azimuth_deg[0]), radians(self.azimuth_deg[1])),
            radius_m=self.radius_m,
            height_m=self.height_m,
            roll_rad=(radians(self.roll_deg[0]), radians(self.roll_deg[1])),
        )

    def settings(self, sensors: tuple[ExpectedSensor, ...], marker_std_m: float) -> DesignSettings:
        """Return the settings of the design, in SI units, for these sensors.

        ``marker_std_m``: prior of the markers' positions, per axis, m.
        """
        # Imported when needed, here and below: most nodes plan nothing.
        from remaster_ros.planning.planned_design import DesignSettings

        box = self.tool_box
        return DesignSettings(
            optimal=self.design == OPTIMAL,
            whole_poses=self.solutions == ALL,
            fastest=self.order == FASTEST,
            sensors=sensors,
            marker_std_m=marker_std_m,
            tool_share=self.tool_share,
            joint_std_rad=None if self.joint_std_deg is None else radians(self.joint_std_deg),
            tool_std_m=self.tool_std_m,
            box=None if box is None else ToolBox(np.array(box.center_m), np.array(box.size_m)),
        )

    def given(self) -> Mapping[str, object]:
        """Return the settings that differ from their defaults, key -> value, without ranges."""
        plain = PoseSettings()
        return {
            key: getattr(self, key)
            for key in self.__struct_fields__
            if key not in RANGES and getattr(self, key) != getattr(plain, key)
        }

    def problem(self) -> str:
        """Sentence on the first problem of the keys, with the remedy; '' if there is none.

        A problem is a descending range, angles that look like radians, an unknown word, or a
        key that has no effect with the others.
        """
        for key in RANGES:
            low, high = getattr(self, key)
            if low > high:
                return (
                    f'poses.{key} goes from {low:g} down to {high:g}; give the smaller one first'
                )
            if key.endswith('_deg') and low < high and max(abs(low), abs(high)) < 2.0 * pi + 0.01:
                return (
                    f'poses.{key} is {low:g} to {high:g}, a range of {high - low:.3g} degrees; if '
                    f'radians were meant, write {degrees(low):.4g}, {degrees(high):.4g}'
                )
        choices = {
            'design': (OPTIMAL, LATIN_HYPERCUBE),
            'solutions': (ALL, CHOSEN),
            'order': (NEAREST, FASTEST),
        }
        for key, words in choices.items():
            if getattr(self, key) not in words:
                return f'poses.{key} is {getattr(self, key)!r}; write {" or ".join(words)}'
        return self._without_effect()

    def _without_effect(self) -> str:
        """Sentence on the first key that has no effect with the others, with the remedy.

        '' if there is none.
        """
        given = self.given()
        if self.solutions == CHOSEN and (self.design, self.order) == (LATIN_HYPERCUBE, NEAREST):
            return (
                f'poses.solutions: {CHOSEN} has no effect with design: {LATIN_HYPERCUBE} and '
                f'order: {NEAREST}; leave it out'
            )
        if 'tool_share' in given and self.design != OPTIMAL:
            return (
                f'poses.tool_share has no effect with design: {self.design}; write design: '
                f'{OPTIMAL}, or leave it out'
            )
        if self.design != OPTIMAL:
            if 'tool_box' in given and 'tool_std_m' not in given:
                return (
                    'poses.tool_box has no effect without tool_std_m; write it, or leave both out'
                )
            return ''
        if 'joint_std_deg' in given and self.tool_share == 1.0:
            return 'poses.joint_std_deg has no effect with tool_share: 1; write less, such as 0.5'
        if 'tool_std_m' in given and self.tool_share == 0.0:
            return 'poses.tool_std_m has no effect with tool_share: 0; write more, such as 0.5'
        return ''
