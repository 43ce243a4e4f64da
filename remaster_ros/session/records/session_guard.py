# SPDX-License-Identifier: Apache-2.0
"""Detection of changes that other programs make to the files of a session while it is written.

An editor that saves a file replaces it, and the writer's open file then has no name; a file can be
changed in place, and a folder removed. The writer still has all acknowledged records in memory,
and can write them again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from remaster_ros.errors import DiskError
from remaster_ros.session.files import (
    reason,
    writing,
)

Signature = tuple[int, int, int, int]
"""Device, inode, bytes, time of change in ns."""


def signature(path: Path) -> Signature | None:
    """Return device, inode, size and time of change of a file; None if it is missing.

    Raises DiskError if it cannot be looked up.
    """
    with writing(path):
        try:
            status = path.stat()
        except FileNotFoundError:
            return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


class SessionGuard:
    """Detects changes by others to a session's files, by their last known state or their content.

    ``content``: returns the bytes that the writer put into the file of a name.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], content: Callable[[str], bytes]
    ) -> None:
        self._folder, self._names, self._content = folder, names, content
        self._descriptor = -1
        self.take_place()
        self._seen: dict[str, Signature | None] = {}

    def note(self, name: str) -> None:
        """Remember the present state of the file ``name``, after the writer has changed it."""
        self._seen[name] = signature(self._folder / name)

    def note_all(self) -> None:
        """Remember the present state of all files."""
        for name in self._names:
            self.note(name)

    def is_in_place(self) -> bool:
        """Return whether the path still leads to the opened folder, by device and inode."""
        found, mine = signature(self._folder), os.fstat(self._descriptor)
        return found is not None and found[:2] == (mine.st_dev, mine.st_ino)

    def take_place(self) -> None:
        """Open the folder that is at the session's path now, in place of the one before.

        `is_in_place` compares with it from then on. It is kept open, because the inode of a
        removed folder may be reused. Raises DiskError if it cannot be opened.
        """
        self.close()
        with writing(self._folder):
            self._descriptor = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)

    def close(self) -> None:
        """Close the folder; a second call does nothing."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def differing(self, *, content: bool) -> dict[str, str]:
        """Return how each file differs from its last known state, by name; {} if none does.

        'was removed', 'was replaced …' or 'was changed'. With ``content`` every byte is compared,
        else only files whose size or time has changed.
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


def rename_changed(path: Path) -> str:
    """Rename a foreign file to ``NAME.changed`` (``.changed2``, … if taken); return its new name.

    '' if there is no file. Raises DiskError if it cannot be renamed.
    """
    number, new_path = 1, path.with_name(f'{path.name}.changed')
    while os.path.lexists(new_path):
        number += 1
        new_path = path.with_name(f'{path.name}.changed{number}')
    with writing(path):
        try:
            os.rename(path, new_path)
        except FileNotFoundError:
            return ''
    return new_path.name


def _read(path: Path) -> bytes:
    """Return the content of a file; raise DiskError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise DiskError(f'{path}: cannot be read ({reason(error)}); check the disk') from None
