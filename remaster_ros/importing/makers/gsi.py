# SPDX-License-Identifier: Apache-2.0
"""Leica's GSI, as total stations export it: words of a fixed width, a line for each point.

A word has two digits for its kind (11: name of the point, 81 to 83: east, north, height), four of
information, of which the last is the unit, a sign, and 8 or 16 digits or letters.
"""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NamedColumns, unexpected

_WORD = re.compile(r'(\d\d)([\d.]{4})([+-])([^\s+]{16}|[^\s+]{8})(?=\s|$)')
_LINE = re.compile(rf'\*?(?:{_WORD.pattern}\s*)+')
_NAME, _AXES = '11', ('81', '82', '83')
# Digits behind the decimal sign of a millimetre.
_DIGITS = {'0': 0, '6': 1, '8': 2}


def read(text: str) -> NamedColumns | None:
    """Points of a file in Leica's GSI, mm, with their names; None for other text.

    Lines without a name or coordinates are left out, with a note. Raises InputError, with the
    line, for a line that is no GSI, coordinates that are not metric, or if there are none.
    """
    lines = [(i, line.strip()) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines or not _LINE.fullmatch(lines[0][1]):
        return None
    rows, at = [], []
    for number, line in lines:
        if not _LINE.fullmatch(line):
            raise unexpected(number, line, 'words of GSI, such as 81..00+00002787')
        words = {found[1]: found for found in _WORD.finditer(line)}
        if not {*_AXES} <= {*words} or _NAME not in words:
            continue
        cells = [words[_NAME][4].lstrip('0') or '0']
        for axis in _AXES:
            word = words[axis]
            digits = _DIGITS.get(word[2][-1])
            if digits is None or not word[4].isdigit():
                raise unexpected(number, line, 'coordinates in metres')
            cells.append(f'{word[3]}{int(word[4]) / 10**digits:.{digits}f}')
        rows.append(tuple(cells))
        at.append(number)
    if not rows:
        raise InputError(
            'line 1: there are no coordinates in it (words 81, 82 and 83); angles and distances '
            'are no points: export coordinates'
        )
    skipped_lines = len(lines) - len(rows)
    return NamedColumns(
        kind="points in Leica's GSI, mm",
        instrument='tracker',
        names=('name', *(f'{axis} [mm]' for axis in 'XYZ')),
        rows=tuple(rows),
        lines=tuple(at),
        notes=(f'{skipped_lines} lines without coordinates were left out',) * bool(skipped_lines),
    )
