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
    """Array as nested lists, or mapping as a dict; for a JSON encoder that calls this for them.

    The values in a mapping are not converted. Raises TypeError for other types.
    """
    if isinstance(values, np.ndarray | np.generic):
        return values.tolist()
    if isinstance(values, Mapping):
        return dict(values)
    raise TypeError(f'no JSON for {type(values)}')


def checked(content: Mapping[str, Any] | msgspec.Struct, record: type[Record]) -> Record:
    """Content converted to a record type: arrays as lists, NaN as None, unknown keys dropped.

    Raises msgspec.ValidationError if a key is missing or has another type.
    """
    return msgspec.json.decode(msgspec.json.encode(content, enc_hook=plain), type=record)


def encoded(content: msgspec.Struct) -> bytes:
    """Bytes of a record as JSON, indented by two blanks, with a line end."""
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b'\n'


class _AnyFile(msgspec.Struct):
    """The key that each JSON file of this program has."""

    format: str | None = None


def format_of(data: bytes) -> str | None:
    """Value of the key ``format`` in the bytes of a JSON file; None if it has none.

    None also if the file is damaged. Other keys are skipped, not built: a hostile file takes
    no more memory than its own size.
    """
    try:
        return msgspec.json.decode(data, type=_AnyFile).format
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def decoded(data: bytes, path: Path, record: type[Record], form: str, remedy: str) -> Record:
    """Record of a type in the bytes of a JSON file; unknown keys are dropped.

    ``form``: value of the key ``format`` that the file must have. Raises InputError, a line with
    ``path``, the key and the ``remedy``, if it is damaged, lacks a key, or has another format.
    """
    # First: another file's keys would only confuse.
    given = format_of(data)
    why = f'format is {(given or "")[:60]!r}, not {form!r}'
    if given in (None, form):
        try:
            return msgspec.json.decode(data, type=record)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            why = ' '.join(str(error).split())
    raise InputError(f'{path}: {why}; {remedy}')
