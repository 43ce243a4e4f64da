# SPDX-License-Identifier: Apache-2.0
"""Joint states and points as printed by ``rostopic echo -p`` and ``ros2 topic echo --csv``.

ROS 1 has the names of the joints in cells of their own (``field.name0``); ROS 2 has no header: a
second, a nanosecond, the frame, the names, then positions, velocities and efforts.
"""

from __future__ import annotations

import re

from remaster_ros.importing.makers.named import NUMBER, NamedColumns, unexpected

_FIELD = re.compile(r'field\.(name|position)\[?(\d+)\]?')


def read(text: str) -> NamedColumns | None:
    """Joints or points of a topic printed by ROS 1 or ROS 2 as CSV; None for other text.

    Raises InputError, with the line, if lines differ in names or number of cells.
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        return None
    head = [cell.strip() for cell in lines[0][1].split(',')]
    if any(_FIELD.fullmatch(cell) for cell in head):
        return _with_header(head, lines[1:])
    if _names(head):
        return _without_header(lines)
    return _places(lines) if _is_place(head) else None


def _with_header(head: list[str], lines: list[tuple[int, str]]) -> NamedColumns | None:
    """Joint states as ROS 1 prints them; `head`: cells of the first line, `lines`: the others.

    None if there is no time, or names and positions do not match. Raises InputError, with the
    line, if the names change.
    """
    columns = {cell: i for i, cell in enumerate(head)}
    names, positions = dict[str, int](), dict[str, int]()
    for cell, i in columns.items():
        if match := _FIELD.fullmatch(cell):
            (names if match[1] == 'name' else positions)[match[2]] = i
    if not names or {*names} != {*positions}:
        return None
    # The time of the message, not that of printing it.
    time = next(
        (columns[name] for name in ('field.header.stamp', '%time') if name in columns), None
    )
    if time is None:
        return None
    first: list[str] = []
    rows = []
    for number, line in lines:
        cells = [cell.strip() for cell in line.split(',')]
        line_names = [cells[i] for i in names.values()] if len(cells) == len(head) else []
        first = first or line_names
        if not line_names or line_names != first:
            raise unexpected(number, line, f'{len(head)} cells with the same names of joints')
        rows.append((cells[time], *(cells[positions[i]] for i in names)))
    return _named(first, rows, lines, 'ns')


def _names(cells: list[str]) -> list[str]:
    """Joint names in a line of ``ros2 topic echo --csv``; [] for other lines."""
    if len(cells) < 5 or not _stamp(cells):
        return []
    names = []
    for cell in cells[3:]:
        if NUMBER.fullmatch(cell):
            break
        names.append(cell)
    return names if len(names) > 1 and len(cells) >= 3 + 2 * len(names) and all(names) else []


def _without_header(lines: list[tuple[int, str]]) -> NamedColumns:
    """Joint states as ROS 2 prints them, from lines (number, text).

    Raises InputError, with the line, if the names change.
    """
    first = _names([cell.strip() for cell in lines[0][1].split(',')])
    rows = []
    for number, line in lines:
        cells = [cell.strip() for cell in line.split(',')]
        if _names(cells) != first:
            raise unexpected(number, line, f'second, nanosecond, frame, {", ".join(first)}')
        start = 3 + len(first)
        rows.append((_stamp(cells), *cells[start : start + len(first)]))
    return _named(first, rows, lines, 's')


def _stamp(cells: list[str]) -> str:
    """Time of a line that begins with second and nanosecond, s, as text; '' for other lines."""
    if not (cells[0].isdigit() and cells[1].isdigit() and int(cells[1]) < 1e9):
        return ''
    return f'{cells[0]}.{int(cells[1]):09d}'


def _is_place(cells: list[str]) -> bool:
    """Whether a line is a point or pose: second, nanosecond, frame, 3 or 7 numbers."""
    return (
        len(cells) - 3 in (len('xyz'), len('xyz') + len('xyzw'))
        and bool(_stamp(cells))
        and not NUMBER.fullmatch(cells[2])
        and all(map(NUMBER.fullmatch, cells[3:]))
    )


def _places(lines: list[tuple[int, str]]) -> NamedColumns:
    """Points of ``ros2 topic echo --csv``, m, with quaternions x, y, z, w if present.

    Raises InputError, with the line, if a line is no point or pose as the first one is.
    """
    rows = []
    width = len(lines[0][1].split(','))
    for number, line in lines:
        cells = [cell.strip() for cell in line.split(',')]
        if len(cells) != width or not _is_place(cells):
            raise unexpected(number, line, f'second, nanosecond, frame and {width - 3} numbers')
        rows.append((_stamp(cells), *cells[3:]))
    axes = [*(f'{axis} [m]' for axis in 'xyz'), *(f'q{axis}' for axis in 'xyzw')]
    return NamedColumns(
        kind='points as ROS prints them',
        names=('time [s]', *axes[: width - 3]),
        rows=tuple(rows),
        lines=tuple(number for number, _ in lines),
    )


def _named(
    joints: list[str], rows: list[tuple[str, ...]], lines: list[tuple[int, str]], unit: str
) -> NamedColumns:
    """Columns of joint states; `unit` is that of the time, `rows` are time and positions."""
    return NamedColumns(
        kind='joint states as ROS prints them',
        names=(f'time [{unit}]', *(f'{joint} position' for joint in joints)),
        rows=tuple(rows),
        lines=tuple(number for number, _ in lines),
    )
