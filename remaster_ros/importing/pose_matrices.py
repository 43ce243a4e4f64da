# SPDX-License-Identifier: Apache-2.0
"""Poses in a table as 4×4 matrices, sixteen columns each, replaced by point and quaternion."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.rigid_numbers import COUNT, SIZE, rigid
from remaster_ros.importing.text_table import TextTable
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.types import FloatArray

# A column by row and column of its number, `T[0][3]`, or by one count, `O_T_EE_12`.
_ROW_AND_COLUMN = re.compile(r'(.*?)[\[(_ ]*([0-4])[\])_, \[(]*([0-4])[\])]?')
_COUNTED = re.compile(r'(.*?)[\[(_ ]*(\d{1,2})[\])]?')


def with_poses(table: TextTable) -> TextTable:
    """Table with X, Y, Z and quaternion in place of the sixteen columns of each 4×4 matrix.

    The seven columns are named ``pose x`` to ``pose qw``, with the matrix's name for ``pose``.
    By that name `groups` of the result has the columns of the point, `turns` those of the
    quaternion. Sixteen columns of which a row is no rigid motion stay as they are; a table
    without matrices is returned unchanged.
    """
    names, rows = list(table.names), [list(row) for row in table.rows]
    dropped: set[int] = set()
    poses: dict[str, list[int]] = {}
    found = _matrices_by_name(table) if table.has_header else _matrices_by_place(table)
    for stem, places in found.items():
        numbers = _numbers(table, places)
        T = None if numbers is None else rigid(numbers)
        if T is None:
            continue
        of = stem or 'pose'
        # Where they stood: seven columns in place of sixteen.
        labels = [f'{of} {axis}' for axis in 'xyz'] + [f'{of} q{axis}' for axis in 'xyzw']
        values = np.column_stack((T[:, :3, 3], [quaternion_xyzw(matrix[:3, :3]) for matrix in T]))
        for column, label, cells in zip(places, labels, values.T):
            names[column] = label
            for row, value in zip(rows, cells):
                text = repr(float(value))
                row[column] = text.replace('.', ',') if table.decimal == ',' else text
        poses[of] = places[: len(labels)]
        dropped.update(places[len(labels) :])
    if not dropped:
        return table
    kept = [i for i in range(len(names)) if i not in dropped]
    at = {column: i for i, column in enumerate(kept)}
    return replace(
        table,
        names=tuple(names[i] for i in kept),
        rows=tuple(tuple(row[i] for i in kept) for row in rows),
        groups={of: tuple(at[i] for i in columns[:3]) for of, columns in poses.items()},
        turns={of: tuple(at[i] for i in columns[3:]) for of, columns in poses.items()},
    )


def _matrices_by_name(table: TextTable) -> Mapping[str, list[int]]:
    """Sixteen column indices of each 4×4 matrix, by the matrix's name in the headers.

    The headers have the name and then row and column of the element, or only its number from 0
    to 15; all may count from 1 instead. The indices are in the order of rows, or of the
    numbers. {} if there is no such matrix.
    """
    found: dict[str, list[int]] = {}
    for pattern, counts in ((_ROW_AND_COLUMN, SIZE), (_COUNTED, COUNT)):
        by_stem: dict[str, dict[tuple[int, ...], int]] = defaultdict(dict)
        for i, name in enumerate(table.names):
            if match := pattern.fullmatch(name):
                by_stem[match[1]].setdefault(tuple(map(int, match.groups()[1:])), i)
        for stem, columns in by_stem.items():
            if stem in found or len(columns) != COUNT:
                continue
            for first in (0, 1):
                each = range(first, first + counts)
                order = [*product(each, repeat=2 if counts == SIZE else 1)]
                if {*columns} == {*order}:
                    found[stem] = [columns[key] for key in order]
    return found


def _matrices_by_place(table: TextTable) -> Mapping[str, list[int]]:
    """Sixteen adjacent column indices of each 4×4 matrix in a table without headers.

    Columns that are a rigid motion in every row. The keys are ``pose`` for a single one, else
    ``pose 1``, ``pose 2``, …; {} if there are none.
    """
    found: dict[str, list[int]] = {}
    first = 0
    while first + COUNT <= len(table.names):
        columns = [*range(first, first + COUNT)]
        # The first row tells where there can be none.
        first_row = _numbers(table.select([0]), columns)
        numbers = (
            None if first_row is None or rigid(first_row) is None else _numbers(table, columns)
        )
        if numbers is not None and rigid(numbers) is not None:
            found[f'pose {len(found) + 1}'] = columns
            first += COUNT
        else:
            first += 1
    return {'pose': found['pose 1']} if len(found) == 1 else found


def _numbers(table: TextTable, columns: list[int]) -> FloatArray | None:
    """Numbers of the columns, (n, len(columns)); None if a cell is empty or no number."""
    try:
        cells = [[table.number(row, i) for i in columns] for row in range(len(table.rows))]
    except InputError:
        return None
    if any(None in row for row in cells):
        return None
    return np.array(cells, float)
