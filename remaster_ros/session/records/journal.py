# SPDX-License-Identifier: Apache-2.0
"""Append-only journals: JSON lines with a checksum each, durable before `append` returns.

A crash can leave only the last line incomplete: truncated, also inside a character, or followed by
zeros of blocks that the file system reserved. Such a line was never acknowledged; it is reported
and dropped. A damaged line before another line is not the effect of a crash, and the file is
refused.
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
    """The content of a journal."""

    # One record for each whole line.
    records: list[Record]
    # Bytes of the whole lines, and number of bytes of an incomplete line behind them.
    whole: bytes
    torn: int


class Journal:
    """Writer of a journal, new or existing; a record is on the disk once `append` returns.

    Opening removes an incomplete last line. While it is open, no other process can open the file
    for writing; the lock ends with the process, however that ends. Raises InputError if another
    process writes the file, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = AppendFile(path)
        try:
            self._lock()
            # All records so far, and the bytes of their lines.
            self.records, content, torn = read_journal(path)
            self.content = bytearray(content)
            # What was removed from the end, in one line; '' for nothing.
            self.lost = ''
            if torn:
                self._file.truncate(len(content))
                self.lost = (
                    f'{path}, line {len(self.records) + 1}: {torn} bytes of a line cut off while '
                    'being written are dropped'
                )
        except BaseException:
            self._file.close()
            raise

    @property
    def names(self) -> int:
        """Number of names (hard links) of the open file: 0 after it was removed."""
        return os.fstat(self._file.descriptor).st_nlink

    def restore(self) -> None:
        """Write all records into a new file at the journal's path, and continue in that.

        For a journal whose file was removed or replaced by others. Raises InputError if
        another process writes the file that is now there, DiskError if the disk is full.
        """
        write_atomically(self.path, self.content)
        self._file.close()
        self._file = AppendFile(self.path)
        self._lock()

    def _lock(self) -> None:
        """Lock the open file; raise InputError if another process has locked it."""
        with writing(self.path):
            try:
                fcntl.flock(self._file.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f'{self.path}: another process is writing it; end that one, or name another '
                    'folder'
                ) from None

    def append(self, record: Record) -> None:
        """Append one record durably; it is added to `records` and `content`.

        Raises DiskError if the disk is full; the file is then as before. ValueError for NaN or
        infinity.
        """
        line = format_record(record)
        self._file.append(line)
        self.content += line
        self.records.append(record)

    def take_back(self) -> None:
        """Remove the last appended record from file, `records` and `content`.

        Raises DiskError if the file cannot be shortened, InputError if it is closed.
        """
        previous_size = self.content.rfind(b'\n', 0, -1) + 1
        self._file.truncate(previous_size)
        del self.content[previous_size:]
        self.records.pop()

    def close(self) -> None:
        """Close and unlock the file; a second call does nothing."""
        self._file.close()


def read_journal(path: Path) -> JournalText:
    """Read a journal that may be in the process of being written, or cut off by a power failure.

    Raises InputError if it cannot be read, or a line before the last one is damaged.
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
    remainder = data[size:]
    # Zeros may hide the line end of the torn line, and a whole line may only come before it.
    following = remainder.split(b'\n')[1:]
    if any(parse_record(line) is not None for line in following):
        raise InputError(
            f'{path}, line {len(records) + 1}: damaged, though whole lines follow; '
            'take another copy of the file'
        )
    return JournalText(records, data[:size], len(remainder))


def format_record(record: Record) -> bytes:
    """Return a record as one line with its end: JSON whose last member is the CRC-32 of the rest.

    Raises ValueError for NaN or infinity. The record must not be empty.
    """
    text = json.dumps(record, ensure_ascii=False, separators=(',', ':'), allow_nan=False)
    body = text[:-1].encode()
    return body + _seal(body) + b'\n'


def parse_record(line: bytes) -> Record | None:
    """Return the record of a line without its end; None if the line is incomplete or damaged."""
    body, seal = line[:-_SEAL_LENGTH], line[-_SEAL_LENGTH:]
    if _seal(body) != seal:
        return None
    try:
        record = json.loads(body + b'}')
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _seal(body: bytes) -> bytes:
    """Return the last member of a line: the CRC-32 of its body, in hexadecimal."""
    return b',"crc32":"%08x"}' % zlib.crc32(body)


_SEAL_LENGTH = len(_seal(b''))
