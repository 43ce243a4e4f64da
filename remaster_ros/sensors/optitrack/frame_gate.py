# SPDX-License-Identifier: Apache-2.0
"""From a frame of data to one marker reading, or the reason why not; no sockets, no clocks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack.natnet import (
    MODEL_FILLED,
    NOT_LIVE,
    OCCLUDED,
    UNLABELED,
    Frame,
    LabeledMarker,
)
from remaster_ros.types import FARTHEST_M, FloatArray

# Whose frames are believed: one source, an address with a port; pure, no sockets, no clocks.
#
# From which port a server sends its frames is not documented and changes when it is started
# again, so the port cannot be configured. It is learnt: the source of the first frames that
# follow an answer of the command channel gets the *lock*, if it is the only one that sends for a
# moment. While a source holds the lock, every other one is refused, whatever it sends. Once the
# holder has been silent the lock is free: the same source has it back with its next frame,
# another one gets it in the same way as the first did, after a new answer.
#
# What cannot be detected: datagrams with the server's own address *and* port. A program on
# another computer can forge both with raw sockets, unless the network drops foreign addresses; a
# program on the server itself can take over a port that the server has closed.


Source = tuple[str, int]
"""An address and a port."""

PROBATION_S = 0.2
"""A source must have been the only one for so long: six frames at 30 Hz."""
PROBATION_FRAMES = 3
REFUSED_FOR_S = 30.0
"""A source that sent beside the believed one is refused until it was silent for so long."""
REMEMBERED = 64
"""Sources; a forger with a new port for every frame must not fill the memory."""


class SourceVerdict(Enum):
    """What to do with a frame."""

    BELIEVED = 'believed'
    PROBATION = 'probation'
    """No source has the lock yet; the frame counts towards it and gives no reading."""
    FOREIGN = 'foreign'


@dataclass
class _Other:
    """A source without the lock: when it first and last sent, s, and how many frames."""

    first_s: float
    last_s: float
    frames: int = 1
    beside: bool = False
    """It sent while another source had the lock, so it is not that one under a new port."""


class SourceLock:
    """Decide whose frames are believed.

    Times are of one monotonic clock, s.

    ``silence_s``: A source that sent no whole frame for longer counts as silent.
    Attributes: ``source``: the source with the lock; None while there is none; ``taken``: how
    often the lock was given to another source than before.
    """

    def __init__(self, silence_s: float) -> None:
        self._silence_s = silence_s
        self.source: Source | None = None
        self._last: Source | None = None
        self.taken = 0
        self._last_frame_s = 0.0
        self._answered = False
        self._others: dict[Source, _Other] = {}

    def answer(self) -> None:
        """Note that the command channel has answered: frames from now on may get the lock."""
        self._answered = True

    def release_if_silent(self, now_s: float) -> bool:
        """Free the lock after a silence of its holder; return whether it was freed now."""
        if self.source is None or now_s - self._last_frame_s <= self._silence_s:
            return False
        self.source = None
        self._answered = False
        return True

    def is_refused(self, source: Source, now_s: float) -> bool:
        """Return whether nothing of this source counts, decoded or not; note that it sent."""
        if source == self.source:
            return False
        if self.source is not None:
            self._note(source, now_s)
            return True
        other = self._others.get(source)
        if other is None or not other.beside or now_s - other.last_s > REFUSED_FOR_S:
            return False
        other.last_s = now_s
        return True

    def judge(self, source: Source, now_s: float) -> SourceVerdict:
        """Decide on a whole frame, and give the lock where it is due."""
        if self.is_refused(source, now_s):
            return SourceVerdict.FOREIGN
        if source == self.source:
            self._last_frame_s = now_s
            for other in self._others.values():
                other.beside = other.beside or now_s - other.first_s > PROBATION_S
            return SourceVerdict.BELIEVED
        if source == self._last:
            self.source, self._last_frame_s = source, now_s
            return SourceVerdict.BELIEVED
        if not self._answered:
            return SourceVerdict.PROBATION
        known = self._note(source, now_s)
        alone = len(self._candidates(now_s)) == 1
        if not alone or known.frames < PROBATION_FRAMES or now_s - known.first_s < PROBATION_S:
            return SourceVerdict.PROBATION
        del self._others[source]
        self.source = self._last = source
        self._last_frame_s = now_s
        self.taken += 1
        return SourceVerdict.BELIEVED

    def rivals(self, now_s: float) -> tuple[Source, ...]:
        """Return the refused sources that sent lately, while or after another had the lock."""
        return tuple(
            source
            for source, other in list(self._others.items())
            if (self.source is not None or other.beside) and now_s - other.last_s <= REFUSED_FOR_S
        )

    def contestants(self, now_s: float) -> tuple[Source, ...]:
        """Return the sources of which one could get the lock, if there are several; else none."""
        candidates = self._candidates(now_s) if self.source is None else []
        return tuple(candidates) if len(candidates) > 1 else ()

    def _candidates(self, now_s: float) -> list[Source]:
        return [
            source
            for source, other in list(self._others.items())
            if not other.beside and now_s - other.last_s <= self._silence_s
        ]

    def _note(self, source: Source, now_s: float) -> _Other:
        known = self._others.get(source)
        patience_s = REFUSED_FOR_S if known is not None and known.beside else self._silence_s
        if known is None or now_s - known.last_s > patience_s:
            self._others.pop(source, None)
            if len(self._others) >= REMEMBERED:
                oldest = min(self._others.items(), key=lambda o: (o[1].beside, o[1].last_s))
                del self._others[oldest[0]]
            known = self._others[source] = _Other(now_s, now_s)
        else:
            known.last_s = now_s
            known.frames += 1
        return known


def describe(source: Source) -> str:
    """Write a source as address:port."""
    return f'{source[0]}:{source[1]}'


REORDER_WINDOW = 16
"""A frame number further back than this is a restarted stream, not a late datagram."""
MOST_LOST = 10_000_000
"""A frame number further ahead, half a day of frames, is another stream's or damaged."""
RESTART_S = 1.0
"""A frame time further back than this is a restarted stream too."""
MAX_AGE_S = 10.0
"""A reading that claims to be older when it is sent has stamps of another clock."""
FROZEN_FRAMES = 10
"""So many readings in a row that are the same to the last bit are no measurements."""
JUMP_MARGIN_M = 0.005
"""Far above any noise; what a marker may move between frames beyond `max_speed_m_s`."""


