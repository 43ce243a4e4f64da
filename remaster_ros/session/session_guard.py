"""Notice that the files of a session are no longer those that its writer opened.

An editor that saves a file puts a new one in its place, and what is appended to the old one has
no name any more; a file can be changed in place, and a folder removed. What the writer
acknowledged it still has in memory, so it can write it again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from remaster_ros.errors import DiskError
from remaster_ros.session.files import reason, writing

Signature = tuple[int, int, int, int]
"""Device, inode, bytes, time of change in ns."""


def signature(path: Path) -> Signature | None:
    """Return what identifies a file and its state; None where there is none.

    Raises
    ------
    DiskError
        It cannot be looked at.
    """
    with writing(path):
        try:
            found = path.stat()
        except FileNotFoundError:
            return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


class SessionGuard:
    """Compare the files of a folder with what they were and with what they must hold.

    Parameters
    ----------
    folder
        The session's.
    names
        The files.
    content
        Name of a file -> the bytes that the writer put there.
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

        Parameters
        ----------
        content
            Read every file; else only those whose size or time of change is different.
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
    """Rename a file that is not the writer's; return its new name, '' where there is none.

    Raises
    ------
    DiskError
        It cannot be renamed.
    """
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
