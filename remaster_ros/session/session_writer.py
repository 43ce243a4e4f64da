"""Write a session observation by observation, and go on with one after whatever has happened.

Each record goes into the journal first (a line with a checksum, synced), then its rows go into
observations.csv (synced), and only then does the caller learn that it is recorded. All rows of a
configuration are one record: after a crash they are all there or none is. What the journal holds
and observations.csv does not is added when the session is opened again.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal

from remaster_ros.errors import InputError, MovedError
from remaster_ros.session.files import (
    AppendFile,
    cannot_write,
    make_folder,
    make_new_folder,
    read_limited,
    remove_leftovers,
    sync_folder,
    write_atomically,
)
from remaster_ros.session.journal import Journal, Record
from remaster_ros.session.manifest import (
    check_file,
    read_manifest,
    remove_manifest,
    write_sums,
)
from remaster_ros.session.observations import check_row, format_header, format_observation
from remaster_ros.session.reader import (
    HEADER,
    OBSERVATIONS_LIMIT,
    ROWS,
    URDF,
    URDF_LIMIT,
    read_chain,
)
from remaster_ros.session.safe_yaml import dump_yaml, load_yaml
from remaster_ros.session.sequence_rules import RowKeys, SequenceRules
from remaster_ros.session.session_guard import SessionGuard, set_aside
from remaster_ros.session.session_yaml import parse_header, write_header
from remaster_ros.session.yaml_records import YAML_LIMIT
from remaster_ros.types import Observation, Session

JOURNAL = 'journal.jsonl'
PLAN = 'plan.jsonl'

ExitStatus = Literal['complete', 'stopped', 'aborted']

_COMPARED = ('robot', 'markers', 'sensors', 'settle_s', 'marker_std_m', 'base_prior')


class ChangedError(InputError):
    """observations.csv is not what the journal has, and no crash made it so."""


class SessionWriter:
    """Write a session; what `append` or `record` returned from is on the disk.

    The folder can be read at any moment: it says ``exit_status: aborted`` until `close`, and a
    line cut off by a crash is the only thing a reader may find incomplete. A writer is also a
    context manager: it closes as ``complete``, or as ``aborted`` where an exception passes.

    Parameters
    ----------
    folder
        New or empty; with `resume` also that of an unfinished session of the same robot, markers
        and sensors.
    header
        Everything but the observations; its measurements and exit status are not used.
    resume
        Go on with what the folder holds.
    even_complete
        Open a complete session too, which remains complete until it is closed (recovery).

    Attributes
    ----------
    records
        The journal: every record so far, also those of the runs before.
    resumed
        Whether the folder held a session.
    lost
        What a crash has left incomplete, and was dropped; '' where nothing was.
    observations, configurations
        The next free numbers.
    last_stamp_s
        Time of the last observation, s; None before the first.
    restored
        What `check` found changed by others and restored, a line each.
    beyond_repair
        What others destroyed and the journal has not; '' where nothing is. Such a session is not
        closed as complete.

    Raises
    ------
    InputError
        The folder holds something else, a complete session, or one of another robot; another
        process writes it; it cannot be written to; or the header breaks the format.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        header: Session,
        *,
        resume: bool = False,
        even_complete: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self._rows_path = self.folder / ROWS
        self._chain = read_chain(
            header.urdf, self.folder / URDF, header.base_link, header.tip_link
        )
        self._sensors, self._markers = header.sensor_names, header.marker_names
        self._header_line = format_header(len(self._chain))
        self._text = write_header(header, URDF, 'aborted')
        if resume:
            make_folder(self.folder)
            self._remove_beginnings()
        self.resumed = resume and (self.folder / HEADER).exists()
        if self.resumed:
            self._compare(header.urdf, even_complete)
        else:
            self._begin(header.urdf)
        self._closed = False
        self._closed_as: ExitStatus = 'aborted'
        self.restored: list[str] = []
        self.beyond_repair = ''
        self._urdf = header.urdf.encode()
        self._journal = Journal(self.folder / JOURNAL)
        holds = {
            HEADER: lambda data: data == self._text.encode(),
            URDF: lambda data: data == self._urdf,
            ROWS: lambda data: data == self._wanted_rows(),
            JOURNAL: self._journal.holds,
        }
        try:
            self._guard = SessionGuard(self.folder, holds)
        except InputError:
            self._journal.close()
            raise
        try:
            self._rows = AppendFile(self._rows_path)
        except InputError:
            self._journal.close()
            self._guard.close()
            raise
        try:
            if self.resumed:
                self._reopen(even_complete)
            self._restore(even_complete)
            self._guard.note_all()
        except BaseException:
            self.release()
            raise

    @property
    def records(self) -> list[Record]:
        """Every record of the journal."""
        return self._journal.records

    def _begin(self, urdf: str) -> None:
        # The planner may have been there first.
        if not (self.folder.is_dir() and os.listdir(self.folder) == [PLAN]):
            make_new_folder(self.folder)
        try:
            sync_folder(self.folder.parent)
        except OSError as error:
            raise cannot_write(self.folder, error) from None
        write_atomically(self.folder / URDF, urdf)
        write_atomically(self._rows_path, self._header_line)
        # Last: with it the folder is a session.
        write_atomically(self.folder / HEADER, self._text)

    def _remove_beginnings(self) -> None:
        """Remove what a writer has left that was killed before the folder was a session."""
        names = {path.name for path in self.folder.iterdir() if path.suffix != '.tmp'} - {PLAN}
        if HEADER in names or names - {URDF, ROWS}:
            return
        if ROWS in names and self._read_rows() != self._header_line.encode():
            return
        remove_leftovers(self.folder)
        for name in names:
            try:
                os.unlink(self.folder / name)
            except OSError as error:
                raise cannot_write(self.folder / name, error) from None

    def _compare(self, urdf: str, even_complete: bool) -> None:
        """Refuse to go on with another session than the one that is to be recorded."""
        folder, path = self.folder, self.folder / HEADER
        data = read_limited(path, YAML_LIMIT, 'it was there a moment ago')
        old, new = parse_header(data, path), parse_header(self._text.encode(), path)
        if old.exit_status == 'complete' and not even_complete:
            raise InputError(f'{folder}: this session is complete; name a new folder')
        same_urdf = read_limited(folder / old.robot.urdf, URDF_LIMIT, 'it is part of a session')
        differing = [name for name in _COMPARED if getattr(old, name) != getattr(new, name)]
        differing += ['URDF'] * (same_urdf != urdf.encode())
        if differing:
            raise InputError(
                f'{folder}: holds an unfinished session with another {" and ".join(differing)}; '
                'to go on, start with what it was begun with; else name a new folder'
            )
        if not (folder / JOURNAL).exists() and self._read_rows() != self._header_line.encode():
            raise InputError(
                f'{folder}: holds a session without {JOURNAL}, from which alone it could be '
                'resumed; name a new folder'
            )
        sums = read_manifest(folder)
        for name in sums:
            check_file(sums, folder / name)

    def _reopen(self, even_complete: bool) -> None:
        """Take back that the session was closed."""
        path = self.folder / HEADER
        remove_leftovers(self.folder)
        remove_manifest(self.folder)
        old = path.read_text(encoding='utf-8-sig')
        self._text = old if even_complete else with_exit_status(old, 'aborted')
        if self._text != old:
            write_atomically(path, self._text)

    def _read_rows(self) -> bytes:
        return read_limited(self._rows_path, OBSERVATIONS_LIMIT, f'a session folder holds {ROWS}')

    def _wanted_rows(self) -> bytes:
        """Return what observations.csv must be: the rows of the journal, all acknowledged."""
        rows = (row for record in self.records for row in record.get('rows', ()))
        return ''.join((self._header_line, *(f'{row}\n' for row in rows))).encode()

    def _restore(self, even_changed: bool) -> None:
        """Bring observations.csv up to the journal, and learn the numbers to go on with."""
        self.lost = self._journal.lost
        rows = [row for record in self.records for row in record.get('rows', ())]
        try:
            missing = self._missing(rows)
        except ChangedError:
            if not even_changed:
                raise
            self._note_restored(ROWS, 'was changed', self._restore_rows())
            missing = b''
        if missing:
            self._rows.append(missing)
        self._rules = SequenceRules()
        self._line = 2
        self.observations = self.configurations = 0
        self.last_stamp_s: float | None = None
        for number, row in enumerate(rows, start=2):
            self._accept(self._check(row, number, self._rules))

    def _missing(self, rows: Sequence[str]) -> bytes:
        """Cut observations.csv where a crash tore it; return what the journal has beyond that."""
        data = self._read_rows()
        wanted = ''.join((self._header_line, *(f'{row}\n' for row in rows))).encode()
        if wanted.startswith(data):
            return wanted[len(data) :]
        differing = (i for i, (a, b) in enumerate(zip(data, wanted)) if a != b)
        good = next(differing, len(wanted))
        start = wanted.rfind(b'\n', 0, good) + 1
        last = next((record['rows'] for record in reversed(self.records) if 'rows' in record), ())
        torn_from = len(wanted) - sum(len(row.encode()) + 1 for row in last)
        # Only the last piece can be torn; it never reaches beyond what was being written.
        if start < torn_from or len(data) > len(wanted):
            line = data.count(b'\n', 0, start) + 1
            raise ChangedError(
                f'{self._rows_path}, line {line}: not as {JOURNAL} has it; the session cannot be '
                'resumed from a file that was changed: undo that, let `remaster recover` restore '
                'it, or name a new folder'
            )
        self._rows.truncate(start)
        return wanted[start:]

    def append(self, observation: Observation) -> None:
        """Write one observation; durable on return, or not there at all (see `record`)."""
        self.record({'kind': 'observation'}, [observation])

    def record(self, record: Record, observations: Sequence[Observation] = ()) -> None:
        """Write one record and its observations; durable on return, or not there at all.

        Parameters
        ----------
        record
            What the journal keeps beside the rows: plain data with a ``kind``.
        observations
            In the order measured.

        Raises
        ------
        InputError
            An observation breaks the format (and nothing is written), or the writer is closed.
        DiskError
            The disk does not take it; try again when there is room.
        """
        if self._closed:
            raise InputError(f'{self.folder}: the session is closed; start a new one')
        self.check()
        rows = [format_observation(observation).rstrip('\n') for observation in observations]
        keys = self._checked(rows)
        if rows:
            record = {**record, 'rows': rows}
        self._journal.append(record)
        self._guard.note(JOURNAL)
        if not rows:
            return
        try:
            self._rows.append(''.join(f'{row}\n' for row in rows).encode())
        except InputError:
            try:
                self._journal.take_back()
                self._guard.note(JOURNAL)
            except InputError:
                # It is ahead now: only opening the session again brings the two together.
                self.release()
            raise
        self._guard.note(ROWS)
        for key in keys:
            self._accept(key)

    def check(self, *, content: bool = False) -> None:
        """Notice what others did to the files, and restore them; `restored` tells what.

        A file that was replaced, removed or changed is written again from what is in memory: all
        that was acknowledged. What is found in its place is renamed to ``NAME.changed``. A folder
        that was removed is made again, though the bag and the plan in it are lost.

        Parameters
        ----------
        content
            Compare every byte; else files of the same size and time of change pass.

        Raises
        ------
        MovedError, DiskError
            The folder was renamed or replaced; or the disk does not take what is to be restored.
            Nothing may be recorded until it is as before: try again.
        """
        if self._closed:
            return
        if not self._guard.is_in_place():
            self._make_folder_again()
        for name, what in self._guard.differing(content=content).items():
            if name == ROWS:
                aside = self._restore_rows()
            else:
                aside = set_aside(self.folder / name)
                if name == JOURNAL:
                    self._journal.restore()
                else:
                    data = self._text if name == HEADER else self._urdf
                    write_atomically(self.folder / name, data)
            self._guard.note(name)
            self._note_restored(name, what, aside)
            self._journal.append({'kind': 'restored', 'file': name, 'what': what, 'aside': aside})
            self._guard.note(JOURNAL)

    def _restore_rows(self) -> str:
        """Write observations.csv again; return the name of what was found there."""
        aside = set_aside(self._rows_path)
        write_atomically(self._rows_path, self._wanted_rows())
        self._rows.close()
        self._rows = AppendFile(self._rows_path)
        return aside

    def _note_restored(self, name: str, what: str, aside: str) -> None:
        kept = f'; what was found there is {aside}' if aside else ''
        self.restored.append(
            f'{self.folder / name}: {what} while the session was written; it was restored with '
            f'all that was acknowledged{kept}'
        )

    def _make_folder_again(self) -> None:
        """Make the folder again if it was removed; `MovedError` if it lives on elsewhere."""
        if self._journal.names:
            raise MovedError(
                f'{self.folder}: the session folder was renamed, replaced or unmounted while the '
                'session is written; put it back under its name, and the run goes on'
            )
        make_folder(self.folder)
        self._guard.take_place()
        self.beyond_repair = 'the folder was removed, and with it the bag and the plan'

    def _checked(self, rows: Sequence[str]) -> list[RowKeys]:
        """Hold the rows of one record to what the reader will demand of them."""
        keys = []
        rules = self._rules.branch()
        for number, row in enumerate(rows, start=self._line):
            keys.append(self._check(row, number, rules))
            rules.accept(keys[-1])
        return keys

    def _check(self, row: str, line: int, rules: SequenceRules) -> RowKeys:
        return check_row(
            row, line, self._rows_path, self._chain, self._sensors, self._markers, rules
        )

    def _accept(self, key: RowKeys) -> None:
        self._rules.accept(key)
        self._line = key.line + 1
        self.observations = max(self.observations, key.observation + 1)
        self.configurations = max(self.configurations, key.configuration + 1)
        self.last_stamp_s = key.stamp_s

    def close(self, exit_status: ExitStatus = 'complete') -> ExitStatus:
        """Say in session.yaml how the session ended, and write the checksums of its files.

        Before that every byte of them is compared with what was acknowledged (`check`), and the
        checksums are of that. Closing again does nothing.

        Returns
        -------
        str
            What it was closed as: ``aborted`` instead of ``complete`` where something is
            `beyond_repair`.

        Raises
        ------
        DiskError
            The disk does not take it; try again when there is room. Until then the session
            remains readable, as aborted or without checksums.
        """
        if self._closed:
            return self._closed_as
        self.check(content=True)
        if self.beyond_repair and exit_status == 'complete':
            exit_status = 'aborted'
        self._text = with_exit_status(self._text, exit_status)
        write_atomically(self.folder / HEADER, self._text)
        self._guard.note(HEADER)
        sums = {
            name: hashlib.sha256(data).hexdigest()
            for name, data in (
                (HEADER, self._text.encode()),
                (URDF, self._urdf),
                (ROWS, self._wanted_rows()),
            )
        }
        write_sums(self.folder, {**sums, JOURNAL: self._journal.sha256})
        self._closed_as = exit_status
        # Behind the checksums: nobody else may write as long as they are not there.
        self.release()
        return exit_status

    def release(self) -> None:
        """Let others go on with the session as it is on the disk, closed or not."""
        self._closed = True
        self._rows.close()
        self._journal.close()
        self._guard.close()

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self.close('complete' if kind is None else 'aborted')
        finally:
            self.release()


def with_exit_status(text: str, exit_status: str) -> str:
    """Return the text of a session.yaml that says how the session ended, else the same."""
    content = load_yaml(text)
    content['exit_status'] = exit_status
    return dump_yaml(content)
