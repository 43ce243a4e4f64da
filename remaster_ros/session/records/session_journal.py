# SPDX-License-Identifier: Apache-2.0
"""State of a recorder on the disk: the session, and its decisions so far.

A restarted recorder finds here its earlier decisions, so that nothing is recorded twice, and the
points by which its sensors were registered. Outcomes of configurations are stored only here:
planner and reports read them from this journal.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from remaster_ros.collection.events import Decided, Outcome
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.collection.recording import BY_HAND
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION
from remaster_ros.session.files import read_limited
from remaster_ros.session.records.journal import Record, read_journal
from remaster_ros.session.records.reader import (
    HEADER,
    JOURNAL,
    OBSERVATIONS_LIMIT,
    ROWS,
    read_header,
)
from remaster_ros.session.records.session_writer import SessionWriter
from remaster_ros.session.records.session_yaml import ExitStatus
from remaster_ros.session.yaml_records import from_plain, to_plain
from remaster_ros.types import Correction, FloatArray, Observation, Session, Split

SHIFT_S = 1.0
"""Time between two rows if the clock ran backwards between them, s."""

_FINAL: tuple[Outcome, ...] = ('recorded', 'partial')


class Outcomes:
    """Outcomes of the configurations of a plan, from the records of a session's journal."""

    def __init__(self) -> None:
        self.plan = ''  # By which they are numbered; '' before the first
        # Pose -> split and outcomes of its solutions; the pose of the last record is last
        self.poses: dict[int, tuple[str, dict[int, str]]] = {}

    def take(self, record: Record) -> None:
        """Update the outcomes by the next record of the journal.

        The last record of a configuration counts; a new plan drops all outcomes; registrations
        by hand and other records change nothing.
        """
        if record['kind'] == 'plan':
            self.plan, self.poses = record['id'], {}
        elif record['kind'] == 'configuration' and record['pose'] != BY_HAND.pose:
            split, ends = self.poses.pop(record['pose'], (record['split'], {}))
            self.poses[record['pose']] = split, {**ends, record['solution']: record['result']}

    def of(self, pose: int, solution: int) -> str:
        """Return a configuration's outcome, such as 'recorded'; '' if it has none yet.

        ``pose``, ``solution``: the planner's numbers.
        """
        return self.poses.get(pose, ('', {}))[1].get(solution, '')

    def decided(self) -> Decided:
        """Return the outcomes in the form of the message to the planner.

        Last pose (None if there is none) with its solutions that have an outcome, number of
        solutions by outcome (references and registrations not counted), and number of outcomes
        of references.
        """
        last = next(reversed(self.poses), None)
        solutions = () if last is None else tuple(self.poses[last][1])
        ends = [
            (split, end) for split, outcomes in self.poses.values() for end in outcomes.values()
        ]
        counts = Counter(end for split, end in ends if split not in (REFERENCE, REGISTRATION))
        references = sum(split == REFERENCE for split, _ in ends)
        return Decided(last, solutions, dict(counts), references)


def read_outcomes(folder: Path) -> Outcomes:
    """Return the outcomes in a session folder; empty if it has no journal.

    Raises InputError if the journal is damaged.
    """
    outcomes = Outcomes()
    if (folder / JOURNAL).exists():
        for record in read_journal(folder / JOURNAL).records:
            outcomes.take(record)
    return outcomes


