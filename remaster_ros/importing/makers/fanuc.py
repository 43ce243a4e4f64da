"""FANUC's teach pendant programs as text (.ls): the positions at their end.

FANUC counts J3 from the horizontal: what the axis itself turns is J3 + J2.
"""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, Named, axes_in_order, unexpected

_OPEN = re.compile(r'\s*(PR?\[\d+)(?:\s*:\s*"[^"]*")?\]\s*\{\s*')
_CLOSE = re.compile(r'\s*\}\s*;?\s*')
_GROUP = re.compile(r'\s*GP(\d+)\s*:')
_IGNORED = re.compile(r"\s*(?:U[FT]\s*:\s*\w+|CONFIG\s*:\s*'[^']*')\s*,?\s*")
_JOINT = re.compile(rf'\s*(J\d|E\d)\s*=\s*({NUMBER.pattern})\s+(deg|mm)\s*,?\s*')
_PLACE = re.compile(rf'\s*[XYZWPR]\s*=\s*{NUMBER.pattern}\s*(?:mm|deg)\s*,?\s*')


def read(text: str) -> Named | None:
    """Return the joint positions of a program of FANUC's; None for anything else."""
    if not re.search(r'^\s*/PROG\b|^\s*PR?\[\d+[^\n]*\]\s*\{', text, re.MULTILINE):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    name, opened, place, places = '', 0, False, 0
    values: dict[str, str] = {}
    # Of a motion group, such as a positioner, beside that of the arm.
    group, other, others = '', False, set[str]()
    for number, line in enumerate(text.splitlines(), 1):
        at = 0
        while at < len(line):
            if not opened:
                begin = _OPEN.match(line, at)
                if begin is None:
                    if re.match(r'\s*(?:PR?\s*\[|[JE]\d\s*=|GP\d+\s*:|U[FT]\s*:|\})', line[at:]):
                        raise unexpected(number, line, 'P[1]{ before it')
                    break
                name, opened, values, place, at = f'{begin[1]}]', number, {}, False, begin.end()
                group, other = '', False
            elif of := _GROUP.match(line, at):
                group = group or of[1]
                other, at = of[1] != group, of.end()
            elif ignored := _IGNORED.match(line, at):
                at = ignored.end()
            elif other and (joint := _JOINT.match(line, at)):
                others.add(joint[1])
                at = joint.end()
            elif joint := _JOINT.match(line, at):
                if joint[1] in values or (joint[1][0] == 'J' and joint[3] != 'deg'):
                    raise unexpected(number, line, 'each axis once, in deg,')
                values[joint[1]] = joint[2]
                at = joint.end()
            elif cartesian := _PLACE.match(line, at):
                place, at = True, cartesian.end()
            elif (end := _CLOSE.match(line, at)) and (values or place):
                if place:
                    places += 1
                else:
                    found.append((opened, name, values))
                opened, at = 0, end.end()
            elif line[at:].strip():
                raise unexpected(number, line, f'J1= … deg and so on of {name}')
            else:
                break
    if opened:
        raise InputError(f'line {opened}: {name} does not end with }};, as is expected')
    if not found:
        raise InputError('line 1: there is no position of joints in it (P[1]{ … J1= … deg … };)')
    notes = (f'{places} Cartesian positions were left out',) * bool(places)
    notes += ('the axes of other motion groups were left out',) * bool(others)
    return axes_in_order(
        'positions of a FANUC program',
        found,
        ('J', 'E'),
        maker='FANUC',
        coupling={'J3': ('J2', 1)},
        notes=notes,
    )
