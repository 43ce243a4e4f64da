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
    """Return the SHA-256 (hexadecimal) of each closed file by name; {} if there is no manifest.

    A last line without its end is not counted. Raises InputError if the manifest is damaged.
    """
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
    """Write a manifest with these checksums by file name, sorted; the old one is replaced.

    Raises DiskError if that fails.
    """
    lines = [f'{checksum}  {name}\n' for name, checksum in sorted(sums.items())]
    write_atomically(folder / MANIFEST, ''.join(lines))


def add_to_manifest(folder: Path, name: str) -> None:
    """Add the checksum of one more closed file to the manifest.

    Raises InputError if the file or the manifest cannot be read, DiskError if it cannot be
    written.
    """
    write_sums(folder, {**read_manifest(folder), name: sha256_of(folder / name)})


def remove_manifest(folder: Path) -> None:
    """Remove the manifest durably, if there is one, before its files are changed.

    Raises DiskError if that fails.
    """
    path = folder / MANIFEST
    with writing(path):
        if path.exists():
            os.unlink(path)
            sync_folder(folder)


def check_data(sums: Mapping[str, str], path: Path, data: bytes) -> None:
    """Raise InputError if the content of a file differs from its checksum in ``sums``.

    ``sums``: SHA-256 by file name; ``data``: the content. A file that is not listed is
    accepted.
    """
    _compare(sums, path, hashlib.sha256(data).hexdigest())


def check_file(sums: Mapping[str, str], path: Path) -> None:
    """Raise InputError if the SHA-256 of a file differs from that in ``sums``.

    For files too large to read at once. A file that ``sums`` does not list is not read.
    """
    if path.name in sums:
        _compare(sums, path, sha256_of(path))


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; raise InputError if it is unreadable."""
    try:
        if path.exists() and not path.is_file():
            # A pipe or a device has no end.
            raise InputError(f'{path}: not a regular file; take another copy')
        with path.open('rb') as file:
            return hashlib.file_digest(file, 'sha256').hexdigest()
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({reason(error)})') from None


def _compare(sums: Mapping[str, str], path: Path, found: str) -> None:
    """Raise InputError if a file is listed with another checksum than ``found``."""
    if sums.get(path.name, found) != found:
        raise InputError(
            f'{path}: not as it was closed, by its checksum in {MANIFEST}; take another copy '
            f'(or remove {MANIFEST}, if you changed the file yourself)'
        )
