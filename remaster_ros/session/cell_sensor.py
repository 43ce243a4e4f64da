"""The sensors of a cell file, and the markers that each of them measures."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from typing import Annotated

import msgspec
import numpy as np

from remaster_ros.collection.plausibility import SMALLEST_M
from remaster_ros.errors import did_you_mean
from remaster_ros.planning.expected_sensors import POSE_SIGMA_M, SIGMA_M
from remaster_ros.session.source_topics import POSE, source_problem
from remaster_ros.session.yaml_records import Bounds, Triple
from remaster_ros.types import FARTHEST_M

# From the resolution of an interferometer to a depth camera's noise.
NOISE = Bounds(1e-7, 0.05, 'm')
# A retroreflector or sphere is seen from further round than this.
VIEW = Bounds(3.5, 180.0, 'degrees')
# Twice what a reading may at least be off before it counts as that of another marker.
LEAST_APART_M = 2.0 * SMALLEST_M
LAST_MEMBER = 65535
"""The wire has 16 bits for the number of a marker in its rigid body."""


class CellSensor(msgspec.Struct, forbid_unknown_fields=True):
    """A sensor of a cell.

    Attributes
    ----------
    marker
        The marker it follows.
    further_markers
        Further markers that it measures, by name: in the same frame, each with its number in the
        rigid body; or, where it is `single_shot`, one after another while the arm stands.
    topic
        Where its readings are published (geometry_msgs/PointStamped, sensor frame); relative to
        the nodes' namespace, unless it begins with ``/``. Further markers have topics of their
        own below it, ``TOPIC/NAME``; each has a message for every frame in which one of them was
        seen, NaN where this one was not.
    rough_position_m
        Where it stands in the robot base, roughly.
    single_shot
        True for an instrument that measures on request.
    measure_service
        The service (std_srvs/Trigger) that makes it measure.
    max_angle_deg
        Largest angle between the tool's z axis and the line to the sensor at which the marker
        is seen.
    message_type
        Where `topic` is of a node that is not of this package, the type of its messages, one of
        `source_topics.MESSAGE_TYPES`.
    noise_m, pose_noise_m, frame_noise_m
        Standard deviations per axis that are expected: of a reading, of the error that all
        readings at one pose share, and of the one that the markers of one frame share. Only plans
        depend on them; a fit estimates its own.
    """

    marker: str
    topic: str
    rough_position_m: Annotated[Triple, Bounds(-FARTHEST_M, FARTHEST_M, 'm')]
    single_shot: bool = False
    measure_service: str = ''
    max_angle_deg: Annotated[float, VIEW] = 60.0
    noise_m: Annotated[float, NOISE] = SIGMA_M
    pose_noise_m: Annotated[float, Bounds(0.0, 0.05, 'm')] = POSE_SIGMA_M
    frame_noise_m: Annotated[float, Bounds(0.0, 0.05, 'm')] = 0.0
    further_markers: dict[str, int] = {}
    message_type: str = ''
    # No key of the file: the topic of such a node, whose readings are published on `topic` anew.
    source: str = ''

    def publish_anew(self, name: str) -> None:
        """Read the topic of a node that is not of this package; publish it as others are."""
        if self.message_type:
            self.source, self.topic = self.topic, f'{name}/marker'

    @property
    def markers(self) -> tuple[str, ...]:
        """Every marker that it measures, the one it follows first."""
        return (self.marker, *self.further_markers)

    @property
    def topics(self) -> dict[str, str]:
        """Marker -> where its readings are published."""
        further = {name: f'{self.topic}/{name}' for name in self.further_markers}
        return {self.marker: self.topic, **further}

    @property
    def pose_topic(self) -> str:
        """Where its full poses are published beside the positions; '' where it has none.

        The recorder takes these: position and orientation then come in one message.
        """
        return f'{self.topic}/pose' if self.message_type == POSE else ''

    def problem(self, where: str, markers: Mapping[str, Triple]) -> str:
        """Return what is wrong with it, being at `where` in the file; '' where nothing is."""
        return self._marker_problem(where, markers) or source_problem(
            where, self.source, self.message_type, single_shot=self.single_shot
        )

    def _marker_problem(self, where: str, markers: Mapping[str, Triple]) -> str:
        known = ', '.join(markers)
        if self.marker not in markers:
            meant = did_you_mean(self.marker, markers)
            return f'{where}.marker is {self.marker!r}; markers has {known}{meant}'
        where += '.further_markers'
        for name, number in self.further_markers.items():
            if name not in markers:
                return f'{where} has {name!r}; markers has {known}{did_you_mean(name, markers)}'
            if name == self.marker:
                return f'{where} has {name!r}, which is its marker already; leave it out there'
            if not re.fullmatch('[A-Za-z][A-Za-z0-9_]*', name):
                return (
                    f'{where}: {name!r} is the end of a topic; name the marker with letters, '
                    'digits and underscores'
                )
            if not 1 <= number <= LAST_MEMBER:
                return f'{where}.{name} is {number}; markers of a body have the numbers 1 to 65535'
            if list(self.further_markers.values()).count(number) > 1:
                return f'{where}: two markers have the number {number}; give each its own'
        for one, other in itertools.combinations(self.markers, 2):
            apart = float(np.linalg.norm(np.subtract(markers[one], markers[other])))
            if apart < LEAST_APART_M:
                return (
                    f'{where}: {one} and {other} are {1e3 * apart:.0f} mm apart; below '
                    f'{1e3 * LEAST_APART_M:.0f} mm one could be taken for the other'
                )
        return ''
