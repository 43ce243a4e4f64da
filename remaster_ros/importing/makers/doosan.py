# SPDX-License-Identifier: Apache-2.0
"""Doosan's DRL, also in Python: positions of joints, posj(…), in degrees."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_CALL = re.compile(r'\bposj\s*\(')
_LIST = re.compile(r'\bposj\s*\(\s*\[?([^()\[\]]*)\]?\s*\)')
_PLACE = re.compile(r'\bposx\s*\(')
_SIX = re.compile(r'(?:[-+.\d]+\s*,\s*){5}[-+.\d]')
_NAME = re.compile(r'\s*(?:[A-Za-z_]\w*\.)?([A-Za-z_]\w*)\s*=\s*$')
_MOVE = re.compile(r'\s*(?:[A-Za-z_]\w*\.)?a?movej\s*\(\s*$')
_RELATIVE = re.compile(r'\bDR_MV_MOD_REL\b|\bmod\s*=\s*1\b')
_EXPECTED = 'posj(…) with an angle in degrees for each joint, once a line,'


def read(text: str) -> NamedColumns | None:
    """Joint positions, posj(…), of a Doosan program (DRL), degrees; None for other text.

    Cartesian positions are left out, with a note. Raises InputError, with the line, for
    relative moves, text that cannot be read, or if there are no joint positions.
    """
    if not _CALL.search(text):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    places = 0
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition('#')[0]
        calls = len(_CALL.findall(code))
        if not calls:
            place = _PLACE.search(code)
            if _SIX.search(code) and not place:
                raise unexpected(number, line, _EXPECTED)
            places += bool(place)
            continue
        listed = _LIST.search(code)
        before = '' if listed is None else code[: listed.start()]
        name = _NAME.fullmatch(before)
        cells = [] if listed is None else [cell.strip() for cell in listed[1].split(',')]
        if (
            calls > 1
            or not (name or not before.strip() or _MOVE.fullmatch(before))
            or not all(map(NUMBER.fullmatch, cells))
            or _RELATIVE.search(code)
        ):
            raise unexpected(number, line, _EXPECTED)
        axes = {f'J{i}': cell for i, cell in enumerate(cells, 1)}
        found.append((number, name[1] if name else '', axes))
    if not found:
        raise InputError(f'line 1: there is no {_EXPECTED} in it')
    notes = (f'{places} Cartesian positions were left out',) * bool(places)
    return axes_in_order('positions of Doosan', found, ('J',), maker='Doosan', notes=notes)
