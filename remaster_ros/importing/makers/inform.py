# SPDX-License-Identifier: Apache-2.0
"""Jobs of Yaskawa's (.JBI): positions in degrees, or in pulses of the motors."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_JOB = re.compile(r'\s*/JOB\b')
_TYPE = re.compile(r'\s*///POSTYPE\s+(\w+)')
_POSITION = re.compile(r'\s*(B?E?[CP]\d+)\s*=\s*(.*?)\s*$')
_UNITS = {'PULSE': 'pulses', 'ANGLE': 'deg'}
_REMEDY = (
    'give a table with the joint angles in degrees as the pendant shows them at each position '
    '(S, L, U, R, B, T), with their names'
)


def read(text: str) -> NamedColumns | None:
    """Joint positions of a Yaskawa job, degrees or pulses; None for other text.

    Cartesian positions are left out, with a note. Raises InputError, with the line, for mixed
    units, text that cannot be read, or if there are no joint positions.
    """
    if _JOB.match(text) is None:
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    kind, unit, places = '', '', 0
    for number, line in enumerate(text.splitlines(), 1):
        if stated := _TYPE.match(line):
            kind = stated[1].upper()
        elif line.startswith('//INST'):
            break
        elif position := _POSITION.match(line):
            if kind not in _UNITS:
                places += 1
                continue
            cells = [cell.strip() for cell in position[2].split(',')]
            if not all(map(NUMBER.fullmatch, cells)):
                raise unexpected(number, line, 'a number for each axis')
            unit = unit or _UNITS[kind]
            if unit != _UNITS[kind]:
                raise unexpected(number, line, f'a position in {unit}, as those above,')
            axes = {f'J{i}': cell for i, cell in enumerate(cells, 1)}
            found.append((number, position[1], axes))
        elif line.strip() and ('=' in line or not line.strip().startswith('/')):
            raise unexpected(number, line, 'a position such as C00001=…')
    if not found:
        raise InputError(
            f'line 1: there is no position of joints in this job, {places} Cartesian ones; '
            f'{_REMEDY}'
        )
    notes = (f'{places} Cartesian positions were left out',) * bool(places)
    return axes_in_order(
        'positions of a Yaskawa job', found, ('J',), maker='Yaskawa', notes=notes, unit=unit
    )
