# SPDX-License-Identifier: Apache-2.0
"""Rows of joint angles and points in SI, from one table or from two that are joined."""

from __future__ import annotations

import itertools
import re
import string
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import AXES, ColumnChoice, Columns, Table, find_columns
from remaster_ros.importing.makers import kuka
from remaster_ros.importing.makers.named import first_names
from remaster_ros.importing.pose_matrices import with_poses
from remaster_ros.importing.pulses import in_degrees
from remaster_ros.importing.standstills import stopped
from remaster_ros.importing.text_table import (
    MOST_COLUMNS,
    TABLE_LIMIT,
    TextTable,
    decode,
    is_missing,
    read_tables,
)
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.importing.values import (
    DAY_S,
    WITHOUT_DATE_S,
    joint_values,
    length_unit,
    numbers,
    refuse_far,
    times,
)
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse_poses
from remaster_ros.session.files import read_limited
from remaster_ros.session.records.observations import LENGTH_TOLERANCE
from remaster_ros.types import AngleUnit, BoolArray, FloatArray, IntArray, SensorKind

# Criterion by which rows of joints and rows of points are paired; '' for the first that works.
JoinCriterion = Literal['', 'name', 'time', 'order']
# A joint that turns by more between the reports before and after a point was moving, in the
# units of the table: degrees; in radians a thousandth.
_STILL_DEG = 0.05
# Separators between the parts of a name: SpatialAnalyzer's collection::group::point, and paths.
_PATH = re.compile(r'::|[/\\|]')
# Levels of `_comparison_keys`. From the first on, at least `_FEWEST_NAMES` names have to match.
# One table has at most `_MOST_TIMES` as many names as the other.
_DISTINCT_PART, _LAST_WORD, _FEWEST_NAMES, _MOST_TIMES = 3, 4, 4, 3
_WORDS = re.compile(r'[\s_.-]+')
# A number with a decimal sign is measured, no name.
_MEASURED = re.compile(r'[+-]?\d*[.,]\d+(?:[eE][+-]?\d+)?')
_BRACKETS = re.compile(r'[\[\](){}_\s-]')


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of rows of a table of points and a table of joints."""

    # Row indices in the two tables, (n,) each.
    points: IntArray
    joints: IntArray
    # Criterion of the pairing in words, such as "by time".
    criterion: str
    # Rows that were left out, with the reason, a sentence each.
    left_out: tuple[str, ...] = ()


def join(
    points: Table,
    joints: Table,
    how: JoinCriterion = '',
    within_s: float = 1.0,
) -> Pairs:
    """Pair the rows of two tables by name, time or order, or by the first of these that works.

    By order unasked only for data frames whose rows were counted alike. `within_s`: largest
    difference of times, s. Raises InputError if nothing pairs them, a name is twice, no times are
    near, every point was measured in motion, or the numbers of rows differ for ``order``.
    """
    if how in ('', 'name'):
        pairs = _pairs_by_name(points, joints, by_header=how == '')
        if pairs is not None:
            return pairs
    if how in ('', 'time'):
        pairs = _pairs_by_time(points, joints, within_s)
        if pairs is None and not how:
            pairs = _pairs_by_name(points, joints, by_header=False)
        if pairs is not None:
            return pairs
    a, b = points[0], joints[0]
    if how in ('', 'order') and a.rows_in_order and a.rows_in_order == b.rows_in_order:
        # Also where rows of either were left out.
        _, rows, of = np.intersect1d(a.lines, b.lines, return_indices=True)
        return Pairs(rows, of, 'by the order of their rows')
    if how == 'order':
        if len(a.rows) != len(b.rows):
            raise InputError(
                f'{a.path} has {len(a.rows)} rows, {b.path} {len(b.rows)}; only equally many can '
                'be joined by their order: remove what the other has not (such as a home position)'
            )
        rows = np.arange(len(a.rows))
        return Pairs(rows, rows, 'by the order of their rows')
    what = {'': 'neither names nor times', 'name': 'no names', 'time': 'no times'}[how]
    same = len(a.rows) == len(b.rows)
    remedy = (
        f'both have {len(a.rows)} rows: if each belongs to the one in the same place, say --join '
        'order'
        if same
        else 'give both a column with the name of the point'
    )
    raise InputError(f'{a.path} and {b.path} have {what} in common; {remedy}')


def common_names(
    points: Table, joints: Table, by_header: bool = True
) -> tuple[int, int, list[str], list[str]] | None:
    """The pair of columns whose names match in most rows, and the names in comparable form.

    Result: index in points, in joints (from 0), names in points, in joints. Names are compared at
    rising levels until some match: `P01`, `p1` and `P1 ` are equal; then the last parts
    (`A::KR6::P1` and `P1`), then names without brackets and underscores (`P[1]`), then without the
    beginning and end that all names of a table share (`KR6_P1` and `Pose 1`), then the last words
    (`KR6_P1` and `P1`). At the last two levels one table must contain all names of the other, at
    least four. If not `by_header`, any unused column may hold the names. None if no level matches.
    """
    named = [(i, j) for i in points[1].others['name'] for j in joints[1].others['name']]
    for level in range(_LAST_WORD + 1):
        found = _best_name_columns(points, joints, level, named, level < _DISTINCT_PART)
        if found is not None:
            return found
    if by_header:
        return None
    pairs = [
        (i, j) for i in _possible_name_columns(*points) for j in _possible_name_columns(*joints)
    ]
    for level in range(_LAST_WORD + 1):
        found = _best_name_columns(points, joints, level, pairs, False)
        if found is not None:
            return found
    return None


def _possible_name_columns(table: TextTable, columns: Columns) -> list[int]:
    """Indices of columns that may be names: of no other use, no two rows alike.

    None of the cells is empty or a number with a decimal sign.
    """
    used = {*columns.joints, *columns.from_joints, *columns.point}
    used |= {
        i
        for kind, kind_columns in columns.others.items()
        if kind not in ('name', 'pose')
        for i in kind_columns
    }
    return [
        i
        for i in range(len(table.names))
        if i not in used
        and all(row[i] and not _MEASURED.fullmatch(row[i]) for row in table.rows)
        and len({row[i] for row in table.rows}) == len(table.rows)
    ]


def _best_name_columns(
    points: Table, joints: Table, level: int, columns: Iterable[tuple[int, int]], sure: bool
) -> tuple[int, int, list[str], list[str]] | None:
    """The pair of columns with most names in common at one level of `_comparison_keys`.

    As in `common_names`; `columns`: the pairs to compare. If not `sure` (the header does not call
    them names), one table must contain all names of the other, at least four. None if no pair
    matches.
    """
    best: tuple[int, int, int, list[str], list[str]] | None = None
    for i, j in columns:
        a, b = _comparison_keys(points[0], i, level), _comparison_keys(joints[0], j, level)
        common = len(set(a) & set(b))
        fewer, more = sorted((len(set(a)), len(set(b))))
        # A log counts all of its rows: such numbers are no names of points.
        if more > _MOST_TIMES * fewer and (not sure or ''.join((*a, *b)).isdigit()):
            continue
        if not sure and not common == fewer >= _FEWEST_NAMES:
            continue
        if common and (best is None or common > best[0]):
            best = common, i, j, a, b
    return best and best[1:]


def _pairs_by_name(points: Table, joints: Table, *, by_header: bool) -> Pairs | None:
    """Pairs of rows with equal names; None if the tables share none.

    Rows whose name is not in the other table are left out, with a sentence. Raises InputError if a
    common name is twice, in points only if these have neither sensors nor markers.
    """
    best = common_names(points, joints, by_header)
    if best is None:
        return None
    i, j, a, b = best
    has_several_readings = (
        points[1].first_of_kind('sensor') is not None
        or points[1].first_of_kind('marker') is not None
    )
    for keys, (table, _), column in ((a, points, i), (b, joints, j)):
        count = Counter(keys)
        repeated = [
            row for row, key in enumerate(keys) if count[key] > 1 and key in set(a) & set(b)
        ]
        if repeated and not (has_several_readings and table is points[0]):
            raise table.fault(
                repeated[1],
                column,
                f'is also on {table.counted} {table.lines[repeated[0]]}; keep one, or say --join '
                'order',
            )
    at = {key: row for row, key in enumerate(b)}
    rows = np.array([row for row, key in enumerate(a) if key in at], dtype=np.int64)
    left_out = []
    for (table, _), column, keys, other in ((points, i, a, set(b)), (joints, j, b, set(a))):
        unmatched = [table.rows[row][column] for row, key in enumerate(keys) if key not in other]
        if unmatched:
            left_out.append(
                f'{table.path}: {first_names(unmatched)}: not in the other table, left out'
            )
    return Pairs(
        rows,
        np.array([at[a[row]] for row in rows], dtype=np.int64),
        f'by {points[0].names[i]} and {joints[0].names[j]}',
        tuple(left_out),
    )


def _comparison_keys(table: TextTable, column: int, level: int) -> list[str]:
    """Names of a column in the form in which they are compared at a level.

    0: whole; 1: last part of a path; 2: without brackets; 3: without the beginning and end that
    all names share; 4: last word. All lower case, numbers without leading zeros.
    """
    names = [row[column] for row in table.rows]
    if level > 0:
        names = [_PATH.split(name.strip())[-1] for name in names]
    if level == _LAST_WORD:
        names = [_WORDS.split(name.strip())[-1] for name in names]
    elif level == _DISTINCT_PART:
        begin = _common_prefix_length([name.casefold() for name in names])
        end = _common_prefix_length([name[begin:][::-1].casefold() for name in names])
        names = [name[begin : len(name) - end] for name in names]
    elif level > 1:
        names = [_BRACKETS.sub('', name) for name in names]
    return [
        re.sub(r'\d+', lambda digits: str(int(digits[0])), name.strip().casefold())
        for name in names
    ]


def _common_prefix_length(names: Sequence[str]) -> int:
    """Number of letters with which all names begin, digits at its end not counted."""
    first, last = min(names), max(names)
    same = itertools.takewhile(lambda pair: pair[0] == pair[1], zip(first, last))
    return len(''.join(letter for letter, _ in same).rstrip(string.digits))


def _pairs_by_time(points: Table, joints: Table, within_s: float) -> Pairs | None:
    """Pairs of each point with the joints reported nearest in time, `within_s` at most.

    None if a table has no times. Times of day without a date are moved by whole days. A point
    between two reports that differ by over 0.05 degrees in a joint was measured in motion and is
    left out. Raises InputError if no point is near, all were in motion, or rows of joints share a
    time.
    """
    when, reported = times(*points), times(*joints)
    if when is None or reported is None:
        return None
    order = np.argsort(reported, kind='stable')
    reported = reported[order]
    days = np.round((np.median(reported) - np.median(when)) / DAY_S)
    if days and any(np.all(np.abs(t - WITHOUT_DATE_S) < 2.0 * DAY_S) for t in (when, reported)):
        # One of the two tables has times of day without dates.
        when = when + days * DAY_S
    after = np.searchsorted(reported, when)
    before = np.clip(after - 1, 0, len(reported) - 1)
    after = np.clip(after, 0, len(reported) - 1)
    nearer = np.where(
        np.abs(reported[after] - when) < np.abs(reported[before] - when), after, before
    )
    has_report = np.abs(reported[nearer] - when) <= within_s
    table = points[0]
    if not has_report.any():
        raise InputError(
            f'{table.path}: its times ({_span(when)}) are not those of {joints[0].path} '
            f'({_span(reported)}); set the clocks equal, or join by name or by order (--join)'
        )
    # Where both neighbours are near, the joints are a stream: it tells whether the arm moved.
    q = numbers(joints[0], joints[1].joints)
    _refuse_equal_times(joints, reported, order, q, nearer[has_report])
    still = _STILL_DEG if np.abs(q).max(initial=0.0) > 2.1 * np.pi else np.deg2rad(_STILL_DEG)
    stream = has_report & (np.abs(reported[before] - when) <= within_s)
    stream &= np.abs(reported[after] - when) <= within_s
    moved = stream & (np.abs(q[order[before]] - q[order[after]]).max(axis=1) > still)
    kept = has_report & ~moved
    left_out = []
    for why, rows in (
        (f'no joints within {within_s:g} s', np.flatnonzero(~has_report)),
        ('measured while the arm moved', np.flatnonzero(moved)),
    ):
        if len(rows):
            left_out.append(f'{table.at_rows(rows.tolist())}: {why}, left out')
    if not kept.any():
        raise InputError(f'{table.path}: every point was measured while the arm moved')
    return Pairs(np.flatnonzero(kept), order[nearer[kept]], 'by time', tuple(left_out))


def _span(times_s: FloatArray) -> str:
    """First and last time as text: local dates, or seconds if the times have no date."""
    ends = times_s.min(), times_s.max()
    if ends[0] < WITHOUT_DATE_S:
        return f'{ends[0]:.1f} to {ends[1]:.1f} s'
    return ' to '.join(datetime.fromtimestamp(end).isoformat(' ', 'seconds') for end in ends)


def _refuse_equal_times(
    joints: Table, reported: FloatArray, order: IntArray, q: FloatArray, used: IntArray
) -> None:
    """Raise InputError if a row of joints that a point needs has the time of another row.

    ``reported``: times of the joints, s, rising; ``order``: their row in the table; ``used``:
    indices into ``reported`` of the rows that are needed.
    """
    table, columns = joints
    for at in np.unique(used):
        for other in (at - 1, at + 1):
            if not 0 <= other < len(reported) or reported[other] != reported[at]:
                continue
            earlier, later = sorted((order[at], order[other]))
            if np.any(q[earlier] != q[later]):
                column = next(
                    c for kind in ('time', 'clock', 'date') for c in columns.others[kind]
                )
                raise table.fault(
                    int(later),
                    column,
                    f'is the time of {table.counted} {table.lines[earlier]} as well, and the '
                    'joints are others; give times with seconds, or say --join order',
                )


# A marker whose extent is less than this share of the largest one is not on the arm. A marker on
# the first link would move so little only within a fiftieth of the arm's reach from its axis.
STATIC = 0.02
# With fewer configurations two equal times may be a coincidence.
_FEWEST_ALIKE = 4
_OTHERS = ('pose', 'configuration', 'split', 'sensor', 'marker')


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


@dataclass(frozen=True, eq=False)
class RawRows:
    """Rows of joint angles and points in SI, in the order measured."""

    source: tuple[str, ...]  # File and line of each row, for messages, n texts
    joint_columns: tuple[str, ...]  # Names of the k joint columns
    # rad and m, (n, k) and (n, 3); NaN where unknown
    q: FloatArray
    from_q: FloatArray
    position: FloatArray
    std: FloatArray
    stamp_s: FloatArray | None  # s, (n,); None where there are no times
    # ``pose``, ``configuration``, ``split``, ``sensor``, ``marker`` -> n texts, where given
    labels: dict[str, list[str]]
    # (n,); NaN and -1 where unknown
    temperature_c: FloatArray
    samples: FloatArray
    columns: dict[str, str]  # Column -> its meaning in words
    description: tuple[str, ...]  # How the files were read and joined, a line each
    warnings: tuple[str, ...]  # A sentence each
    # Marker -> names of its columns X, Y and Z; empty for a bag
    points: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    length_unit: str = 'm'  # Unit of the points in the file
    # Unit of the joints in the table; None if they are those of the URDF in SI, as in a bag
    angle_unit: AngleUnit | None = None
    # Index of the reading of each row, (n,): rows of one reading were measured at the same time.
    # None if each row is a reading of its own
    reading: IntArray | None = None
    # Quaternion x, y, z, w of the marker in the sensor's frame, (n, 4), NaN if unknown; None if
    # no orientation was measured
    orientation: FloatArray | None = None
    # Orientation whose convention (Euler order, quaternion order) the columns do not state, (n, 3)
    # or (n, 4), with its unit ('' if not stated) and column names
    ambiguous_orientation: FloatArray | None = None
    ambiguous_unit: str = ''
    ambiguous_columns: str = ''
    # Joint column -> (coupled joint column, 1 or -1), as the controller of this file counts
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] = field(default_factory=dict)
    maker: str = ''  # Manufacturer of the controller; '' if unknown
    # Kind of the instrument that measured the points; '' if unknown
    instrument: Literal['', SensorKind] = ''
    effort: FloatArray | None = None  # Measured torques, N m, (n, k); None if not measured

    def in_order(self) -> RawRows:
        """Rows sorted by their times, with a warning unless these rise already.

        Unchanged without times, too.
        """
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
            source=tuple(self.source[i] for i in order),
            labels={kind: [names[i] for i in order] for kind, names in self.labels.items()},
            warnings=(*self.warnings, 'the rows were put in the order of their times'),
        )


def read_rows(
    files: Sequence[Path | TextTable], chain: SerialChain, options: TableOptions
) -> RawRows:
    """Rows of one table with joints and points, or of one table of each, in SI.

    Read from files or tables in memory, at most two, and joined; of streams the means at
    standstills are taken. A .dat and a .src file of one name are one table of a KUKA controller.

    Raises
    ------
    InputError
        One line naming file, line, column and remedy: more files, unclear or missing columns,
        another number of joints than the robot's, cells that are no numbers, or rows that cannot
        be joined.
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
    tables = [
        _in_move_order(table, programs[table.path]) if table.path in programs else table
        for table in tables
    ]
    sliding = np.flatnonzero(chain.slides).tolist()

    def with_columns(tables: list[TextTable]) -> list[Table]:
        found, problems = [], []
        for table in tables:
            chosen = _choice_for_table(options.chosen, table, tables)
            try:
                found.append((table, find_columns(table, chain.joint_names, chosen, sliding)))
            except InputError as error:
                # A workbook has sheets for other things.
                if not table.part:
                    raise
                problems.append(error)
        if problems and not any(c.points or c.joints for _, c in found):
            raise problems[0]
        return found

    if not (options.chosen.joints or options.chosen.points):
        # Column numbers that the user gave count the columns of the file as it is.
        tables = [table if table.has_header else with_poses(table) for table in tables]
    found = with_columns(tables)
    if not any(columns.points for _, columns in found) and not options.chosen.points:
        tables = [with_poses(table) for table in tables]
        found = with_columns(tables)
    _refuse_absent_columns(found, options.chosen)
    complete_tables = [pair for pair in found if pair[1].points and pair[1].joints]
    if len(complete_tables) == 1 and all(table.part for table, _ in found):
        # Beside it a workbook has sums, and an archive other arrays.
        found = complete_tables
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
    warnings = [note for table in tables for note in table.notes]
    warnings += [
        f'{table.path} left out: it is neither with the joints nor with the points used'
        for table in tables
        if table.part and table not in (points[0], joints[0])
    ]
    joints, idle = _without_unused_axes(joints, len(chain))
    if idle:
        warnings.append(f'{joints[0].path}: {", ".join(idle)} left out: 0 in every row')
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
    same = joints is points
    joints, how_pulses = in_degrees(joints, options.pulses_per_degree, options.angles)
    description += filter(None, [how_pulses])
    if same:
        points = joints
    for table, columns in with_points:
        if table.path != points[0].path:
            unused = ', '.join(table.names[i] for i in columns.point)
            warnings.append(f'{table.path}: {unused} left out, the points are in {points[0].path}')
    stamp = None
    in_order = options.join == 'order'
    chosen = options.join in ('name', 'time') or options.chosen.time == 'none'
    still = None
    # A clock that was told is that of two streams.
    if options.clock_offset_s is not None or (
        not chosen and (in_order or joints is points or not common_names(points, joints))
    ):
        still = stopped(
            points, joints, chain, options.angles, options.length, options.clock_offset_s, in_order
        )
    if still is not None:
        points, joints, stamp = still.points, still.joints, still.stamp_s
        description += still.description
        warnings += still.warnings
    else:
        points, joints, omissions = _without_incomplete_rows(points, joints)
        warnings += omissions
    if still is None and joints[0] is not points[0]:
        pairs = join(points, joints, options.join, options.within_s)
        description.append(f'{len(pairs.points)} rows joined {pairs.criterion}')
        warnings += pairs.left_out
        points = points[0].select(pairs.points), points[1]
        joints = joints[0].select(pairs.joints), joints[1]
    return _raw_rows(points, joints, chain, options, stamp, tuple(description), tuple(warnings))


