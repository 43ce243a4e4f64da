# SPDX-License-Identifier: Apache-2.0
"""FANUC's texts: positions at the end of a program (.ls), and position registers (posreg.va).

FANUC counts J3 from the horizontal: the axis itself turns by J3 + J2.
"""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_OPEN = re.compile(r'\s*(PR?\[\d+)(?:\s*:\s*"[^"]*")?\]\s*\{\s*')
_INCREMENT = re.compile(r'\s*\d+:\s*[JLC]\s+PR?\[.*\bINC\b', re.IGNORECASE)
_CLOSE = re.compile(r'\s*\}\s*;?\s*')
_GROUP = re.compile(r'\s*GP(\d+)\s*:')
_IGNORED = re.compile(r"\s*(?:U[FT]\s*:\s*\w+|CONFIG\s*:\s*'[^']*')\s*,?\s*")
# Mark of a position that was never taught.
_UNTAUGHT = r'\*{2,}'
_JOINT = re.compile(
    rf'\s*(J\d|E(?:XT)?\d)\s*[=:]\s*({NUMBER.pattern}|{_UNTAUGHT})\s+(deg|mm)\s*,?\s*'
)
_PLACE = re.compile(
    rf'\s*[XYZWPR]\s*[=:]\s*(?:{NUMBER.pattern}|{_UNTAUGHT})\s*(?:mm|deg)?\s*,?\s*'
)
# A register of a motion group: group, number, and what follows its comment.
_REGISTER = re.compile(r"\s*\[(\d+),(\d+)\]\s*=\s*'[^']*'\s*(.*?)\s*")
_OF_GROUP = re.compile(r'\s*(?:Group\s*:\s*(\d+))?\s*(?:Config\s*:\s*([^:=]*))?\s*')


def read(text: str) -> NamedColumns | None:
    """Joint positions of a FANUC program or of position registers; None for other text.

    Degrees as the controller counts them, with the coupling of J3 to J2 noted in the result.
    Cartesian and untaught positions and other motion groups are left out, with notes. Raises
    InputError, with the line, for text that cannot be read, increments, or if there are no
    joint positions.
    """
    if re.search(r'\$POSREG\b.*\bARRAY\b', text):
        return _registers(text)
    if not re.search(r'^[ \t]*/PROG\b|^[ \t]*PR?\[\d+[^\n]*\]\s*\{', text, re.MULTILINE):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    name, opened, place, places, untaught = '', 0, False, 0, 0
    values: dict[str, str] = {}
    # Of a motion group, such as a positioner, beside that of the arm.
    group, other, other_axes = '', False, set[str]()
    for number, line in enumerate(text.splitlines(), 1):
        at = 0
        while at < len(line):
            if not opened:
                begin = _OPEN.match(line, at)
                if begin is None:
                    if _INCREMENT.match(line):
                        raise unexpected(number, line, 'a position, not an increment (INC),')
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
                other_axes.add(joint[1])
                at = joint.end()
            elif joint := _JOINT.match(line, at):
                if joint[1].replace('XT', '') in values or (
                    joint[1][0] == 'J' and joint[3] != 'deg'
                ):
                    raise unexpected(number, line, 'each axis once, in deg,')
                values[joint[1].replace('XT', '')] = joint[2]
                at = joint.end()
            elif cartesian := _PLACE.match(line, at):
                place, at = True, cartesian.end()
            elif (end := _CLOSE.match(line, at)) and (values or place):
                if place:
                    places += 1
                elif '*' in ''.join(values.values()):
                    untaught += 1
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
    return _positions('positions of a FANUC program', found, places, untaught, bool(other_axes))


def _registers(text: str) -> NamedColumns:
    """Position registers of `posreg.va` in joints, of the first motion group; raises as `read`."""
    found: list[tuple[int, str, dict[str, str]]] = []
    places, untaught, has_other_groups = set[int](), set[int](), False
    values: dict[str, str] | None = None
    opened = 0
    for number, line in enumerate(text.splitlines(), 1):
        code = re.sub(r'</?[A-Za-z!][^<>]*>', '', line)
        if register := _REGISTER.fullmatch(code):
            value = register[3]
            values, opened = {}, number
            if value.lower() == 'uninitialized':
                values = None
                continue
            if not _OF_GROUP.fullmatch(value):
                raise unexpected(number, line, "[1,1] = '…' Group: 1")
            if register[1] != '1':
                has_other_groups, values = True, {}
            else:
                found.append((number, f'PR[{register[2]}]', values))
            continue
        at = 0
        while at < len(code.rstrip()):
            if values is None or not opened:
                if re.search(r'\b[JXYZWPR]\d?\s*[=:]\s*[-+.\d*]', code):
                    raise unexpected(number, line, "[1,1] = '…' Group: 1 before it")
                break
            if joint := _JOINT.match(code, at):
                if joint[1] in values or (
                    joint[1][0] == 'J' and joint[3] != 'deg' and not has_other_groups
                ):
                    raise unexpected(number, line, 'each axis once, in deg,')
                values[joint[1].replace('XT', '')] = joint[2]
                if '*' in joint[2]:
                    untaught.add(opened)
                at = joint.end()
            elif place := _PLACE.match(code, at):
                places.add(opened)
                at = place.end()
            elif (of := _OF_GROUP.match(code, at)) and of.end() > at:
                at = of.end()
            else:
                raise unexpected(number, line, 'J1 = … deg and so on')
    excluded = places | untaught
    found = [entry for entry in found if entry[0] not in excluded]
    for number, name, values in found:
        if not values:
            raise InputError(f'line {number}: {name} has no axes, J1 = … deg is expected')
    if not found:
        raise InputError('line 1: no position register is in joints (J1 = … deg); record them so')
    return _positions(
        'position registers of FANUC', found, len(places), len(untaught - places), has_other_groups
    )


def _positions(
    kind: str,
    found: list[tuple[int, str, dict[str, str]]],
    places: int,
    untaught: int,
    has_other_groups: bool,
) -> NamedColumns:
    """Columns of the joint positions, with notes on what was left out.

    `kind`: of the file, in words; `found`: line, name and axes of each position; `places`,
    `untaught`: numbers of Cartesian and untaught positions; `has_other_groups`: whether there
    were other motion groups.
    """
    notes = (f'{places} Cartesian positions were left out',) * bool(places)
    notes += (f'{untaught} positions that were never taught were left out',) * bool(untaught)
    notes += ('the axes of other motion groups were left out',) * has_other_groups
    return axes_in_order(
        kind, found, ('J', 'E'), maker='FANUC', coupling={'J3': ('J2', 1)}, notes=notes
    )
