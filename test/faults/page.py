# SPDX-License-Identifier: Apache-2.0
"""The tables of observed.md, which the tests write (FAULTS_PAGE=write or add) or compare.

``write`` replaces the rows that were tried; ``add`` keeps what they were before as well: where a
fault ends differently from time to time, the page has a line for each.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

PAGE = Path(__file__).with_name('observed.md')
BEGIN, END = '<!-- observed by the tests: {} -->', '<!-- end -->'
MODE = os.environ.get('FAULTS_PAGE', '')
WRITES = MODE in ('write', 'add')


def body(name: str) -> str:
    """Return a section as it stands on the page."""
    _, tail = PAGE.read_text().split(BEGIN.format(name))
    return tail.split(END, 1)[0].strip()


def replace(name: str, text: str) -> None:
    """Put another text into a section."""
    begin = BEGIN.format(name)
    head, remainder = PAGE.read_text().split(begin)
    _, tail = remainder.split(END, 1)
    PAGE.write_text(f'{head}{begin}\n\n{text}\n\n{END}{tail}')


def rows(name: str) -> list[tuple[str, ...]]:
    """Return the cells of a section's table, without its heading."""
    lines = [line for line in body(name).splitlines() if line.startswith('|')][2:]
    return [tuple(cell.strip() for cell in line.strip('|').split(' | ')) for line in lines]


def table(heading: tuple[str, ...], cells: list[tuple[str, ...]]) -> str:
    """Return a table."""
    lines = ['| ' + ' | '.join(heading) + ' |', '|---' * len(heading) + '|']
    return '\n'.join([*lines, *('| ' + ' | '.join(row) + ' |' for row in cells)])


def cells(name: str) -> dict[str, dict[str, str]]:
    """Return a section's rows by their first cells, each by the heading of its column."""
    heading = [cell.strip() for cell in body(name).splitlines()[0].strip('|').split(' | ')]
    return {row[0]: dict(zip(heading[1:], row[1:], strict=True)) for row in rows(name)}


def compare(name: str, heading: tuple[str, ...], row: str, column: str, seen: str) -> None:
    """See that a cell of the page is what was seen, or write it there."""
    known = cells(name)
    if WRITES:
        known.setdefault(row, {})[column] = seen
        lines = [(key, *(known[key].get(c, '') for c in heading[1:])) for key in known]
        replace(name, table(heading, lines))
        return
    page = known.get(row, {}).get(column, 'nothing')
    assert page == seen, (
        f'test/faults/observed.md is not what was observed (make faults): {row}, {column}'
    )


def same(first: tuple[str, ...], second: tuple[str, ...]) -> bool:
    """Whether two rows are the same but for their numbers."""
    return [_masked(cell) for cell in first] == [_masked(cell) for cell in second]


def allows(page: list[tuple[str, ...]], seen: tuple[str, ...], said: int) -> bool:
    """Whether the page's lines of a fault have what was seen of it.

    What is commanded and how it goes on must be as in one of them. Of several reasons not each is
    told every time, as the first one may be over when a node looks again: none may be new.

    Parameters
    ----------
    page
        The lines of this fault.
    seen
        As a line.
    said
        The column of reasons.
    """
    lines = {tuple(_masked(c) for i, c in enumerate(row) if i != said) for row in page}
    known = {part for row in page for part in _parts(row[said])}
    mine = tuple(_masked(c) for i, c in enumerate(seen) if i != said)
    return mine in lines and _parts(seen[said]) <= known


def _parts(said: str) -> set[str]:
    # Of several sensors that are waited for, any may be the first, which follows these two words.
    parts = _masked(said).lower().split('; ')
    return {part.removeprefix('waiting for ') for part in parts}


def _masked(cell: str) -> str:
    return re.sub(r'\d+(\.\d+)?', '…', cell)
