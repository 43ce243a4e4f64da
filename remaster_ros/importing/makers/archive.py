# SPDX-License-Identifier: Apache-2.0
"""Zip archives that workbooks and arrays of NumPy are: what a damaged one raises, in one line."""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from remaster_ros.errors import InputError

# Of damaged directories `zipfile` raises what places and lengths without sense lead to.
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    KeyError,
    MemoryError,
    NotImplementedError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
)


@contextmanager
def damage_said() -> Iterator[None]:
    """Raise an InputError in place of what a damaged or locked archive raises."""
    try:
        yield
    except _DAMAGED:
        raise InputError('a zip archive that is damaged or locked; take another copy') from None
