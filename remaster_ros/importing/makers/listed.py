# SPDX-License-Identifier: Apache-2.0
"""Logs in which each line has the joints as a list in brackets: `P1: [0, 1]`."""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import (
    NUMBER,
    UNUSED,
    NamedColumns,
    leading_column,
    unexpected,
)

# A list in square brackets or braces, or in round ones alone; behind it arguments of a call, or
# the external axes of RAPID. Each alternative matches in one way only, so that other lines of a
# large log are rejected quickly.
_LINE = re.compile(
    r'(?:(?P<before>(?:[^\[\]{}]|\[\d+\])*)(?:\[{1,2}\(?|\{)(?P<list>[^\[\](){}]*)\)?'
    r'(?:\]\s*,\s*\[(?P<external>[^\[\]]*)\]\]|(?:\]{1,2}|\})(?:,\s*[\w.=]+\s*)*\)?)'
    r'|(?P<head>[^\[\](){}]*)\({1,2}(?P<row>[^\[\](){}]*)\){1,2})\s*(?:[,;]\s*)?'
)
# Lines of text between the lists have at most this many numbers.
_ANY_NUMBER = re.compile(r'\d+(?:\.\d*)?')
_MOST_IN_TEXT = 2
# A call with the list, and names of calls that take Cartesian poses.
_CALLED = re.compile(r'([A-Za-z_]\w*)\s*\(\s*[\[(]?\s*[-+.\d]')
_PLACES = re.compile(r'lin|pose|cart|tcp|move_?[lcp]\b|frame|trans', re.IGNORECASE)
_RAPID = ('jointtarget', 'moveabsj')
_BETWEEN = re.compile(r'\s*[,;]\s*|\s+')
# Characters around a name that are no part of it.
_DELIMITERS = ' \t:;,="\'('
_FEWEST, _MOST = 2, 12


def read(text: str) -> NamedColumns | None:
    """Lists in brackets, one in each line of a log, with names or times; None for other text.

    Lists of three numbers are points, of 4 to 12 joints. Lines with up to two numbers are left
    out, with a note. Raises InputError, with the line, for other lines, lists of other lengths
    than the first, Cartesian poses, or external axes in use.
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    # Titles and keys have no numbers.
    head = next((i for i, (_, line) in enumerate(lines) if re.search(r'\d', line)), len(lines))
    first = [_LINE.fullmatch(line) for _, line in lines[head : head + 2]]
    if not first or not all(first) or any(word in text.lower() for word in _RAPID):
        return None
    if head and re.search(r'[,;\t]', (first[0] and _label_and_list(first[0])[0]) or ''):
        # The names of columns.
        return None
    rows: list[list[str]] = []
    labels: list[str] = []
    numbers_of: list[int] = []
    text_lines, call, rapid = 0, '', False
    for number, line in lines[head:]:
        match = _LINE.fullmatch(line)
        words, numbers = ('', '') if match is None else _label_and_list(match)
        cells = _BETWEEN.split(numbers) if numbers else []
        listed = bool(cells) and all(map(NUMBER.fullmatch, cells))
        if not rows and (
            not (_FEWEST < len(cells) <= _MOST and listed)
            # A log of RAPID.
            or (match and match['external'] and not words)
        ):
            return None
        if rows and len(_ANY_NUMBER.findall(line)) <= _MOST_IN_TEXT:
            text_lines += 1
            continue
        if not listed or (rows and len(cells) != len(rows[0])) or not _has_no_external_axes(match):
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
        labels.append(words)
        numbers_of.append(number)
    lead, labels = leading_column(labels)
    # External axes are of RAPID, which counts in degrees.
    joints = [f'J{i}{" [deg]" * rapid}' for i in range(1, len(rows[0]) + 1)]
    is_point = len(rows[0]) == len('XYZ')
    return NamedColumns(
        kind='lists of points' if is_point else 'lists of joints',
        names=(*lead, *('XYZ' if is_point else joints)),
        rows=tuple(
            (*([words] if lead else []), *cells) for words, cells in zip(labels, rows, strict=True)
        ),
        lines=tuple(numbers_of),
        notes=(f'{text_lines} lines without a list were left out',) * bool(text_lines),
    )


def _label_and_list(line: re.Match[str]) -> tuple[str, str]:
    """Text before the list of a line, without delimiters, and text within its brackets."""
    before = line['before'] or line['head'] or ''
    return before.strip(_DELIMITERS), (line['list'] or line['row'] or '').strip()


def _has_no_external_axes(line: re.Match[str] | None) -> bool:
    """Whether the external axes of a line are absent, unused (from 9e9 on) or at 0.

    `line`: match of `_LINE`; None counts as absent.
    """
    external = (line and line['external']) or '0'
    cells = [cell.strip() for cell in external.split(',')]
    return all(
        NUMBER.fullmatch(cell) and (float(cell) == 0.0 or float(cell) >= UNUSED) for cell in cells
    )
