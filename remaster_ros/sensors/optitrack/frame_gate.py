# SPDX-License-Identifier: Apache-2.0
"""From a frame of data to one marker reading, or the reason why not; no sockets, no clocks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack.natnet_frame import (
    MODEL_FILLED,
    NOT_LIVE,
    OCCLUDED,
    UNLABELED,
    Frame,
    LabeledMarker,
)
from remaster_ros.types import FARTHEST_M, FloatArray

REORDER_WINDOW = 16
"""Largest step back of a late frame's number; a larger step means a restarted stream."""
MOST_LOST = 10_000_000
"""Largest step forward of the frame number, half a day of frames; a larger step means another
stream or damage."""
RESTART_S = 1.0
"""Largest step back of the frame time, s; a larger step means a restarted stream too."""
MAX_AGE_S = 10.0
"""Largest age of a reading when it is sent, s; a larger age means stamps of another clock."""
FROZEN_FRAMES = 10
"""Number of successive readings, identical to the last bit, that are no measurements."""
JUMP_MARGIN_M = 0.005
"""Movement between frames allowed in addition to `max_speed_m_s`, m; far above any noise."""


class Dropped(StrEnum):
    """Reason why a datagram or a frame gave no reading."""

    FOREIGN = 'foreign'
    """Datagram from an address that is not the configured server's, or from another port of the
    server than the believed one (`frame_source`)."""
    PROBATION = 'probation'
    """Frame of a source that is not believed yet: it must be the only source for a moment."""
    OVERRUN = 'overrun'
    """Backlog too large: this computer cannot keep up."""
    MALFORMED = 'malformed'
    UNRESOLVED = 'unresolved'
    """The bitstream version or the marker's id is not known (yet)."""
    DUPLICATE = 'duplicate'
    OUT_OF_ORDER = 'out_of_order'
    STALE = 'stale'
    """The frame's time did not advance."""
    NOT_LIVE = 'not_live'
    """Motive plays a recording."""
    NOT_PRESENT = 'not_present'
    AMBIGUOUS = 'ambiguous'
    """The marker is there twice; with `lone_marker`, another marker is in view."""
    UNLABELLED = 'unlabelled'
    OCCLUDED = 'occluded'
    MODEL_FILLED = 'model_filled'
    FROZEN = 'frozen'
    """Position identical to the last bit in successive frames: no measurement."""
    JUMP = 'jump'
    """Position further from the last reading than the marker could have moved."""
    IMPLAUSIBLE = 'implausible'
    """Distance or age larger than any bar's reading can have."""
    DISAGREEMENT = 'disagreement'
    """A third-party client has read another position from the same datagram."""


@dataclass(frozen=True)
class MarkerChoice:
    """Choice of the labelled marker that is the calibration marker."""

    rigid_body: str = ''  # Name of the rigid body in Motive; '' for the only one
    member: int = 1  # Number of the marker within that body, from 1
    # Id on the wire, ``asset id << 16 | member``; overrides the two above
    marker_id: int | None = None
    # A single sphere without a rigid body: the only marker in view is used, and none while there
    # are two. Overrides the three above.
    lone_marker: bool = False
    max_speed_m_s: float = 5.0  # A reading that implies a faster move is dropped

    def __post_init__(self) -> None:
        """Raises InputError for values that can never match."""
        if not 1 <= self.member < 1 << 16:
            raise InputError(f'member: {self.member} is not 1 to 65535 (counted from 1)')
        if not self.max_speed_m_s > 0:
            raise InputError(f'max_speed_m_s: {self.max_speed_m_s} is not above 0')


@dataclass(frozen=True, eq=False)
class MarkerSample:
    """Measured position of the calibration marker."""

    frame_number: int
    timestamp_s: float  # Time of the frame on the server, s since the stream started
    # Time from exposure (or, without such a clock, from the data's arrival at the server) to
    # transmission, s; before 3.0 the server's own estimate of its latency
    age_s: float
    position: FloatArray  # In the sensor's frame N, m, (3,)
    received_s: float  # When the datagram arrived here, by the clock given to the client, s
    marker: str = ''  # Name of a further marker; '' for the calibration marker itself


