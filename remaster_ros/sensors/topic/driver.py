# SPDX-License-Identifier: Apache-2.0
"""Topic as a sensor: positions that a node of another package publishes.

That node sends no heartbeat. Its state is judged from its messages: their rate, their age, and
whether the marker stands still in them.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from remaster_ros.collection.message_fields import unit_quaternion
from remaster_ros.errors import DeviceError
from remaster_ros.parameters import parameter
from remaster_ros.sensors.driver import SensorClock, SensorParameters, SensorState, StreamDriver
from remaster_ros.types import FloatArray, MarkerReading

POINT, POSE, MARKERS = (
    'geometry_msgs/msg/PointStamped',
    'geometry_msgs/msg/PoseStamped',
    'mocap4r2_msgs/msg/Markers',
)
WAIT_S = 0.05
"""Longest wait for a reading, s: a simulated world waits for this node, at most 0.15 s ahead."""
SILENT_S = 1.0
"""Time without a message, s of wall time, after which the topic counts as silent."""
JUDGED = 200
"""Largest number of messages for rate and standard deviation."""
JUDGED_S = 1.0
RATED_S = 3.0
"""Largest age of these messages, s by their stamps, for the standard deviation (`JUDGED_S`) and
the rate (`RATED_S`): messages at intervals above a second have a rate too."""
EARLY_S = 0.1
"""Largest lead of a stamp, s; a larger one means another clock. A simulated clock advances in
steps, and a message may come before the step: there the lead may be as large as the age."""
FROZEN = 10
"""Number of successive positions, identical to the last bit, that are no measurements."""


class Sighting(NamedTuple):
    """Marker in a message: time, frame, position and orientation."""

    stamp_s: float  # Stamp of the header, s; 0 if the sending node has set none
    frame: str
    # m, (3,); None if the message has no marker, or no measured position of the marker
    position: FloatArray | None
    # Unit quaternion x, y, z, w, (4,); None if the message has none, or one of another length, as
    # drivers without measured orientations send
    orientation: FloatArray | None = None


def _sighting(message: Any, place: Any, turn: Any = None) -> Sighting:
    """Sighting of a message; its position is None if `place` is None, not finite or the origin.

    `place`, `turn`: fields of the message with position and orientation.
    """
    stamp = message.header.stamp
    position = None
    if place is not None:
        measured = np.array([place.x, place.y, place.z], dtype=float)
        # Drivers send a marker that is out of sight as NaN, or as exactly the origin.
        position = measured if np.all(np.isfinite(measured)) and np.any(measured) else None
    return Sighting(
        stamp.sec + 1e-9 * stamp.nanosec,
        message.header.frame_id,
        position,
        None if turn is None else unit_quaternion(turn),
    )


def _marker(message: Any, marker: str) -> Any:
    """Translation (fields x, y, z) of the marker with a name or number; None if there is none.

    ``message``: with a list of markers; ``marker``: the name, or the number as text.
    """
    for entry in message.markers:
        if marker in (entry.marker_name, str(entry.marker_index)):
            return entry.translation
    return None


READERS: dict[str, Callable[[Any, str], Sighting]] = {
    POINT: lambda message, marker: _sighting(message, message.point),
    POSE: lambda message, marker: _sighting(
        message, message.pose.position, message.pose.orientation
    ),
    MARKERS: lambda message, marker: _sighting(message, _marker(message, marker)),
}
"""Message type -> its reader; the second argument is the name or the number of the marker."""


@dataclass(frozen=True)
class Parameters(SensorParameters):
    """Parameters of the node that reads a topic; the topic is in the cell file."""

    select: str = parameter(
        '', "name or number of the marker in mocap4r2_msgs/msg/Markers; empty for the cell's name"
    )
    stamps: str = parameter(
        'header',
        'what counts as the time of capture; arrival where the other host has another clock, and '
        'the arm stands still for far longer than a message takes',
        choices=('header', 'arrival'),
    )
    max_age_s: float = parameter(
        1.0, 'an older message, by its stamp, is left out', unit='s', low=0.01, high=60.0
    )
    always_sends: bool = parameter(
        False,
        'the other node sends messages also while the marker is hidden: the arm waits where none '
        'come; false for one that sends only what it sees',
    )
    min_rate_hz: float = parameter(
        5.0, 'fewer messages are reported as too few', unit='Hz', low=0.1, high=1000.0
    )


class TopicDriver(StreamDriver):
    """Driver of a sensor on a topic; the node subscribes and passes each message to `take`."""

    parameters_type = Parameters
    device = 'topic'

    def __init__(self, parameters: Parameters, clock: SensorClock) -> None:
        self.p, self._clock = parameters, clock
        self._early_s = parameters.max_age_s if clock.simulated else EARLY_S
        self._readings: queue.SimpleQueue[tuple[MarkerReading, float]] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._recent: deque[MarkerReading] = deque(maxlen=JUDGED)
        self._counts: Counter[str] = Counter()
        self._came_wall: float | None = None
        self._stamp_s, self._age_s = 0.0, 0.0
        self._frame = self._trouble = ''
        self._hidden = False
        self.topic = self._type = self._marker = ''
        self._on_tool = False
        self._publishers: Callable[[], Sequence[tuple[str, str]]] = tuple

    def follow(
        self,
        topic: str,
        message_type: str,
        marker: str,
        publishers: Callable[[], Sequence[tuple[str, str]]],
        on_tool: bool = False,
    ) -> None:
        """Set the topic that the node subscribes to.

        Parameters
        ----------
        topic, message_type
            As in the cell file.
        marker
            Name of the marker in the cell.
        publishers
            Returns node and message type of each present publisher of the topic.
        on_tool
            Whether the sensor is on the tool: a position without an orientation is then of no use.
        """
        self.topic, self._type, self._marker = topic, message_type, self.p.select or marker
        self._publishers, self._on_tool = publishers, on_tool

    def open(self) -> None:
        """Check that a node publishes the topic, with its message type; else DeviceError."""
        if problem := self._unpublished():
            raise DeviceError(problem)

    def close(self) -> None:
        """Do nothing: the subscription is the node's."""

    def _unpublished(self) -> str:
        """Reason why the topic has no message of the expected type; '' if a node sends it."""
        found = self._publishers()
        if any(kind == self._type for _, kind in found):
            return ''
        if not found:
            return f'no node publishes {self.topic}; is its driver running, in this namespace?'
        node, kind = found[0]
        return (
            f'{node} publishes {self.topic} as {kind}, message_type of the cell file is '
            f'{self._type}; correct that'
        )

    def take(self, message: Any) -> None:
        """Process a message; called from any thread.

        It becomes a reading for `read`, unless it is left out (`_refused`) or has no position;
        both are counted. Its time of capture is its stamp, or its arrival by the parameter
        `stamps`.
        """
        found, now = READERS[self._type](message, self._marker), self._clock.now()
        arrival = self.p.stamps == 'arrival' or found.stamp_s == 0.0
        stamp_s = now if arrival else found.stamp_s
        with self._lock:
            self._came_wall = time.monotonic()
            self._age_s = now - stamp_s
            self._frame = self._frame or found.frame
            reason, self._trouble = self._refused(found, stamp_s)
            self._hidden = not reason and found.position is None
            if reason or found.position is None:
                self._counts[reason or 'occluded'] += 1
                return
            self._stamp_s = stamp_s
            reading = MarkerReading(stamp_s, found.position, orientation=found.orientation)
            self._recent.append(reading)
        self._readings.put((reading, now))

    def _refused(self, found: Sighting, stamp_s: float) -> tuple[str, str]:
        """Reason why a message is left out, as a word and as a sentence; '' if it is not.

        In this order: another frame, a stamp ahead or older than `max_age_s`, no orientation on
        the tool, a stamp that does not advance (without a sentence: no fault). ``stamp_s``: time
        of capture, s.
        """
        if found.frame != self._frame:
            return 'other_frame', (
                f'{self.topic} was in frame {self._frame!r} and is in {found.frame!r} now; one '
                'marker needs one frame: start this node again where the new one is meant'
            )
        if not -self._early_s <= self._age_s <= self.p.max_age_s:
            way = 'behind' if self._age_s > 0.0 else 'ahead of'
            return 'other_clock', (
                f'stamps of {self.topic} are {abs(self._age_s):.2f} s {way} the clock of this '
                'host; synchronise the clocks (chrony), or set the parameter stamps to arrival'
            )
        if self._on_tool and found.position is not None and found.orientation is None:
            return 'no_orientation', (
                f'the poses on {self.topic} have no orientation, without which a sensor on the '
                'tool tells nothing; have its driver publish it'
            )
        if stamp_s <= self._stamp_s:
            # A repeated measurement, or one out of order, is counted and no fault.
            return 'repeated', ''
        return '', ''

    def read(self) -> MarkerReading | None:
        """Next position; None without one in `WAIT_S`; see `StreamDriver.read`."""
        try:
            reading, self.received_s = self._readings.get(timeout=WAIT_S)
        except queue.Empty:
            return None
        return reading

    def state(self) -> SensorState:
        """State by the messages received, and by the publishers once silent for `SILENT_S`.

        Not ready if the last message was refused with a fault, or if the positions repeat
        (`FROZEN`). A silent topic is not ready if no node publishes it with its type, or if
        the parameter `always_sends` is set. A hidden marker, or a low rate, is a trouble that
        leaves it ready.
        """
        with self._lock:
            last_wall, counts = self._came_wall, dict(self._counts)
            trouble, hidden, age_s = self._trouble, self._hidden, self._age_s
            still, rated = (
                [r for r in self._recent if r.stamp_s > self._stamp_s - back_s]
                for back_s in (JUDGED_S, RATED_S)
            )
            same = [r.position for r in list(self._recent)[-FROZEN:]]
        ready, level = True, 'ok'
        rate_hz, std_m = _rate_hz(rated), _std_m(still)
        silent_s = np.inf if last_wall is None else time.monotonic() - last_wall
        if silent_s > SILENT_S:
            trouble = self._unpublished()
            # A detector that sends only visible markers may see the marker at the next
            # configuration.
            ready = hidden = not (trouble or self.p.always_sends)
            ago = 'yet' if last_wall is None else f'for {silent_s:.1f} s'
            remedy = 'is the marker in view?'
            if not hidden:
                remedy = (
                    'look at its driver (or set always_sends to false, where it sends only what '
                    'it sees)'
                )
            trouble = trouble or f'nothing on {self.topic} {ago}: {remedy}'
        elif trouble:
            ready = False
        elif len(same) == FROZEN and not np.any(np.ptp(same, axis=0)):
            ready = False
            trouble = (
                f'{self.topic} repeats one position to the last bit, which no measurement does; '
                'look at its driver'
            )
        elif hidden:
            trouble = f'the marker is not in view ({self.topic})'
        elif rate_hz is not None and rate_hz < self.p.min_rate_hz:
            level = 'warn'
            trouble = (
                f'{self.topic} comes at {rate_hz:.1f} Hz, fewer than min_rate_hz '
                f'({self.p.min_rate_hz:g}); prolong dwell_s of the recorder, or look at its driver'
            )
        if trouble and level == 'ok':
            level = 'warn' if ready else 'error'
        values = {
            'source': self.topic,
            'frame': self._frame,
            'rate_hz': 'unknown' if rate_hz is None else f'{rate_hz:.1f}',
            'age_s': f'{age_s:.3f}',
            'std_mm': 'unknown' if std_m is None else f'{1e3 * std_m:.3f}',
            'fault': 'marker' if hidden else 'none',
            **{f'dropped_{reason}': count for reason, count in sorted(counts.items())},
        }
        return SensorState(ready, trouble, 'ok', level, values)


def _rate_hz(recent: Sequence[MarkerReading]) -> float | None:
    """Rate of the messages, Hz, by the median interval; None for fewer than two.

    The median excludes intervals in which the marker was hidden.
    """
    if len(recent) < 2:
        return None
    return float(1.0 / np.median(np.diff([reading.stamp_s for reading in recent])))


def _std_m(recent: Sequence[MarkerReading]) -> float | None:
    """Largest standard deviation of an axis, m: a measure of the marker's stillness.

    None for fewer than two readings.
    """
    if len(recent) < 2:
        return None
    return float(np.max(np.std([r.position for r in recent], axis=0, ddof=1)))
