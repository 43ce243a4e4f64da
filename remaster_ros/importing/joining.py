"""Which row of the joints belongs to which row of the points: by name, by time or by order."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Columns
from remaster_ros.importing.standstills import some
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.values import labels, numbers, times
from remaster_ros.types import IntArray

How = Literal['', 'name', 'time', 'order']
# A joint that turns by more between the reports before and after a point was moving, in the
# units of the table: degrees; in radians a thousandth.
_STILL_DEG = 0.05
# Between the parts of a name: SpatialAnalyzer's collection::group::point, and paths.
_PATH = re.compile(r'::|[/\\|]')
_BRACKETS = re.compile(r'[\[\](){}_\s-]')


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs found.

    Attributes
    ----------
    points, joints
        Rows of the two tables, (n,) each.
    how
        By what they were paired, for people.
    left_out
        What was left out and why, a sentence each.
    """

    points: IntArray
    joints: IntArray
    how: str
    left_out: tuple[str, ...] = ()


def join(
    points: tuple[TextTable, Columns],
    joints: tuple[TextTable, Columns],
    how: How = '',
    within_s: float = 1.0,
) -> Pairs:
    """Pair the rows of two tables.

    Raises
    ------
    InputError
        Nothing tells which rows belong together; names given twice.
    """
    if how in ('', 'name'):
        pairs = _by_name(points, joints)
        if pairs is not None:
            return pairs
    if how in ('', 'time'):
        pairs = _by_time(points, joints, within_s)
        if pairs is not None:
            return pairs
    a, b = points[0], joints[0]
    if how == 'order':
        if len(a.rows) != len(b.rows):
            raise InputError(
                f'{a.path} has {len(a.rows)} rows, {b.path} {len(b.rows)}; only equally many can '
                'be joined by their order'
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
    points: tuple[TextTable, Columns], joints: tuple[TextTable, Columns]
) -> tuple[int, int, list[str], list[str]] | None:
    """Return the columns by whose names most rows belong together, and the names as compared.

    `P01`, `p1` and `P1 ` are the same; where no names are, then the last parts (`A::KR6::P1` and
    `P1`), then those without brackets and underscores (`P[1]`).
    """
    best: tuple[int, int, int, int, list[str], list[str]] | None = None
    for level in range(3):
        for i in points[1].others['name']:
            for j in joints[1].others['name']:
                a, b = _keys(points[0], i, level), _keys(joints[0], j, level)
                common = len(set(a) & set(b))
                if common and (best is None or common > best[0]):
                    best = common, level, i, j, a, b
        if best is not None:
            return best[2:]
    return None


def _by_name(points: tuple[TextTable, Columns], joints: tuple[TextTable, Columns]) -> Pairs | None:
    best = common_names(points, joints)
    if best is None:
        return None
    i, j, a, b = best
    several = points[1].one('sensor') is not None or points[1].one('marker') is not None
    for keys, (table, _), column in ((a, points, i), (b, joints, j)):
        count = Counter(keys)
        twice = [row for row, key in enumerate(keys) if count[key] > 1 and key in set(a) & set(b)]
        if twice and not (several and table is points[0]):
            raise table.fault(
                twice[1],
                column,
                f'is also on line {table.lines[twice[0]]}; keep one, or say --join order',
            )
    at = {key: row for row, key in enumerate(b)}
    rows = np.array([row for row, key in enumerate(a) if key in at], dtype=np.int64)
    left_out = []
    for (table, _), column, keys, other in ((points, i, a, set(b)), (joints, j, b, set(a))):
        alone = [table.rows[row][column] for row, key in enumerate(keys) if key not in other]
        if alone:
            left_out.append(f'{table.path}: {some(alone)}: not in the other table, left out')
    return Pairs(
        rows,
        np.array([at[a[row]] for row in rows], dtype=np.int64),
        f'by {points[0].names[i]} and {joints[0].names[j]}',
        tuple(left_out),
    )


def _keys(table: TextTable, column: int, level: int) -> list[str]:
    """Return names as they are compared: 0 whole, 1 their last parts, 2 those without brackets."""
    names = labels(table, column) or []
    if level > 0:
        names = [_PATH.split(name.strip())[-1] for name in names]
    if level > 1:
        names = [_BRACKETS.sub('', name) for name in names]
    return [
        re.sub(r'\d+', lambda digits: str(int(digits[0])), name.strip().casefold())
        for name in names
    ]


def _by_time(
    points: tuple[TextTable, Columns], joints: tuple[TextTable, Columns], within_s: float
) -> Pairs | None:
    """Pair each point with the joints reported next to it, where the arm stood still."""
    when, reported = times(*points), times(*joints)
    if when is None or reported is None:
        return None
    order = np.argsort(reported, kind='stable')
    reported = reported[order]
    after = np.searchsorted(reported, when)
    before = np.clip(after - 1, 0, len(reported) - 1)
    after = np.clip(after, 0, len(reported) - 1)
    nearer = np.where(
        np.abs(reported[after] - when) < np.abs(reported[before] - when), after, before
    )
    near = np.abs(reported[nearer] - when) <= within_s
    table = points[0]
    if not near.any():
        raise InputError(
            f'{table.path}: its times ({when.min():.1f} to {when.max():.1f} s) are not those of '
            f'{joints[0].path} ({reported.min():.1f} to {reported.max():.1f} s); set the clocks '
            'equal, or join by name or by order (--join)'
        )
    # Where both neighbours are near, the joints are a stream: it tells whether the arm moved.
    q = numbers(joints[0], joints[1].joints)
    still = _STILL_DEG if np.abs(q).max(initial=0.0) > 2.1 * np.pi else np.deg2rad(_STILL_DEG)
    stream = near & (np.abs(reported[before] - when) <= within_s)
    stream &= np.abs(reported[after] - when) <= within_s
    moved = stream & (np.abs(q[order[before]] - q[order[after]]).max(axis=1) > still)
    kept = near & ~moved
    left_out = []
    for why, rows in (
        (f'no joints within {within_s:g} s', np.flatnonzero(~near)),
        ('measured while the arm moved', np.flatnonzero(moved)),
    ):
        if len(rows):
            lines = some([str(table.lines[row]) for row in rows])
            left_out.append(f'{table.path}, line {lines}: {why}, left out')
    if not kept.any():
        raise InputError(f'{table.path}: every point was measured while the arm moved')
    return Pairs(np.flatnonzero(kept), order[nearer[kept]], 'by time', tuple(left_out))
