# SPDX-License-Identifier: Apache-2.0
"""Joint positions of UR programs: of movej, of waypoints named …_q, and of a .urp file."""

from __future__ import annotations

import math
import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_MOVE = re.compile(r'\b(?:movej|servoj)\s*\(\s*')
_LIST = re.compile(r'\[([^\[\]]*)\]')
_ASSIGNED = re.compile(r'\s*(?:global\s+|local\s+)?([A-Za-z]\w*)\s*=\s*')
# A list of positions.
_SEVERAL = re.compile(rf'{_ASSIGNED.pattern}\[\s*((?:\[[^\[\]]*\]\s*(?:,\s*)?)+)\]\s*')
_LISTED = re.compile(rf'{_ASSIGNED.pattern}\[')
_DEGREES = re.compile(rf'd2r\(\s*({NUMBER.pattern})\s*\)')
# Six numbers in a list, and calls other than movej that take such lists.
_SIX = re.compile(r'(?<!p)\[\s*(?:[-+.\deE]+\s*,\s*){5}')
_OTHERS = re.compile(r'\b(?:speed[jl]|set_\w+|force_mode|inverse_\w+|textmsg|get_\w+)\s*\(')
# Elements of a .urp file: a waypoint with its name, and its joint angles.
_WAYPOINT = re.compile(r'<Waypoint\b[^<>]*\bname="([^"<>]*)"|<JointAngles\b([^<>]*)(?:>|$)')
_ANGLES = re.compile(r'\s*angles="([^"<>]*)"\s*/?\s*')
_EXPECTED = 'a list of the joints in rad, [0.1, -1.5, …],'


def read(text: str) -> NamedColumns | None:
    """Joint positions in a URScript program or a .urp file, rad; None for other text.

    A row for each list of joint values, of a move or of a waypoint's definition; a move to a
    named waypoint adds none. Moves to Cartesian poses are left out, with a note. Raises
    InputError, with the line, for text that cannot be read, a movej to an unknown waypoint, or
    if there are no joint positions.
    """
    if re.search(r'<JointAngles\b', text):
        return _waypoints(text)
    if not re.search(
        r'\b(?:move[jlp]|servoj)\s*\(|^[ \t]*(?:global[ \t]+)?\w+_q[ \t]*=\s*\[',
        text,
        re.MULTILINE,
    ):
        return None
    named = {*re.findall(r'\bmovej\s*\(\s*([A-Za-z]\w*)\s*[,)]', text)}
    found: list[tuple[int, str, dict[str, str]]] = []
    defined: set[str] = set()
    places = 0
    for number, line in _whole_lists(text):
        if len(_SIX.findall(line)) > 1 and (several := _SEVERAL.fullmatch(line)):
            for i, joint_list in enumerate(_LIST.finditer(several[2])):
                found.append((number, f'{several[1]}[{i}]', _joints(number, line, joint_list[1])))
            defined.add(several[1])
            continue
        if len(_SIX.findall(line)) > 1:
            raise unexpected(number, line, 'one move or waypoint a line')
        assigned, move = _ASSIGNED.match(line), _MOVE.search(line)
        name = ''
        if assigned and (assigned[1].endswith('_q') or assigned[1] in named):
            name, start = re.sub(r'_q$', '', assigned[1]), assigned.end()
            defined.add(assigned[1])
        elif move:
            start = move.end()
        else:
            if _SIX.search(line) and not (_LISTED.match(line) or _OTHERS.search(line)):
                raise unexpected(number, line, 'movej([…])')
            continue
        if re.match(r'p\[|pose_|get_inverse_kin', line[start:]):
            places += 1
            continue
        if (
            move
            and not assigned
            and re.match(r'[A-Za-z]\w*(?:\[\s*\w+\s*\])?\s*[,)]', line[start:])
        ):
            # A waypoint, which stands above.
            continue
        listed = _LIST.match(line, start)
        if listed is None:
            raise unexpected(number, line, _EXPECTED)
        found.append((number, name, _joints(number, line, listed[1])))
    absent = named - defined
    if absent:
        raise InputError(
            f'line 1: {min(absent)} of movej is nowhere; {min(absent)}=[…] is expected'
        )
    if not found:
        raise InputError(
            'line 1: there is no joint position in it (movej([…]), Waypoint_1_q=[…]); of '
            'Cartesian waypoints record what the joints were there'
        )
    notes = (f'{places} moves to Cartesian poses were left out',) * bool(places)
    return axes_in_order(
        'joint positions of URScript', found, ('J',), maker='UR', notes=notes, unit='rad'
    )


def _whole_lists(text: str) -> list[tuple[int, str]]:
    """Lines without comments, a list of several lines as one, with the line where each begins."""
    lines: list[tuple[int, list[str]]] = []
    opened = 0
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition('#')[0]
        if opened > 0:
            lines[-1][1].append(code.strip())
        else:
            lines.append((number, [code]))
        opened = max(opened, 0) + code.count('[') - code.count(']')
    return [(number, ' '.join(parts)) for number, parts in lines]


def _waypoints(text: str) -> NamedColumns:
    """Waypoints of a program that PolyScope saved (.urp), which is XML, rad.

    Raises InputError, with the line, for angles that cannot be read.
    """
    found = []
    name = ''
    for number, line in enumerate(text.splitlines(), 1):
        matches = [*_WAYPOINT.finditer(line)]
        count = sum(match[1] is None for match in matches)
        if any(len(re.findall(word, line)) != count for word in ('JointAngles', 'angles')):
            raise unexpected(number, line, '<JointAngles angles="…"/>')
        for match in matches:
            if match[1] is not None:
                name = match[1]
                continue
            angles = _ANGLES.fullmatch(match[2])
            if angles is None:
                raise unexpected(number, line, '<JointAngles angles="…"/>')
            found.append((number, name, _joints(number, line, angles[1])))
    return axes_in_order('waypoints of PolyScope', found, ('J',), maker='UR', unit='rad')


def _joints(number: int, line: str, listed: str) -> dict[str, str]:
    """Joint angles of a list such as ``0.1, d2r(30)``, rad, as text, by J1, J2, ….

    Raises InputError, with the line, if a part is neither a number nor d2r(…).
    """
    values = {}
    for i, cell in enumerate(listed.split(','), 1):
        degrees = _DEGREES.fullmatch(cell.strip())
        if degrees:
            values[f'J{i}'] = repr(math.radians(float(degrees[1])))
        elif NUMBER.fullmatch(cell.strip()):
            values[f'J{i}'] = cell.strip()
        else:
            raise unexpected(number, line, _EXPECTED)
    return values
