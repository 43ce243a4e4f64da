# SPDX-License-Identifier: Apache-2.0
"""Conversion of joints in motor pulses, as Yaskawa's controllers save them, to degrees."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Columns, Table
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.units import PULSES, other_unit
from remaster_ros.importing.values import numbers

# Whole numbers above this, ten turns in degrees, are pulses and no angles.
_LARGEST_DEG = 3600.0
_UNIT = re.compile(rf'\s*[\[(]?\b(?:{"|".join(PULSES)})\b[\])]?\s*$', re.IGNORECASE)


def in_degrees(joints: Table, per_degree: tuple[float, ...], angles: str) -> tuple[Table, str]:
    """Table of joints converted from motor pulses to degrees, and a sentence on it.

    `per_degree`: pulses of a degree for each joint, base to tip; all joints are divided by it.
    () if the user gave none: the table is returned as it is, with ''. `angles`: unit that the
    user stated, '' if none. The headers of converted columns end in ``[deg]``.

    Raises
    ------
    InputError
        The joints are in pulses and `per_degree` is not given, or its number is not that of
        the joints.
    """
    table, columns = joints
    headers = [table.names[i] for i in columns.joints]
    stated = [name for name in headers if other_unit(name).lower() in PULSES]
    if not per_degree:
        if stated or _look_like_pulses(table, columns, angles):
            largest = np.abs(numbers(table, columns.joints, optional=True))
            seen = (
                'by their header' if stated else f'whole numbers, up to {np.nanmax(largest):.0f}'
            )
            raise InputError(
                f'{table.path}: {headers[0]} … {headers[-1]} are pulses of the motors ({seen}), '
                'which '
                'tell no angles without the pulses of a degree; state them, base to tip, with '
                '--pulses-per-degree N,N,… (the pulses that the pendant shows at a known angle, '
                'by that angle), or give a table in degrees'
            )
        return joints, ''
    if len(per_degree) != len(headers):
        raise InputError(
            f'--pulses-per-degree: {len(per_degree)} numbers, and {len(headers)} joints '
            f'({headers[0]} … '
            f'{headers[-1]}); give one for each, base to tip'
        )
    both = dict(zip(columns.joints, per_degree))
    both |= dict(zip(columns.from_joints, per_degree))
    values = numbers(table, tuple(both), optional=True) / [*both.values()]
    cells = [list(row) for row in table.rows]
    names = list(table.names)
    for column, degrees in zip(both, values.T):
        names[column] = f'{_UNIT.sub("", names[column])} [deg]'
        for row, angle in zip(cells, degrees):
            if np.isfinite(angle):
                row[column] = repr(float(angle)).replace('.', table.decimal)
    table = replace(table, names=tuple(names), rows=tuple(map(tuple, cells)))
    units = {**columns.units, **dict.fromkeys(both, 'deg')}
    listed = ', '.join(f'{name} {count:g}' for name, count in zip(headers, per_degree))
    return (table, replace(columns, units=units)), f'pulses a degree, as told: {listed}'


def _look_like_pulses(table: TextTable, columns: Columns, angles: str) -> bool:
    """Whether joints without a unit are all whole numbers, with one above 3600 (ten turns).

    `angles`: as in `in_degrees`.
    """
    if angles or any(columns.units.get(i) for i in columns.joints):
        return False
    values = numbers(table, columns.joints, optional=True)
    values = values[np.isfinite(values)]
    return bool(np.abs(values).max(initial=0.0) > _LARGEST_DEG and np.all(values % 1.0 == 0.0))