def _without_unused_axes(joints: Table, count: int) -> tuple[Table, list[str]]:
    """Table of joints without axes beyond the first `count` that are 0 throughout.

    A controller that has seven axes writes 0 for the seventh of an arm with six. Last result: the
    names of the axes left out.
    """
    table, columns = joints
    beyond = columns.joints[count:]
    if not beyond or np.any(numbers(table, beyond)):
        return joints, []
    kept = replace(columns, joints=columns.joints[:count])
    return (table, kept), [table.names[i] for i in beyond]


def _without_incomplete_rows(points: Table, joints: Table) -> tuple[Table, Table, tuple[str, ...]]:
    """Points and joints without rows that lack joints or a point.

    A row lacks them if all their cells are missing; in data frames if any is, unless the columns
    are more than the joints. If all rows do, none is left out. Last result: sentences on what is
    left out.
    """
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
        return (table, points[1]), (table, joints[1]), tuple(notes)
    tables = [
        (table.select(np.flatnonzero(kept[what]).tolist()), columns)
        for what, (table, columns) in (('no point', points), ('no joints', joints))
    ]
    return tables[0], tables[1], tuple(notes)


def _in_move_order(data: TextTable, program: Path) -> TextTable:
    """Positions of a KUKA data file (.dat) in the order of the moves of its program (.src).

    As often as there are moves; positions without a move are dropped. If no move names one, the
    order stays, with a note.
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


def _raw_rows(
    points: Table,
    joints: Table,
    chain: SerialChain,
    options: TableOptions,
    stamp: FloatArray | None,
    description: tuple[str, ...],
    warnings: tuple[str, ...],
) -> RawRows:
    """Rows in SI from a table of points and a table of joints that belong together row by row.

    One for each marker seen in a row. `stamp`: times by another clock, s, (n,); None to take the
    table's. Raises InputError for missing or faulty numbers, units that do not fit, or points
    beyond 200 m.
    """
    table, columns = points
    q, units, scale = joint_values(*joints, chain, options.angles)
    angle = next((unit for unit, _ in units if unit in ANGLES), None)
    several = len(columns.points) > 1
    raw = np.array(
        [numbers(table, marker_columns, several) for marker_columns in columns.points.values()]
    )
    _refuse_part_of_a_point(table, columns, raw)
    # A row of the table for each marker that was seen in it.
    row, marker = np.nonzero(np.isfinite(raw[:, :, 0]).T)
    modelled = chain.forward(q)[:, :3, 3]
    length, how_length = length_unit(
        table, columns, options.length, raw[marker, row], modelled[row]
    )
    refuse_far(table, columns, length)
    names = list(columns.points)
    if several:
        moved, omissions = _markers_on_arm(raw, names, table)
        warnings += omissions
        row, marker = row[moved[marker]], marker[moved[marker]]
    n, k = q.shape
    from_q = np.full((n, k), np.nan)
    if len(joints[1].from_joints) == k:
        from_q = numbers(joints[0], joints[1].from_joints, optional=True) * scale
    std = np.full((len(names), n, 3), np.nan)
    turns = np.full((len(names), n, 4), np.nan)
    for i, name in enumerate(names):
        if name in columns.stds:
            std[i] = numbers(table, columns.stds[name], optional=True) * LENGTHS[length]
        if name in columns.orientations:
            turns[i] = numbers(table, columns.orientations[name], optional=True)
            _refuse_non_unit_quaternions(table, columns.orientations[name], turns[i])
    effort = None
    # Of a stream the torques are those of one moment, and no mean over a standstill.
    if joints[1].efforts and stamp is None:
        effort = numbers(joints[0], joints[1].efforts, optional=True)
    if stamp is None and options.chosen.time != 'none':
        stamp = times(*points)
        if stamp is None and joints[0] is not table:
            stamp = times(*joints)
    if stamp is not None and (equal := _shared_time_note(stamp, q)):
        stamp = None
        warnings += (equal,)
    given = {}
    for kind in _OTHERS:
        for text_table, found in (points, joints):
            column = found.first_of_kind(kind)
            if column is not None and kind not in given:
                given[kind] = [text_table.rows[i][column] for i in row]
    if several:
        given['marker'] = [names[i] for i in marker]
    meanings: dict[str, str] = {}
    both = [points] if joints[0].path == table.path else [points, joints]
    for text_table, found in both:
        prefix = f'{text_table.path.name}: ' if len(both) > 1 else ''
        is_joints, is_points = found is joints[1], found is columns
        meaning = _column_meanings(
            found if is_joints else replace(found, joints=(), from_joints=(), efforts=()),
            chain,
            tuple(f'{unit} ({how})' for unit, how in units),
            f'{length} ({how_length})' if is_points else '',
        )
        meanings |= {
            f'{prefix}{name}': meaning.get(i, 'not used')
            for i, name in enumerate(text_table.names)
        }
    return RawRows(
        source=tuple(table.at(int(i)) for i in row),
        joint_columns=tuple(joints[0].names[i] for i in joints[1].joints),
        q=q[row],
        from_q=from_q[row],
        position=raw[marker, row] * LENGTHS[length],
        std=std[marker, row],
        stamp_s=None if stamp is None else stamp[row],
        labels=given,
        temperature_c=_optional_column(points, 'temperature')[row],
        samples=np.nan_to_num(_optional_column(points, 'samples')[row], nan=-1.0),
        columns=meanings,
        description=description,
        warnings=warnings,
        points={
            name: tuple(table.names[i] for i in marker_columns)
            for name, marker_columns in columns.points.items()
        },
        length_unit=length,
        angle_unit=cast(AngleUnit | None, angle),
        reading=row if several else None,
        orientation=turns[marker, row] if columns.orientations else None,
        ambiguous_orientation=numbers(table, columns.ambiguous_orientation, optional=True)[row]
        if columns.ambiguous_orientation
        else None,
        ambiguous_unit=columns.units.get(columns.ambiguous_orientation[0], '')
        if columns.ambiguous_orientation
        else '',
        ambiguous_columns=', '.join(
            table.names[i]
            for i in (
                *columns.ambiguous_orientation,
                *itertools.chain.from_iterable(columns.orientations.values()),
            )
        ),
        coupling=joints[0].coupling,
        maker=joints[0].maker,
        # A controller's own file has points that were computed from its joints.
        instrument=table.instrument or ('controller' if table.maker else ''),
        effort=None if effort is None else effort[row],
    )


def _refuse_part_of_a_point(table: TextTable, columns: Columns, raw: FloatArray) -> None:
    """Raise InputError for a point of which X, Y or Z is missing, or if no point is left."""
    for marker_columns, points in zip(columns.points.values(), raw):
        empty = np.isnan(points)
        for row in np.flatnonzero(empty.any(axis=1) & ~empty.all(axis=1))[:1]:
            raise table.fault(
                int(row),
                marker_columns[int(np.argmax(empty[row]))],
                'is empty, and the others of its point are not; complete it or empty all three',
            )
    if len(raw) > 1 and np.isnan(raw).all():
        raise InputError(f'{table.path}: it has no point that was measured')


def _refuse_non_unit_quaternions(
    table: TextTable, columns: Sequence[int], turns: FloatArray
) -> None:
    """Raise InputError for the first quaternion, (n, 4), whose length differs from 1 by over 1e-3.

    NaN is allowed. `columns`: indices of the four columns.
    """
    off = np.abs(np.linalg.norm(turns, axis=1) - 1.0) > LENGTH_TOLERANCE
    for row in np.flatnonzero(off)[:1]:
        raise table.fault(
            int(row),
            columns[0],
            'and the three beside it are no quaternion of length 1; correct them, or '
            'leave the four cells of the row empty',
        )


def moving_markers(raw: FloatArray) -> BoolArray:
    """Mask of the markers in (markers, n, 3), NaN for missing readings, that move with the arm.

    A marker does if its extent along an axis is over 2 % (`STATIC`) of the largest one's.
    """
    seen = np.isfinite(raw[:, :, 0])
    extent = np.array(
        [
            np.ptp(marker_points[at], axis=0).max() if at.any() else 0.0
            for marker_points, at in zip(raw, seen)
        ]
    )
    return np.asarray(extent > STATIC * extent.max(initial=0.0))


def _markers_on_arm(
    raw: FloatArray, names: Sequence[str], table: TextTable
) -> tuple[BoolArray, tuple[str, ...]]:
    """Mask of the markers that move with the arm, (markers,), as `moving_markers`.

    Last result: a sentence on each other marker, whether unmoved or never seen.
    """
    moved = moving_markers(raw)
    return moved, tuple(
        f'{table.path}: {name} stays in its place, so it is not on the arm; left out'
        if np.isfinite(marker_points[:, 0]).any()
        else f'{table.path}: {name} was never seen; left out'
        for name, is_moved, marker_points in zip(names, moved, raw)
        if not is_moved
    )


def _shared_time_note(stamp: FloatArray, q: FloatArray) -> str:
    """Sentence that over half of the configurations share one time, which is unusable then.

    '' if not, or for fewer than four configurations.
    """
    configurations = np.unique(np.column_stack((q, stamp)), axis=0)
    if len(configurations) < _FEWEST_ALIKE:
        return ''
    _, count = np.unique(configurations[:, -1], return_counts=True)
    if 2 * count.max() <= len(configurations):
        return ''
    return (
        f'{count.max()} of {len(configurations)} configurations have one and the same time, so '
        'the times are left out'
    )


def _optional_column(points: Table, kind: str) -> FloatArray:
    """Numbers of the first column of a kind, (n,); NaN if empty or if there is no such column."""
    column = points[1].first_of_kind(kind)
    if column is None:
        return np.full(len(points[0].rows), np.nan)
    return numbers(points[0], (column,), optional=True)[:, 0]


def _column_meanings(
    columns: Columns, chain: SerialChain, units: Sequence[str], length: str
) -> dict[int, str]:
    """Meaning of each column in words, by column index from 0; unused columns are left out.

    `units`: text on the unit of each joint; columns of points only if `length`, their unit, is
    given.
    """

    def how(i: int) -> str:
        place = {'place': ', by its place', 'told': ', as told'}
        return place.get(columns.origin.get(i, ''), '')

    found: dict[int, str] = {}
    for kind, joints in (('', columns.joints), ('coming from, ', columns.from_joints)):
        for joint, i in enumerate(joints):
            name, unit = chain.joint_names[joint], units[joint]
            found.setdefault(i, f'{kind}joint {joint + 1} ({name}), {unit}{how(i)}')
    for name, i in zip(chain.joint_names, columns.efforts):
        found.setdefault(i, f'torque of {name}, N m')
    for marker, marker_columns in columns.points.items() if length else ():
        of = f'marker {marker}' if marker else 'the marker'
        spread, turned = columns.stds.get(marker, ()), columns.orientations.get(marker, ())
        for axis, i in zip(AXES, marker_columns):
            found.setdefault(i, f'{axis} of {of}, {length}{how(i)}')
        for axis, i in zip(AXES, spread):
            found.setdefault(i, f'standard deviation of {axis} of {of}, {length}')
        for letter, i in zip('xyzw', turned):
            found.setdefault(i, f'{letter} of the quaternion of {of}{how(i)}')
    for i in columns.ambiguous_orientation if length else ():
        found.setdefault(i, f'orientation of the marker{how(i)}')
    for kind, places in columns.others.items():
        for i in places:
            found.setdefault(i, f'{kind}{how(i)}')
    return found


def _choice_for_table(
    chosen: ColumnChoice, table: TextTable, tables: Sequence[TextTable]
) -> ColumnChoice:
    """Chosen columns that concern one table: numbers count only for a table without names.

    If all `tables` have names, numbers count for all. See `_choice_for_file`.
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

    Ranges are expanded to their numbers. `paths`: all files.
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


def _refuse_absent_columns(found: list[Table], chosen: ColumnChoice) -> None:
    """Raise InputError if a column that the user chose is in no table; ``none`` is no column."""
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


def from_tool(rows: RawRows) -> RawRows:
    """Rows of a sensor on the tool, with the pose of the sensor in the frame of its target.

    Inverse of the measured pose of the target in the sensor's frame.

    Raises
    ------
    InputError
        A row without an orientation.
    """
    orientation = np.full((1, 4), np.nan) if rows.orientation is None else rows.orientation
    unknown = np.isnan(orientation).any(axis=1)
    if unknown.any():
        which = f'reading {int(np.argmax(unknown)) + 1} has no orientation'
        raise InputError(
            f'--on-tool: {which} (qx, qy, qz, qw), without which what a sensor on the tool '
            'measures tells nothing; add the columns, or leave such rows out'
        )
    position, orientation = inverse_poses(rows.position, orientation)
    return replace(rows, position=position, orientation=orientation)
