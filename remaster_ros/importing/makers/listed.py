"""Logs in which each line has the joints in brackets, as programs print a list: `P1: [0, 1]`."""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import NUMBER, Named, unexpected

# In square brackets, or in round ones alone. Each has one way to match: a line of a large log that
# is none of both is told at once.
_LINE = re.compile(
    r'(?:(?P<before>[^\[\]]*)\[{1,2}\(?(?P<list>[^\[\]()]*)\)?\]{1,2}\)?'
    r'|(?P<head>[^\[\]()]*)\({1,2}(?P<row>[^\[\]()]*)\){1,2})\s*(?:[,;]\s*)?'
)
_BETWEEN = re.compile(r'\s*[,;]\s*|\s+')
_TIME = re.compile(r'\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?|\d{5,}\.\d+')
# What a name is set apart by, and what it is set before.
_APART = ' \t:;,="\'('
_FEWEST, _MOST = 2, 12


def read(text: str) -> Named | None:
    """Return the lists of a log, with their names or times; None for anything else."""
    if not _LINE.fullmatch(text.lstrip().partition('\n')[0].rstrip('\r')):
        return None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    found = [(number, line, _LINE.fullmatch(line)) for number, line in lines]
    if not all(match for *_, match in found[:2]):
        return None
    rows: list[list[str]] = []
    before: list[str] = []
    for number, line, match in found:
        words, numbers = ('', '') if match is None else _parts(match)
        cells = _BETWEEN.split(numbers) if numbers else []
        if not rows and not (_FEWEST < len(cells) <= _MOST and all(map(NUMBER.fullmatch, cells))):
            return None
        if (
            match is None
            or (rows and len(cells) != len(rows[0]))
            or not all(map(NUMBER.fullmatch, cells))
        ):
            raise unexpected(number, line, f'a list of {len(rows[0])} numbers in brackets')
        rows.append(cells)
        before.append(words)
    stamps = [_TIME.search(words) for words in before]
    lead: list[str] = []
    if all(stamps):
        lead, before = ['time'], [stamp[0].replace(',', '.') for stamp in stamps if stamp]
    elif all(before) and len({*before}) == len(before):
        lead = ['name']
    return Named(
        kind='lists of joints',
        names=(*lead, *(f'J{i}' for i in range(1, len(rows[0]) + 1))),
        rows=tuple(
            (*([words] if lead else []), *cells) for words, cells in zip(before, rows, strict=True)
        ),
        lines=tuple(number for number, _ in lines),
    )


def _parts(line: re.Match[str]) -> tuple[str, str]:
    """Return what stands before a list, and what is in it."""
    before = line['before'] or line['head'] or ''
    return before.strip(_APART), (line['list'] or line['row'] or '').strip()
