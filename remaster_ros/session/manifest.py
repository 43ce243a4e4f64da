# SPDX-License-Identifier: Apache-2.0
"""SHA256SUMS: the checksums of a folder's closed files, as ``sha256sum --check`` reads them."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.session.files import (
    decode_text,
    read_limited,
    reason,
    sync_folder,
    write_atomically,
    writing,
)

MANIFEST = 'SHA256SUMS'
MANIFEST_LIMIT = 1024**2

_LINE = re.compile(r'([0-9a-f]{64}) [ *]([^\0]+)')


def read_manifest(folder: Path) -> dict[str, str]:
    """Return the checksum of every closed file by its name; nothing where there is no manifest."""
    path = folder / MANIFEST
    if not path.exists():
        return {}
    text = decode_text(read_limited(path, MANIFEST_LIMIT, 'it was there a moment ago'), path)
    sums = {}
    for number, line in enumerate(text.split('\n')[:-1], start=1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise InputError(
                f'{path}, line {number}: no checksum and file name; take another copy of the file'
            )
        sums[match[2]] = match[1]
    return sums


def write_sums(folder: Path, sums: Mapping[str, str]) -> None:
    """Write down checksums by name of the file, of what the caller put there."""
    lines = [f'{checksum}  {name}\n' for name, checksum in sorted(sums.items())]
    write_atomically(folder / MANIFEST, ''.join(lines))


def add_to_manifest(folder: Path, name: str) -> None:
    """Write down one more closed file; what is written down already stays."""
    write_sums(folder, {**read_manifest(folder), name: sha256_of(folder / name)})


def remove_manifest(folder: Path) -> None:
    """Take the manifest away, durable on return, before its files are changed."""
    path = folder / MANIFEST
    with writing(path):
        if path.exists():
            os.unlink(path)
            sync_folder(folder)


def check_data(sums: Mapping[str, str], path: Path, data: bytes) -> None:
    """Refuse the content of a file that is not what was closed; unlisted files pass."""
    _compare(sums, path, hashlib.sha256(data).hexdigest())


def check_file(sums: Mapping[str, str], path: Path) -> None:
    """As `check_data`, for a file too large to hold."""
    if path.name in sums:
        _compare(sums, path, sha256_of(path))


def sha256_of(path: Path) -> str:
    """Return a file's checksum in hexadecimal."""
    try:
        if path.exists() and not path.is_file():
            # A pipe or a device has no end.
            raise InputError(f'{path}: not a regular file; take another copy')
        with path.open('rb') as file:
            return hashlib.file_digest(file, 'sha256').hexdigest()
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({reason(error)})') from None


def _compare(sums: Mapping[str, str], path: Path, found: str) -> None:
    if sums.get(path.name, found) != found:
        raise InputError(
            f'{path}: not as it was closed, by its checksum in {MANIFEST}; take another copy '
            f'(or remove {MANIFEST}, if you changed the file yourself)'
        )
