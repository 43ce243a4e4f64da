# SPDX-License-Identifier: Apache-2.0
"""Reports with a row for each of X, Y and Z, as inspection programs write them, made wide."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from remaster_ros.errors import InputError

_AXES = ('X', 'Y', 'Z')
_NAMED = re.compile(r'(.+?)[ ._:/-]+([XYZxyz])')
# Least share of rows that are X, Y or Z; the others are diameters and distances.
_SHARE = 0.5
_FEWEST_POINTS = 3
_SEEN = 100
# Characters of a cell with name, separator and axis. In a longer run of separators the expression
# above would try every beginning.
_LONGEST = 200

Rows = list[tuple[str, ...]]


def wide(
    names: Sequence[str], rows: Rows, lines: Sequence[int], is_number: Callable[[str], bool]
) -> tuple[list[str], Rows, list[int]] | None:
    """Column names, rows and lines of a table with one row a point; None for other tables.

    For a report with a row for each of X, Y and Z: of its rows, at least 9, over half are for
    an axis, and those of a point are one below the other in this order. The name of the point
    comes first; a column ``name`` of numbers becomes three, ``name X`` and so on, other
    columns are left out. `lines`: line of each row in the file; the result has that of each
    point's X; `is_number`: whether a cell may stand in a column of numbers (is a number, or
    empty).

    Raises
    ------
    InputError
        A point without one of its axes, or out of order, with its line.
    """
    if len(rows) < _FEWEST_POINTS * len(_AXES):
        return None
    # Logs are large.
    found = _axes(rows) if _axes(rows[:_SEEN]) else None
    if found is None:
        return None
    axes, column, labels = found
    values = [
        i
        for i in range(len(names))
        if i != column and all(is_number(r[i]) for r, axis in zip(rows, axes) if axis)
    ]
    texts = [i for i in range(len(names)) if i not in (column, *values)]
    if labels is None and texts:
        labels = [row[texts[0]] for row in rows]
    head = [names[texts[0]] if texts else names[column]] if labels is not None else []
    wide_rows: Rows = []
    at: list[int] = []
    point: list[int] = []
    label = first = ''
    for i, axis in enumerate(axes):
        if labels is not None:
            # A report names a point once.
            label = labels[i] or label
        if not axis:
            continue
        wanted = _AXES[len(point)]
        if axis != wanted or (point and label != first):
            of = f'{wanted} of {first}' if point and label != first else wanted
            raise InputError(
                f'line {lines[i]}: {axis} of {label or "a point"}, where {of} is expected: X, Y '
                'and Z of each point one below the other'
            )
        first = label
        point.append(i)
        if len(point) == len(_AXES):
            cells = [rows[row][value] for value in values for row in point]
            wide_rows.append((*[label] * len(head), *cells))
            at.append(lines[point[0]])
            point = []
    if point:
        raise InputError(
            f'line {lines[point[-1]]}: the last one, where {_AXES[len(point)]} is expected: X, Y '
            'and Z of each point one below the other'
        )
    return [*head, *(f'{names[i]} {axis}' for i in values for axis in _AXES)], wide_rows, at


def _axes(rows: Rows) -> tuple[list[str], int, list[str] | None] | None:
    """Axis of each row, 'X', 'Y', 'Z' or '', and index of the column with the axes, from 0.

    Last result: names of the points if that column has them (``P1.X``), else None. None if no
    column has an axis in over half of the rows.
    """
    for column, cells in enumerate(zip(*rows)):
        axes = [cell.upper() if cell.upper() in _AXES else '' for cell in cells]
        if {*_AXES} <= {*axes} and sum(map(bool, axes)) > _SHARE * len(rows):
            return axes, column, None
        named = [_NAMED.fullmatch(cell) if len(cell) <= _LONGEST else None for cell in cells]
        if sum(map(bool, named)) > _SHARE * len(rows):
            axes = [match[2].upper() if match else '' for match in named]
            if {*_AXES} <= {*axes}:
                return axes, column, [match[1] if match else '' for match in named]
    return None
