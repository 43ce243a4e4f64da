# SPDX-License-Identifier: Apache-2.0
"""Choice of the table of points and the table of joints among the tables that were read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.column_search import find_columns
from remaster_ros.importing.columns import ColumnChoice, Table
from remaster_ros.importing.pose_matrices import with_poses
from remaster_ros.importing.text_table import MOST_COLUMNS, TextTable
from remaster_ros.kinematics.serial_chain import SerialChain


def assign_columns(
    tables: list[TextTable], chain: SerialChain, chosen: ColumnChoice
) -> tuple[list[TextTable], list[Table]]:
    """Tables, with points in place of 4×4 matrices, and those whose columns have a meaning.

    The second result has each table with its columns. If all are sheets or arrays, and just
    one has joints and points, it is that one alone. Raises InputError for columns that are
    unclear, or chosen and absent.
    """
    if not (chosen.joints or chosen.points):
        # Column numbers that the user gave count the columns of the file as it is.
        tables = [table if table.has_header else with_poses(table) for table in tables]
    found = _with_columns(tables, chain, chosen)
    if not any(columns.points for _, columns in found) and not chosen.points:
        tables = [with_poses(table) for table in tables]
        found = _with_columns(tables, chain, chosen)
    _refuse_absent_columns(found, chosen)
    complete_tables = [pair for pair in found if pair[1].points and pair[1].joints]
    if len(complete_tables) == 1 and all(table.part for table, _ in found):
        # Beside it a workbook has sums, and an archive other arrays.
        found = complete_tables
    return tables, found


def points_and_joints(tables: Sequence[TextTable], found: list[Table]) -> tuple[Table, Table]:
    """The table of the measured points and that of the joint angles, which may be the same.

    `tables`: all, for messages; `found`: as of `assign_columns`. Raises InputError if there is
    none, or if several could be meant.
    """
    with_points = _prefer_chosen([pair for pair in found if pair[1].points], 'points')
    with_joints = _prefer_chosen([pair for pair in found if pair[1].joints], 'joints')
    # A log of joints may have where the robot believes its tool to be.
    point_tables = [pair for pair in with_points if not pair[1].joints]
    points = _single_table(
        point_tables if len(point_tables) == 1 else with_points,
        tables,
        'a measured point (X, Y, Z)',
        '--points',
    )
    # Where the points' table repeats the joints, those of the other table were meant.
    joints = _single_table(
        [pair for pair in with_joints if pair is not points] or with_joints,
        tables,
        'the joint angles',
        '--joints',
    )
    return points, joints


def unused_points(found: list[Table], used: TextTable) -> list[str]:
    """Sentences on the points of tables other than `used`, which has the points that are used.

    If the user chose columns of points in some of the tables `found`, only on those tables.
    """
    return [
        f'{table.path}: {", ".join(table.names[i] for i in columns.point)} left out, the points '
        f'are in {used.path}'
        for table, columns in _prefer_chosen([pair for pair in found if pair[1].points], 'points')
        if table.path != used.path
    ]


def _with_columns(
    tables: list[TextTable], chain: SerialChain, chosen: ColumnChoice
) -> list[Table]:
    """Tables with the meaning of their columns; unclear sheets and arrays are left out.

    Raises InputError for an unclear table that is no sheet or array, or if no table that is
    left has points or joints.
    """
    sliding = np.flatnonzero(chain.slides).tolist()
    found, problems = [], []
    for table in tables:
        of_table = _choice_for_table(chosen, table, tables)
        try:
            found.append((table, find_columns(table, chain.joint_names, of_table, sliding)))
        except InputError as error:
            # A workbook has sheets for other things.
            if not table.part:
                raise
            problems.append(error)
    if problems and not any(c.points or c.joints for _, c in found):
        raise problems[0]
    return found


def _choice_for_table(
    chosen: ColumnChoice, table: TextTable, tables: Sequence[TextTable]
) -> ColumnChoice:
    """Chosen columns that concern one table, as `_choice_for_file`.

    If some of `tables` have column names and some have none, column numbers are left out for a
    table with names.
    """
    of_table = _choice_for_file(chosen, table.path, [text_table.path for text_table in tables])
    if not table.has_header or all(text_table.has_header for text_table in tables):
        return of_table
    points, joints = (
        () if names and all(map(str.isdigit, names)) else names
        for names in (of_table.points, of_table.joints)
    )
    return replace(of_table, points=points, joints=joints)


def _choice_for_file(chosen: ColumnChoice, path: Path, paths: Sequence[Path]) -> ColumnChoice:
    """Chosen columns that concern one file: `joints.txt:1-6` is for that file alone.

    Columns without a file's name concern every file. Ranges are expanded to their numbers.
    `paths`: all files.
    """
    of_file: dict[str, tuple[str, ...]] = {}
    for kind, names in (('joints', chosen.joints), ('points', chosen.points)):
        for other in paths:
            for name in (str(other), other.name):
                if names and names[0].startswith(f'{name}:'):
                    names_of_file = (names[0][len(name) + 1 :], *names[1:])
                    names = names_of_file if other == path else ()
        of_file[kind] = tuple(column for name in names for column in _expanded_range(name))
    return replace(chosen, joints=of_file['joints'], points=of_file['points'])


def _expanded_range(name: str) -> list[str]:
    """Column numbers of a range such as `1-6`; the name itself if it is no range.

    A falling range, or one beyond 5000 columns, is none.
    """
    ends = re.fullmatch(r'(\d+)-(\d+)', name)
    if ends is None or not int(ends[1]) <= int(ends[2]) <= MOST_COLUMNS:
        return [name]
    return [str(i) for i in range(int(ends[1]), int(ends[2]) + 1)]


def _refuse_absent_columns(found: list[Table], chosen: ColumnChoice) -> None:
    """Raise InputError if columns that the user chose were found in none of the tables `found`.

    ``none`` for times or names means no column, and is accepted.
    """
    for option, names, attribute in (
        ('--joints', chosen.joints, 'joints'),
        ('--points', chosen.points, 'point'),
    ):
        if names and not any(
            getattr(columns, attribute)
            and columns.origin[getattr(columns, attribute)[0]] == 'told'
            for _, columns in found
        ):
            has = '; '.join(f'{table.path} has {", ".join(table.names)}' for table, _ in found)
            known = {name.casefold() for table, _ in found for name in table.names}
            absent = next((name for name in names if name.casefold() not in known), names[0])
            raise InputError(f'{option}: there is no column {absent!r}; {has}')
    for option, name in (('--time', chosen.time), ('--names', chosen.names)):
        if name not in ('', 'none') and not any('told' in c.origin.values() for _, c in found):
            has = '; '.join(f'{table.path} has {", ".join(table.names)}' for table, _ in found)
            raise InputError(f'{option}: there is no column {name!r}; {has}')


def _prefer_chosen(found: list[Table], kind: str) -> list[Table]:
    """Tables in which the user chose columns of a kind; all tables if none were chosen.

    `kind`: ``joints``, or anything else for points.
    """
    chosen = [
        pair
        for pair in found
        if 'told'
        in (pair[1].origin.get(i) for i in (pair[1].joints if kind == 'joints' else pair[1].point))
    ]
    return chosen or found


def _single_table(
    found: list[Table], tables: Sequence[TextTable], what: str, option: str
) -> Table:
    """The only table of a list. Raises InputError if the list has none or several.

    `what`, `option`: what is looked for and the option that names it, for the message.
    """
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
