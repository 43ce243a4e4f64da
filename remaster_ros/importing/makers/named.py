# SPDX-License-Identifier: Apache-2.0
"""What a maker's own file has: named columns, and what is known of how its controller counts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from remaster_ros.errors import InputError
from remaster_ros.types import SensorKind

SHOWN = 60
NUMBER = re.compile(r'[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?', re.ASCII)
_TIME = re.compile(r'\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?|\d{5,}\.\d+')
# An arm that this program calibrates has more than one joint, and no controller has more axes.
_FEWEST_AXES, _MOST_AXES = 2, 100


@dataclass(frozen=True, eq=False)
class Named:
    """Named columns of a text."""

    # What the file is, for people, where it is no plain table.
    kind: str
    # Of the columns, with their units in brackets; numbers from 1 on where there is no header.
    names: tuple[str, ...]
    # Cells as text, and the line of each row in the file.
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    # Sign of the numbers.
    decimal: str = '.'
    # Marker -> columns X, Y and Z, where the file itself names its markers, and -> columns of its
    # quaternion x, y, z, w.
    groups: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    turns: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    # The markers that are taken where nothing is told; () for all of them.
    points: tuple[str, ...] = ()
    # Joint column -> (another one, 1 or -1) that the controller does not count with it.
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] = field(default_factory=dict)
    # Of the controller; '' where it is not known.
    maker: str = ''
    # Kind of the instrument that measured the points; '' where it is not known.
    instrument: Literal['', SensorKind] = ''
    # What was left out of the file, a sentence each.
    notes: tuple[str, ...] = ()
    has_header: bool = True  # The names stand in the file


def unexpected(number: int, line: str, expected: str) -> InputError:
    """Return the error of a line that is not what it should be."""
    text = line.strip()
    shown = text if len(text) <= SHOWN else f'{text[:SHOWN]}…'
    return InputError(f'line {number}: {shown!r}, where {expected} is expected')


def some(names: Sequence[str]) -> str:
    """Return the first five names, and how many more there are."""
    more = f' and {len(names) - 5} more' if len(names) > 5 else ''
    return f'{", ".join(names[:5])}{more}'


def leading(before: list[str]) -> tuple[list[str], list[str]]:
    """Return the name of what stands before the numbers of each line, and its cells; [] of none.

    They are times, or names where most are unlike.
    """
    stamps = [_TIME.search(words) for words in before]
    if all(stamps):
        return ['time'], [stamp[0].replace(',', '.') for stamp in stamps if stamp]
    return ['name'] * (2 * len({*before}) > len(before) and any(before)), before


def axes_in_order(
    kind: str,
    found: Sequence[tuple[int, str, Mapping[str, str]]],
    letters: Sequence[str],
    maker: str = '',
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] | None = None,
    notes: tuple[str, ...] = (),
    unit: str = 'deg',
) -> Named:
    """Return positions as columns: their names where any has one, then the axes in order.

    Each position is `found` as its line, name ('' for none) and axes, such as ``A1``. `letters`
    are those of the arm's axes, then of external axes, which are left out where they stay at 0.
    """
    every = {axis for _, _, values in found for axis in values}
    if len(every) > _MOST_AXES:
        number = next(number for number, _, values in found if values)
        raise unexpected(number, f'{len(every)} axes', f'{_MOST_AXES} at the most')
    axes = sorted(every, key=lambda axis: (letters.index(axis[0]), int(axis[1:])))
    arm = [axis for axis in axes if axis[0] == letters[0]]
    if arm != [f'{letters[0]}{i}' for i in range(1, len(arm) + 1)] or len(arm) < _FEWEST_AXES:
        raise unexpected(found[0][0], ', '.join(axes), f'{letters[0]}1, {letters[0]}2 and so on')
    for number, name, values in found:
        for axis in arm:
            if axis not in values:
                raise unexpected(number, f'{name} {", ".join(values)}', f'{axis} as well')
    moved = {axis for *_, values in found for axis, cell in values.items() if float(cell)}
    axes = arm + [axis for axis in axes if axis[0] != letters[0] and axis in moved]
    named = any(name for _, name, _ in found)
    return Named(
        kind=kind,
        names=(*['name'] * named, *(f'{axis} [{unit}]' for axis in arm), *axes[len(arm) :]),
        rows=tuple(
            (*[name] * named, *(values.get(axis, '') for axis in axes))
            for _, name, values in found
        ),
        lines=tuple(number for number, _, _ in found),
        maker=maker,
        coupling=coupling or {},
        notes=notes,
    )