class Dropped(StrEnum):
    """Why a datagram or a frame gave no reading."""

    FOREIGN = 'foreign'
    """It came from an address that is not the configured server's, or from a port of it that is
    not the believed one (`frame_source`)."""
    PROBATION = 'probation'
    """Its source is not believed yet: it must be the only one for a moment."""
    OVERRUN = 'overrun'
    """This computer cannot keep up: too much waits to be decoded."""
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
    """The same to the last bit in one frame after the other: no measurement."""
    JUMP = 'jump'
    """Further from the last reading than the marker could have moved."""
    IMPLAUSIBLE = 'implausible'
    """Further away, or longer on its way, than any bar's reading can be."""
    DISAGREEMENT = 'disagreement'
    """A third-party client read something else from the same datagram."""


@dataclass(frozen=True)
class MarkerChoice:
    """Which labelled marker is the calibration marker."""

    rigid_body: str = ''  # Name of the rigid body in Motive; '' for the only one
    member: int = 1  # Number of the marker within that body, from 1
    # Id on the wire, ``asset id << 16 | member``; overrides the two above
    marker_id: int | None = None
    # A single sphere that belongs to no rigid body: take the only marker in view, and nothing
    # while there are two. Overrides the three above.
    lone_marker: bool = False
    max_speed_m_s: float = 5.0  # A reading that implies a faster move is dropped

    def __post_init__(self) -> None:
        """Refuse values that can never match."""
        if not 1 <= self.member < 1 << 16:
            raise InputError(f'member: {self.member} is not 1 to 65535 (counted from 1)')
        if not self.max_speed_m_s > 0:
            raise InputError(f'max_speed_m_s: {self.max_speed_m_s} is not above 0')


@dataclass(frozen=True, eq=False)
class MarkerSample:
    """A measured position of the calibration marker."""

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
    """What a gate has let through and dropped."""

    # Count by reason; every reason is a key from the start
    dropped: dict[Dropped, int] = field(default_factory=lambda: dict.fromkeys(Dropped, 0))
    # Frames seen, readings let through
    frames: int = 0
    accepted: int = 0
    lost: int = 0  # Frame numbers that never came
    restarts: int = 0  # How often the frame numbers began again
    last_reason: Dropped | None = None  # Why the latest frame was dropped; None if it was accepted
    marker_id: int | None = None  # Id on the wire; None while unknown, and for a lone marker
    problem: str = ''  # Why the marker cannot be identified, with the remedy; '' if it can
    labels: tuple[int, ...] = ()  # The first labels of the last frame