@dataclass(kw_only=True)
class GateCounts:
    """Counts of accepted and dropped frames of a gate."""

    # Count by reason; every reason is a key from the start
    dropped: dict[Dropped, int] = field(default_factory=lambda: dict.fromkeys(Dropped, 0))
    # Number of frames, and of accepted readings
    frames: int = 0
    accepted: int = 0
    lost: int = 0  # Number of missing frame numbers
    restarts: int = 0  # Number of restarts of the frame numbers
    last_reason: Dropped | None = None  # Reason of the last frame's drop; None if it was accepted
    marker_id: int | None = None  # Id on the wire; None while unknown, and for a lone marker
    problem: str = ''  # Reason why the marker cannot be identified, with the remedy; '' if it can
    labels: tuple[int, ...] = ()  # The first labels of the last frame


class MarkerGate:
    """Filter that takes one marker's readings from frames, and counts why others are dropped."""

    def __init__(self, choice: MarkerChoice, counts: GateCounts) -> None:
        self._choice = choice
        self.counts = counts
        self._last_number: int | None = None
        self._last_timestamp = -math.inf
        self._last_reading: MarkerSample | None = None
        # Whether the stream was restarted since the last reading.
        self._restarted = False
        self._repeats = 0
        self.forget_assets()

    @property
    def resolved(self) -> bool:
        """Whether the marker's id is known, so that frames can be searched for it."""
        return self._choice.lone_marker or self.counts.marker_id is not None

    def forget_assets(self) -> None:
        """Discard the server's rigid bodies: the marker's id is that of the choice, or unknown."""
        self.counts.marker_id = None if self._choice.lone_marker else self._choice.marker_id
        self.counts.problem = '' if self.resolved else 'the server has not named its rigid bodies'

    def name_assets(self, assets: Mapping[str, int]) -> None:
        """Find the marker's id among the rigid bodies that the server streams, id by name.

        If it is not found, `counts.problem` says why. A given id or a lone marker is kept.
        """
        self.forget_assets()
        if self.resolved:
            return
        name, names = self._choice.rigid_body, ', '.join(sorted(assets)) or 'none'
        if not name and len(assets) == 1:
            (name,) = assets
        if name in assets:
            self.counts.marker_id = assets[name] << 16 | self._choice.member
            self.counts.problem = ''
        elif name:
            self.counts.problem = f'no rigid body {name!r}; the server streams: {names}'
        elif assets:
            self.counts.problem = f'several rigid bodies ({names}): set rigid_body to one of them'
        else:
            self.counts.problem = (
                'the server streams no rigid body: create one from the markers in Motive and '
                'switch its streaming on, or set lone_marker for a single sphere'
            )

    def drop(self, reason: Dropped) -> None:
        """Count a datagram dropped before it became a frame, by its reason."""
        self.counts.dropped[reason] += 1

    def pass_over(self, reason: Dropped) -> None:
        """Count a whole frame, and the reason why it is not searched for the marker.

        It is not remembered: later frames are not compared with it.
        """
        self.counts.frames += 1
        self.counts.dropped[reason] += 1
        self.counts.last_reason = reason

    def begin_source(self) -> None:
        """Forget the frames before, as later ones are of another source."""
        self._last_number = None
        self._last_timestamp = -math.inf
        self._last_reading = None
        self._repeats = 0

    def admit(self, frame: Frame, received_s: float, ticks_per_s: int) -> MarkerSample | None:
        """Return the marker's reading in a frame; None if it is dropped, with the reason counted.

        ``frame``: decoded; ``received_s``: time of arrival, s; ``ticks_per_s``: frequency of
        the frame's stamps; 0 before NatNet 3.
        """
        self.counts.frames += 1
        found = self._order(frame) or self._find(frame)
        if isinstance(found, LabeledMarker):
            reading = _sample(frame, found, received_s, ticks_per_s)
            found = _implausible(reading) or self._jump(reading) or self._frozen(reading) or found
        if isinstance(found, Dropped):
            self.counts.dropped[found] += 1
            self.counts.last_reason = found
            return None
        self._last_reading, self._restarted = reading, False
        self.counts.accepted += 1
        self.counts.last_reason = None
        return reading

    def disown(self, reason: Dropped) -> None:
        """Withdraw the last accepted reading, counted with a reason.

        The next reading is compared with none before.
        """
        self.counts.accepted -= 1
        self.counts.dropped[reason] += 1
        self.counts.last_reason = reason
        self._last_reading = None

    def _order(self, frame: Frame) -> Dropped | None:
        """Reason to drop a frame (not live, duplicate, out of order, stale), or None.

        Counts lost frames and restarts, and remembers the frame: called once per frame. A restart
        of the server is a number ahead by more than `MOST_LOST` or behind by more than
        `REORDER_WINDOW`, or a timestamp that goes back by more than `RESTART_S`; stale is one that
        does not advance.
        """
        if frame.params & NOT_LIVE:
            return Dropped.NOT_LIVE
        if self._last_number is not None:
            step = frame.number - self._last_number
            back_s = self._last_timestamp - frame.timestamp
            if not -REORDER_WINDOW <= step <= MOST_LOST or back_s > RESTART_S:
                self.counts.restarts += 1
                self._last_timestamp = -math.inf
                self._restarted = True
            elif step == 0:
                return Dropped.DUPLICATE
            elif step < 0:
                return Dropped.OUT_OF_ORDER
            else:
                self.counts.lost += step - 1
        self._last_number = frame.number
        if frame.timestamp <= self._last_timestamp:
            return Dropped.STALE
        self._last_timestamp = frame.timestamp
        return None

    def _find(self, frame: Frame) -> LabeledMarker | Dropped:
        """The marker in a frame, or the reason why not; never occluded or model-filled.

        A lone marker is the only marker that is neither, labelled or not; another marker is
        found by its id, and must be labelled. Sets `counts.labels`.
        """
        self.counts.labels = tuple(marker.id for marker in frame.labeled_markers[:8])
        if self._choice.lone_marker:
            found = [m for m in frame.labeled_markers if not m.params & (OCCLUDED | MODEL_FILLED)]
        elif self.counts.marker_id is not None:
            found = [m for m in frame.labeled_markers if m.id == self.counts.marker_id]
        else:
            return Dropped.UNRESOLVED
        if len(found) != 1:
            return Dropped.AMBIGUOUS if found else Dropped.NOT_PRESENT
        params = found[0].params
        if params & OCCLUDED:
            return Dropped.OCCLUDED
        if params & MODEL_FILLED:
            return Dropped.MODEL_FILLED
        if params & UNLABELED and not self._choice.lone_marker:
            return Dropped.UNLABELLED
        return found[0]

    def _jump(self, reading: MarkerSample) -> Dropped | None:
        """`Dropped.JUMP` if the marker is farther from the last reading than its speed allows.

        None if it is not, or if there is no last reading.
        """
        last = self._last_reading
        if last is None:
            return None
        moved = float(np.linalg.norm(reading.position - last.position))
        # A damaged frame number looks like a restart, during which the marker does not jump:
        # across a restart, whose two times are unrelated, the times of arrival count.
        elapsed = reading.timestamp_s - last.timestamp_s
        if self._restarted:
            elapsed = reading.received_s - last.received_s
            if elapsed < 0.0:
                # The clock of arrival was set back, too.
                return None
        if moved > JUMP_MARGIN_M + self._choice.max_speed_m_s * elapsed:
            return Dropped.JUMP
        return None

    def _frozen(self, reading: MarkerSample) -> Dropped | None:
        """`Dropped.FROZEN` if the position repeats the last readings to the last bit, else None.

        From the `FROZEN_FRAMES`-th repeat on. Counts repeats: called once per reading.
        """
        last = self._last_reading
        same = last is not None and np.array_equal(reading.position, last.position)
        self._repeats = self._repeats + 1 if same else 0
        return Dropped.FROZEN if self._repeats >= FROZEN_FRAMES else None


