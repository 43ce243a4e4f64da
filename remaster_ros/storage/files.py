"""Reading files from strangers and writing files that survive a crash."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from remaster_ros.core.errors import InputError


def read_limited(path: Path, limit: int, missing: str) -> bytes:
    """Read a regular file of at most `limit` bytes.

    Parameters
    ----------
    path
        The file.
    limit
        Largest size accepted, bytes.
    missing
        What to tell the user where there is no such file.

    Raises
    ------
    InputError
        No such file, not a regular file, not readable, or larger than `limit`.
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


def decode_text(data: bytes, path: Path) -> str:
    """Decode UTF-8, with or without a byte order mark; an `InputError` names the line."""
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        line = data.count(b'\n', 0, error.start) + 1
        raise InputError(f'{path}, line {line}: not UTF-8 text; save the file as UTF-8') from None


def make_folder(folder: Path) -> None:
    """Create an output folder with its parents; an `InputError` says why it cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from None


def make_new_folder(folder: Path) -> None:
    """Create an output folder, or take an empty one; `InputError` where it holds files."""
    make_folder(folder)
    try:
        occupied = any(folder.iterdir())
    except OSError as error:
        raise cannot_write(folder, error) from None
    if occupied:
        raise InputError(
            f'{folder}: already holds files, which are not overwritten; name a new or empty folder'
        )


def write_atomically(path: Path, data: str | bytes) -> None:
    """Replace a file in one step, durable on return: readers see the old text or the new.

    Raises
    ------
    InputError
        The folder cannot be written to, or the disk is full.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
    try:
        with temporary.open('wb') as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise cannot_write(path, error) from None


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable: without it a power cut may lose a new file's name."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cannot_write(path: Path, error: OSError) -> InputError:
    """Return the error that says why a file or folder cannot be written, and the remedy."""
    return InputError(
        f'{path}: cannot be written ({reason(error)}); '
        'name a folder you may write to, with free space'
    )


def reason(error: Exception) -> str:
    """Return an operating-system error in words, without the path it repeats."""
    return getattr(error, 'strerror', None) or str(error)
