# SPDX-License-Identifier: Apache-2.0
"""Kawasaki's AS: joint displacements of a saved file (.JOINTS) and of a program (#PPOINT)."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_SECTION = re.compile(r'\s*\.(\w+)')
_NAME = r'#[A-Za-z][\w.]*(?:\[\s*\d+\s*\])?'
_ROW = re.compile(rf'\s*({_NAME})((?:[\s,]+{NUMBER.pattern})+)\s*')
_POINT = re.compile(rf'\s*(?:POINT\s+)?({_NAME})\s*=\s*#PPOINT\s*\(([^()]*)\)\s*', re.IGNORECASE)
_CALL = re.compile(r'#PPOINT\s*\(', re.IGNORECASE)
_SIX = re.compile(r'(?:[-+.\d]+[\s,]+){5}[-+.\d]')
_EXPECTED = '#name and an angle for each joint'


def read(text: str) -> NamedColumns | None:
    """Joint displacements in a Kawasaki file or program (AS), degrees; None for other text.

    Transformations (Cartesian) are left out, with a note. Raises InputError, with the line,
    for text that cannot be read, or if there are no joint displacements.
    """
    if not (
        re.search(r'^[ \t]*\.JOINTS', text, re.MULTILINE | re.IGNORECASE) or _CALL.search(text)
    ):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    section, places = '', 0
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition(';')[0]
        if (begins := _SECTION.match(code)) and not code.lstrip().startswith('.*'):
            section = begins[1].upper()
            if _SIX.search(code):
                raise unexpected(number, line, 'a section, such as .JOINTS, on a line of its own')
            continue
        if not code.strip():
            continue
        if section == 'JOINTS':
            row = _ROW.fullmatch(code)
        else:
            row = _POINT.fullmatch(code)
            places += section == 'TRANS'
            if row is None and not _CALL.search(code):
                if '#' in code and _SIX.search(code):
                    raise unexpected(number, line, '.JOINTS before it')
                continue
        cells = [] if row is None else re.findall(r'[^\s,]+', row[2])
        if row is None or not all(map(NUMBER.fullmatch, cells)):
            raise unexpected(number, line, _EXPECTED)
        name = re.sub(r'\s', '', row[1][1:])
        found.append((number, name, {f'J{i}': cell for i, cell in enumerate(cells, 1)}))
    if not found:
        raise InputError(f'line 1: there are no joint displacements in it ({_EXPECTED})')
    notes = (f'{places} transformations were left out',) * bool(places)
    return axes_in_order(
        'joint displacements of Kawasaki', found, ('J',), maker='Kawasaki', notes=notes
    )
