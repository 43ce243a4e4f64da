# SPDX-License-Identifier: Apache-2.0
"""Errors of damaged zip archives (workbooks, NumPy arrays) as one line."""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from remaster_ros.errors import InputError

# Exceptions that `zipfile` raises for damaged or locked archives.
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
def damage_as_input_error() -> Iterator[None]:
    """Context that replaces the exceptions for a damaged or locked zip archive by InputError.

    An InputError passes as it is.
    """
    try:
        yield
    except _DAMAGED:
        raise InputError('a zip archive that is damaged or locked; take another copy') from None
