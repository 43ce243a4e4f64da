# SPDX-License-Identifier: Apache-2.0
"""Changes of the setup that are reported, each once, while a session is measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from remaster_ros.collection.events import SetupChanged
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.collection.reference_watch import ReferenceReading, ReferenceWatch, SetupChange
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

GROWN = 1.5
"""Factor of growth from which a reported change is reported again."""
PAUSED = 'paused'
"""Token in place of that of a paused run that was lost with the recorder."""


class SetupChanges:
    """Changes of the set-up during a session, each reported once, and the runs that they stop.

    Parameters
    ----------
    chain, markers
        As for `ReferenceWatch`.
    stop_m
        Size of a change that stops the collection, m; 0 for none.

    Attributes
    ----------
    change
        Change since the beginning, or since a person has checked the last change.
    stopped_run
        Planner's run that a change has stopped and no person has checked yet; '' for an unknown
        run, None if none was stopped.
    """

    def __init__(
        self, chain: SerialChain, markers: Mapping[str, FloatArray], stop_m: float
    ) -> None:
        # Imported now, and not with the first test at the third round: the import may take seconds
        # on a busy computer, while an arm and the nodes that watch it wait for this process.
        import scipy.stats  # noqa: F401

        self._stop_m = stop_m
        self._watch = ReferenceWatch(chain, markers, **({'stop_m': stop_m} if stop_m else {}))
        self._reported: SetupChange | None = None
        self.change: SetupChange | None = None
        self.stopped_run: str | None = None

    @property
    def rounds(self) -> int:
        """Number of rounds of visits to the references that have begun."""
        return self._watch.rounds

    @property
    def stops(self) -> bool:
        """Whether the change is larger than `stop_m`, so that the collection stops; not if 0."""
        change = self.change
        return change is not None and bool(self._stop_m) and change.size_m > self._stop_m

    def describe(self) -> str:
        """The change and the remedy, in a line; '' without a change."""
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
        """Restore the state of an earlier recorder from its log (`SessionJournal.watched`).

        ``log``: kind (reference, accepted or other), configuration, readings; ``T_R_N``:
        registration of each sensor, (4, 4), by name. If the change found `stops` the
        collection, `stopped_run` becomes '': which run was stopped is not known.
        """
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
        """Process the readings at a reference; return whether a new change is to be reported.

        ``configuration``: its number in the session; ``T_R_N``: registration of each sensor,
        (4, 4), by name; ``last``: whether it is the last reference of its round. A round is
        judged after its last reference, or before a reading that begins the next round; else
        the result is False. New: as of `judge`.
        """
        new = False
        for reading in readings:
            row = ReferenceReading(**vars(reading), configuration=configuration)
            if self._watch.rounds and self._watch.begins_round(row):
                new |= self.judge(T_R_N)
            self._watch.add(row)
        return self.judge(T_R_N) or new if last else new

    def leave(self, T_R_N: Mapping[str, FloatArray]) -> bool:
        """Judge the round and end it, as the arm leaves the references; return as `judge`."""
        new = self.judge(T_R_N)
        self._watch.end_round()
        return new

    def judge(self, T_R_N: Mapping[str, FloatArray]) -> bool:
        """Judge the round so far, once; return whether there is a new change to report.

        New is another subject, growth by more than `GROWN` since the last report, or, of each
        round, any change that `stops`.
        """
        self.change = self._watch.judge(T_R_N)
        if self.change is None or self.change is self._reported:
            return False
        before, now = self._reported, self.change
        new = before is None or now.size_m > GROWN * before.size_m or now.subject != before.subject
        if new or self.stops:
            self._reported = now
        return new or self.stops

    def report(self, run: str) -> SetupChanged | None:
        """Event of the change, if there is one; a large change stops the run.

        ``run``: token of the present run, '' for none.
        """
        if self.change is None:
            return None
        if self.stops:
            self.stopped_run = run
        return SetupChanged(stops=self.stops, text=self.describe())

    def accept(self) -> None:
        """Forget the change, which a person has checked: the next round is a new beginning."""
        self._watch.accept()
        self.change = self._reported = self.stopped_run = None

    def follow(self, state: str, run: str) -> bool:
        """Process the planner's state; returns whether a person has checked the change.

        True if a change has stopped a run, and a run with another token is under way, as after
        /remaster/collect. A restarted recorder does not know which run was stopped
        (`stopped_run` is ''): the result is then False, and `stopped_run` becomes ``run`` if the
        planner is running, `PAUSED` (the token of no run) if it is paused; else it stays ''.
        ``state, run``: the planner's state and the token of its run, '' for none.
        """
        if self.stopped_run == '':
            self.stopped_run = run if state == 'running' else PAUSED * (state == 'paused')
            return False
        return bool(run) and self.stopped_run not in (None, run)
