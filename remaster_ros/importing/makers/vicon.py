# SPDX-License-Identifier: Apache-2.0
"""Vicon's export of a capture (Nexus, Tracker): markers, or objects, a line for each frame.

Each section has its title, the frames per second, the names of the objects, the axes, the units
and then the frames. It has no times.
"""

from __future__ import annotations

import csv
import re

from remaster_ros.importing.makers.named import NUMBER, NamedColumns, unexpected

# Sections that describe a tool, the likeliest first.
_SECTIONS = ('Objects', 'Segments', 'Global Angles', 'Trajectories', 'Markers')
_START = re.compile(r'\s*"?([A-Z][A-Za-z ]+?)"?[,;\t]*\s*')
_AXES = {**{f'T{axis}': axis for axis in 'XYZ'}, **{axis: axis for axis in 'XYZ'}}
_TURNS = {f'R{axis}': axis.lower() for axis in 'XYZW'}
_HEAD_LINES = 5


def read(text: str) -> NamedColumns | None:
    """Columns of a capture exported by Vicon; None for other text.

    Of one section, the first of `_SECTIONS` that is there: time (frame by rate), positions,
    and quaternions. Orientations in angles and other sections are left out, with notes. Raises
    InputError, with the line, for missing sections, axes or units, rows of other lengths, or
    frames that do not increase.
    """
    if not re.search(r'^"?Frame"?[,;\t]"?Sub Frame"?[,;\t]', text, re.MULTILINE):
        return None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1)]
    titles = [(i, _START.fullmatch(line)) for i, (_, line) in enumerate(lines)]
    starts = {title[1]: i for i, title in titles if title is not None}
    chosen = next((name for name in _SECTIONS if name in starts), '')
    if not chosen:
        raise unexpected(*lines[0], f'a section {", ".join(_SECTIONS[:-1])} or {_SECTIONS[-1]}')
    part = lines[starts[chosen] :]
    if len(part) <= _HEAD_LINES:
        raise unexpected(*part[-1], 'the rate, names, axes, units and frames')
    separator = next((sign for sign in ';\t' if sign in part[3][1]), ',')
    rows = [next(csv.reader([line], delimiter=separator)) for _, line in part]
    rate, names, axes, units = rows[1], rows[2], rows[3], rows[4]
    if not (rate and NUMBER.fullmatch(rate[0].strip()) and float(rate[0]) > 0.0):
        raise unexpected(*part[1], 'the number of frames per second')
    width = len(axes)
    for head, row in zip(part[2:_HEAD_LINES], rows[2:_HEAD_LINES]):
        if any(row[width:]):
            raise unexpected(*head, f'{width} cells')
    groups, turns = dict[str, tuple[int, ...]](), dict[str, tuple[int, ...]]()
    labels, name = ['Time [s]'], ''
    found: dict[str, dict[str, int]] = {}
    for i in range(2, width):
        name = _name(names[i].strip()) if i < len(names) and names[i].strip() else name
        axis = axes[i].strip().upper()
        if not name or axis not in {**_AXES, **_TURNS} or axis in found.setdefault(name, {}):
            raise unexpected(
                *part[3], f'X, Y and Z once for each of {", ".join(filter(None, names))}'
            )
        unit = units[i].strip() if i < len(units) else ''
        if axis in _AXES and not unit:
            raise unexpected(*part[4], 'the unit of each column')
        labels.append(f'{name} {axis}' + (f' [{unit}]' if unit else ''))
        found[name][axis] = i - 1
    other_turns = False
    for name, columns in found.items():
        places = {_AXES[axis]: i for axis, i in columns.items() if axis in _AXES}
        turned = {_TURNS[axis]: i for axis, i in columns.items() if axis in _TURNS}
        if {*places} != {*'XYZ'}:
            raise unexpected(*part[3], f'X, Y and Z of {name}')
        groups[name] = tuple(places[axis] for axis in 'XYZ')
        if {*turned} == {*'xyzw'}:
            turns[name] = tuple(turned[axis] for axis in 'xyzw')
        other_turns |= 0 < len(turned) < len('xyzw')
    table, at = [], []
    before = -1.0
    for (number, line), row in zip(part[_HEAD_LINES:], rows[_HEAD_LINES:]):
        if not line.strip(' ,;\t'):
            # The next section follows.
            break
        cells = [cell.strip() for cell in row]
        if len(cells) > width and not any(cells[width:]):
            cells = cells[:width]
        if len(cells) != width or not cells[0].isdigit() or not cells[1].isdigit():
            raise unexpected(number, line, f'a frame, a sub frame and {width - 2} more cells')
        time_s = int(cells[0]) / float(rate[0])
        if time_s <= before:
            raise unexpected(number, line, f'a frame after {cells[0]}')
        before = time_s
        table.append((f'{time_s:.6f}', *cells[2:]))
        at.append(number)
    notes = (f'{", ".join(name for name in starts if name != chosen)}: sections left out',) * (
        len(starts) > 1
    )
    if other_turns:
        notes += ('angles left out, as it is not written how they turn: export quaternions',)
    return NamedColumns(
        kind=f'a capture of Vicon ({chosen}), {rate[0].strip()} frames per second',
        instrument='camera',
        names=tuple(labels),
        rows=tuple(table),
        lines=tuple(at),
        decimal=',' if separator != ',' and any(',' in c for r in table[:100] for c in r) else '.',
        groups=groups,
        turns=turns,
        notes=notes,
    )


def _name(text: str) -> str:
    """Name of an object in a header: ``Tool`` of ``Global Angle Tool:Tool``.

    The kind of measurement and the repetition of the name are taken off; ``A:B`` stays.
    """
    text = re.sub(r'^Global Angle (?:\(.*?\) )?', '', text)
    subject, sign, object_name = text.partition(':')
    return object_name if sign and object_name == subject else text
