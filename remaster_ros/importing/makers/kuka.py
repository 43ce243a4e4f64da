# SPDX-License-Identifier: Apache-2.0
"""KUKA's texts: axis positions of a .dat or .src file, and printed values of $AXIS_ACT."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_AGGREGATE = re.compile(r'\{([^{}]*)\}')
_AXES = re.compile(r'\b(?:E6)?AXIS\b|\$AXIS_ACT', re.IGNORECASE)
_PLACE = re.compile(r'\bE6POS\b|\bPOS\b|\bFRAME\b|[{:,]\s*X\s+[-+.\d]', re.IGNORECASE)
_ENTRY = re.compile(rf'\s*(?:(?:E6)?AXIS\s*:)?\s*([AE]\d)\s+({NUMBER.pattern})\s*', re.IGNORECASE)
_AXIS = re.compile(r'\bA\d\s+[-+.\d]', re.IGNORECASE)
_RELATIVE = re.compile(r'\bS?PTP_REL\b', re.IGNORECASE)
_MOVE_TO = re.compile(r'\bS?PTP\s*\{', re.IGNORECASE)
_NO_NAMES = ('AXIS_ACT', 'PTP', 'SPTP')
_MOVE = re.compile(r'\s*S?(?:PTP|LIN)\s+([A-Za-z]\w*)', re.IGNORECASE)
# Of a variable, also of an array; and what stands before a position in a log.
_NAME = re.compile(r'([A-Za-z]\w*(?:\[\d+\])?)\s*=\s*$')
_LABEL = re.compile(r'\s*([A-Za-z]\w*)\s*[:;,]?\s*$')
_PROGRAM = re.compile(r'\s*(?:&[A-Z]|;\s*FOLD|DEF(?:DAT)?\s+\w[^:\n]*(?:\n|$))', re.IGNORECASE)
# A name in KRL has 24 characters, and stands directly before its position.
_LONGEST_NAME = 200
_EXPECTED = '{E6AXIS: A1 …, A2 …} with a number for each axis'


def read(text: str) -> NamedColumns | None:
    """Axis positions in a program, data file or log of KUKA, degrees; None for other text.

    Cartesian points are left out, with a note. Raises InputError, with the line, for relative
    moves, text that cannot be read, or if there are no axis positions.
    """
    if not (re.search(r'\{[^{}]*\b[Aa]1\s+[-+.\d]', text) or _PROGRAM.match(text)):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    places = []
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition(';')[0]
        aggregates = [*_AGGREGATE.finditer(code)]
        axes = [a for a in aggregates if re.search(r'\b[Aa]\d\b', a[1])]
        if axes and _RELATIVE.search(code):
            raise unexpected(number, line, 'a position, not a way from one to another,')
        if axes:
            ends = [0, *(aggregate.end() for aggregate in axes)]
            for end, aggregate in zip(ends, axes):
                before = code[max(end, aggregate.start() - _LONGEST_NAME) : aggregate.start()]
                found.append((number, *_position(number, line, before, aggregate)))
        elif _PLACE.search(code):
            places.append(number)
        elif (
            _MOVE_TO.search(code)
            or len(_AXIS.findall(code)) > 1
            or (_AXES.search(code) and re.search(r'[={}]', code))
        ):
            raise unexpected(number, line, _EXPECTED)
    if not found:
        raise InputError(
            'line 1: there are no axis positions in it ({E6AXIS: A1 …}); where its moves name '
            'points, give the .dat file of the program, and of Cartesian points what $AXIS_ACT '
            'was there'
        )
    notes: tuple[str, ...] = ()
    if places:
        notes = (f'{len(places)} Cartesian points (first on line {places[0]}) were left out',)
    return axes_in_order(
        'positions of a KUKA controller', found, ('A', 'E'), maker='KUKA', notes=notes
    )


def moves(text: str) -> tuple[str, ...]:
    """Names of the points to which the moves of a program go, in order, with repetitions.

    Moves are PTP, LIN, SPTP and SLIN at the begin of a line; XP1 is named P1. () if there are
    none.
    """
    codes = (line.partition(';')[0] for line in text.splitlines())
    return tuple(_point(found[1]) for found in map(_MOVE.match, codes) if found)


def _point(name: str) -> str:
    """Name of a point by the name of its data: P1 for XP1; names without X in front stay."""
    return name[1:] if name.upper().startswith('X') and len(name) > 1 else name


def _position(
    number: int, line: str, before: str, aggregate: re.Match[str]
) -> tuple[str, dict[str, str]]:
    """Name of a position ('' if it has none), and its axes: name -> value as text.

    ``aggregate``: match of its braces; ``before``: text between the previous position and this
    one; ``number``, ``line``: for the message. Raises InputError for text that is no axis
    position.
    """
    values: dict[str, str] = {}
    for part in aggregate[1].split(','):
        entry = _ENTRY.fullmatch(part)
        if entry is None or entry[1].upper() in values:
            raise unexpected(number, line, _EXPECTED)
        values[entry[1].upper()] = entry[2]
    named = _NAME.search(before) or _LABEL.fullmatch(before)
    name = '' if named is None or named[1].upper() in _NO_NAMES else named[1]
    return _point(name), values
