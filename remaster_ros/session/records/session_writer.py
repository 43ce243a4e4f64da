# SPDX-License-Identifier: Apache-2.0
"""Writer of a session, observation by observation, which can be resumed after any interruption.

Each record goes into the journal first (a line with a checksum, synced), then its rows go into
observations.csv (synced), and only then does the call return. All rows of a configuration are one
record: after a crash all of them are there, or none. Rows of the journal that are missing in
observations.csv are added when the session is opened again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from remaster_ros.errors import InputError, MovedError
from remaster_ros.session.files import (
    URDF_LIMIT,
    AppendFile,
    make_folder,
    make_new_folder,
    read_limited,
    remove_leftovers,
    sync_folder,
    write_atomically,
    writing,
)
from remaster_ros.session.manifest import check_file, read_manifest, remove_manifest, write_sums
from remaster_ros.session.records.journal import Journal, Record
from remaster_ros.session.records.observation_rules import RowKeys, SequenceRules
from remaster_ros.session.records.observations import RowFormat
from remaster_ros.session.records.reader import (
    HEADER,
    JOURNAL,
    OBSERVATIONS_LIMIT,
    PLAN,
    ROWS,
    URDF,
    read_chain,
    read_header,
)
from remaster_ros.session.records.session_guard import SessionGuard, rename_changed
from remaster_ros.session.records.session_yaml import (
    ExitStatus,
    parse_header,
    with_correction,
    with_exit_status,
    write_header,
)
from remaster_ros.types import Correction, Observation, Session

_COMPARED = ('robot', 'markers', 'sensors', 'settle_s', 'marker_std_m', 'base_prior')

FILES = (HEADER, URDF, ROWS, JOURNAL)


class ChangedError(InputError):
    """observations.csv differs from the journal, and not by a crash."""


def _begin(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of a session without rows into a new folder, or one with only a plan.

    ``files``: content by name. Raises InputError if the folder has files, DiskError if it cannot
    be written to.
    """
    # The planner may have created the folder.
    if not (folder.is_dir() and os.listdir(folder) == [PLAN]):
        make_new_folder(folder)
    with writing(folder):
        sync_folder(folder.parent)
    # session.yaml last: it makes the folder a session.
    for name in (URDF, ROWS, HEADER):
        write_atomically(folder / name, files[name])


def _remove_beginnings(folder: Path, empty_rows: bytes) -> None:
    """Remove the files of a writer that was killed before it wrote session.yaml.

    A folder with a session, or with other files than such a writer's and a plan, is unchanged.
    ``empty_rows``: content of observations.csv without rows.
    """
    names = {path.name for path in folder.iterdir() if path.suffix != '.tmp'} - {PLAN}
    if HEADER in names or names - {URDF, ROWS}:
        return
    if ROWS in names and _read_rows(folder) != empty_rows:
        return
    remove_leftovers(folder)
    for name in names:
        with writing(folder / name):
            os.unlink(folder / name)


def _refuse_another(folder: Path, files: Mapping[str, bytes], even_complete: bool) -> None:
    """Raise InputError if the folder has another session than the one to be recorded.

    ``files``: those of the session to be recorded, without rows. Refused are another robot, other
    markers or sensors, a complete session (unless ``even_complete``), one without a journal, and
    one whose files changed after it was closed.
    """
    old, new = read_header(folder), parse_header(files[HEADER], folder / HEADER)
    if old.exit_status == 'complete' and not even_complete:
        raise InputError(f'{folder}: this session is complete; name a new folder')
    urdf = read_limited(folder / old.robot.urdf, URDF_LIMIT, 'it is part of a session')
    differing = [name for name in _COMPARED if getattr(old, name) != getattr(new, name)]
    differing += ['URDF'] * (urdf != files[URDF])
    if differing:
        raise InputError(
            f'{folder}: holds an unfinished session with another {" and ".join(differing)}; '
            'to go on, start with what it was begun with; else name a new folder'
        )
    if not (folder / JOURNAL).exists() and _read_rows(folder) != files[ROWS]:
        raise InputError(
            f'{folder}: holds a session without {JOURNAL}, from which alone it could be resumed; '
            'name a new folder'
        )
    sums = read_manifest(folder)
    for name in sums:
        check_file(sums, folder / name)


def _reopen(folder: Path, *, keep_status: bool) -> str:
    """Prepare a session folder for more rows; return its session.yaml as text.

    Temporary files and the checksums are removed, and the exit status becomes ``aborted``,
    unless ``keep_status``.
    """
    path = folder / HEADER
    remove_leftovers(folder)
    remove_manifest(folder)
    old = path.read_text(encoding='utf-8-sig')
    text = old if keep_status else with_exit_status(old, 'aborted')
    if text != old:
        write_atomically(path, text)
    return text


