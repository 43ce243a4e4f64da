# SPDX-License-Identifier: Apache-2.0
"""Reports with one number a line: `P1.X;1,5`, or a name and below it `X 1.5`, `Y 2.5`, `Z 3.5`."""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import NamedColumns, unexpected

_LINE = re.compile(
    r'\s*"?(?:(?P<name>[^\s;,\t].*?)"?[\s.,;:_-]+"?)?(?P<axis>[XYZ])"?(?:\s*[;:=,\t]\s*|\s+)'
    r'"?(?P<value>[+-]?\d+(?:[.,]\d+)?)"?(?:\s*mm)?\s*[;,]?\s*',
    re.ASCII,
)
_AXES = 'XYZ'
_SEEN = 60
# Longest line with a name, an axis and a number; matching longer lines takes exponential time.
_LONGEST = 200


def read(text: str) -> NamedColumns | None:
    """Points of a report with one number a line; None for other text.

    Columns X, Y and Z, and before them ``name`` if the points have different names. Raises
    InputError, with the line, if the axes of a point are not X, Y and Z in this order.
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    seen = [match['axis'] for _, line in lines[:_SEEN] if (match := _match(line))]
    if len(seen) < 2 * len(_AXES) or 2 * len(seen) <= len(lines[:_SEEN]):
        return None
    names: list[str] = []
    rows: list[list[str]] = []
    at: list[int] = []
    above, values = '', list[str]()
    for number, line in lines:
        match = _match(line)
        if match is None:
            # Between the axes of a point no other line may stand.
            if values or len(re.findall(r'\d+(?:[.,]\d+)?', line)) > 1:
                raise unexpected(number, line, f'{_AXES[len(values)]} and its number')
            above = line.strip(' \t;,"')
            continue
        name = match['name'] or above
        if match['axis'] != _AXES[len(values)] or (values and name != names[-1]):
            raise unexpected(number, line, f'{_AXES[len(values)]} of {name or "a point"}')
        if not values:
            names.append(name)
            at.append(number)
        values.append(match['value'])
        if len(values) == len(_AXES):
            rows.append(values)
            values = []
    if values:
        raise unexpected(*lines[-1], f'{_AXES[len(values)]} below it')
    named = len({*names}) > 1
    decimal = ',' if any(',' in cell for row in rows for cell in row) else '.'
    return NamedColumns(
        kind='points with a line for each axis',
        names=(*['name'] * named, *_AXES),
        rows=tuple((*[name] * named, *row) for name, row in zip(names, rows, strict=True)),
        lines=tuple(at),
        decimal=decimal,
    )


def _match(line: str) -> re.Match[str] | None:
    """Match of a line with an axis, its value and perhaps a name; None for other lines.

    None also for lines of over 200 letters.
    """
    return _LINE.fullmatch(line) if len(line) <= _LONGEST else None
