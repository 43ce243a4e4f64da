# SPDX-License-Identifier: Apache-2.0
"""Logs in which each line has the joints in brackets, as programs print a list: `P1: [0, 1]`."""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import NUMBER, Named, leading, unexpected

# In square brackets or braces, or in round ones alone; behind them arguments of a call, or the
# external axes of RAPID. Each has one way to match: a line of a large log that is none of them is
# told at once.
_LINE = re.compile(
    r'(?:(?P<before>(?:[^\[\]{}]|\[\d+\])*)(?:\[{1,2}\(?|\{)(?P<list>[^\[\](){}]*)\)?'
    r'(?:\]\s*,\s*\[(?P<external>[^\[\]]*)\]\]|(?:\]{1,2}|\})(?:,\s*[\w.=]+\s*)*\)?)'
    r'|(?P<head>[^\[\](){}]*)\({1,2}(?P<row>[^\[\](){}]*)\){1,2})\s*(?:[,;]\s*)?'
)
# Text between the lists has fewer numbers.
_ANY_NUMBER = re.compile(r'\d+(?:\.\d*)?')
_MOST_BESIDE = 2
# A call with the list, and what calls are named that take places.
_CALLED = re.compile(r'([A-Za-z_]\w*)\s*\(\s*[\[(]?\s*[-+.\d]')
_PLACES = re.compile(r'lin|pose|cart|tcp|move_?[lcp]\b|frame|trans', re.IGNORECASE)
_RAPID = ('jointtarget', 'moveabsj')
_UNUSED = 9e9
_BETWEEN = re.compile(r'\s*[,;]\s*|\s+')
# What a name is set apart by, and what it is set before.
_APART = ' \t:;,="\'('
_FEWEST, _MOST = 2, 12


def read(text: str) -> Named | None:
    """Return the lists of a log, with their names or times; None for anything else."""
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    # Titles and keys have no numbers.
    head = next((i for i, (_, line) in enumerate(lines) if re.search(r'\d', line)), len(lines))
    first = [_LINE.fullmatch(line) for _, line in lines[head : head + 2]]
    if not first or not all(first) or any(word in text.lower() for word in _RAPID):
        return None
    if head and re.search(r'[,;\t]', (first[0] and _parts(first[0])[0]) or ''):
        # The names of columns.
        return None
    rows: list[list[str]] = []
    before: list[str] = []
    numbers_of: list[int] = []
    beside, call, rapid = 0, '', False
    for number, line in lines[head:]:
        match = _LINE.fullmatch(line)
        words, numbers = ('', '') if match is None else _parts(match)
        cells = _BETWEEN.split(numbers) if numbers else []
        listed = bool(cells) and all(map(NUMBER.fullmatch, cells))
        if not rows and (
            not (_FEWEST < len(cells) <= _MOST and listed)
            # A log of RAPID.
            or (match and match['external'] and not words)
        ):
            return None
        if rows and len(_ANY_NUMBER.findall(line)) <= _MOST_BESIDE:
            beside += 1
            continue
        if not listed or (rows and len(cells) != len(rows[0])) or not _is_unused(match):
            raise unexpected(
                number, line, f'a list of {len((rows or [cells])[0])} numbers in brackets'
            )
        called = _CALLED.search(line)
        other = called and (_PLACES.search(called[1]) or called[1] != (call or called[1]))
        # A pose of URScript.
        if other or re.search(r'\bp\[', line):
            raise unexpected(number, line, 'the joints in every line, of one call,')
        rapid = bool(match and match['external'])
        call = call or (called[1] if called else '')
        rows.append(cells)
        before.append(words)
        numbers_of.append(number)
    lead, before = leading(before)
    # External axes are of RAPID, which counts in degrees.
    joints = [f'J{i}{" [deg]" * rapid}' for i in range(1, len(rows[0]) + 1)]
    is_point = len(rows[0]) == len('XYZ')
    return Named(
        kind='lists of points' if is_point else 'lists of joints',
        names=(*lead, *('XYZ' if is_point else joints)),
        rows=tuple(
            (*([words] if lead else []), *cells) for words, cells in zip(before, rows, strict=True)
        ),
        lines=tuple(numbers_of),
        notes=(f'{beside} lines without a list were left out',) * bool(beside),
    )


def _parts(line: re.Match[str]) -> tuple[str, str]:
    """Return what stands before a list, and what is in it."""
    before = line['before'] or line['head'] or ''
    return before.strip(_APART), (line['list'] or line['row'] or '').strip()


def _is_unused(line: re.Match[str] | None) -> bool:
    """Return whether the external axes of a line are none, or at 0."""
    external = (line and line['external']) or '0'
    cells = [cell.strip() for cell in external.split(',')]
    return all(
        NUMBER.fullmatch(cell) and (float(cell) == 0.0 or float(cell) >= _UNUSED) for cell in cells
    )