def _intact_size(path: Path, data: bytes, wanted: bytes, last_rows: Sequence[str]) -> int:
    """Number of intact bytes at the begin of observations.csv after a crash, which are kept.

    ``data``: content of the file; ``wanted``: its content by the journal. All bytes if
    ``wanted`` begins with them; else the whole lines before the first byte that differs. That
    byte may only be in ``last_rows``, the rows that were written last, as a crash can tear
    these alone. Raises ChangedError if it is earlier, or the file is longer than ``wanted``.
    """
    if wanted.startswith(data):
        return len(data)
    differing = (i for i, (a, b) in enumerate(zip(data, wanted)) if a != b)
    good = next(differing, len(wanted))
    start = wanted.rfind(b'\n', 0, good) + 1
    torn_from = len(wanted) - sum(len(row.encode()) + 1 for row in last_rows)
    # A crash damages only the rows that were being written.
    if start < torn_from or len(data) > len(wanted):
        line = data.count(b'\n', 0, start) + 1
        raise ChangedError(
            f'{path}, line {line}: not as {JOURNAL} has it; the session cannot be resumed from a '
            'file that was changed: undo that, let `remaster recover` restore it, or name a new '
            'folder'
        )
    return start


def _read_rows(folder: Path) -> bytes:
    """Return the content of observations.csv; raise InputError if it cannot be read."""
    return read_limited(folder / ROWS, OBSERVATIONS_LIMIT, f'a session folder holds {ROWS}')


