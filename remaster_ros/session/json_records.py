# SPDX-License-Identifier: Apache-2.0
"""Records of JSON files, each declared once: arrays and NaN on their way to a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec
import numpy as np

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
