# SPDX-License-Identifier: Apache-2.0
"""Reading of files of unknown origin, and writing of files that survive a crash."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from types import FrameType

from remaster_ros.errors import DiskError, InputError

URDF_LIMIT = 16 * 1024**2
"""Largest robot description that is read, bytes."""

# New files and folders of the present `undone_on_failure`, in the order made.
_MADE: ContextVar[list[Path] | None] = ContextVar('made', default=None)


@contextlib.contextmanager
def undone_on_failure() -> Iterator[None]:
    """Context that removes the new files and folders of its body if that fails or is interrupted.

    Those that `made_if_new` registered, as most functions of this module do. Earlier files,
    and those that others put there meanwhile, remain, with their folder.
    """
    outer, made = _MADE.get(), list[Path]()
    token = _MADE.set(made)
    try:
        yield
    except BaseException:
        for path in reversed(made):
            # A folder with files of others is not empty, and remains.
            with contextlib.suppress(OSError):
                path.rmdir() if path.is_dir() else path.unlink()
        raise
    finally:
        _MADE.reset(token)
    if outer is not None:
        outer += made


def made_if_new(path: Path) -> None:
    """Register a path that is about to be made, so that `undone_on_failure` can remove it.

    Nothing happens if the path exists, or outside of `undone_on_failure`.
    """
    made = _MADE.get()
    if made is not None and not os.path.lexists(path):
        made.append(path)


def read_limited(path: Path, limit: int, missing: str) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    ``missing``: remedy at the end of the message if there is no such file. Raises InputError if
    the file is missing, not regular, unreadable or larger.
    """
    try:
        if not path.exists():
            raise InputError(f'{path}: no such file; {missing}')
        if not path.is_file():
            raise InputError(f'{path}: not a regular file; {missing}')
        with path.open('rb') as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:
        raise InputError(
            f'{path}: cannot be read ({reason(error)}); check its name and permissions'
        ) from None
    if len(data) > limit:
        raise InputError(f'{path}: larger than {limit} bytes; this is not a file of this format')
    return data


class _CpuTimeUsedUp(BaseException):
    """Raised by the signal of `cpu_limited`; no handler of ordinary errors catches it."""


