"""Jobs of Yaskawa's (.JBI). Pulses of the motors tell no angles without the robot's gears."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, Named, axes_in_order, unexpected

_JOB = re.compile(r'\s*/JOB\b')
_TYPE = re.compile(r'\s*///POSTYPE\s+(\w+)')
_POSITION = re.compile(r'\s*(B?E?[CP]\d+)\s*=\s*(.*?)\s*$')
_REMEDY = (
    'give a table with the joint angles in degrees as the pendant shows them at each position '
    '(S, L, U, R, B, T), with their names'
)


def read(text: str) -> Named | None:
    """Return the positions of a job that are in degrees; None for anything else."""
    if _JOB.match(text) is None:
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    kind, pulses, places = '', 0, 0
    for number, line in enumerate(text.splitlines(), 1):
        if stated := _TYPE.match(line):
            kind = stated[1].upper()
        elif line.startswith('//INST'):
            break
        elif position := _POSITION.match(line):
            if kind == 'PULSE':
                pulses = pulses or number
            elif kind == 'ANGLE':
                cells = [cell.strip() for cell in position[2].split(',')]
                if not all(map(NUMBER.fullmatch, cells)):
                    raise unexpected(number, line, 'an angle for each axis')
                axes = {f'J{i}': cell for i, cell in enumerate(cells, 1)}
                found.append((number, position[1], axes))
            else:
                places += 1
        elif line.strip() and ('=' in line or not line.strip().startswith('/')):
            raise unexpected(number, line, 'a position such as C00001=…')
    if pulses and not found:
        raise InputError(
            f'line {pulses}: positions in pulses of the motors, which tell no angles without the '
            f'gears of this robot; {_REMEDY}'
        )
    if not found:
        raise InputError(
            f'line 1: there is no position of joints in this job, {places} Cartesian ones; '
            f'{_REMEDY}'
        )
    notes = (f'{places} Cartesian positions were left out',) * bool(places)
    return axes_in_order('positions of a Yaskawa job', found, ('J',), maker='Yaskawa', notes=notes)