class MarkerGate:
    """Lets through the readings of one marker and counts everything else with its reason."""

    def __init__(self, choice: MarkerChoice, counts: GateCounts) -> None:
        self._choice = choice
        self.counts = counts
        self._last_number: int | None = None
        self._last_timestamp = -math.inf
        self._last_reading: MarkerSample | None = None
        # Whether the stream has begun again since that reading.
        self._restarted = False
        self._repeats = 0
        self.forget_assets()

    @property
    def resolved(self) -> bool:
        """Whether a frame can be searched for the marker."""
        return self._choice.lone_marker or self.counts.marker_id is not None

    def forget_assets(self) -> None:
        """Drop what is known of the server's rigid bodies."""
        self.counts.marker_id = None if self._choice.lone_marker else self._choice.marker_id
        self.counts.problem = '' if self.resolved else 'the server has not named its rigid bodies'

    def name_assets(self, assets: Mapping[str, int]) -> None:
        """Find the marker's id among the rigid bodies that the server streams, id by name."""
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
        """Count something dropped before it became a frame."""
        self.counts.dropped[reason] += 1

    def pass_over(self, reason: Dropped) -> None:
        """Count a whole frame that is not looked at; it is compared with no other."""
        self.counts.frames += 1
        self.counts.dropped[reason] += 1
        self.counts.last_reason = reason

    def begin_source(self) -> None:
        """Compare the frames to come with none before: they are another source's."""
        self._last_number = None
        self._last_timestamp = -math.inf
        self._last_reading = None
        self._repeats = 0

    def admit(self, frame: Frame, received_s: float, ticks_per_s: int) -> MarkerSample | None:
        """Return the reading in a frame, or None and count why.

        ``frame``: as decoded; ``received_s``: when it arrived, s; ``ticks_per_s``: frequency of
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
        """Take back the last reading, which turned out not to be one."""
        self.counts.accepted -= 1
        self.counts.dropped[reason] += 1
        self.counts.last_reason = reason
        self._last_reading = None

    def _order(self, frame: Frame) -> Dropped | None:
        """Follow the frame numbers and the time."""
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
        """Find the marker; never one that is occluded or filled in by the model."""
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
        last = self._last_reading
        if last is None:
            return None
        moved = float(np.linalg.norm(reading.position - last.position))
        # A damaged frame number looks like a restart, which takes the marker nowhere: across one,
        # where two times have nothing in common, that of arrival counts.
        elapsed = reading.timestamp_s - last.timestamp_s
        if self._restarted:
            elapsed = reading.received_s - last.received_s
            if elapsed < 0.0:
                # This clock was set back, too.
                return None
        if moved > JUMP_MARGIN_M + self._choice.max_speed_m_s * elapsed:
            return Dropped.JUMP
        return None

    def _frozen(self, reading: MarkerSample) -> Dropped | None:
        last = self._last_reading
        same = last is not None and np.array_equal(reading.position, last.position)
        self._repeats = self._repeats + 1 if same else 0
        return Dropped.FROZEN if self._repeats >= FROZEN_FRAMES else None


def _implausible(reading: MarkerSample) -> Dropped | None:
    near = np.max(np.abs(reading.position)) <= FARTHEST_M
    return None if near and reading.age_s <= MAX_AGE_S else Dropped.IMPLAUSIBLE


def _sample(
    frame: Frame, marker: LabeledMarker, received_s: float, ticks_per_s: int
) -> MarkerSample:
    age_s = max(frame.software_latency, 0.0)
    if ticks_per_s:
        # USB cameras have no clock of their own, and leave the exposure out.
        begin = frame.mid_exposure or frame.data_received
        age_s = max(frame.transmitted - begin, 0) / ticks_per_s if begin else 0.0
    return MarkerSample(
        frame_number=frame.number,
        timestamp_s=frame.timestamp,
        age_s=age_s,
        position=np.array(marker.position),
        received_s=received_s,
    )
