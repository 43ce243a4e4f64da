# SPDX-License-Identifier: Apache-2.0
"""Logs in which a name precedes each number: `P1 X=1.5 Y=2.5 Z=3.5`, `A1 10.0 A2 …`."""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import NUMBER, NamedColumns, leading_column, unexpected

_PAIR = re.compile(
    rf'(?<![\w.$])([A-Za-z]\w*)(?:\s*[=:]\s*"?|\s+)({NUMBER.pattern})"?'
    r'(?:\s*(°|(?:deg|rad|mm|m)\b))?(?![\w.])\s*[,;/>)]*\s*'
)
_FEWEST = 3
_SEEN = 50
_NUMBERS = re.compile(r'\d+(?:\.\d*)?')
# Lines of text between the records have at most this many numbers.
_MOST_IN_TEXT = 2
_DELIMITERS = ' \t:;,=<("'


def read(text: str) -> NamedColumns | None:
    """Columns of a log in which a name precedes each number; None for other text.

    Of the first 50 lines with three numbers, over half must have three named ones. Lines with
    up to two numbers are left out, with a note. Raises InputError, with the line, if names
    differ between lines.
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    seen = [line for _, line in lines[:_SEEN] if len(_NUMBERS.findall(line)) >= _FEWEST]
    # Titles have such words as well.
    if not seen or 2 * sum(map(_is_keyed, seen)) <= len(seen):
        return None
    keys: list[str] = []
    rows: list[tuple[str, ...]] = []
    labels: list[str] = []
    at: list[int] = []
    text_lines = 0
    for number, line in lines:
        pairs = [*_PAIR.finditer(line)]
        if len(pairs) < _FEWEST and len(_NUMBERS.findall(line)) <= _MOST_IN_TEXT:
            text_lines += 1
            continue
        line_keys = [f'{pair[1]} [{pair[3]}]' if pair[3] else pair[1] for pair in pairs]
        keys = keys or line_keys
        first = pairs[0].start() if pairs else 0
        # Nothing but the pairs, behind a name.
        remainder = _PAIR.sub('', line[first:]).strip(' \t,;)/>')
        if line_keys != keys or len({*line_keys}) < len(line_keys) or re.search(r'\d', remainder):
            raise unexpected(number, line, ', '.join(f'{key}=…' for key in keys))
        rows.append(tuple(pair[2] for pair in pairs))
        labels.append(line[:first].strip(_DELIMITERS))
        at.append(number)
    lead, labels = leading_column(labels)
    return NamedColumns(
        kind='lines with named numbers',
        names=(*lead, *keys),
        rows=tuple((*[name] * len(lead), *row) for name, row in zip(labels, rows, strict=True)),
        lines=tuple(at),
        notes=(f'{text_lines} lines without named numbers were left out',) * bool(text_lines),
    )


def _is_keyed(line: str) -> bool:
    """Whether a line has at least three named numbers, each name once."""
    keys = [pair[0] for pair in _PAIR.findall(line)]
    return len(keys) >= _FEWEST and len({*keys}) == len(keys)