def _implausible(reading: MarkerSample) -> Dropped | None:
    """`Dropped.IMPLAUSIBLE` beyond `FARTHEST_M` or older than `MAX_AGE_S`; else None."""
    is_in_range = np.max(np.abs(reading.position)) <= FARTHEST_M
    return None if is_in_range and reading.age_s <= MAX_AGE_S else Dropped.IMPLAUSIBLE


def _sample(
    frame: Frame, marker: LabeledMarker, received_s: float, ticks_per_s: int
) -> MarkerSample:
    """Sample of a marker in a frame, with its age at transmission, s.

    The age is the time since exposure or, without its time, since the data arrived at the
    server; 0 if the frame has neither time. Without a clock of the server it is the server's
    own estimate of its latency. ``received_s``: when this computer got the frame, s;
    ``ticks_per_s``: of the server's clock, 0 for none.
    """
    age_s = max(frame.software_latency, 0.0)
    if ticks_per_s:
        # USB cameras have no clock and send no exposure time.
        begin = frame.mid_exposure or frame.data_received
        age_s = max(frame.transmitted - begin, 0) / ticks_per_s if begin else 0.0
    return MarkerSample(
        frame_number=frame.number,
        timestamp_s=frame.timestamp,
        age_s=age_s,
        position=np.array(marker.position),
        received_s=received_s,
    )
