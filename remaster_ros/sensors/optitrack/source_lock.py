# SPDX-License-Identifier: Apache-2.0
"""Source whose frames are believed: one address with a port; pure, no sockets, no clocks.

From which port a server sends its frames is not documented and changes when it is started
again, so the port cannot be configured. It is learnt: the source of the first frames that
follow an answer of the command channel gets the *lock*, if it is the only one that sends for a
moment. While a source holds the lock, every other one is refused, whatever it sends. Once the
holder has been silent the lock is free: the same source has it back with its next frame,
another one gets it in the same way as the first did, after a new answer.

What cannot be detected: datagrams with the server's own address *and* port. A program on
another computer can forge both with raw sockets, unless the network drops foreign addresses; a
program on the server itself can take over a port that the server has closed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

Source = tuple[str, int]
"""Address and port."""
PROBATION_S = 0.2
"""Time, s, for which a source must have been the only one: six frames at 30 Hz."""
PROBATION_FRAMES = 3
REFUSED_FOR_S = 30.0
"""Silence, s, until which a source is refused that sent at the same time as the believed one."""
REMEMBERED = 64
"""Largest number of sources: a forger with a new port for every frame must not fill the memory."""


class SourceVerdict(Enum):
    """Verdict on the source of a frame."""

    BELIEVED = 'believed'
    PROBATION = 'probation'
    """No source has the lock yet; the frame counts towards a lock and gives no reading."""
    FOREIGN = 'foreign'


@dataclass
class _OtherSource:
    """Source without the lock: times of its first and last frame, s, and number of frames."""

    first_s: float
    last_s: float
    frames: int = 1
    simultaneous: bool = False
    """Whether it sent while another source had the lock, so that it is not that source with a new
    port."""


class SourceLock:
    """Decision which source's (address and port) frames are believed: the one that has the lock.

    Times are of one monotonic clock, s. ``silence_s``: longest time without a whole frame
    before a source counts as silent. Attributes: ``source``: source with the lock, or None;
    ``taken``: number of changes of the lock to another source.
    """

    def __init__(self, silence_s: float) -> None:
        self._silence_s = silence_s
        self.source: Source | None = None
        self._last: Source | None = None
        self.taken = 0
        self._last_frame_s = 0.0
        self._answered = False
        self._others: dict[Source, _OtherSource] = {}

    def answer(self) -> None:
        """Record that the server has answered on its command channel.

        From then on a source other than the last holder may get the lock, by the rules of
        `judge`.
        """
        self._answered = True

    def release_if_silent(self, now_s: float) -> bool:
        """Release the lock if its source is silent; return whether it was released now.

        Silent: its last whole frame is more than `silence_s` ago. After a release the same
        source gets the lock back with its next frame; another one can get it only after the
        server has answered anew (`answer`). False if no source has the lock. ``now_s``: s.
        """
        if self.source is None or now_s - self._last_frame_s <= self._silence_s:
            return False
        self.source = None
        self._answered = False
        return True

    def is_refused(self, source: Source, now_s: float) -> bool:
        """Whether all datagrams of this source are ignored now; if so, note that it has sent one.

        While a source has the lock, all other sources are ignored. While none has it, a source
        is ignored that had first sent more than `PROBATION_S` before a frame of the last
        holder, until it has been silent for more than `REFUSED_FOR_S`. ``now_s``: s.
        """
        if source == self.source:
            return False
        if self.source is not None:
            self._note(source, now_s)
            return True
        other = self._others.get(source)
        if other is None or not other.simultaneous or now_s - other.last_s > REFUSED_FOR_S:
            return False
        other.last_s = now_s
        return True

    def judge(self, source: Source, now_s: float) -> SourceVerdict:
        """Verdict on a whole frame by its source, which may get the lock with this frame.

        FOREIGN if the source `is_refused`; BELIEVED if it has the lock. While no source has
        it, the last holder gets it back with its next frame (BELIEVED). Another source gets it
        only after the server has answered on its command channel (`answer`), once the source has
        sent `PROBATION_FRAMES` frames over at least `PROBATION_S`, and no other candidate was
        heard in the last `silence_s`; until then the verdict is PROBATION. ``now_s``: time of the
        frame, s.
        """
        if self.is_refused(source, now_s):
            return SourceVerdict.FOREIGN
        if source == self.source:
            self._last_frame_s = now_s
            for other in self._others.values():
                other.simultaneous = other.simultaneous or now_s - other.first_s > PROBATION_S
            return SourceVerdict.BELIEVED
        if source == self._last:
            self.source, self._last_frame_s = source, now_s
            return SourceVerdict.BELIEVED
        if not self._answered:
            return SourceVerdict.PROBATION
        known = self._note(source, now_s)
        is_single = len(self._candidates(now_s)) == 1
        if not is_single or known.frames < PROBATION_FRAMES or now_s - known.first_s < PROBATION_S:
            return SourceVerdict.PROBATION
        del self._others[source]
        self.source = self._last = source
        self._last_frame_s = now_s
        self.taken += 1
        return SourceVerdict.BELIEVED

    def rivals(self, now_s: float) -> tuple[Source, ...]:
        """Sources other than the believed one that sent in the last `REFUSED_FOR_S`.

        While no source has the lock, only those that are refused, as they sent while another
        source had it (`is_refused`). ``now_s``: s.
        """
        return tuple(
            source
            for source, other in list(self._others.items())
            if (self.source is not None or other.simultaneous)
            and now_s - other.last_s <= REFUSED_FOR_S
        )

    def contestants(self, now_s: float) -> tuple[Source, ...]:
        """Sources that compete for the lock: () while a source has it, or for fewer than two."""
        candidates = self._candidates(now_s) if self.source is None else []
        return tuple(candidates) if len(candidates) > 1 else ()

    def _candidates(self, now_s: float) -> list[Source]:
        """Sources that could get the lock: heard in the last `silence_s`, and no rivals.

        A rival had first sent more than `PROBATION_S` before a frame of a source with the
        lock. The last holder is not in the list: it gets the lock back at once. ``now_s``: s.
        """
        return [
            source
            for source, other in list(self._others.items())
            if not other.simultaneous and now_s - other.last_s <= self._silence_s
        ]

    def _note(self, source: Source, now_s: float) -> _OtherSource:
        """Count a frame of a source that has not the lock; return the record of the source.

        The count begins anew after a silence of `silence_s`, or of `REFUSED_FOR_S` for a
        refused source. Beyond `REMEMBERED` sources, the one heard longest ago is removed,
        those never refused first. ``now_s``: s of the clock of all calls.
        """
        known = self._others.get(source)
        patience_s = REFUSED_FOR_S if known is not None and known.simultaneous else self._silence_s
        if known is None or now_s - known.last_s > patience_s:
            self._others.pop(source, None)
            if len(self._others) >= REMEMBERED:
                oldest = min(self._others.items(), key=lambda o: (o[1].simultaneous, o[1].last_s))
                del self._others[oldest[0]]
            known = self._others[source] = _OtherSource(now_s, now_s)
        else:
            known.last_s = now_s
            known.frames += 1
        return known


def describe(source: Source) -> str:
    """Source as address:port."""
    return f'{source[0]}:{source[1]}'
