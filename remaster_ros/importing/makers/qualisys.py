# SPDX-License-Identifier: Apache-2.0
"""Qualisys' exports of a capture (QTM, .tsv): markers (3D) or rigid bodies (6D), a line a frame.

Above the frames are lines with a key each. Lengths are in mm; 0 0 0 stands for a point that was
not seen.
"""

from __future__ import annotations

import re

import numpy as np

from remaster_ros.importing.makers.named import NUMBER, NamedColumns, unexpected
from remaster_ros.kinematics.transforms import quaternion_xyzw

_START = re.compile(r'\s*NO_OF_FRAMES\t')
_KEY = re.compile(r'[A-Z][A-Z_]+')
_AXES = ('X', 'Y', 'Z')
# Of a body: place, angles, residual, and the rotation matrix column by column.
_BODY = (*_AXES, 'Roll', 'Pitch', 'Yaw', 'Residual', *(f'Rot[{i}]' for i in range(9)))


def read(text: str) -> NamedColumns | None:
    """Columns of a capture exported by Qualisys; None for other text.

    Time, position of each marker or body, mm, and the quaternion of bodies. Raises InputError,
    with the line, for missing names or rate, rows of other lengths, times that do not
    increase, or matrices that are no rotations.
    """
    if _START.match(text) is None:
        return None
    head: dict[str, list[str]] = {}
    lines = [(i, line.rstrip('\t ')) for i, line in enumerate(text.splitlines(), 1)]
    lines = [(i, line) for i, line in lines if line]
    at = 0
    while at < len(lines) and _KEY.fullmatch(lines[at][1].split('\t')[0]):
        key, *values = lines[at][1].split('\t')
        head[key] = [value.strip() for value in values]
        at += 1
    bodies = (head.get('DATA_INCLUDED') or [''])[0].upper() == '6D'
    names = head.get('BODY_NAMES' if bodies else 'MARKER_NAMES', [])
    names = [name for name in names if name]
    if not names or len({*names}) < len(names):
        number, line = lines[min(at, len(lines) - 1)]
        key = 'BODY_NAMES' if bodies else 'MARKER_NAMES'
        raise unexpected(number, line, f'a line {key} with each name once above it')
    each = len(_BODY) if bodies else len(_AXES)
    timed = False
    if at < len(lines) and not NUMBER.fullmatch(lines[at][1].split('\t')[0].strip()):
        number, line = lines[at]
        cells = [cell.strip() for cell in line.split('\t')]
        timed = cells[:2] == ['Frame', 'Time']
        # Bodies have their name before their first axis alone.
        axes = [cell.split()[-1] if cell else '' for cell in cells[2 * timed :]]
        if axes != [*(_BODY if bodies else _AXES)] * len(names) or not (
            bodies
            or all(
                cell.startswith(f'{name} ')
                for cell, name in zip(cells[2 * timed :], np.repeat(names, each).tolist())
            )
        ):
            raise unexpected(number, line, f'Frame, Time and the columns of {", ".join(names)}')
        at += 1
    rate = (head.get('FREQUENCY') or [''])[0]
    if not timed and not (NUMBER.fullmatch(rate) and float(rate) > 0.0):
        raise unexpected(*lines[0], 'a line FREQUENCY with the frames per second')
    labels, groups, turns = ['Time [s]'], {}, {}
    for name in names:
        groups[name] = tuple(range(len(labels), len(labels) + 3))
        labels += [f'{name} {axis} [mm]' for axis in _AXES]
        if bodies:
            turns[name] = tuple(range(len(labels), len(labels) + 4))
            labels += [f'{name} q{axis}' for axis in 'xyzw']
    width = 2 * timed + each * len(names)
    rows, at_lines, before = [], [], -np.inf
    for i, (number, line) in enumerate(lines[at:]):
        cells = [cell.strip() for cell in line.split('\t')]
        if len(cells) != width or not all(NUMBER.fullmatch(cell) for cell in cells if cell):
            raise unexpected(number, line, f'{width} numbers')
        time = cells[1] if timed else f'{i / float(rate):.6f}'
        if not time or float(time) <= before:
            raise unexpected(number, line, f'a time after {before:g} s')
        before = float(time)
        row = [time]
        for start in range(2 * timed, width, each):
            row += _position_cells(number, line, cells[start : start + each])
        rows.append(tuple(row))
        at_lines.append(number)
    return NamedColumns(
        kind=f'a capture of Qualisys ({"6D" if bodies else "3D"})',
        instrument='camera',
        names=tuple(labels),
        rows=tuple(rows),
        lines=tuple(at_lines),
        groups=groups,
        turns=turns,
    )


def _position_cells(number: int, line: str, cells: list[str]) -> list[str]:
    """Position, mm, and quaternion x, y, z, w for a body, of one marker or body, as text.

    Empty cells if it was lost: 0 0 0 or nothing. Raises InputError, with the line, if numbers are
    missing or the matrix is no rotation.
    """
    size = 3 if len(cells) == len(_AXES) else 7
    given = [cell for cell in cells if cell]
    if not given or all(float(cell) == 0.0 for cell in cells[:3] if cell):
        return [''] * size
    if len(given) < len(cells):
        raise unexpected(number, line, 'all numbers of what was seen')
    if size == len(_AXES):
        return cells
    R = np.array(cells[-9:], float).reshape(3, 3).T
    # As rounded to six digits.
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0.0:
        raise unexpected(number, line, 'a rotation matrix in Rot[0] … Rot[8]')
    return [*cells[:3], *(repr(float(value)) for value in quaternion_xyzw(R))]
