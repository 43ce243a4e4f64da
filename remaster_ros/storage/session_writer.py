"""Write a session observation by observation, and go on with one after whatever has happened.

Each record goes into the journal first (a line with a checksum, synced), then its rows go into
observations.csv (synced), and only then does the caller learn that it is recorded. All rows of a
configuration are one record: after a crash they are all there or none is. What the journal holds
and observations.csv does not is added when the session is opened again.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal

from remaster_ros.core.errors import InputError
from remaster_ros.core.types import Observation, Session
from remaster_ros.storage.files import (
    AppendFile,
    cannot_write,
    make_folder,
    make_new_folder,
    read_limited,
    remove_leftovers,
    sync_folder,
    write_atomically,
)
from remaster_ros.storage.journal import Journal, Record
from remaster_ros.storage.manifest import (
    check_file,
    read_manifest,
    remove_manifest,
    write_manifest,
)
from remaster_ros.storage.observations import check_row, format_header, format_observation
from remaster_ros.storage.safe_yaml import dump_yaml, load_yaml
from remaster_ros.storage.sequence_rules import RowKeys, SequenceRules
from remaster_ros.storage.session import (
    HEADER,
    OBSERVATIONS_LIMIT,
    ROWS,
    URDF,
    URDF_LIMIT,
    read_chain,
)
from remaster_ros.storage.session_yaml import YAML_LIMIT, parse_header, write_header

JOURNAL = 'journal.jsonl'
PLAN = 'plan.jsonl'

ExitStatus = Literal['complete', 'stopped', 'aborted']

_COMPARED = ('robot', 'markers', 'sensors', 'settle_s', 'marker_std_m', 'base_prior')


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
        self._journal = Journal(self.folder / JOURNAL)
        try:
            self._rows = AppendFile(self._rows_path)
        except InputError:
            self._journal.close()
            raise
        try:
            if self.resumed:
                self._reopen(even_complete)
            self._restore()
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

    def _restore(self) -> None:
        """Bring observations.csv up to the journal, and learn the numbers to go on with."""
        self.lost = self._journal.lost
        rows = [row for record in self.records for row in record.get('rows', ())]
        missing = self._missing(rows)
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
            raise InputError(
                f'{self._rows_path}, line {line}: not as {JOURNAL} has it; the session cannot be '
                'resumed from a file that was changed: undo that, or name a new folder'
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
        rows = [format_observation(observation).rstrip('\n') for observation in observations]
        keys = self._checked(rows)
        if rows:
            record = {**record, 'rows': rows}
        self._journal.append(record)
        if not rows:
            return
        try:
            self._rows.append(''.join(f'{row}\n' for row in rows).encode())
        except InputError:
            try:
                self._journal.take_back()
            except InputError:
                # It is ahead now: only opening the session again brings the two together.
                self.release()
            raise
        for key in keys:
            self._accept(key)

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

    def close(self, exit_status: ExitStatus = 'complete') -> None:
        """Say in session.yaml how the session ended, and write the checksums of its files.

        Closing again does nothing.

        Raises
        ------
        DiskError
            The disk does not take it; try again when there is room. Until then the session
            remains readable, as aborted or without checksums.
        """
        if self._closed:
            return
        write_atomically(self.folder / HEADER, with_exit_status(self._text, exit_status))
        write_manifest(self.folder, (HEADER, URDF, ROWS, JOURNAL))
        # Behind the checksums: nobody else may write as long as they are not there.
        self.release()

    def release(self) -> None:
        """Let others go on with the session as it is on the disk, closed or not."""
        self._closed = True
        self._rows.close()
        self._journal.close()

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