class SessionJournal:
    """Writer of a session, new or unfinished, and of its decisions.

    Parameters
    ----------
    folder
        The session's. A complete session is not written to; `closed` is then set from the start,
        and `reopen` may continue it.
    header
        Everything but the observations.

    Raises
    ------
    InputError
        If the folder holds other files, another process writes it, or it cannot be written to.
    """

    def __init__(self, folder: Path, header: Session) -> None:
        self.folder, self._header = folder, header
        self._writer: SessionWriter | None = None
        self.closed = ''  # The exit status once the session is closed, else ''
        self.outcomes = Outcomes()
        self.observations = 0
        # Messages on the state in which the session was found
        self.notes: list[str] = []
        # Readings of earlier runs by which the sensors were registered
        self.registration: list[PairedReading] = []
        # Reference measurements of earlier runs, in order: ``reference`` with the number of the
        # configuration and its readings, ``other`` for any other configuration, ``accepted`` when
        # a person accepted a change
        self.watched: list[tuple[str, int, list[PairedReading]]] = []
        self._shift_s = 0.0
        self.reopen()

    def reopen(self, *, go_further: bool = False) -> None:
        """Continue a stopped session; with ``go_further``, a complete one.

        The state is restored from the journal. Without ``go_further`` a complete session stays
        closed, which a line in `notes` says. Raises InputError as the class.
        """
        if is_complete(self.folder) and not go_further:
            rows = read_limited(self.folder / ROWS, OBSERVATIONS_LIMIT, 'it is part of a session')
            self.observations = rows.count(b'\n') - 1
            self.closed = 'complete'
            self.outcomes = read_outcomes(self.folder)
            self.notes = [f'{self.folder}: this session is complete; name a new folder to record']
            return
        self._writer = SessionWriter(self.folder, self._header, resume=True, go_further=go_further)
        self.closed, self.notes = '', []
        self.observations = self._writer.observations
        if self._writer.resumed:
            self.notes.append(f'{self.folder}: going on after {self.observations} observations')
        if self._writer.lost:
            self.notes.append(self._writer.lost)
        self.registration, self.outcomes, self.watched = [], Outcomes(), []
        for record in self._writer.records:
            self._replay(record)

    def _replay(self, record: Record) -> None:
        """Restore registrations, references, outcomes and clock shift by a record."""
        kind = record['kind']
        self.outcomes.take(record)
        if kind == 'configuration':
            readings = from_plain(record.get('readings', []), list[PairedReading])
            if record.get('split') == REGISTRATION:
                self.registration += readings
            elif record.get('split') == REFERENCE and readings:
                self.watched.append(('reference', record['number'], readings))
            elif record.get('rows') and self.watched:
                self.watched.append(('other', 0, []))
        elif kind == 'accepted':
            self.watched.append(('accepted', 0, []))
        elif kind == 'shift':
            self._shift_s = record['shift_s']

    def _append(self, record: Record, observations: Sequence[Observation] = ()) -> None:
        """Write a record and its observations durably, and update the outcomes.

        Raises as `SessionWriter.record`.
        """
        assert self._writer is not None
        self._writer.record(record, observations)
        self.outcomes.take(record)

    @property
    def plan_id(self) -> str:
        """Identifier of the plan that numbers the configurations; '' before the first."""
        return self.outcomes.plan

    def follow(self, plan_id: str) -> bool:
        """Bind the session to a plan; return False if it has observations of another plan.

        Else True: the session has this plan already; or it has no observations or no plan yet,
        and the new plan is written to the journal.
        """
        if plan_id == self.plan_id:
            return True
        if self.observations and self.plan_id:
            return False
        self._append({'kind': 'plan', 'id': plan_id})
        return True

    def result(self, pose: int, solution: int) -> Outcome | None:
        """Return a configuration's outcome if it is 'recorded' or 'partial'; else None.

        ``pose``, ``solution``: the planner's numbers.
        """
        result = self.outcomes.of(pose, solution)
        return next((final for final in _FINAL if final == result), None)

    @property
    def correction(self) -> Correction | None:
        """Correction that the bridge applied to the commands of this session, as recorded in it.

        None if none is recorded, or if the session was complete when it was opened.
        """
        return None if self._writer is None else self._writer.correction

    def take_correction(self, correction: Correction) -> None:
        """Note in the session, before its first row, that the bridge corrects the commands.

        Nothing changes if one is noted already. Raises InputError if rows were written without
        one, DiskError if the disk is full.
        """
        assert self._writer is not None
        self._writer.correct(correction)

    def write(
        self,
        *,
        pose: int,
        solution: int,
        split: str,
        result: str,
        reason: str,
        readings: Sequence[PairedReading] = (),
        from_q: FloatArray | None = None,
        temperatures_c: Sequence[float | None] = (),
        change: FloatArray | None = None,
    ) -> int:
        """Write the outcome of a configuration durably; return its number in the session.

        Parameters
        ----------
        pose, solution
            The planner's numbers.
        split
            ``registration``, ``reference``, ``optimization`` or ``validation``.
        result, reason
            ``recorded``, ``partial``, ``rejected``, ``failed`` or ``no_free_path``, and why.
        readings, temperatures_c
            Accepted readings, and the temperature with each, degrees Celsius, None if unknown.
        from_q
            Previous configuration of the arm, rad, (k,); None if unknown.
        change
            Commanded minus desired joint angles by a correction, rad, (k,); None if it was off.

        Raises
        ------
        DiskError
            If the disk is full; call again when there is room.
        """
        record: Record = {
            'kind': 'configuration',
            'pose': pose,
            'solution': solution,
            'split': split,
            'result': result,
            'reason': reason,
        }
        number = 0 if self._writer is None else self._writer.configurations
        if split == REGISTRATION:
            self._append({**record, 'readings': _plain(readings)})
        else:
            if split == REFERENCE:
                record['number'] = number
                record['readings'] = _plain(readings)
            rows = self._rows(pose, split, readings, from_q, temperatures_c, change)
            self._append(record, rows)
            self.observations += len(readings)
        return number

    def note_accepted(self) -> None:
        """Record that a person has accepted a change at the references."""
        self._append({'kind': 'accepted'})

    def _rows(
        self,
        pose: int,
        split: str,
        readings: Sequence[PairedReading],
        from_q: FloatArray | None,
        temperatures_c: Sequence[float | None],
        change: FloatArray | None,
    ) -> list[Observation]:
        """Return the observations of readings, sorted by time; [] without readings.

        Arguments as of `write`. If the clock ran backwards, a shift is written to the journal
        first.
        """
        writer = self._writer
        if not readings or writer is None:
            return []
        pairs = sorted(zip(readings, temperatures_c), key=lambda pair: pair[0].stamp_s)
        self._keep_time(pairs[0][0].stamp_s)
        markers = Counter(reading.sensor for reading in readings)
        return [
            Observation(
                observation=writer.observations + number,
                pose=pose,
                configuration=writer.configurations,
                split=_split(split),
                from_q=from_q,
                temperature_c=temperature_c,
                # A stream has one frame in a configuration; single shots have none in common.
                frame=writer.configurations
                if markers[reading.sensor] > 1 and reading.std is not None
                else None,
                # Reached minus change: the deviation from the command is part of the error.
                wanted=None
                if writer.correction is None
                else reading.q - (0.0 if change is None else change),
                correction=None if writer.correction is None else change is not None,
                **self._columns(reading),
            )
            for number, (reading, temperature_c) in enumerate(pairs)
        ]

    def _columns(self, reading: PairedReading) -> dict[str, Any]:
        """Return the fields of an `Observation` that a reading has, name -> value.

        The stamp is shifted (`_keep_time`); the pose by a sensor on the tool is inverted. The
        number of frames that were dropped from the reading is no such field.
        """
        if reading.sensor in self._header.on_tool:
            reading = reading.inverted()
        values = vars(replace(reading, stamp_s=reading.stamp_s + self._shift_s))
        return {name: value for name, value in values.items() if name != 'dropped'}

    def _keep_time(self, stamp_s: float) -> None:
        """Set and record a shift of stamps if the clock ran backwards: session time never does.

        ``stamp_s``: stamp of the first of the next rows. With the shift it is 1 s (`SHIFT_S`)
        after the last row. Nothing happens if the clock did not run backwards.
        """
        assert self._writer is not None
        last_s = self._writer.last_stamp_s
        if last_s is None or stamp_s + self._shift_s >= last_s:
            return
        shift_s = last_s + SHIFT_S - stamp_s
        self._append({'kind': 'shift', 'shift_s': shift_s})
        self._shift_s = shift_s
        self.notes.append(f'the clock ran backwards: stamps are shifted by {self._shift_s:.3f} s')

    def check(self) -> None:
        """Repair files that others changed, unless the session is closed.

        Raises MovedError or DiskError as `SessionWriter.check`.
        """
        if not self.closed and self._writer is not None:
            self._writer.check()

    def take_restored(self) -> list[str]:
        """Return the repairs since the last call, one line each, and forget them."""
        if self._writer is None:
            return []
        lines, self._writer.restored = self._writer.restored, []
        return lines

    @property
    def beyond_repair(self) -> str:
        """Why the session can no longer become complete; '' if it can."""
        return '' if self._writer is None else self._writer.beyond_repair

    def close(self, exit_status: ExitStatus) -> None:
        """Close the session; a second call does nothing. Raises DiskError if it remains open.

        Sets `closed` to the exit status; see `SessionWriter.close`.
        """
        if not self.closed and self._writer is not None:
            self.closed = self._writer.close(exit_status)


def is_complete(folder: Path) -> bool:
    """Whether a folder has a session with exit status 'complete'.

    False without session.yaml; raises InputError for a damaged one.
    """
    return (folder / HEADER).exists() and read_header(folder).exit_status == 'complete'


def _split(name: str) -> Split:
    """Return the split of a row; unknown names of other versions count as optimization."""
    if name == 'validation':
        return 'validation'
    return 'reference' if name == REFERENCE else 'optimization'


def _plain(readings: Sequence[PairedReading]) -> list[dict[str, Any]]:
    """Return readings as plain data, fields that are None left out."""
    return [{k: v for k, v in reading.items() if v is not None} for reading in to_plain(readings)]
