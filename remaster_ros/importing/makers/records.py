# SPDX-License-Identifier: Apache-2.0
"""Nested data (JSON, YAML) as named columns: a row for each record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import NUMBER, NamedColumns, unexpected
from remaster_ros.importing.rigid_numbers import COUNT, rigid
from remaster_ros.kinematics.transforms import quaternion_xyzw

_FEWEST_RECORDS = 2
# A record of an arm has fewer numbers; a longer one is a cloud of points or an image.
_MOST_CELLS = 500
_DEEPEST = 20
# Keys of a list of joint names, in a message or once in a file.
_JOINT_NAMES = ('name', 'names', 'joint_names', 'jointNames', 'joints')
_OF_A_POSE = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
_EMPTY = ('null', '~', 'none', 'nan', '.nan')
_SECONDS = (('sec', 'nanosec'), ('secs', 'nsecs'), ('sec', 'nsec'), ('s', 'ns'))


class Mapping(dict[str, Any]):
    """JSON object or YAML mapping, with the line on which it begins."""

    line = 0


class Items(list[Any]):
    """JSON array or YAML sequence, with the line on which it begins."""

    line = 0


Record = tuple[int, dict[str, str]]


def read(kind: str, data: Any) -> NamedColumns | None:
    """Records in nested data (JSON, YAML) as rows of named columns; None if there are none.

    `kind`: of the file, for messages; `data`: Mapping, Items or scalars as text. None also for
    fewer than two records, or records of one cell or more than 500. Raises InputError, with
    the line, if a record has other keys than most.
    """
    found, names, dropped_keys = _records(data, ())
    if len(found) < _FEWEST_RECORDS:
        return None
    rows = [(line, dict(_cells('', record, names, 0, line))) for line, record in found]
    usual = Counter(tuple(cells) for _, cells in rows).most_common(1)[0][0]
    if len(usual) < _FEWEST_RECORDS or len(usual) > _MOST_CELLS:
        return None
    known = {*usual}
    expected = f'{", ".join(usual[:6])}{", …" * (len(usual) > 6)}'
    for line, cells in rows:
        # A place that is null has no x, y and z.
        for key in [key for key, text in cells.items() if not text and key not in known]:
            del cells[key]
            cells.update((component, '') for component in usual if component.startswith(f'{key} '))
        if other := next((key for key in cells if key not in known), ''):
            raise unexpected(line, other, expected)
        if absent := next((key for key in usual if key not in cells), ''):
            given = ', '.join([*cells][:6])
            raise unexpected(line, given, f'{absent} as well, null where it was not measured,')
    single = all(key.isdigit() for key in usual)
    return NamedColumns(
        kind=kind,
        names=tuple(key or '1' for key in usual),
        rows=tuple(tuple(cells.get(key, '') for key in usual) for _, cells in rows),
        lines=tuple(line for line, _ in rows),
        has_header=not single,
        notes=(f'{", ".join(dropped_keys[:5])} left out: not of each record',)
        * bool(dropped_keys),
    )


def _records(
    data: Any, names: Sequence[str]
) -> tuple[list[tuple[int, Any]], Sequence[str], list[str]]:
    """Records in nested data, each with its line, then names of joints, and keys left out.

    `names`: of joints, if known from above. The records are [] if there are none; a list of
    joint names in the data replaces `names`.
    """
    if isinstance(data, Items):
        if _are_records(data):
            return [(item.line or data.line, item) for item in data], names, []
        deeper = [item for item in data if isinstance(item, (Items, Mapping))]
        return _records(deeper[0], names) if len(deeper) == 1 else ([], names, [])
    if not isinstance(data, Mapping):
        return [], names, []
    if isinstance(data.get('columns'), Items) and isinstance(data.get('data'), Items):
        # As pandas writes a frame that is split.
        header = [str(item) for item in data['columns']]
        named = Items(_named(header, row) for row in data['data'] if isinstance(row, Items))
        return [(item.line, item) for item in named], names, []
    for key in _JOINT_NAMES:
        joint_names = data.get(key)
        if (
            isinstance(joint_names, Items)
            and joint_names
            and all(_is_name(item) for item in joint_names)
        ):
            names = [str(item) for item in joint_names]
            break
    else:
        key = ''
    mappings = data and all(isinstance(item, Mapping) for item in data.values())
    if mappings and (found := _records_by_key(data)):
        return found, names, []
    columns = {
        name: value
        for name, value in data.items()
        if name != key and isinstance(value, Items) and len(value) >= _FEWEST_RECORDS
    }
    if columns:
        # Of the most alike, those with most in them.
        count = Counter(len(value) for value in columns.values())
        size = max(count, key=lambda n: (count[n] > 1, _weight(columns, n), n))
        chosen = {name: value for name, value in columns.items() if len(value) == size}
        dropped_keys = [name for name in data if name not in chosen and name != key]
        if (
            len(chosen) == 1
            and _are_records(only := next(iter(chosen.values())))
            and all(isinstance(item, Mapping) for item in only)
        ):
            return [(item.line, item) for item in only], names, dropped_keys
        rows = [Mapping(zip(chosen, values)) for values in zip(*chosen.values())]
        for i, row in enumerate(rows):
            lines = [getattr(value[i], 'line', 0) for value in chosen.values()]
            row.line = max(lines) or next(iter(chosen.values())).line
        return [(row.line, row) for row in rows], names, dropped_keys
    deeper = [value for value in data.values() if isinstance(value, Mapping)]
    return _records(deeper[0], names) if len(deeper) == 1 else ([], names, [])


def _weight(columns: dict[str, Items], size: int) -> int:
    """Number of cells in a record of one item from each list in `columns` with `size` items.

    An item that is a list or mapping counts with its length (that of the first one), another
    as 1.
    """
    return sum(
        len(value[0]) if isinstance(value[0], (Items, Mapping)) else 1
        for value in columns.values()
        if len(value) == size
    )


def _are_records(data: Items) -> bool:
    """Whether a list holds at least two records, all of them mappings or all lists."""
    kinds = {type(item) for item in data}
    return len(data) >= _FEWEST_RECORDS and kinds in ({Mapping}, {Items})


def _named(header: Sequence[str], row: Items) -> Mapping:
    """Record of a row with the names of a header; raises InputError if their numbers differ."""
    if len(row) != len(header):
        raise unexpected(row.line, str([*row]), f'{len(header)} values')
    found = Mapping(zip(header, row))
    found.line = row.line
    return found


def _records_by_key(data: Mapping) -> list[tuple[int, Any]]:
    """Records, each with its line, of a mapping whose values are mappings with equal keys.

    These are a data frame by column (column -> row number -> cell), or one by row, or records
    by name: of the latter two the outer key becomes the record's ``name``. [] if the keys
    differ, or are those of points (x, y, z).
    """
    inner = [tuple(mapping) for mapping in data.values()]
    if len({*inner}) != 1 or any(
        isinstance(cell, (Items, Mapping))
        for mapping in data.values()
        for cell in mapping.values()
    ):
        # Of records that have names.
        shapes = {frozenset(mapping) for mapping in data.values()}
        if len(data) < _FEWEST_RECORDS or len(shapes) != 1 or {*shapes.pop()} <= {*'xyzw'}:
            return []
        return [(mapping.line, _with_name(key, mapping)) for key, mapping in data.items()]
    if {*inner[0]} <= {*'xyzw'}:
        return []
    if all(key.isdigit() for key in inner[0]):
        return [
            (data.line, Mapping({key: mapping[row] for key, mapping in data.items()}))
            for row in inner[0]
        ]
    return [(mapping.line, _with_name(key, mapping)) for key, mapping in data.items()]


def _with_name(key: str, record: Mapping) -> Mapping:
    """Record with its key first, as ``name``; a name of its own stays."""
    found = Mapping({'name': key, **record})
    found.line = record.line
    return found


def _cells(
    name: str, value: Any, names: Sequence[str], depth: int, line: int
) -> Iterator[tuple[str, str]]:
    """Yield column name and text of each scalar in `value`, a record or a part of one.

    The name is that of the record's part (`name`, '' for the record) and the keys below it,
    separated by blanks. Numbers of a list are named by `names` (of joints) if equally many, by
    x, y, z if they are three, else from 1; 4×4 matrices become point and quaternion. `depth`:
    levels above `value`; raises InputError, with `line`, if they are over 20.
    """
    if depth > _DEEPEST:
        raise InputError(f'line {line}: more than {_DEEPEST} levels of brackets')
    if isinstance(value, Mapping):
        yield from _of_mapping(name, value, names, depth, line)
    elif isinstance(value, Items):
        flat = [*_flat(value)]
        if len(flat) == COUNT and (pose := _pose(flat)):
            for label, number in zip(_OF_A_POSE, pose):
                yield f'{name} {label}'.strip(), repr(number)
            return
        if not all(_is_scalar_number(item) for item in flat):
            # Names and the like that a record has itself.
            for i, item in enumerate(value, 1):
                yield from _cells(f'{name} {i}'.strip(), item, names, depth + 1, line)
            return
        if len(names) == len(flat) and len(flat) != len('xyz'):
            labels: Sequence[Any] = names
        else:
            labels = 'xyz' if len(flat) == len('xyz') else range(1, len(flat) + 1)
        for label, item in zip(labels, flat):
            yield f'{name} {label}'.strip(), _text(item)
    else:
        yield name, _text(value)


def _of_mapping(
    name: str, value: Mapping, names: Sequence[str], depth: int, line: int
) -> Iterator[tuple[str, str]]:
    """Yield column and text of each scalar of a mapping; arguments as of `_cells`.

    A list of joint names in it labels the lists of numbers, in place of `names`. Seconds and
    nanoseconds become one number, in a column ending in ``[s]``.
    """
    for seconds, part in _SECONDS:
        if {*value} == {seconds, part} and all(str(item).isdigit() for item in value.values()):
            yield f'{name} [s]', f'{value[seconds]}.{value[part]:0>9}'
            return
    keyed = next(
        (
            key
            for key in _JOINT_NAMES
            if isinstance(value.get(key), Items)
            and value[key]
            and all(_is_name(item) for item in value[key])
        ),
        '',
    )
    joint_names = [str(item) for item in value[keyed]] if keyed else names
    for key, item in value.items():
        if key != keyed:
            yield from _cells(f'{name} {key}'.strip(), item, joint_names, depth + 1, line)


def _pose(cells: Sequence[Any]) -> list[float]:
    """Position and quaternion x, y, z, w of the sixteen numbers of a 4×4 matrix.

    [] if they are not all numbers, or no rigid motion.
    """
    if not all(NUMBER.fullmatch(str(cell)) for cell in cells):
        return []
    T = rigid(np.array(cells, float))
    return [] if T is None else [*map(float, (*T[0, :3, 3], *quaternion_xyzw(T[0, :3, :3])))]


def _flat(value: Items) -> Iterator[Any]:
    """Yield the scalars of nested lists."""
    for item in value:
        if isinstance(item, Items):
            yield from _flat(item)
        else:
            yield item


def _is_scalar_number(value: Any) -> bool:
    """Whether a value is a number or an empty entry such as null, and no list or object."""
    return not isinstance(value, (Items, Mapping)) and (
        str(value).lower() in _EMPTY or bool(NUMBER.fullmatch(str(value)))
    )


def _is_name(value: Any) -> bool:
    """Whether a value is neither a list, nor a mapping, nor the text of a number."""
    return not isinstance(value, (Items, Mapping)) and not NUMBER.fullmatch(str(value))


def _text(value: Any) -> str:
    """Value as text with single blanks; '' for null, none, nan or ~, in any case."""
    text = ' '.join(str(value).split())
    return '' if text.lower() in _EMPTY else text
