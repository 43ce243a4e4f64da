# SPDX-License-Identifier: Apache-2.0
"""Write a session observation by observation, and go on with one after whatever has happened.

Each record goes into the journal first (a line with a checksum, synced), then its rows go into
observations.csv (synced), and only then does the call return. All rows of a
configuration are one record: after a crash they are all there or none is. What the journal holds
and observations.csv does not is added when the session is opened again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from remaster_ros.errors import DiskError, InputError, MovedError
from remaster_ros.session.files import (
    URDF_LIMIT,
    AppendFile,
    make_folder,
    make_new_folder,
    read_limited,
    reason,
    remove_leftovers,
    sync_folder,
    write_atomically,
    writing,
)
from remaster_ros.session.journal import Journal, Record
from remaster_ros.session.manifest import check_file, read_manifest, remove_manifest, write_sums
from remaster_ros.session.observations import RowFormat, RowKeys, SequenceRules
from remaster_ros.session.reader import (
    HEADER,
    JOURNAL,
    OBSERVATIONS_LIMIT,
    PLAN,
    ROWS,
    URDF,
    read_chain,
    read_header,
)
from remaster_ros.session.session_yaml import (
    ExitStatus,
    parse_header,
    with_correction,
    with_exit_status,
    write_header,
)
from remaster_ros.types import Correction, Observation, Session

# Notice that the files of a session are no longer those that its writer opened.
#
# An editor that saves a file puts a new one in its place, and what is appended to the old one has
# no name any more; a file can be changed in place, and a folder removed. What the writer
# acknowledged it still has in memory, so it can write it again.


Signature = tuple[int, int, int, int]
"""Device, inode, bytes, time of change in ns."""


def signature(path: Path) -> Signature | None:
    """Return what identifies a file and its state; None where there is none."""
    with writing(path):
        try:
            found = path.stat()
        except FileNotFoundError:
            return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


class SessionGuard:
    """Compare the files of a folder with what they were and with what they must hold.

    `content` returns the bytes that the writer put into the file of a name.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], content: Callable[[str], bytes]
    ) -> None:
        self._folder, self._names, self._content = folder, names, content
        self._descriptor = -1
        self.take_place()
        self._seen: dict[str, Signature | None] = {}

    def note(self, name: str) -> None:
        """Take a file as it is now; for the writer, after it has changed it."""
        self._seen[name] = signature(self._folder / name)

    def note_all(self) -> None:
        """Take all files as they are now."""
        for name in self._names:
            self.note(name)

    def is_in_place(self) -> bool:
        """Return whether the folder of this name is still the one that was opened."""
        found, mine = signature(self._folder), os.fstat(self._descriptor)
        return found is not None and found[:2] == (mine.st_dev, mine.st_ino)

    def take_place(self) -> None:
        """Take the folder that has this name now for the session's.

        It is kept open: the number of a folder that was removed is given to the next one.
        """
        self.close()
        with writing(self._folder):
            self._descriptor = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)

    def close(self) -> None:
        """Let the folder go; closing again does nothing."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def differing(self, *, content: bool) -> dict[str, str]:
        """Return the files that are not as the writer left them, and what is wrong with each.

        With `content` every file is read, else only those of another size or time of change.
        """
        wrong = {}
        for name in self._names:
            path, seen = self._folder / name, self._seen.get(name)
            now = signature(path)
            if now is None:
                wrong[name] = 'was removed'
            elif seen is None or now[:2] != seen[:2] or not path.is_file():
                wrong[name] = 'was replaced by another file, as editors do when they save'
            elif content or now != seen:
                if _read(path) == self._content(name):
                    self._seen[name] = now
                else:
                    wrong[name] = 'was changed'
        return wrong


def set_aside(path: Path) -> str:
    """Rename a file that is not the writer's; return its new name, '' where there is none."""
    number, aside = 1, path.with_name(f'{path.name}.changed')
    while os.path.lexists(aside):
        number += 1
        aside = path.with_name(f'{path.name}.changed{number}')
    with writing(path):
        try:
            os.rename(path, aside)
        except FileNotFoundError:
            return ''
    return aside.name


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DiskError(f'{path}: cannot be read ({reason(error)}); check the disk') from None


# Begin a session folder, or take up one that its writer left unfinished, whatever stopped it.

_COMPARED = ('robot', 'markers', 'sensors', 'settle_s', 'marker_std_m', 'base_prior')


class ChangedError(InputError):
    """observations.csv is not what the journal has, and no crash made it so."""


