"""Records with NumPy arrays as plain data (dictionaries, lists, numbers), and back."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np


def to_plain(value: Any) -> Any:
    """Return a dataclass, struct or container as plain data; floats keep every bit."""
    return msgspec.to_builtins(value, enc_hook=lambda array: array.tolist())


def from_plain(content: Any, record: Any) -> Any:
    """Return what `to_plain` made plain, a `record` (a type); its arrays are of floats.

    Raises
    ------
    ValueError
        The content does not fit it; names the place.
    """
    return msgspec.convert(content, record, dec_hook=lambda _, values: np.array(values, float))
