"""Append-only journals: JSON lines with a checksum each, durable before anybody is told.

A crash can leave only the last line incomplete: cut anywhere, also inside a character, or with
zeros where the file system had reserved blocks but not yet written them. Such a line was never
acknowledged; it is reported and dropped. A damaged line that others follow is not a crash's work,
and the file is refused.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple

from remaster_ros.errors import InputError
from remaster_ros.session.files import AppendFile, cannot_write, read_limited, write_atomically

JOURNAL_LIMIT = 1024**3

Record = dict[str, Any]


class JournalText(NamedTuple):
    """A journal as read.

    Attributes
    ----------
    records
        What the whole lines say.
    size
        How many bytes these lines are.
    torn
        How many bytes behind them are no whole line.
    """

    records: list[Record]
    size: int
    torn: int


class Journal:
    """Write a journal, or go on with one; what `append` returned from is on the disk.

    Opening cuts off what a crash has left of a line. While it is open, nobody else can open it
    for writing; the lock goes with the process, however that ends.

    Parameters
    ----------
    path
        The file; made where there is none, its name durable.

    Attributes
    ----------
    records
        Every record so far.
    lost
        What was cut off when opening, in words; '' where nothing was.

    Raises
    ------
    InputError
        Another process writes it, it is damaged, or it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = AppendFile(path)
        try:
            self._lock()
            self.records, size, torn = read_journal(path)
            self.lost = torn_words(path, len(self.records), torn)
            if torn:
                self._file.truncate(size)
            self._before = self._file.size
            whole = read_limited(path, JOURNAL_LIMIT, 'it was there a moment ago')[:size]
            self._sum = self._sum_before = hashlib.sha256(whole)
        except BaseException:
            self._file.close()
            raise

    @property
    def sha256(self) -> str:
        """Checksum of all that was written, in hexadecimal."""
        return self._sum.hexdigest()

    @property
    def names(self) -> int:
        """How many names the open file has: 0 after it was removed."""
        return os.fstat(self._file.descriptor).st_nlink

    def holds(self, data: bytes) -> bool:
        """Tell whether these bytes are what was written."""
        return hashlib.sha256(data).hexdigest() == self.sha256

    def restore(self) -> None:
        """Write every record again, where the file is no longer the one that was opened.

        Raises
        ------
        DiskError
            The disk does not take it.
        InputError
            Another process writes the file that is there.
        """
        data = b''.join(map(format_record, self.records))
        write_atomically(self.path, data)
        self._file.close()
        self._file = AppendFile(self.path)
        self._lock()
        self._before = self._file.size
        self._sum = self._sum_before = hashlib.sha256(data)

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f'{self.path}: another process is writing it; end that one, or name another folder'
            ) from None
        except OSError as error:
            raise cannot_write(self.path, error) from None

    def append(self, record: Record) -> None:
        """Write one record; durable on return.

        Raises
        ------
        DiskError
            The disk does not take it; the file is as it was before.
        """
        line = format_record(record)
        self._before, self._sum_before = self._file.size, self._sum.copy()
        self._file.append(line)
        self._sum.update(line)
        self.records.append(record)

    def take_back(self) -> None:
        """Cut off the record that was appended last; `InputError` where that is not possible."""
        self._file.truncate(self._before)
        self._sum = self._sum_before
        self.records.pop()

    def close(self) -> None:
        """Close the file and let others open it; closing again does nothing."""
        self._file.close()


def read_journal(path: Path) -> JournalText:
    """Read a journal that is perhaps just being written, or was when the power failed.

    Raises
    ------
    InputError
        It cannot be read, or a line that others follow is damaged.
    """
    data = read_limited(path, JOURNAL_LIMIT, 'without its journal a session cannot be resumed')
    records: list[Record] = []
    size = 0
    lines = data.split(b'\n')
    for line in lines[:-1]:
        record = parse_record(line)
        if record is None:
            break
        records.append(record)
        size += len(line) + 1
    rest = data[size:]
    # Zeros may hide the line end of the torn line, and a whole line may only come before it.
    following = rest.split(b'\n')[1:]
    if any(parse_record(line) is not None for line in following):
        raise InputError(
            f'{path}, line {len(records) + 1}: damaged, though whole lines follow; '
            'take another copy of the file'
        )
    return JournalText(records, size, len(rest))


def torn_words(path: Path, whole: int, torn: int) -> str:
    """Say what of a journal with `whole` good lines is dropped; '' where nothing is."""
    if not torn:
        return ''
    return (
        f'{path}, line {whole + 1}: {torn} bytes of a line cut off while being written are dropped'
    )


def format_record(record: Record) -> bytes:
    """Return a record as one line: JSON whose last member is the CRC-32 of what is before it."""
    text = json.dumps(record, ensure_ascii=False, separators=(',', ':'), allow_nan=False)
    body = text[:-1].encode()
    return body + _seal(body) + b'\n'


def parse_record(line: bytes) -> Record | None:
    """Undo `format_record` for a line without its end; None where it is not whole."""
    body, seal = line[:-_SEAL_LENGTH], line[-_SEAL_LENGTH:]
    if _seal(body) != seal:
        return None
    try:
        record = json.loads(body + b'}')
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _seal(body: bytes) -> bytes:
    return b',"crc32":"%08x"}' % zlib.crc32(body)


_SEAL_LENGTH = len(_seal(b''))
