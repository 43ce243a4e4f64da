# SPDX-License-Identifier: Apache-2.0
"""Joint positions of Denso's PacScript (.pcs) and PAC: `J[10] = J(…)`, eight axes each."""

from __future__ import annotations

import re

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

# `J(…)` in PacScript, `(…)` in PAC; a line may begin with its number or `Let`.
_POSITION = re.compile(
    r'\s*(?:\d+\s+)?(?:let\s+)?(?P<name>(?P<kind>[JPT])(?:\[\s*(?P<index>\w+)\s*\]|(?P<number>\d+)))'
    r'\s*=\s*(?P<call>[JPT]?)\s*\((?P<list>[^()]*)\)\s*',
    re.IGNORECASE,
)
_ASSIGNED = re.compile(r'\s*(?:\d+\s+)?(?:let\s+)?J(?:\[[^\]]*\]|\d+)\s*=.*\d', re.IGNORECASE)
# Any list of numbers, and which kind of position it is; its bracket may be lost.
_LISTED = re.compile(r'([JPT]?)[ \t]*\(?(?:[ \t]*[-+]?[\d.]+[ \t]*,){4}', re.IGNORECASE)
_FEWEST, _MOST = 3, 8


def read(text: str) -> NamedColumns | None:
    """Joint positions of a PacScript program (Denso), degrees; None for other text.

    Cartesian positions are left out, with a note. Raises InputError for a malformed or cut
    statement, or a program without joint positions.
    """
    if not re.search(
        r'^[^\S\n]*(?:let\s+)?J\[\s*\w+\s*\]\s*=\s*J?\s*\(', text, re.MULTILINE | re.I
    ):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    places = 0
    width = 0
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition("'")[0]
        position = _POSITION.fullmatch(code)
        if position is None:
            listed = _LISTED.search(code)
            if listed and listed[1].upper() in ('P', 'T'):
                places += 1
            elif listed or _ASSIGNED.match(code) or _is_cut(code, line):
                raise unexpected(number, line, 'J[…] = J(…) with a number for each axis')
            continue
        if position['kind'].upper() != 'J':
            places += 1
            continue
        cells = [cell.strip() for cell in position['list'].split(',')]
        width = width or len(cells)
        if (
            position['call'].upper() not in ('', 'J')
            or len(cells) != width
            or not _FEWEST <= width <= _MOST
            or not all(map(NUMBER.fullmatch, cells))
        ):
            raise unexpected(number, line, f'J[…] = J(…) with {width or 8} numbers')
        found.append((number, position['name'], {f'J{i}': c for i, c in enumerate(cells, 1)}))
    if not found:
        raise InputError('line 1: no joint position in it; J[1] = J(…) is expected')
    notes = (f'{places} Cartesian positions were left out',) * bool(places)
    return axes_in_order('joint positions of PacScript', found, ('J',), maker='Denso', notes=notes)


def _is_cut(code: str, line: str) -> bool:
    """Whether a comment cuts off an assignment to a joint position, such as ``J[1] = J(1, ' 2)``.

    `code`: the part of `line` before the comment. True if its brackets do not match, or it
    ends before the value; False without a comment.
    """
    return code != line and (
        any(code.count(a) != code.count(b) for a, b in ('[]', '()'))
        or bool(
            re.fullmatch(r'\s*(?:\d+\s+)?(?:let\s+)?J(?:\[[^\]]*\]\s*=?)?\s*J?\s*', code, re.I)
        )
    )