def _begin(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of a session without rows into a new folder, or one with only a plan."""
    # The planner may have been there first.
    if not (folder.is_dir() and os.listdir(folder) == [PLAN]):
        make_new_folder(folder)
    with writing(folder):
        sync_folder(folder.parent)
    # session.yaml last: with it the folder is a session.
    for name in (URDF, ROWS, HEADER):
        write_atomically(folder / name, files[name])


def _remove_beginnings(folder: Path, empty_rows: bytes) -> None:
    """Remove what a writer has left that was killed before the folder was a session.

    A folder that holds a session, or anything else, is left as it is.
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
    """Refuse to go on with a session that is not the one to be recorded.

    `files` are those of the session to be recorded, without rows. An `InputError` for another
    robot, markers or sensors, a complete session, one without a journal, or files that changed
    since the session was closed.
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
    """Take back that a session was closed; return the text of its session.yaml.

    Its exit status becomes ``aborted``, unless it is to be kept.
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
    """Return how many bytes of observations.csv are whole lines as the journal has them.

    `data` is what the file holds, `wanted` what it must hold by the journal, whose last record
    with rows has `last_rows`: only these can be torn. A `ChangedError` where it differs before.
    """
    if wanted.startswith(data):
        return len(data)
    differing = (i for i, (a, b) in enumerate(zip(data, wanted)) if a != b)
    good = next(differing, len(wanted))
    start = wanted.rfind(b'\n', 0, good) + 1
    torn_from = len(wanted) - sum(len(row.encode()) + 1 for row in last_rows)
    # What a crash tore never reaches beyond what was being written.
    if start < torn_from or len(data) > len(wanted):
        line = data.count(b'\n', 0, start) + 1
        raise ChangedError(
            f'{path}, line {line}: not as {JOURNAL} has it; the session cannot be resumed from a '
            'file that was changed: undo that, let `remaster recover` restore it, or name a new '
            'folder'
        )
    return start


def _read_rows(folder: Path) -> bytes:
    return read_limited(folder / ROWS, OBSERVATIONS_LIMIT, f'a session folder holds {ROWS}')


FILES = (HEADER, URDF, ROWS, JOURNAL)


class SessionWriter:
    """Write a session; what `append` or `record` returned from is on the disk.

    The folder can be read at any moment: it has ``exit_status: aborted`` until `close`, and a
    line cut off by a crash is the only thing a reader may find incomplete. A writer is also a
    context manager: it closes as ``complete``, or as ``aborted`` where an exception passes.

    The folder is new or empty; with `resume` also that of an unfinished session of the same robot,
    markers and sensors, which goes on. With `even_complete` a complete session is opened too, and
    remains complete until it is closed (recovery); with `go_further` it is unfinished until it is
    closed again. Of the header, measurements and exit status are not used.

    An `InputError` where the folder holds something else, a complete session, or one of another
    robot; another process writes it; it cannot be written to; or the header breaks the format.
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
        # Columns for what may come: of frames with several markers, of bodies' orientations.
        self._optional: tuple[str, ...] = ()
        self._add_columns(
            *['frame'] * bool(header.further_markers), *['orientation'] * bool(header.oriented)
        )
        plain_rows = self._empty_rows
        # That `correct` was told of.
        self.correction: Correction | None = None
        # Files that are to be written again for it.
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
        # What `check` found changed by others and restored, a line each.
        self.restored: list[str] = []
        # What others destroyed and the journal has not; such a session is not closed as complete.
        self.beyond_repair = ''
        with contextlib.ExitStack() as undo:
            self._journal = Journal(self.folder / JOURNAL)
            undo.callback(self._journal.close)
            self._guard = SessionGuard(self.folder, FILES, self._content)
            undo.callback(self._guard.close)
            if self.resumed:
                self._text = _reopen(self.folder, keep_status=even_complete)
                self._take_up_correction(plain_rows)
            self._rows = AppendFile(self._rows_path)
            undo.callback(lambda: self._rows.close())
            self._take_up_rows(even_complete)
            self._guard.note_all()
            undo.pop_all()

    def _add_columns(self, *fields: str) -> None:
        self._optional = (*self._optional, *fields)
        self._format = RowFormat(self._rows_path, self._chain, *self._names, self._optional)
        self._empty_rows = self._format.header.encode()

    def _take_up_correction(self, plain_rows: bytes) -> None:
        """Write columns and key of a correction that was noted, if a crash came in between."""
        noted = [record for record in self.records if record['kind'] == 'correction']
        if not noted:
            return
        self._use_correction(Correction(noted[-1]['form'], noted[-1]['sha256']))
        if _read_rows(self.folder) == plain_rows:
            write_atomically(self._rows_path, self._empty_rows)
        if (self.folder / HEADER).read_bytes() != self._text.encode():
            write_atomically(self.folder / HEADER, self._text)

    def _use_correction(self, correction: Correction) -> None:
        self.correction = correction
        self._add_columns('wanted', 'correction')
        self._text = with_correction(self._text, correction)

    def correct(self, correction: Correction) -> None:
        """Note the correction that is on, before the first row: what was wanted gets columns.

        After a `DiskError` try again when there is room.
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
        """Every record of the journal, also those of the runs before."""
        return self._journal.records

    def _content(self, name: str) -> bytes:
        """Return what a file of the session must hold: all that was acknowledged."""
        if name == ROWS:
            rows = (row for record in self.records for row in record.get('rows', ()))
            return self._empty_rows + ''.join(f'{row}\n' for row in rows).encode()
        if name == JOURNAL:
            return bytes(self._journal.content)
        return self._text.encode() if name == HEADER else self._urdf

    def _take_up_rows(self, even_changed: bool) -> None:
        """Bring observations.csv up to the journal, and find the numbers to go on with."""
        # What a crash has left incomplete, and was dropped; '' where nothing was.
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
        """Write one observation; durable on return, or not there at all (see `record`)."""
        self.record({'kind': 'observation'}, [observation])

    def record(self, record: Record, observations: Sequence[Observation] = ()) -> None:
        """Write one record and its observations; durable on return, or not there at all.

        The record is plain data with a ``kind``; the observations are in the order measured. An
        `InputError` where one breaks the format (and nothing is written), or the writer is closed;
        a `DiskError` where the disk does not take it: try again when there is room.
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
                # It is ahead now: only opening the session again brings the two together.
                self.release()
            raise
        self._guard.note(ROWS)
        self._accept(keys)

    def check(self, *, content: bool = False) -> None:
        """Notice what others did to the files, and restore them; `restored` lists what.

        A file that was replaced, removed or changed is written again from what is in memory: all
        that was acknowledged. What is found in its place is renamed to ``NAME.changed``. A folder
        that was removed is made again, though the bag and the plan in it are lost. With `content`
        every byte is compared; else files of the same size and time of change pass.

        After a `MovedError` (the folder was renamed or replaced) or a `DiskError` nothing may be
        recorded until it is as before: try again.
        """
        if self._closed:
            return
        if not self._guard.is_in_place():
            self._make_folder_again()
        for name, what in self._guard.differing(content=content).items():
            aside = self._restore(name)
            self._guard.note(name)
            self._note_restored(name, what, aside)
            self._journal.append({'kind': 'restored', 'file': name, 'what': what, 'aside': aside})
            self._guard.note(JOURNAL)

    def _restore(self, name: str) -> str:
        """Write a file again; return the new name of what was found there."""
        aside = set_aside(self.folder / name)
        if name == JOURNAL:
            self._journal.restore()
            return aside
        write_atomically(self.folder / name, self._content(name))
        if name == ROWS:
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
        """Make the folder again if it was removed; `MovedError` if it is elsewhere now."""
        if self._journal.names:
            raise MovedError(
                f'{self.folder}: the session folder was renamed, replaced or unmounted while the '
                'session is written; put it back under its name, and the run goes on'
            )
        make_folder(self.folder)
        self._guard.take_place()
        self.beyond_repair = 'the folder was removed, and with it the bag and the plan'

    def _accept(self, keys: Sequence[RowKeys]) -> None:
        """Take rows that are on the disk for the last ones."""
        for key in keys:
            self._rules.accept(key)
            self._line = key.line + 1
            self.observations = max(self.observations, key.observation + 1)
            self.configurations = max(self.configurations, key.configuration + 1)
            self.last_stamp_s = key.stamp_s

    def close(self, exit_status: ExitStatus = 'complete') -> ExitStatus:
        """Write to session.yaml how the session ended, and the checksums of all files.

        Before that every byte of them is compared with what was acknowledged (`check`), and the
        checksums are of that. Closing again does nothing. Returns what it was closed as:
        ``aborted`` instead of ``complete`` where something is `beyond_repair`.

        After a `DiskError` try again when there is room. Until then the session remains readable,
        as aborted or without checksums.
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
        # After the checksums: until they are there no other process may write.
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

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        try:
            self.close('complete' if kind is None else 'aborted')
        finally:
            self.release()
