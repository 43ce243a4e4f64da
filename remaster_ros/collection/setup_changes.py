"""What has changed in the setup, by the references: reported once, and whether to stop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from remaster_ros.collection.events import SetupChanged
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.collection.reference_watch import ReferenceReading, ReferenceWatch, SetupChange
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

GROWN = 1.5
"""A change that was reported is reported again where it has grown so many times."""
PAUSED = 'paused'
"""In place of a run that was paused, and whose token was lost with the recorder."""


class SetupChanges:
    """Follow the references of a session, and remember what a person has not seen to yet.

    Parameters
    ----------
    chain, markers
        As for `ReferenceWatch`.
    stop_m
        A change larger than this stops the collection, m; 0 for none.

    Attributes
    ----------
    change
        What has changed since the beginning, or since a person has seen to the last change.
    stopped_run
        The planner's run that a change has stopped, and that no person has seen to yet; '' for
        one that is not known, None where nothing has stopped.
    """

    def __init__(
        self, chain: SerialChain, markers: Mapping[str, FloatArray], stop_m: float
    ) -> None:
        self._stop_m = stop_m
        self._watch = ReferenceWatch(chain, markers, **({'stop_m': stop_m} if stop_m else {}))
        self._reported: SetupChange | None = None
        self.change: SetupChange | None = None
        self.stopped_run: str | None = None

    @property
    def rounds(self) -> int:
        """How many rounds have begun."""
        return self._watch.rounds

    @property
    def stops(self) -> bool:
        """Whether the change is large enough to stop for."""
        change = self.change
        return change is not None and bool(self._stop_m) and change.size_m > self._stop_m

    def describe(self) -> str:
        """Return what has changed and what to do, in a line; '' where nothing has."""
        if self.change is None:
            return ''
        text = self.change.describe()
        if not self.stops:
            return text
        return (
            f'{text}. That is more than {1e3 * self._stop_m:g} mm: what was measured before and '
            'after does not fit together. Look at it; then begin a new session (best), or go on '
            'with /remaster/collect'
        )

    def take_back(
        self,
        log: Iterable[tuple[str, int, Sequence[PairedReading]]],
        T_R_N: Mapping[str, FloatArray],
    ) -> None:
        """Take up what a recorder before this one has logged (`SessionJournal.watched`)."""
        for kind, configuration, readings in log:
            if kind == 'reference':
                self.read(configuration, readings, T_R_N)
            elif kind == 'accepted':
                self.accept()
            else:
                self.leave(T_R_N)
        self.judge(T_R_N)
        if self.stops:
            self.stopped_run = ''

    def read(
        self,
        configuration: int,
        readings: Sequence[PairedReading],
        T_R_N: Mapping[str, FloatArray],
        last: bool = False,
    ) -> bool:
        """Take the readings at a reference; return whether something new is to be reported.

        Parameters
        ----------
        last
            Whether it is the last one of its round.
        """
        new = False
        for reading in readings:
            row = ReferenceReading(**vars(reading), configuration=configuration)
            if self._watch.rounds and self._watch.begins_round(row):
                new |= self.judge(T_R_N)
            self._watch.add(row)
        return self.judge(T_R_N) or new if last else new

    def leave(self, T_R_N: Mapping[str, FloatArray]) -> bool:
        """Take it that the arm goes elsewhere; return as `read`."""
        new = self.judge(T_R_N)
        self._watch.end_round()
        return new

    def judge(self, T_R_N: Mapping[str, FloatArray]) -> bool:
        """Judge the round so far, once; return as `read`."""
        self.change = self._watch.judge(T_R_N)
        if self.change is None or self.change is self._reported:
            return False
        before, now = self._reported, self.change
        new = before is None or now.size_m > GROWN * before.size_m or now.subject != before.subject
        if new or self.stops:
            self._reported = now
        return new or self.stops

    def report(self, run: str) -> SetupChanged | None:
        """Return the event of the change, if there is one; a large change stops the run.

        Parameters
        ----------
        run
            Token of the run under way, '' for none.
        """
        if self.change is None:
            return None
        if self.stops:
            self.stopped_run = run
        return SetupChanged(
            stops=self.stops,
            text=self.describe(),
            cause=self.change.kind,
            size_m=self.change.size_m,
        )

    def accept(self) -> None:
        """Take it that a person has seen to the change: the next round is a new beginning."""
        self._watch.accept()
        self.change = self._reported = self.stopped_run = None

    def follow(self, state: str, run: str) -> bool:
        """Take what the planner does; return whether a person has seen to the change.

        A person has where another run has begun, as /remaster/collect does. A recorder that was
        started again has no record of which run was stopped: the one that it finds running is,
        and after a pause none.

        Parameters
        ----------
        state, run
            The planner's state and the token of its run, '' for none.
        """
        if self.stopped_run == '':
            self.stopped_run = run if state == 'running' else PAUSED * (state == 'paused')
            return False
        return bool(run) and self.stopped_run not in (None, run)
