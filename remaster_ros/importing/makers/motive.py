"""OptiTrack Motive's export of a take: rigid bodies and markers, a line a frame.

Above the frames stand a line about the take and one line each for type, name, ID, in newer
versions the parent, the quantity and the axis; they are recognised by words, not by their number.
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence

from remaster_ros.importing.makers.named import Named, unexpected

_UNITS = {
    **dict.fromkeys(('millimeters', 'millimetres', 'mm'), 'mm'),
    **dict.fromkeys(('centimeters', 'centimetres', 'cm'), 'cm'),
    **dict.fromkeys(('meters', 'metres', 'm'), 'm'),
    **dict.fromkeys(('inches', 'in'), 'in'),
}
_START = re.compile(r'\s*"?Format Version"?([,;\t])')
_KIND_NAMES = ('Rigid Body', 'Rigid Body Marker', 'Marker', 'Bone', 'Bone Marker', 'Skeleton')
# A take that was written without its first line.
_HEADLESS = re.compile(
    rf'[ \r\n]*([,;\t])"?(?:Type)?"?\1+"?(?:{"|".join(_KIND_NAMES)})"?(?:\1|\r?\n)', re.ASCII
)
_NUMBER = re.compile(r'[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?', re.ASCII)
_MOST_HEAD_LINES = 12
# A marker that moves by less than this share of what others move is not on the arm.
_STATIC = 0.02
# What a tool carries, the likeliest kind first: the points of a body are of one solution.
_KINDS = ('Rigid Body', 'Marker', 'Rigid Body Marker')


def _likeliness(kind: str) -> int:
    return _KINDS.index(kind) if kind in _KINDS else len(_KINDS)


def read(text: str) -> Named | None:
    """Return the columns of a take; None for anything else."""
    start = _START.match(text) or _HEADLESS.match(text)
    if start is None:
        return None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip(' \t,;')]
    rows = [next(csv.reader([line], delimiter=start[1])) for _, line in lines]
    at = next(
        (i for i, row in enumerate(rows[:_MOST_HEAD_LINES]) if row[0].strip() == 'Frame'), None
    )
    if at is None:
        raise unexpected(*lines[min(len(lines), _MOST_HEAD_LINES) - 1], 'the line Frame, Time, …')
    take, above = {}, rows[: at - 1]
    unit = ''
    if _START.match(text):
        take, above = dict(zip(rows[0][::2], rows[0][1::2])), rows[1 : at - 1]
        unit = _UNITS.get(take.get('Length Units', '').strip().lower(), '')
        if not unit:
            raise unexpected(*lines[0], 'a Length Units such as Millimeters')
    head = {row[1].strip(): row for row in above if len(row) > 1}
    if 'Type' not in head and len(above) > 1 and {*_KIND_NAMES} & {*above[0]}:
        # Some versions leave the words for these lines out.
        head |= {'Type': above[0], 'Name': above[1]}
    axes, quantities = [cell.strip() for cell in rows[at]], rows[at - 1]
    width = len(axes)
    for what, row in (
        ('Type', head.get('Type')),
        ('Name', head.get('Name')),
        ('Position', quantities if 'Position' in quantities else None),
    ):
        if row is None or len(row) != width:
            raise unexpected(*lines[at], f'a line with {width} cells and {what} above this one')
    places: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)
    turns: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)
    for i in range(2, width):
        asset = head['Type'][i].strip(), head['Name'][i].strip()
        of = {'Position': places, 'Rotation': turns}.get(quantities[i].strip())
        if of is not None:
            if axes[i] in of[asset] or axes[i] not in (*'XYZW',):
                raise unexpected(*lines[at], f'X, Y and Z once for {" ".join(asset)}')
            of[asset][axes[i]] = i
    for asset, columns in places.items():
        if {*columns} != {*'XYZ'}:
            raise unexpected(*lines[at], f'X, Y and Z once for {" ".join(asset)}')
    names, used = ['Frame', 'Time [s]'], [0, 1]
    groups, quaternions = {}, {}
    kinds: dict[str, str] = {}
    for (kind, name), columns in places.items():
        likeliest = min((k for k, other in places if other == name), key=_likeliness)
        label = name if kind == likeliest else f'{kind} {name}'
        kinds[label] = kind
        groups[label] = tuple(range(len(used), len(used) + 3))
        names += [f'{label} {axis} [{unit}]' if unit else f'{label} {axis}' for axis in 'XYZ']
        used += [columns[axis] for axis in 'XYZ']
        turned = turns[kind, name]
        if len(turned) == 4:
            quaternions[label] = tuple(range(len(used), len(used) + 4))
            names += [f'{label} q{axis}' for axis in 'xyzw']
            used += [turned[axis] for axis in 'XYZW']
    if not groups:
        raise unexpected(*lines[at], 'X, Y and Z of a body or a marker')
    before = float('-inf')
    for (number, line), row in zip(lines[at + 1 :], rows[at + 1 :]):
        if len(row) != width or not (row[0].isdigit() and _NUMBER.fullmatch(row[1])):
            raise unexpected(number, line, f'a frame, its time and {width - 2} more cells')
        time_s = float(row[1].replace(',', '.'))
        if time_s <= before:
            raise unexpected(number, line, f'a time after {before:g} s')
        before = time_s
    labelled = [label for label in groups if not label.startswith('Unlabeled')]
    chosen = next(
        (found for kind in _KINDS if (found := [n for n in labelled if kinds[n] == kind])), ()
    )
    frames = rows[at + 1 :]
    commas = start[1] != ',' and any(',' in cell for row in frames[:100] for cell in row)
    table = [tuple(row[i].strip() for i in used) for row in frames]
    notes: tuple[str, ...] = ()
    if not labelled and (one := _one_of(groups, table)):
        # Whoever loses sight of a marker without a label sees another one afterwards.
        where = groups[one[0]]
        for i, cells in enumerate(table):
            seen = next((groups[label] for label in one if cells[groups[label][0]]), where)
            moved = dict(zip(where, seen, strict=True))
            table[i] = tuple(cells[moved.get(c, c)] for c in range(len(cells)))
        chosen = [one[0], *(label for label in groups if label not in one)]
        notes = (f'{len(one)} markers without a label, of which never two are seen, are one',)
    version = (
        f'format {take.get("Format Version", "?").strip()}' if take else 'without its first line'
    )
    return Named(
        kind=f'a take of Motive ({version}){", " if unit else ""}{unit}',
        names=tuple(names),
        notes=notes,
        rows=tuple(table),
        lines=tuple(number for number, _ in lines[at + 1 :]),
        decimal=',' if commas else '.',
        groups=groups,
        turns=quaternions,
        points=tuple(chosen),
    )


def _one_of(groups: Mapping[str, tuple[int, ...]], table: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the markers that move, where each frame has one of them at most; else []."""
    seen = {
        label: [i for i, row in enumerate(table) if row[places[0]]]
        for label, places in groups.items()
    }
    # What stays in its place is not on the arm.
    extents = {label: _extent(table, groups[label], rows) for label, rows in seen.items() if rows}
    moving = [label for label, size in extents.items() if size > _STATIC * max(extents.values())]
    frames = [i for label in moving for i in seen[label]]
    return moving if len(moving) > 1 and len({*frames}) == len(frames) else []


def _extent(table: Sequence[tuple[str, ...]], places: Sequence[int], rows: Sequence[int]) -> float:
    """Return the longest side of the box around a marker, in the unit of the take."""
    sides = [[float(table[i][place].replace(',', '.')) for i in rows] for place in places]
    return max(max(side) - min(side) for side in sides)