class SessionWriter:
    """Writer of a session; data are on the disk once `append` or `record` returns.

    The folder can be read at any moment: its ``exit_status`` is ``aborted`` until `close`, and
    only the last line may be incomplete after a crash. A writer is also a context manager: it
    closes as ``complete``, or as ``aborted`` after an exception.

    The folder is new or empty; with `resume` also that of an unfinished session of the same robot,
    markers and sensors, which is continued. With `even_complete` a complete session is opened too,
    and remains complete (recovery); with `go_further` it is unfinished until it is closed again.
    Measurements and exit status of the header are not used.

    Raises InputError if the folder holds other files, a complete session, or one of another robot;
    if another process writes it; if it cannot be written to; or if the header breaks the format.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        header: Session,
        *,
        resume: bool = False,
        even_complete: bool = False,
        go_further: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self._rows_path = self.folder / ROWS
        self._chain = read_chain(
            header.urdf, self.folder / URDF, header.base_link, header.tip_link
        )
        self._names = header.sensor_names, header.marker_names
        # Columns that rows may need: frames with several markers, orientations of bodies.
        self._optional: tuple[str, ...] = ()
        self._add_columns(
            *['frame'] * bool(header.further_markers), *['orientation'] * bool(header.oriented)
        )
        plain_rows = self._empty_rows
        # The correction set by `correct`.
        self.correction: Correction | None = None
        # Files to be written again because of it.
        self._due: list[str] = []
        self._text = write_header(header, URDF, 'aborted')
        self._urdf = header.urdf.encode()
        files = {URDF: self._urdf, ROWS: self._empty_rows, HEADER: self._text.encode()}
        if resume:
            make_folder(self.folder)
            _remove_beginnings(self.folder, self._empty_rows)
        # Whether the folder held a session.
        self.resumed = resume and (self.folder / HEADER).exists()
        if self.resumed:
            _refuse_another(self.folder, files, even_complete or go_further)
        else:
            _begin(self.folder, files)
        self._closed = False
        self._closed_as: ExitStatus = 'aborted'
        # Repairs by `check`, one line each.
        self.restored: list[str] = []
        # Loss that the journal cannot repair; such a session is not closed as complete.
        self.beyond_repair = ''
        with contextlib.ExitStack() as undo:
            self._journal = Journal(self.folder / JOURNAL)
            undo.callback(self._journal.close)
            self._guard = SessionGuard(self.folder, FILES, self._content)
            undo.callback(self._guard.close)
            if self.resumed:
                self._text = _reopen(self.folder, keep_status=even_complete)
                self._complete_correction(plain_rows)
            self._rows = AppendFile(self._rows_path)
            undo.callback(lambda: self._rows.close())
            self._complete_rows(even_complete)
            self._guard.note_all()
            undo.pop_all()

    def _add_columns(self, *fields: str) -> None:
        """Add optional columns (of `OPTIONAL`) to the format of the rows, before the first row."""
        self._optional = (*self._optional, *fields)
        self._format = RowFormat(self._rows_path, self._chain, *self._names, self._optional)
        self._empty_rows = self._format.header.encode()

    def _complete_correction(self, plain_rows: bytes) -> None:
        """Complete a correction that the journal has and the other files may lack after a crash.

        Its columns go into an observations.csv without rows, its key into session.yaml.
        Nothing happens if the journal has no correction. ``plain_rows``: content of
        observations.csv without rows and without these columns.
        """
        noted = [record for record in self.records if record['kind'] == 'correction']
        if not noted:
            return
        self._use_correction(Correction(noted[-1]['form'], noted[-1]['sha256']))
        if _read_rows(self.folder) == plain_rows:
            write_atomically(self._rows_path, self._empty_rows)
        if (self.folder / HEADER).read_bytes() != self._text.encode():
            write_atomically(self.folder / HEADER, self._text)

    def _use_correction(self, correction: Correction) -> None:
        """Add the columns and the key of a correction to the contents in memory.

        The files are written by `_write_due`.
        """
        self.correction = correction
        self._add_columns('wanted', 'correction')
        self._text = with_correction(self._text, correction)

    def correct(self, correction: Correction) -> None:
        """Record, before the first row, that the bridge corrects commands; add columns for it.

        The columns have the desired joint angles, and whether the correction was on. A second
        call only completes the first. Raises InputError if there are rows already or the
        writer is closed; DiskError if the disk is full: call again when there is room.
        """
        if self.correction is None:
            if self._closed or self.observations:
                raise InputError(f'{self.folder}: the session was begun without a correction')
            self.check()
            record = {'form': correction.form, 'sha256': correction.sha256}
            self._journal.append({'kind': 'correction', **record})
            self._guard.note(JOURNAL)
            self._use_correction(correction)
            self._due = [ROWS, HEADER]
        self._write_due()

    def _write_due(self) -> None:
        """Write the files whose columns or keys a correction has changed.

        Raises DiskError if the disk is full; files not written then are written by the next
        call.
        """
        while self._due:
            name = self._due[0]
            write_atomically(self.folder / name, self._content(name))
            if name == ROWS:
                self._rows.close()
                self._rows = AppendFile(self._rows_path)
            self._guard.note(name)
            self._due.pop(0)

    @property
    def records(self) -> list[Record]:
        """All records of the journal, those of earlier runs included."""
        return self._journal.records

    def _content(self, name: str) -> bytes:
        """Return the bytes that a file of the session must have, by all records written so far.

        ``name``: one of `FILES`: session.yaml, URDF, observations.csv and journal.
        """
        if name == ROWS:
            rows = (row for record in self.records for row in record.get('rows', ()))
            return self._empty_rows + ''.join(f'{row}\n' for row in rows).encode()
        if name == JOURNAL:
            return bytes(self._journal.content)
        return self._text.encode() if name == HEADER else self._urdf

    def _complete_rows(self, even_changed: bool) -> None:
        """Complete observations.csv from the journal, and find the next free numbers.

        Sets `lost`, `observations`, `configurations` and `last_stamp_s`. A file that was changed
        is restored if ``even_changed``, else ChangedError is raised.
        """
        # Incomplete line that was dropped after a crash; '' for none.
        self.lost = self._journal.lost
        wanted = self._content(ROWS)
        pieces = [record['rows'] for record in self.records if 'rows' in record]
        data = _read_rows(self.folder)
        try:
            size = _intact_size(self._rows_path, data, wanted, pieces[-1] if pieces else ())
        except ChangedError:
            if not even_changed:
                raise
            self._note_restored(ROWS, 'was changed', self._restore(ROWS))
            size = len(wanted)
        else:
            if size < len(data):
                self._rows.truncate(size)
        if size < len(wanted):
            self._rows.append(wanted[size:])
        self._rules = SequenceRules()
        self._line = 2
        # The next free numbers.
        self.observations = self.configurations = 0
        # Time of the last observation, s; None before the first.
        self.last_stamp_s: float | None = None
        rows = [row for piece in pieces for row in piece]
        self._accept(self._format.check(rows, self._line, self._rules.branch()))

    def append(self, observation: Observation) -> None:
        """Write one observation durably, or not at all; raises as `record`."""
        self.record({'kind': 'observation'}, [observation])

    def record(self, record: Record, observations: Sequence[Observation] = ()) -> None:
        """Write one record and its observations durably, or not at all.

        ``record``: plain data with a ``kind``; ``observations``: in the order measured. Raises
        InputError if one breaks the format (and writes nothing), or the writer is closed;
        DiskError if the disk is full: call again when there is room.
        """
        if self._closed:
            raise InputError(f'{self.folder}: the session is closed; start a new one')
        self._write_due()
        self.check()
        rows = [self._format.line(row) for row in observations]
        keys = self._format.check(rows, self._line, self._rules.branch())
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
                # The journal is ahead now: only opening the session again repairs that.
                self.release()
            raise
        self._guard.note(ROWS)
        self._accept(keys)

    def check(self, *, content: bool = False) -> None:
        """Detect changes by others to the files, and repair them; `restored` lists the repairs.

        A file that was replaced, removed or changed is written again from memory with all
        acknowledged records. The foreign file is renamed to ``NAME.changed``. A removed folder is
        made again, though the bag and the plan in it are lost. With `content` every byte is
        compared; else size and time of change.

        After a MovedError (the folder was renamed or replaced) or a DiskError nothing may be
        recorded until the cause is removed: call again.
        """
        if self._closed:
            return
        if not self._guard.is_in_place():
            self._make_folder_again()
        for name, change in self._guard.differing(content=content).items():
            renamed = self._restore(name)
            self._guard.note(name)
            self._note_restored(name, change, renamed)
            self._journal.append(
                {'kind': 'restored', 'file': name, 'what': change, 'aside': renamed}
            )
            self._guard.note(JOURNAL)

    def _restore(self, name: str) -> str:
        """Write a file of the session again from memory; return the new name of the foreign file.

        '' if there was none.
        """
        renamed = rename_changed(self.folder / name)
        if name == JOURNAL:
            self._journal.restore()
            return renamed
        write_atomically(self.folder / name, self._content(name))
        if name == ROWS:
            self._rows.close()
            self._rows = AppendFile(self._rows_path)
        return renamed

    def _note_restored(self, name: str, change: str, renamed: str) -> None:
        """Add a line on a repaired file to `restored`.

        ``name``: of the file; ``change``: what happened to it; ``renamed``: new name of the
        foreign file, '' if there was none.
        """
        kept = f'; what was found there is {renamed}' if renamed else ''
        self.restored.append(
            f'{self.folder / name}: {change} while the session was written; it was restored with '
            f'all that was acknowledged{kept}'
        )

    def _make_folder_again(self) -> None:
        """Make the folder again if it was removed; raise MovedError if it was moved."""
        if self._journal.names:
            raise MovedError(
                f'{self.folder}: the session folder was renamed, replaced or unmounted while the '
                'session is written; put it back under its name, and the run goes on'
            )
        make_folder(self.folder)
        self._guard.take_place()
        self.beyond_repair = 'the folder was removed, and with it the bag and the plan'

    def _accept(self, keys: Sequence[RowKeys]) -> None:
        """Update next free numbers, last stamp and sequence rules by rows that are on the disk.

        The rules (`SequenceRules`) note the rows, to check later ones against them; the rows
        themselves are not checked here. ``keys``: of these rows, in their order.
        """
        for key in keys:
            self._rules.accept(key)
            self._line = key.line + 1
            self.observations = max(self.observations, key.observation + 1)
            self.configurations = max(self.configurations, key.configuration + 1)
            self.last_stamp_s = key.stamp_s

    def close(self, exit_status: ExitStatus = 'complete') -> ExitStatus:
        """Write exit status and checksums of all files; return the exit status.

        Every byte is compared first with what was written, and files that others changed are
        repaired (`check`). A second call does nothing and returns the same. ``aborted`` is
        written and returned instead of ``complete`` if `beyond_repair` has a reason (the
        folder was removed).

        After a DiskError call again when there is room. Until then the session remains
        readable, as aborted or without checksums.
        """
        if self._closed:
            return self._closed_as
        self._write_due()
        self.check(content=True)
        if self.beyond_repair and exit_status == 'complete':
            exit_status = 'aborted'
        self._text = with_exit_status(self._text, exit_status)
        write_atomically(self.folder / HEADER, self._text)
        self._guard.note(HEADER)
        sums = {name: hashlib.sha256(self._content(name)).hexdigest() for name in FILES}
        write_sums(self.folder, sums)
        self._closed_as = exit_status
        # After the checksums: until then no other process may write.
        self.release()
        return exit_status

    def release(self) -> None:
        """Close and unlock the files, whatever the session's state; a second call does nothing."""
        self._closed = True
        self._rows.close()
        self._journal.close()
        self._guard.close()

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        try:
            self.close('complete' if kind is None else 'aborted')
        finally:
            self.release()
