# SPDX-License-Identifier: Apache-2.0
"""Joint targets of RAPID (ABB), as Rokae writes them, and of a log of CJointT()."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import (
    NUMBER,
    UNUSED,
    NamedColumns,
    axes_in_order,
    unexpected,
)

_MODULE = re.compile(
    r'^[ \t]*MODULE[ \t]+\w+|\brobtarget[ \t]+\w+[ \t]*:=', re.IGNORECASE | re.MULTILINE
)
# Lines that end without a semicolon.
_LINE = re.compile(
    r'\s*(?:%%%|VERSION:|LANGUAGE:|(?:LOCAL\s+)?(?:MODULE|PROC|FUNC|TRAP|RECORD)\b|END\w+\s*$|ELSE\s*$'
    r'|(?:ELSEIF|IF)\b.*\bTHEN\s*$|(?:FOR|WHILE)\b.*\bDO\s*$|ERROR\s*$|BACKWARD\s*$|UNDO\s*$)',
    re.IGNORECASE,
)
# An array of targets: its name, and how many there are.
_ARRAY = re.compile(r'\s*([A-Za-z]\w*)\s*\{\s*(\d+)\s*\}\s*:=\s*\[')
_TARGET = re.compile(r'\bjointtarget\b', re.IGNORECASE)
# Rokae's, which may end without a semicolon.
_ROKAE = re.compile(r'\bjointtarget\s+\w+\s*=\s*J\s*:', re.IGNORECASE)
_LISTED = re.compile(r'^[ \t]*\[\s*\[', re.MULTILINE)
_MOVE = re.compile(r'\bMoveAbsJ\s*\[', re.IGNORECASE)
_ASSIGNED = re.compile(r'\s*([A-Za-z]\w*)\s*:?=\s*')
_VALUE = re.compile(
    r'\s*(?:[A-Za-z]\w*\s*:)?\s*[\[{]?\s*[\[{]([^\[\]{}]*)[\]}]\s*,?\s*(?:(?:[A-Za-z]\w*\s*:)?\s*[\[{](?:EJ\s)?([^\[\]{}]*)[\]}])?\s*[\]}]?'
)
_LISTED_AXES = re.compile(r'\[\s*\[([^\[\]]*)\]\s*,\s*\[([^\[\]]*)\]\s*\]')
_ELEMENT = re.compile(r'\s*([A-Za-z]\w*(?:\s*\{\s*\d+\s*\})?)\s*:=\s*')
# Nothing else in RAPID begins with six numbers.
_SIX = re.compile(r'(?:=|^)\s*(?:[A-Za-z]\w*\s*:)?[\s\[{}]*(?:[-+.\deE]+\s*,\s*){5}')
_EXPECTED = '[[…,…],[…]] with a number for each axis'


def read(text: str) -> NamedColumns | None:
    """Joint targets of a RAPID module (ABB, Rokae), degrees, or of a log; None for other text.

    Cartesian targets are left out, with a note. Raises InputError, with the line, for text
    that cannot be read, or if there are no joint targets.
    """
    lower = text.lower()
    # Looking for words is much faster than for patterns, and logs are large.
    known = any(word in lower for word in ('jointtarget', 'moveabsj', 'robtarget', 'module')) and (
        _TARGET.search(text) or _MOVE.search(text) or _MODULE.search(text)
    )
    if not (known or _LISTED.search(text)):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    places = 0
    for number, statement in _statements(text):
        target, move = _TARGET.search(statement), _MOVE.search(statement)
        name = ''
        if target and (array := _ARRAY.match(statement, target.end())):
            listed = [*_LISTED_AXES.finditer(statement, array.end())]
            # A comma between two of them, and a bracket behind the last.
            between = _LISTED_AXES.sub('@', statement[array.end() :])
            if int(array[2]) != len(listed) or not re.fullmatch(
                r'(?:\s*@\s*,)*\s*@\s*\]\s*', between
            ):
                raise unexpected(
                    number,
                    statement,
                    f'jointtarget NAME{{{array[2]}}}:=[…] of {array[2]} {_EXPECTED}',
                )
            for i, axes in enumerate(listed, 1):
                found.append((number, f'{array[1]}{{{i}}}', _axes(number, statement, axes)))
            continue
        if target:
            assigned = _ASSIGNED.match(statement, target.end())
            if assigned is None:
                # A declaration without a value.
                if re.fullmatch(r'\s*[A-Za-z]\w*\s*', statement[target.end() :]):
                    continue
                raise unexpected(number, statement, f'jointtarget NAME:={_EXPECTED}')
            name, start = assigned[1], assigned.end()
        elif (assigned := _ELEMENT.match(statement)) and _SIX.search(statement):
            # Of a target, or of one in an array, that was declared without a value.
            name, start = re.sub(r'\s', '', assigned[1]), assigned.end()
        elif move:
            start = move.end() - 1
        elif _LISTED.match(statement):
            start = 0
        else:
            if _SIX.search(statement) or not known:
                raise unexpected(number, statement, f'jointtarget NAME:={_EXPECTED}')
            places += bool(re.search(r'\brobtarget\b[^;]*:?=', statement, re.IGNORECASE))
            continue
        value = _VALUE.match(statement, start)
        if value is None or (not move and statement[value.end() :].strip(' \t\r\n;')):
            raise unexpected(number, statement, _EXPECTED)
        found.append((number, name, _axes(number, statement, value)))
    if not found:
        raise InputError(f'line 1: there is no joint target in it (jointtarget p1:={_EXPECTED})')
    notes = (f'{places} Cartesian targets were left out',) * bool(places)
    return axes_in_order('joint targets of RAPID', found, ('J', 'E'), notes=notes)


def _statements(text: str) -> list[tuple[int, str]]:
    """Statements of a RAPID module without comments, each with the line, from 1, where it begins.

    Lines such as ``PROC main()`` are left out. A statement ends with a semicolon; only joint
    targets in a log or in Rokae's dialect may end with the line instead.
    """
    statements: list[tuple[int, str]] = []
    parts: list[str] = []
    start = 0
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition('!')[0]
        if not parts and _LINE.match(code):
            continue
        listed = bool(_LISTED.match(code)) and not parts
        for i, piece in enumerate(code.split(';')):
            if i and parts:
                statements.append((start, ' '.join(parts)))
                parts = []
            if piece.strip():
                start = start if parts else number
                parts.append(piece)
        # A log has a target in each line, with or without a semicolon.
        if (listed or _ROKAE.search(code)) and parts:
            statements.append((start, ' '.join(parts)))
            parts = []
    return [*statements, (start, ' '.join(parts))] if parts else statements


def _axes(number: int, statement: str, value: re.Match[str]) -> dict[str, str]:
    """Axes of a joint target as text, J1… and E1…; unused external axes are left out.

    Raises InputError with line and statement for text that is no number, and for an unused axis
    of the arm.
    """
    axes = {}
    for letter, group in (('J', value[1]), ('E', value[2])):
        for i, cell in enumerate((group or '').split(',') if group else (), 1):
            if not NUMBER.fullmatch(cell.strip()):
                raise unexpected(number, statement, _EXPECTED)
            if float(cell) < UNUSED:
                axes[f'{letter}{i}'] = cell.strip()
            elif letter == 'J':
                raise unexpected(number, statement, 'an angle for each axis of the arm')
    return axes
