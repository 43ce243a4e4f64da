"""Whose frames are believed: one source, an address with a port; pure, no sockets, no clocks.

From which port a server sends its frames is not documented and changes when it is started again,
so the port cannot be configured. It is learnt: the source of the first frames that follow an
answer of the command channel gets the *lock*, if it is the only one that sends for a moment. While
a source holds the lock, every other one is refused, whatever it sends. Once the holder has been
silent the lock is free: the same source has it back with its next frame, another one gets it in
the same way as the first did, after a new answer.

What cannot be detected: datagrams with the server's own address *and* port. A program on
another computer can forge both with raw sockets, unless the network drops foreign addresses; a
program on the server itself can take over a port that the server has closed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

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

    Parameters
    ----------
    silence_s
        A source that sent no whole frame for longer counts as silent.

    Attributes
    ----------
    source
        The source with the lock; None while there is none.
    taken
        How often the lock was given to another source than before.
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
