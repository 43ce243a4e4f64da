# SPDX-License-Identifier: Apache-2.0
"""Rows of joint angles and points in SI, from one table or from two that are joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import ColumnChoice, Table
from remaster_ros.importing.makers import kuka
from remaster_ros.importing.paired_tables import PairedTables, raw_rows
from remaster_ros.importing.pulses import in_degrees
from remaster_ros.importing.raw_rows import RawRows
from remaster_ros.importing.standstill_tables import stopped
from remaster_ros.importing.table_choice import assign_columns, points_and_joints, unused_points
from remaster_ros.importing.table_join import JoinCriterion, common_names, join
from remaster_ros.importing.text_table import (
    TABLE_LIMIT,
    TextTable,
    decode,
    is_missing,
    read_tables,
)
from remaster_ros.importing.values import numbers
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.files import read_limited


@dataclass(frozen=True)
class TableOptions:
    """Options of the command that concern the tables; '', () and None if not given."""

    separator: str = ''
    decimal: str = ''
    encoding: str = ''
    angles: str = ''
    length: str = ''
    chosen: ColumnChoice = field(default_factory=ColumnChoice)
    join: JoinCriterion = ''
    within_s: float = 1.0
    clock_offset_s: float | None = None
    pulses_per_degree: tuple[float, ...] = ()  # Base to tip; () if the joints are angles
    sheets: tuple[str, ...] = ()  # Names of workbook sheets; () for all with numbers


def read_rows(
    files: Sequence[Path | TextTable], chain: SerialChain, options: TableOptions
) -> RawRows:
    """Rows in SI of one table with joints and points, or of a table of joints and one of points.

    From files or tables in memory, at most two, which are joined; of streams the means at
    standstills are taken. A .dat and a .src file of one name are one table of a KUKA
    controller.

    Raises
    ------
    InputError
        One line naming file, line, column and remedy: more files, unclear or missing columns,
        another number of joints than the robot's, cells that are no numbers, or rows that
        cannot be joined.
    """
    tables, found = assign_columns(_read_files(files, options), chain, options.chosen)
    points, joints = points_and_joints(tables, found)
    pair = PairedTables(
        points,
        joints,
        description=tuple(table.describe() for table in tables),
        warnings=_notes(tables, points, joints),
    )
    pair = _with_joints_of_robot(pair, chain)
    pair = _with_joints_in_degrees(pair, options)
    pair = pair.noting(warnings=unused_points(found, pair.points[0]))
    paired = _at_standstills(pair, chain, options)
    if paired is None:
        paired = _joined(_without_incomplete_rows(pair), options)
    return raw_rows(paired, chain, options.angles, options.length, options.chosen.time != 'none')


def _read_files(files: Sequence[Path | TextTable], options: TableOptions) -> list[TextTable]:
    """Tables in memory, then those of the files, in this order.

    A KUKA program (.src) puts the points of the data file (.dat) of the same name into the
    order of its moves, and counts as no file of its own. Raises InputError for more than two
    files, or one that cannot be read.
    """
    read_before = [file for file in files if isinstance(file, TextTable)]
    paths = [file for file in files if isinstance(file, Path)]
    programs = {
        data: path
        for path in paths
        for data in paths
        if (path.suffix.lower(), data.suffix.lower()) == ('.src', '.dat')
        and path.stem.lower() == data.stem.lower()
    }
    paths = [path for path in paths if path not in programs.values()]
    if len(paths) + len(read_before) > 2:
        count = len(paths) + len(read_before)
        raise InputError(f'{count} files; give one table, or two that are to be joined')
    tables = [*read_before]
    tables += [
        table
        for path in paths
        for table in read_tables(
            path, options.separator, options.decimal, options.encoding, options.sheets
        )
    ]
    return [
        _in_move_order(table, programs[table.path]) if table.path in programs else table
        for table in tables
    ]


def _in_move_order(data: TextTable, program: Path) -> TextTable:
    """Positions of a KUKA data file (.dat) in the order of the moves of its program (.src).

    A position is repeated as often as the program moves to it, and dropped if it never does.
    Moves to unknown positions are left out, with a note. If no move names a position of the
    file, the rows stay as they are, with a note.
    """
    text, _ = decode(read_limited(program, TABLE_LIMIT, 'name the program'), program, '')
    named = [row[0] for row in data.rows] if data.names[0] == 'name' else []
    order = kuka.moves(text)
    kept = [named.index(name) for name in order if name in named]
    if not kept:
        note = f'{program.name}: its moves name no point of {data.path.name}, whose order is kept'
        return replace(data, notes=(*data.notes, note))
    notes = data.notes
    if stray_names := sorted(set(order).difference(named)):
        notes += (
            f'{program.name}: moves to {", ".join(stray_names)} were left out: no axis positions',
        )
    return replace(data.select(kept), notes=notes)


def _notes(tables: Sequence[TextTable], points: Table, joints: Table) -> tuple[str, ...]:
    """Notes of the tables, and a sentence on each sheet or array that is not used.

    `points`, `joints`: the tables that are used.
    """
    return (
        *(note for table in tables for note in table.notes),
        *(
            f'{table.path} left out: it is neither with the joints nor with the points used'
            for table in tables
            if table.part and table not in (points[0], joints[0])
        ),
    )


def _with_joints_of_robot(pair: PairedTables, chain: SerialChain) -> PairedTables:
    """Tables with as many joint columns as the robot has joints, unused axes left out.

    Raises InputError if the numbers differ.
    """
    joints, idle = _without_unused_axes(pair.joints, len(chain))
    table, columns = joints
    if len(columns.joints) != len(chain):
        given = [table.names[i] for i in columns.joints]
        raise InputError(
            f'{table.path}: {len(given)} joint columns ({given[0]} … {given[-1]}), and '
            f"{len(chain)} joints between '{chain.base_link}' and '{chain.tip_link}' "
            f'({", ".join(chain.joint_names)}); name the columns with --joints, or other links '
            'with --base-link and --tip-link'
        )
    note = f'{table.path}: {", ".join(idle)} left out: 0 in every row'
    return replace(pair, joints=joints).noting(warnings=(note,) * bool(idle))


def _without_unused_axes(joints: Table, count: int) -> tuple[Table, list[str]]:
    """Table of joints without the axes beyond the first `count`, if these are 0 in all rows.

    A controller of seven axes writes 0 for the seventh of an arm with six. Last result: the
    names of the axes left out; [], with the table as it is, if there are none or one is not 0.
    """
    table, columns = joints
    beyond = columns.joints[count:]
    if not beyond or np.any(numbers(table, beyond)):
        return joints, []
    kept = replace(columns, joints=columns.joints[:count])
    return (table, kept), [table.names[i] for i in beyond]


def _with_joints_in_degrees(pair: PairedTables, options: TableOptions) -> PairedTables:
    """Tables with joints converted from motor pulses to degrees, if the user stated the ratios.

    Else as they are. Raises InputError as `in_degrees`.
    """
    joints, how_pulses = in_degrees(pair.joints, options.pulses_per_degree, options.angles)
    points = joints if pair.joints is pair.points else pair.points
    return replace(pair, points=points, joints=joints).noting(filter(None, [how_pulses]))


def _at_standstills(
    pair: PairedTables, chain: SerialChain, options: TableOptions
) -> PairedTables | None:
    """Tables of the means at standstills, if the joints are a stream; None if they are not.

    None also if rows are to be joined instead, unless the user stated a clock offset: if the
    user asked to join by name or time, or not to use times, or if two tables have names in
    common (and the user did not ask to join by order). Raises InputError as `stopped`.
    """
    points, joints = pair.points, pair.joints
    in_order = options.join == 'order'
    chosen = options.join in ('name', 'time') or options.chosen.time == 'none'
    # A clock that was told is that of two streams.
    if options.clock_offset_s is None and (
        chosen or not (in_order or joints is points or not common_names(points, joints))
    ):
        return None
    still = stopped(
        points, joints, chain, options.angles, options.length, options.clock_offset_s, in_order
    )
    if still is None:
        return None
    pair = replace(pair, points=still.points, joints=still.joints, stamp_s=still.stamp_s)
    return pair.noting(still.description, still.warnings)


def _without_incomplete_rows(pair: PairedTables) -> PairedTables:
    """Tables without rows that lack the joints or the point, with sentences on what is left out.

    In files a row lacks them if all cells are missing. In data frames one missing cell is
    enough, except for points of so many markers that they have more columns than there are
    joints. Nothing is left out if all rows lack them.
    """
    points, joints = pair.points, pair.joints
    same = points[0] is joints[0]
    kept, notes = {}, []
    for what, (table, _), places in (
        ('no joints', joints, joints[1].joints),
        ('no point', points, points[1].point),
    ):
        # A file has a damaged point, a frame what its program could not tell: NaN.
        lost = any if table.counted == 'row' and len(places) <= len(joints[1].joints) else all
        known = np.array([not lost(is_missing(row[i]) for i in places) for row in table.rows])
        kept[what] = known
        if not known.all() and known.any():
            notes.append(f'{table.at_rows(np.flatnonzero(~known).tolist())}: {what}, left out')
        if not known.any():
            kept[what] = np.ones(len(table.rows), bool)
    if same:
        both = kept['no joints'] & kept['no point']
        table = points[0].select(np.flatnonzero(both).tolist())
        points, joints = (table, points[1]), (table, joints[1])
    else:
        points, joints = (
            (table.select(np.flatnonzero(kept[what]).tolist()), columns)
            for what, (table, columns) in (('no point', points), ('no joints', joints))
        )
    return replace(pair, points=points, joints=joints).noting(warnings=notes)


def _joined(pair: PairedTables, options: TableOptions) -> PairedTables:
    """Tables whose rows belong together: two tables are joined by name, time or order.

    One table with both is returned as it is. Raises InputError as `join`.
    """
    points, joints = pair.points, pair.joints
    if joints[0] is points[0]:
        return pair
    pairs = join(points, joints, options.join, options.within_s)
    pair = replace(
        pair,
        points=(points[0].select(pairs.points), points[1]),
        joints=(joints[0].select(pairs.joints), joints[1]),
    )
    return pair.noting([f'{len(pairs.points)} rows joined {pairs.criterion}'], pairs.left_out)
