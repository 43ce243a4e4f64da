# SPDX-License-Identifier: Apache-2.0
"""Append-only journals: JSON lines with a checksum each, durable before `append` returns.

A crash can leave only the last line incomplete: cut anywhere, also inside a character, or with
zeros where the file system had reserved blocks but not yet written them. Such a line was never
acknowledged; it is reported and dropped. A damaged line that others follow is not a crash's work,
and the file is refused.
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple

from remaster_ros.errors import InputError
from remaster_ros.session.files import AppendFile, read_limited, write_atomically, writing

JOURNAL_LIMIT = 1024**3

Record = dict[str, Any]


class JournalText(NamedTuple):
    """A journal as read."""

    # One for each whole line.
    records: list[Record]
    # The bytes of these lines, and how many bytes behind them are no whole line.
    whole: bytes
    torn: int


class Journal:
    """Write a journal, or go on with one; what `append` returned from is on the disk.

    Opening cuts off what a crash has left of a line. While it is open, no other process can open
    it for writing; the lock ends with the process, however that ends. The file is made where there
    is none, its name durable. An `InputError` where another process writes it, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = AppendFile(path)
        try:
            self._lock()
            # Every record so far, and the bytes of all their lines.
            self.records, whole, torn = read_journal(path)
            self.content = bytearray(whole)
            # What was cut off, in a line; '' where nothing was.
            self.lost = ''
            if torn:
                self._file.truncate(len(whole))
                self.lost = (
                    f'{path}, line {len(self.records) + 1}: {torn} bytes of a line cut off while '
                    'being written are dropped'
                )
        except BaseException:
            self._file.close()
            raise

    @property
    def names(self) -> int:
        """How many names the open file has: 0 after it was removed."""
        return os.fstat(self._file.descriptor).st_nlink

    def restore(self) -> None:
        """Write every record again, where the file is no longer the one that was opened.

        An `InputError` where another process writes the file that is there.
        """
        write_atomically(self.path, self.content)
        self._file.close()
        self._file = AppendFile(self.path)
        self._lock()

    def _lock(self) -> None:
        with writing(self.path):
            try:
                fcntl.flock(self._file.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f'{self.path}: another process is writing it; end that one, or name another '
                    'folder'
                ) from None

    def append(self, record: Record) -> None:
        """Write one record; durable on return, and with a `DiskError` the file is as before."""
        line = format_record(record)
        self._file.append(line)
        self.content += line
        self.records.append(record)

    def take_back(self) -> None:
        """Cut off the record that was appended last; `InputError` where that is not possible."""
        before = self.content.rfind(b'\n', 0, -1) + 1
        self._file.truncate(before)
        del self.content[before:]
        self.records.pop()

    def close(self) -> None:
        """Close the file and let others open it; closing again does nothing."""
        self._file.close()


def read_journal(path: Path) -> JournalText:
    """Read a journal that is perhaps just being written, or was when the power failed.

    An `InputError` where it cannot be read, or a line that others follow is damaged.
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
    return JournalText(records, data[:size], len(rest))


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
