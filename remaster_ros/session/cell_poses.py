"""The keys of a cell file that say which poses are measured, and in which order."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees, pi, radians
from typing import Annotated

import msgspec
import numpy as np

from remaster_ros.collection.stopping_rule import StoppingGoal
from remaster_ros.planning.candidates import PoseRanges
from remaster_ros.planning.expected_sensors import ExpectedSensor, ToolBox
from remaster_ros.planning.planned_design import DesignSettings
from remaster_ros.session.yaml_records import Bounds, Triple

Range = tuple[float, float]
# No arm or tool of those that this is for reaches so far.
REACH = Bounds(-10.0, 10.0, 'm')
LATIN_HYPERCUBE, OPTIMAL = 'latin_hypercube', 'optimal'
NEAREST, FASTEST = 'nearest', 'fastest'
ALL, CHOSEN = 'all', 'chosen'
RANGES = ('azimuth_deg', 'radius_m', 'height_m', 'roll_deg')


class CellToolBox(msgspec.Struct, forbid_unknown_fields=True):
    """Where the tool is to be accurate: a box in base_link."""

    center_m: Triple
    size_m: Annotated[Triple, Bounds(0.0, 20.0, 'm', above=True)]


class CellPoses(msgspec.Struct, forbid_unknown_fields=True):
    """Ranges of the Latin hypercube of poses, which of them are visited, and in which order.

    Attributes
    ----------
    design
        ``optimal`` for the poses that tell the most, ``latin_hypercube`` for all of its poses.
    solutions
        ``all`` for each pose in all its free joint solutions, nearest first; ``chosen`` for the
        configurations that take the fewest minutes, a pose again where that is shorter.
    order
        ``nearest`` for the nearest pose next, ``fastest`` for the least travel.
    tool_share
        0 for the joint offsets alone, 1 for the tool's error alone, between them for a mixture.
    joint_std_deg, tool_std_m
        What is to be reached: an optimal design is made for it (without, for what the Latin
        hypercube reaches), and a collection ends where it is known to be.
    tool_box
        Where the tool's error counts; without, at all candidate poses.
    """

    azimuth_deg: Range = (0.0, 360.0)
    radius_m: Annotated[Range, Bounds(0.0, 10.0, 'm')] = (0.2, 0.5)
    height_m: Annotated[Range, REACH] = (0.4, 0.8)
    roll_deg: Range = (0.0, 360.0)
    design: str = OPTIMAL
    solutions: str = ALL
    order: str = NEAREST
    tool_share: Annotated[float, Bounds(0.0, 1.0)] = 0.0
    joint_std_deg: Annotated[float | None, Bounds(0.0, 5.0, 'degrees', above=True)] = None
    tool_std_m: Annotated[float | None, Bounds(0.0, 0.1, 'm', above=True)] = None
    tool_box: CellToolBox | None = None

    def ranges(self) -> PoseRanges:
        """Return the ranges in SI units."""
        return PoseRanges(
            azimuth_rad=(radians(self.azimuth_deg[0]), radians(self.azimuth_deg[1])),
            radius_m=self.radius_m,
            height_m=self.height_m,
            roll_rad=(radians(self.roll_deg[0]), radians(self.roll_deg[1])),
        )

    def settings(self, sensors: tuple[ExpectedSensor, ...], marker_std_m: float) -> DesignSettings:
        """Return what the design is chosen by, in SI units."""
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

    def stopping_goal(self) -> StoppingGoal:
        """Return what ends a collection, in SI units: all that counts, where it is stated."""
        optimal, stated = self.design == OPTIMAL, (self.joint_std_deg, self.tool_std_m)
        counts = (self.tool_share < 1.0, self.tool_share > 0.0)
        if optimal and any(one and value is None for one, value in zip(counts, stated)):
            # The design is made for what the Latin hypercube reaches, which no one has stated.
            return StoppingGoal()
        settings = self.settings((), 0.0)
        return StoppingGoal(settings.joint_std_rad, settings.tool_std_m, settings.box)

    def given(self) -> Mapping[str, object]:
        """Return the keys beside the ranges that are not as by default."""
        plain = CellPoses()
        return {
            key: getattr(self, key)
            for key in self.__struct_fields__
            if key not in RANGES and getattr(self, key) != getattr(plain, key)
        }

    def problem(self) -> str:
        """Return what is wrong between the keys; '' where nothing is."""
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
        """Return which key changes nothing beside the others; '' where each does."""
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
