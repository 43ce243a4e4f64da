# SPDX-License-Identifier: Apache-2.0
"""Named columns of a file, and how its controller counts the joints."""

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
# An arm to calibrate has at least two joints, and no controller has more than a hundred axes.
_FEWEST_AXES, _MOST_AXES = 2, 100
UNUSED = 9e9
"""Value of an external axis of RAPID that is not used; larger ones are none either."""


@dataclass(frozen=True, eq=False)
class NamedColumns:
    """Named columns of a file, with cells as text and the line of each row."""

    # Format of the file in words; '' for a plain table.
    kind: str
    # Names of the columns, with units in brackets; numbers from 1 on if there is no header.
    names: tuple[str, ...]
    # Cells as text, and the line of each row in the file.
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    # Decimal sign of the numbers.
    decimal: str = '.'
    # Marker -> columns X, Y and Z, if the file itself names its markers; and marker -> columns of
    # its quaternion x, y, z, w.
    groups: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    turns: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    # Markers that are used unless the user names others; () for all.
    points: tuple[str, ...] = ()
    # Joint column -> (another joint column, 1 or -1) that has to be added to it: the controller
    # counts the two joints as coupled.
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] = field(default_factory=dict)
    # Manufacturer of the controller; '' if unknown.
    maker: str = ''
    # Kind of the instrument that measured the points; '' if unknown.
    instrument: Literal['', SensorKind] = ''
    # Parts of the file that were left out, a sentence each.
    notes: tuple[str, ...] = ()
    has_header: bool = True  # The names stand in the file


def unexpected(number: int, line: str, expected: str) -> InputError:
    """Return an InputError on a line, with its number, its content and what is expected there.

    Only the first 60 letters of the line are shown.
    """
    text = line.strip()
    shown = text if len(text) <= SHOWN else f'{text[:SHOWN]}…'
    return InputError(f'line {number}: {shown!r}, where {expected} is expected')


def first_names(names: Sequence[str]) -> str:
    """The first five names, separated by commas, and the number of others, as text."""
    more = f' and {len(names) - 5} more' if len(names) > 5 else ''
    return f'{", ".join(names[:5])}{more}'


def leading_column(labels: list[str]) -> tuple[list[str], list[str]]:
    """Name and cells of a first column made of the text before the numbers of each line.

    `labels`: these texts. ['time'] and the times if there is one in each text. Else the cells
    are `labels`, and the name is ['name'] if over half of them are different, or [] (no
    column).
    """
    stamps = [_TIME.search(words) for words in labels]
    if all(stamps):
        return ['time'], [stamp[0].replace(',', '.') for stamp in stamps if stamp]
    return ['name'] * (2 * len({*labels}) > len(labels) and any(labels)), labels


def axes_in_order(
    kind: str,
    found: Sequence[tuple[int, str, Mapping[str, str]]],
    letters: Sequence[str],
    maker: str = '',
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] | None = None,
    notes: tuple[str, ...] = (),
    unit: str = 'deg',
) -> NamedColumns:
    """Joint positions as columns: their names, if any has one, then the axes in order.

    Each position in `found` is its line, name ('' for none) and axes, such as ``A1`` -> number
    as text. `letters`: first that of the arm's axes, then those of external axes, which are
    left out if they stay at 0; `unit`: of the arm's axes; `kind`: of the file, in words.
    `maker`, `coupling` (None for none) and `notes` are put into the result as they are. Raises
    InputError if a position lacks an axis of the arm, or axes are not numbered from 1, fewer
    than 2 or more than 100.
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
    return NamedColumns(
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
