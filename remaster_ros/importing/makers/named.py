"""What a maker's own file has: named columns, and what is known of how its controller counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from remaster_ros.errors import InputError

SHOWN = 60


@dataclass(frozen=True)
class Named:
    """Named columns of a text; meanings as of `text_table.TextTable`.

    Attributes
    ----------
    kind
        What the file is, for people.
    names
        Of the columns, with their units in brackets.
    rows, lines
        Cells, and the line of each row.
    decimal
        Sign of the numbers.
    """

    kind: str
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    decimal: str = '.'
    groups: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    turns: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    points: tuple[str, ...] = ()
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] = field(default_factory=dict)
    maker: str = ''
    notes: tuple[str, ...] = ()


def unexpected(number: int, line: str, expected: str) -> InputError:
    """Return the error of a line that is not what it should be."""
    text = line.strip()
    shown = text if len(text) <= SHOWN else f'{text[:SHOWN]}…'
    return InputError(f'line {number}: {shown!r}, where {expected} is expected')
