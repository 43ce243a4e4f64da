# SPDX-License-Identifier: Apache-2.0
"""Joining of a table of points and a table of joints by name, time or order of their rows."""

from __future__ import annotations

import itertools
import re
import string
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Columns, Table
from remaster_ros.importing.makers.named import first_names
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.values import DAY_S, WITHOUT_DATE_S, numbers, times
from remaster_ros.types import FloatArray, IntArray

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
    """Pair the rows of two tables by name, time or order.

    `how`: '' for the first of these that works; by order then only for data frames whose rows
    were counted alike. `within_s`: largest difference of times, s. Raises InputError if
    nothing pairs them, a name is twice, no times are near, every point was measured in motion,
    or the numbers of rows differ for ``order``.
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
    """Pair of columns with most names in common at one level of `_comparison_keys`; None without.

    Result as of `common_names`. `columns`: the pairs to compare, (index in points, index in
    joints); `sure`: False if the headers do not call them names: then one table must contain
    all names of the other, at least four.
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

    Rows whose name is not in the other table are left out, with a sentence. `by_header`: only
    columns whose header says that they are names. Raises InputError if a common name is twice
    in the joints, or in points that have neither a sensor nor a marker column.
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

    None if either table has no times. Times of day without a date are moved by whole days. A
    point between two reports that differ by over 0.05 degrees in a joint was measured in
    motion and is left out, with a sentence, as one without a near report is. Raises InputError
    if no point is near a report, all were in motion, or different joints have the same time.
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
    """Raise InputError if a needed row of joints has the time of a row with other joints.

    ``reported``: times of the joints, s, rising, (n,); ``order``: row in the table of each;
    ``q``: joints of the table's rows, (n, k); ``used``: indices into ``reported`` of the
    needed rows.
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
