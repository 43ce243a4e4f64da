# SPDX-License-Identifier: Apache-2.0
"""Records of JSON files, each declared once: how they are written, read and refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from remaster_ros.errors import InputError

Record = TypeVar('Record', bound=msgspec.Struct)


def plain(values: Any) -> Any:
    """Array as nested lists, mapping as a dict (not deeper), for a JSON encoder.

    Raises TypeError for other types.
    """
    if isinstance(values, np.ndarray | np.generic):
        return values.tolist()
    if isinstance(values, Mapping):
        return dict(values)
    raise TypeError(f'no JSON for {type(values)}')


def checked(content: Mapping[str, Any] | msgspec.Struct, record: type[Record]) -> Record:
    """Content as a record: arrays as lists, NaN as None, unknown keys dropped."""
    return msgspec.json.decode(msgspec.json.encode(content, enc_hook=plain), type=record)


def encoded(content: msgspec.Struct) -> bytes:
    """Bytes of a file, indented."""
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b'\n'


def decoded(data: bytes, path: Path, record: type[Record], form: str, remedy: str) -> Record:
    """Record in the bytes of a file; unknown keys are dropped.

    Raises InputError, a line with `path`, the key and the `remedy`, if it is damaged, lacks a key,
    or has another format than `form`.
    """
    try:
        content = msgspec.json.decode(data)
        # First: another file's keys would only confuse.
        given = content.get('format', form) if isinstance(content, dict) else form
        if given == form or not isinstance(given, str):
            return msgspec.convert(content, record)
        why = f'format is {given[:60]!r}, not {form!r}'
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        why = ' '.join(str(error).split())
    raise InputError(f'{path}: {why}; {remedy}')


def has_format(data: bytes, form: str) -> bool:
    """Whether the bytes of a file are JSON of a format."""
    try:
        content = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return isinstance(content, dict) and content.get('format') == form