@contextlib.contextmanager
def cpu_limited(limit_s: float, refusal: str) -> Iterator[None]:
    """Raise InputError with the text ``refusal`` if the body takes over limit_s of processor time.

    A signal interrupts the body, also within a regular expression. Signals reach the main thread
    only: in any other thread there is no limit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def expired(number: int, frame: FrameType | None) -> None:
        raise _CpuTimeUsedUp

    handler = signal.signal(signal.SIGPROF, expired)
    outer_s, outer_interval_s = signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        yield
    except _CpuTimeUsedUp:
        raise InputError(refusal) from None
    finally:
        signal.setitimer(signal.ITIMER_PROF, outer_s, outer_interval_s)
        signal.signal(signal.SIGPROF, handler)


def refuse_utf16(data: bytes, path: Path) -> None:
    """Raise InputError for text in UTF-16 (or 32), which Windows programs like to save.

    Every second byte of Latin text is zero in it, with or without a byte order mark.
    """
    even, odd = data[:64:2], data[1:64:2]
    marked = data.startswith((b'\xff\xfe', b'\xfe\xff'))
    latin = len(data) > 3 and sorted((any(even), any(odd))) == [False, True]
    # A power cut leaves zeros at the end of a text, not between characters.
    if marked or (latin and (all(even) or all(odd))):
        raise InputError(f'{path}: this is UTF-16 text; save the file as UTF-8')


def decode_text(data: bytes, path: Path) -> str:
    """Decode UTF-8, with or without a byte order mark.

    Raises InputError, which names file and line, for other bytes, or for UTF-16.
    """
    refuse_utf16(data, path)
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        line = data.count(b'\n', 0, error.start) + 1
        raise InputError(f'{path}, line {line}: not UTF-8 text; save the file as UTF-8') from None


def make_folder(folder: Path) -> None:
    """Create an output folder with its parents, durably, unless it exists.

    Raises DiskError if that is impossible.
    """
    with writing(folder):
        new = [path for path in (folder, *folder.parents) if not path.exists()]
        for path in reversed(new):
            made_if_new(path)
        folder.mkdir(parents=True, exist_ok=True)
        # From the top: a folder that loses its name loses its content.
        for path in reversed(new):
            sync_folder(path.parent)


def make_new_folder(folder: Path) -> None:
    """Create an output folder, or accept an empty one.

    Raises InputError if it has files, DiskError if it cannot be made.
    """
    make_folder(folder)
    with writing(folder):
        occupied = any(folder.iterdir())
    if occupied:
        raise InputError(
            f'{folder}: already holds files, which are not overwritten; name a new or empty folder'
        )


def write_atomically(path: Path, data: str | bytes | bytearray) -> None:
    """Replace a file in one step, durably: readers see the old content or the new.

    Raises DiskError if the folder cannot be written to, or the disk is full.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
    made_if_new(path)
    with writing(path):
        try:
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
            try:
                write_all(descriptor, data.encode() if isinstance(data, str) else data)
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            os.replace(temporary, path)
            sync_folder(path.parent)
        except BaseException:
            # Also after an interrupt, so that the folder is empty.
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files (.*.tmp) of atomic writes that a crash interrupted.

    Raises DiskError if one cannot be removed.
    """
    for path in sorted(folder.glob('.*.tmp')):
        with writing(path):
            os.unlink(path)


class AppendFile:
    """A file to which pieces are appended, each durable once `append` returns, or absent.

    Created durably if it does not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor: int | None = None
        made_if_new(path)
        try:
            if path.exists() and not path.is_file():
                # Opened for writing a pipe waits for a reader.
                raise InputError(f'{path}: not a regular file; give another name')
            self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            self.size = os.fstat(self._descriptor).st_size
            # Also if the file exists: its creator may have been killed before this.
            sync_folder(path.parent)
        except OSError as error:
            self.close()
            raise cannot_write(path, error) from None

    @property
    def descriptor(self) -> int:
        """Descriptor of the open file; raises InputError if it is closed."""
        if self._descriptor is None:
            raise InputError(f'{self.path}: closed; open it again')
        return self._descriptor

    def append(self, data: bytes) -> None:
        """Append a piece durably.

        Raises DiskError if the piece cannot be written, such as to a full disk; the file then
        ends as before. If what was written of the piece cannot be removed, the file is closed.
        InputError if it is closed already.
        """
        descriptor = self.descriptor
        with writing(self.path):
            try:
                write_all(descriptor, data)
                os.fsync(descriptor)
            except OSError:
                # Half a piece in the middle would make the whole file unreadable.
                with contextlib.suppress(InputError):
                    self.truncate(self.size)
                raise
        self.size += len(data)

    def truncate(self, size: int) -> None:
        """Truncate the file to a number of bytes, durably.

        Raises DiskError if that fails; the file is then closed. InputError if it is closed
        already.
        """
        try:
            os.ftruncate(self.descriptor, size)
            os.fsync(self.descriptor)
        except OSError as error:
            self.close()
            raise cannot_write(self.path, error) from None
        self.size = size

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class PatientFile:
    """A new file that keeps data in memory while the disk is full, and writes them later.

    Data survive a kill of this process once `write` returns, unless they are `waiting`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting = bytearray()
        self._given = 0
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL
        with writing(path):
            self._descriptor = os.open(path, flags, 0o666)

    @property
    def waiting(self) -> int:
        """Number of bytes not yet on the disk."""
        return len(self._waiting)

    def write(self, data: bytes) -> int:
        """Accept a piece and return its length; it waits in memory if the disk is full.

        It never raises DiskError; `flush` and `waiting` tell what is not on the disk.
        """
        self._waiting += data
        self._given += len(data)
        with contextlib.suppress(DiskError):
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes accepted, waiting ones included."""
        return self._given

    def flush(self) -> None:
        """Write the waiting bytes; raise DiskError if some remain."""
        with writing(self.path):
            while self._waiting:
                del self._waiting[: os.write(self._descriptor, self._waiting)]

    def close(self) -> None:
        """Write the waiting bytes durably and close the file; raise DiskError if that fails."""
        try:
            self.flush()
            with writing(self.path):
                os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)


def write_all(descriptor: int, data: bytes | bytearray) -> None:
    """Write all of ``data`` to a file descriptor; raise OSError if that fails."""
    written = 0
    while written < len(data):
        written += os.write(descriptor, data[written:])


def sync_folder(folder: Path) -> None:
    """Make the file names in a folder durable, or a power cut may lose that of a new file.

    Raises OSError if that fails.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an OSError of the body to a DiskError that names ``path`` and the remedy."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from None


def cannot_write(path: Path, error: OSError) -> DiskError:
    """Return the DiskError for a file or folder, with reason and remedy."""
    return DiskError(
        f'{path}: cannot be written ({reason(error)}); '
        'name a folder you may write to, with free space'
    )


def reason(error: Exception) -> str:
    """Return the reason of an OSError as text, without the path; of another error its text."""
    return getattr(error, 'strerror', None) or str(error)
