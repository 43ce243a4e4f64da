"""From tables to rows of joints and points in SI, each with the line it came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import AXES, Columns, Told, find_columns
from remaster_ros.importing.joining import How, join
from remaster_ros.importing.text_table import TextTable, read_table
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.importing.values import (
    angle_unit,
    labels,
    length_unit,
    numbers,
    refuse_far,
    times,
)
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import AngleUnit, FloatArray

_OTHERS = ('pose', 'configuration', 'split', 'sensor', 'marker')


@dataclass(frozen=True)
class TableOptions:
    """What the user said of the tables; '' and () where nothing."""

    separator: str = ''
    decimal: str = ''
    encoding: str = ''
    angles: str = ''
    length: str = ''
    told: Told = field(default_factory=Told)
    join: How = ''
    within_s: float = 1.0


@dataclass(frozen=True, eq=False)
class RawRows:
    """Rows of joints and points in the order measured.

    Attributes
    ----------
    where
        File and line of each row, for messages, n texts.
    joint_columns
        Names of the k joint columns.
    q, from_q, position, std
        rad and m, (n, k) and (n, 3); NaN where unknown.
    stamp_s
        s, (n,); None where there are no times.
    labels
        ``pose``, ``configuration``, ``split``, ``sensor``, ``marker`` -> n texts, where given.
    temperature_c, samples
        (n,); NaN and -1 where unknown.
    columns
        Column -> what it was taken for, for people.
    angle_unit
        In which the table has the joints; None where they are those of the URDF, as in a bag.
    description
        How the files were read and joined, a line each.
    warnings
        A sentence each.
    """

    where: tuple[str, ...]
    joint_columns: tuple[str, ...]
    q: FloatArray
    from_q: FloatArray
    position: FloatArray
    std: FloatArray
    stamp_s: FloatArray | None
    labels: dict[str, list[str]]
    temperature_c: FloatArray
    samples: FloatArray
    columns: dict[str, str]
    description: tuple[str, ...]
    warnings: tuple[str, ...]
    angle_unit: AngleUnit | None = None

    def in_order(self) -> RawRows:
        """Return the rows in the order of their times."""
        if self.stamp_s is None:
            return self
        order = np.argsort(self.stamp_s, kind='stable')
        if np.all(np.diff(order) > 0):
            return self
        picked: dict[str, Any] = {
            name: value[order]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        return replace(
            self,
            **picked,
            where=tuple(self.where[i] for i in order),
            labels={kind: [names[i] for i in order] for kind, names in self.labels.items()},
            warnings=(*self.warnings, 'the rows were put in the order of their times'),
        )


def read_rows(paths: Sequence[Path], chain: SerialChain, options: TableOptions) -> RawRows:
    """Read one table with joints and points, or one with each.

    Raises
    ------
    InputError
        One line naming file, line, column and remedy.
    """
    tables = [
        read_table(path, options.separator, options.decimal, options.encoding) for path in paths
    ]
    found = [(table, find_columns(table, chain.joint_names, options.told)) for table in tables]
    _refuse_untold(found, options.told)
    with_points = [pair for pair in found if pair[1].point]
    with_joints = [pair for pair in found if pair[1].joints]
    points = _only(with_points, tables, 'a measured point (X, Y, Z)', '--points')
    # Where the points' table repeats the joints, those of the other table were meant.
    joints = _only(
        [pair for pair in with_joints if pair is not points] or with_joints,
        tables,
        'the joint angles',
        '--joints',
    )
    if len(joints[1].joints) != len(chain):
        table, columns = joints
        given = [table.names[i] for i in columns.joints]
        raise InputError(
            f'{table.path}: {len(given)} joint columns ({given[0]} … {given[-1]}), and '
            f"{len(chain)} joints between '{chain.base_link}' and '{chain.tip_link}' "
            f'({", ".join(chain.joint_names)}); name the columns with --joints, or other links '
            'with --base-link and --tip-link'
        )
    description = [table.describe() for table in tables]
    warnings: list[str] = []
    rows_p = rows_j = np.arange(len(points[0].rows))
    if joints is not points:
        pairs = join(points, joints, options.join, options.within_s)
        rows_p, rows_j = pairs.points, pairs.joints
        description.append(f'{len(rows_p)} rows joined {pairs.how}')
        warnings += pairs.left_out
    points = points[0].select(rows_p), points[1]
    joints = joints[0].select(rows_j), joints[1]
    return _values(points, joints, chain, options, tuple(description), tuple(warnings))


def _values(
    points: tuple[TextTable, Columns],
    joints: tuple[TextTable, Columns],
    chain: SerialChain,
    options: TableOptions,
    description: tuple[str, ...],
    warnings: tuple[str, ...],
) -> RawRows:
    table, columns = points
    angle, how_angle = angle_unit(*joints, options.angles)
    q = numbers(joints[0], joints[1].joints) * ANGLES[angle]
    raw = numbers(table, columns.point)
    length, how_length = length_unit(
        table, columns, options.length, raw, chain.forward(q)[:, :3, 3]
    )
    refuse_far(table, columns, length)
    n, k = q.shape
    from_q = np.full((n, k), np.nan)
    if len(joints[1].from_joints) == k:
        from_q = numbers(joints[0], joints[1].from_joints, optional=True) * ANGLES[angle]
    std = np.full((n, 3), np.nan)
    if columns.std:
        std = numbers(table, columns.std, optional=True) * LENGTHS[length]
    stamp = None if options.told.time == 'none' else times(*points)
    if stamp is None and options.told.time != 'none' and joints[0] is not table:
        stamp = times(*joints)
    given = {}
    for kind in _OTHERS:
        for one, found in (points, joints):
            names = labels(one, found.one(kind))
            if names is not None and kind not in given:
                given[kind] = names
    meanings: dict[str, str] = {}
    both = [points] if joints[0].path == table.path else [points, joints]
    for one, found in both:
        prefix = f'{one.path.name}: ' if len(both) > 1 else ''
        is_joints, is_points = found is joints[1], found is columns
        for i, name in enumerate(one.names):
            meaning = _meaning(
                i,
                found if is_joints else replace(found, joints=(), from_joints=()),
                chain,
                f'{angle} ({how_angle})',
                f'{length} ({how_length})' if is_points else '',
            )
            meanings[f'{prefix}{name}'] = meaning
    return RawRows(
        where=tuple(f'{table.path}, line {line}' for line in table.lines),
        joint_columns=tuple(joints[0].names[i] for i in joints[1].joints),
        q=q,
        from_q=from_q,
        position=raw * LENGTHS[length],
        std=std,
        stamp_s=stamp,
        labels=given,
        temperature_c=_optional(points, 'temperature'),
        samples=np.nan_to_num(_optional(points, 'samples'), nan=-1.0),
        columns=meanings,
        description=description,
        warnings=warnings,
        angle_unit=cast(AngleUnit, angle),
    )


def _optional(points: tuple[TextTable, Columns], kind: str) -> FloatArray:
    column = points[1].one(kind)
    if column is None:
        return np.full(len(points[0].rows), np.nan)
    return numbers(points[0], (column,), optional=True)[:, 0]


def _meaning(i: int, columns: Columns, chain: SerialChain, angle: str, length: str) -> str:
    """Return what a column was taken for."""
    how = columns.why.get(i, '')
    by_place = ', by its place' if how == 'place' else ', as told' if how == 'told' else ''
    for kind, joints in (('', columns.joints), ('coming from, ', columns.from_joints)):
        if i in joints:
            joint = joints.index(i)
            return f'{kind}joint {joint + 1} ({chain.joint_names[joint]}), {angle}{by_place}'
    if length and i in columns.point:
        return f'{AXES[columns.point.index(i)]} of the marker, {length}{by_place}'
    if length and i in columns.std:
        return f'standard deviation of {AXES[columns.std.index(i)]}, {length}'
    for kind, places in columns.others.items():
        if i in places:
            return f'{kind}{by_place}'
    return 'not used'


def _only(
    found: list[tuple[TextTable, Columns]], tables: Sequence[TextTable], what: str, option: str
) -> tuple[TextTable, Columns]:
    """Return the one table that has something."""
    if len(found) == 1:
        return found[0]
    names = ' and '.join(str(table.path) for table in tables)
    if not found:
        columns = '; '.join(', '.join(table.names) for table in tables)
        raise InputError(
            f'{names}: no columns that could be {what}; the columns are {columns}; name them with '
            f'{option}'
        )
    raise InputError(f'{names}: both have {what}; give one of them, or name columns with {option}')


def _refuse_untold(found: list[tuple[TextTable, Columns]], told: Told) -> None:
    """Refuse columns that were told and are in no table."""
    for option, names, attribute in (
        ('--joints', told.joints, 'joints'),
        ('--points', told.points, 'point'),
    ):
        if names and not any(
            getattr(columns, attribute) and columns.why[getattr(columns, attribute)[0]] == 'told'
            for _, columns in found
        ):
            has = '; '.join(f'{table.path} has {", ".join(table.names)}' for table, _ in found)
            raise InputError(f'{option}: there is no column {names[0]!r}; {has}')
    for option, name in (('--time', told.time), ('--names', told.names)):
        if name not in ('', 'none') and not any('told' in c.why.values() for _, c in found):
            has = '; '.join(f'{table.path} has {", ".join(table.names)}' for table, _ in found)
            raise InputError(f'{option}: there is no column {name!r}; {has}')
