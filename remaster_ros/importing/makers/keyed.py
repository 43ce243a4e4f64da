# SPDX-License-Identifier: Apache-2.0
"""Logs in which each number has its name before it: `P1 X=1.5 Y=2.5 Z=3.5`, `A1 10.0 A2 …`."""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import NUMBER, Named, leading, unexpected

_PAIR = re.compile(
    rf'(?<![\w.$])([A-Za-z]\w*)(?:\s*[=:]\s*"?|\s+)({NUMBER.pattern})"?'
    r'(?:\s*(°|(?:deg|rad|mm|m)\b))?(?![\w.])\s*[,;/>)]*\s*'
)
_FEWEST = 3
_SEEN = 50
_NUMBERS = re.compile(r'\d+(?:\.\d*)?')
# Text between has fewer numbers.
_MOST_BESIDE = 2
_APART = ' \t:;,=<("'


def read(text: str) -> Named | None:
    """Return the numbers by their names; None for anything else."""
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    seen = [line for _, line in lines[:_SEEN] if len(_NUMBERS.findall(line)) >= _FEWEST]
    # Titles have such words as well.
    if not seen or 2 * sum(map(_is_keyed, seen)) <= len(seen):
        return None
    keys: list[str] = []
    rows: list[tuple[str, ...]] = []
    before: list[str] = []
    at: list[int] = []
    beside = 0
    for number, line in lines:
        pairs = [*_PAIR.finditer(line)]
        if len(pairs) < _FEWEST and len(_NUMBERS.findall(line)) <= _MOST_BESIDE:
            beside += 1
            continue
        own = [f'{pair[1]} [{pair[3]}]' if pair[3] else pair[1] for pair in pairs]
        keys = keys or own
        first = pairs[0].start() if pairs else 0
        # Nothing but the pairs, behind a name.
        rest = _PAIR.sub('', line[first:]).strip(' \t,;)/>')
        if own != keys or len({*own}) < len(own) or re.search(r'\d', rest):
            raise unexpected(number, line, ', '.join(f'{key}=…' for key in keys))
        rows.append(tuple(pair[2] for pair in pairs))
        before.append(line[:first].strip(_APART))
        at.append(number)
    lead, before = leading(before)
    return Named(
        kind='lines with named numbers',
        names=(*lead, *keys),
        rows=tuple((*[name] * len(lead), *row) for name, row in zip(before, rows, strict=True)),
        lines=tuple(at),
        notes=(f'{beside} lines without named numbers were left out',) * bool(beside),
    )


def _is_keyed(line: str) -> bool:
    keys = [pair[0] for pair in _PAIR.findall(line)]
    return len(keys) >= _FEWEST and len({*keys}) == len(keys)
