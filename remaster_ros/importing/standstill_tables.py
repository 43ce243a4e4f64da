# SPDX-License-Identifier: Apache-2.0
"""Tables of one row a standstill, from tables that are streams (a take, a log of joints)."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.arrangement import linear_fit
from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Table
from remaster_ros.importing.standstill_matching import FEWEST_FOR_ROBOT, LARGEST_ERROR, match
from remaster_ros.importing.standstills import (
    SWING_S,
    Standstills,
    Stream,
    between,
    is_stream,
    joint_standstills,
    mean_of,
    point_visits,
    reading_of,
    refuse_sliding,
)
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.importing.values import angle_unit, length_unit, numbers, times
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray

# Reports of a table at one standstill, at least: two equal rows may be two shots.
FEWEST_REPORTS = 3


@dataclass(frozen=True, eq=False)
class Stopped:
    """Tables of points and joints, one row a standstill, that belong together row by row."""

    points: Table
    joints: Table
    # When each was measured, or the standstill ended, by the clock of the joints, s, (n,).
    stamp_s: FloatArray
    # How, and what was left out, a sentence each.
    description: tuple[str, ...]
    warnings: tuple[str, ...]


def stopped(
    points: Table,
    joints: Table,
    chain: SerialChain,
    angles: str = '',
    length: str = '',
    clock_offset_s: float | None = None,
    in_order: bool = False,
) -> Stopped | None:
    """Tables with one row a standstill if the joints are a stream; None if they are not.

    `angles`, `length`: units that the user stated, '' if none; `clock_offset_s`: added to the
    points' times to have the joints', None to find it. `in_order`: the user asked to pair
    points and standstills by their order; None also if then both tables have equally many
    rows, or are one and the same. Raises InputError for a stream that never stands still,
    standstills that do not match, no point at any standstill, or a prismatic joint.
    """
    reported = times(*joints)
    if reported is None or not is_stream(reported):
        return None
    same = points[0] is joints[0]
    if in_order and (same or len(points[0].rows) == len(joints[0].rows)):
        return None
    when = reported if same else times(*points)
    refuse_sliding(chain, joints[0].path)
    unit = ANGLES[angle_unit(*joints, angles)[0]]
    q = Stream.of(reported, unit * numbers(joints[0], joints[1].joints, optional=True))
    still = joint_standstills(q, FEWEST_REPORTS)
    if same and not len(still) and np.median(np.diff(np.sort(reported))) >= SWING_S:
        # Rows of single readings with times of their own kind.
        return None
    if not len(still):
        raise InputError(
            f'{joints[0].path}: the joints never stand still for {SWING_S:g} s, and only what is '
            'measured at a standstill belongs to one configuration; let the arm stop at each pose'
        )
    names = points[0].path.name, joints[0].path.name
    if when is None or in_order:
        return _by_order(points, joints, chain, still, reported, unit, names, in_order)
    markers = {
        name: Stream.of(when, numbers(points[0], columns, optional=True))
        for name, columns in points[1].points.items()
    }
    first = max(markers.values(), key=lambda stream: _extent(stream.values))
    if not len(first.stamps):
        raise InputError(f'{points[0].path}: it has no point that was measured')
    dense = same or is_stream(first.stamps)
    # Where the points are in the time of their own table, for each standstill of the joints.
    windows = np.column_stack((still.begin, still.end))
    how = f'{len(still)} standstills'
    if not same:
        seen = point_visits(first)
        matching = match(seen, still, names, chain, clock_offset_s)
        how = matching.in_words(seen, still, names)
        if not dense:
            rows = _rows_of(first.stamps[matching.points], when)
            return Stopped(
                (points[0].select(rows), points[1]),
                _at_rest(joints, still, matching.joints, reported, unit),
                still.end[matching.joints]
                if matching.offset_s is None
                else when[rows] + matching.offset_s,
                (how,),
                (
                    *_unpaired(points, rows, when, q.stamps, matching.offset_s),
                    *_lost(len(still), matching.joints, names[1]),
                ),
            )
        if matching.offset_s is not None:
            windows = windows - matching.offset_s
        else:
            windows = np.full_like(windows, np.nan)
            windows[matching.joints] = np.column_stack((seen.begin, seen.end))[matching.points]
    scale = _scale(points, chain, length, first, windows, still)
    at, table, unsteady = _means(points, when, windows, scale)
    if not len(at):
        raise InputError(
            f'{names[0]}: at none of the {len(still)} standstills of {names[1]} was a point still'
        )
    return Stopped(
        table,
        _at_rest(joints, still, at, reported, unit),
        still.end[at],
        (f'{how}; means from {SWING_S:g} s after the arm stood still',),
        (
            *[f'{unsteady} readings of a marker that was not still were left out']
            * bool(unsteady),
            *_lost(len(still), at, names[1]),
        ),
    )


def _by_order(
    points: Table,
    joints: Table,
    chain: SerialChain,
    still: Standstills,
    reported: FloatArray,
    unit: float,
    names: tuple[str, str],
    is_stated: bool,
) -> Stopped:
    """Pair points with as many standstills by their order, if the robot agrees or `is_stated`.

    The robot agrees if it fits the first marker of 11 points or more to 15 % of their extent.
    `still`: standstills of the joints; `reported`: times of the joints' rows, s; `unit`: of
    their angles, rad; `names`: of both tables, for messages; `is_stated`: whether the user
    asked for it. Raises InputError if the numbers differ or the robot disagrees.
    """
    raw = numbers(points[0], points[1].point, optional=True)
    rows = np.flatnonzero(np.isfinite(raw).any(axis=1))
    if len(rows) != len(still):
        raise InputError(
            f'{names[0]}: {len(rows)} points, and {len(still)} standstills in {names[1]}; only '
            'equally many can be joined by their order: remove what has no standstill, or give '
            'the points the times at which they were measured'
        )
    order = np.arange(len(still))
    if not is_stated:
        of_first = raw[rows, : len('xyz')]
        known = np.flatnonzero(np.isfinite(of_first).all(axis=1))
        error = np.inf
        if len(known) >= FEWEST_FOR_ROBOT:
            error = float(linear_fit(chain, still.mean[known][None], of_first[known])[0][0])
        if error > LARGEST_ERROR:
            raise InputError(
                f'{names[0]} has no times, and by their order its points are not those of the '
                f'standstills in {names[1]}; give them the times at which they were measured, or '
                'say --join order if they are right so'
            )
    what = 'by their order, as told' if is_stated else 'by their order, with which the robot fits'
    return Stopped(
        (points[0].select(rows.tolist()), points[1]),
        _at_rest(joints, still, order, reported, unit),
        still.end,
        (f'{len(rows)} points of {names[0]} match the standstills of {names[1]} {what}',),
        (),
    )


def _unpaired(
    points: Table, kept: IntArray, when: FloatArray, span: FloatArray, offset: float | None
) -> tuple[str, ...]:
    """Sentences on shots that belong to no standstill: in motion, or outside the record.

    `kept`: rows that belong to one; `when`: times of all rows, s; `span`: times of the joints, s,
    in order; `offset`: of the clocks, s, None for 0.
    """
    lost = np.setdiff1d(np.flatnonzero(np.isfinite(when)), kept)
    clock = when[lost] + (offset or 0.0)
    inside = (clock >= span[0]) & (clock <= span[-1])
    notes = []
    for rows, why in (
        (lost[inside], 'measured while the arm moved'),
        (lost[~inside], 'measured before or after the record of the joints'),
    ):
        if len(rows):
            notes.append(f'{points[0].at_rows(rows.tolist())}: {why}, left out')
    return tuple(notes)


def _lost(count: int, kept: IntArray, name: str) -> tuple[str, ...]:
    """Warning how many standstills of a table have no point, as a tuple; () if none.

    `count`: number of standstills; `kept`: indices of those with a point; `name`: of the table
    of joints.
    """
    lost = count - len(np.unique(kept))
    return (f'{lost} standstills of {name} without a point were left out',) * bool(lost)


def _extent(values: FloatArray) -> float:
    """Longest side of the box around points (n, m); 0 without points."""
    return float(np.ptp(values, axis=0).max()) if len(values) else 0.0


def _rows_of(stamps: FloatArray, when: FloatArray) -> IntArray:
    """Index in `when` of each stamp, (n,): each stamp is one of `when`.

    A stamp that is repeated gets the next row with this time.
    """
    order = np.argsort(when, kind='stable')
    sorted_when = when[order]
    taken: dict[float, int] = {}
    rows = []
    for stamp in stamps:
        rows.append(order[np.searchsorted(sorted_when, stamp) + taken.get(stamp, 0)])
        taken[stamp] = taken.get(stamp, 0) + 1
    return np.array(rows, dtype=np.int64)


def _scale(
    points: Table,
    chain: SerialChain,
    stated_unit: str,
    stream: Stream,
    windows: FloatArray,
    still: Standstills,
) -> float:
    """Unit of the points, m; 1 if there is no point at any standstill.

    The unit that the user stated (`stated_unit`, '' if none), else that of the header, else by
    the size of the modelled motion of the tool. `stream`: points of a marker; `windows`: begin
    and end of each standstill of `still` by the points' clock, s, (n, 2).
    """
    parts = [stream.values[between(stream, *window)] for window in windows]
    seen = [j for j, part in enumerate(parts) if len(part)]
    if not seen:
        return 1.0
    raw = np.array([np.median(parts[j], axis=0) for j in seen])
    modelled = chain.forward(still.mean[seen])[:, :3, 3]
    return LENGTHS[length_unit(*points, stated_unit, raw, modelled)[0]]


def _means(
    points: Table, when: FloatArray, windows: FloatArray, scale: float
) -> tuple[IntArray, Table, int]:
    """Indices of the standstills with a point of any marker, and the table of their mean points.

    Columns for standard deviations and the number of samples are added at the end. Last
    result: the number of readings (standstill and marker) left out because the marker was not
    still. `windows`: begin and end of each standstill by the clock of `when`, s, (n, 2);
    `scale`: unit of the points, m.
    """
    table, columns = points
    spread = {
        name: tuple(range(len(table.names) + 3 * i, len(table.names) + 3 * i + 3))
        for i, name in enumerate(columns.points)
    }
    width = len(table.names) + 3 * len(spread)
    streams = {}
    for name, marker_columns in columns.points.items():
        both = numbers(
            table, (*marker_columns, *columns.orientations.get(name, ())), optional=True
        )
        streams[name] = Stream.of(when, np.column_stack((both, np.arange(len(both)))))
    at, rows, lines, unsteady = [], [], [], 0
    for j, window in enumerate(windows):
        cells: list[str] = []
        for name, stream in streams.items():
            values = stream.values[between(stream, *window)]
            if not len(values):
                continue
            reading = reading_of(scale * values[:, :3])
            if reading is None:
                unsteady += 1
                continue
            _, std, kept = reading
            # In the unit of the table, as one of its rows would have it.
            mean = mean_of(values[kept, :3])
            if not cells:
                first = int(values[kept[0], -1])
                blank = {*columns.point, *columns.others.get('samples', ())}
                cells = ['' if i in blank else cell for i, cell in enumerate(table.rows[first])]
                cells += [''] * (width - len(cells)) + [str(len(kept))]
                lines.append(table.lines[first])
            turned = columns.orientations.get(name, ())
            for column, value in (
                *zip(columns.points[name], mean),
                *zip(spread[name], std / scale),
                *zip(turned, _mean_turn(values[kept, 3:-1]) if turned else ()),
            ):
                cells[column] = '' if np.isnan(value) else _text(value, table.decimal)
        if cells:
            at.append(j)
            rows.append(tuple(cells))
    names = [f'std {axis} of {name or "the point"}' for name in spread for axis in 'xyz']
    other_columns = {kind: list(of) for kind, of in columns.others.items()}
    other_columns['samples'] = [width]
    return (
        np.array(at, dtype=np.int64),
        (
            replace(
                table,
                names=(*table.names, *names, 'samples of the mean'),
                rows=tuple(rows),
                lines=tuple(lines),
            ),
            replace(
                columns,
                stds=spread,
                others=defaultdict(list, other_columns),
                ambiguous_orientation=(),
            ),
        ),
        unsteady,
    )


def _mean_turn(turns: FloatArray) -> FloatArray:
    """Mean of quaternions (n, 4) that are near each other, but for their sign; length 1, (4,)."""
    mean = (turns * np.where(turns @ turns[0] < 0.0, -1.0, 1.0)[:, None]).mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _at_rest(
    joints: Table, still: Standstills, at: IntArray, reported: FloatArray, unit: float
) -> Table:
    """Table of joints with one row, the mean, for each of the standstills `at` (indices).

    Other cells are those of the first row of the standstill. `reported`: times of the rows, s;
    `unit`: of the angles, rad.
    """
    table, columns = joints
    rows, lines = [], []
    order = np.argsort(reported, kind='stable')
    for j in at:
        first = int(order[np.searchsorted(reported[order], still.begin[j])])
        cells = list(table.rows[first])
        for column, value in zip(columns.joints, still.mean[j] / unit, strict=True):
            cells[column] = _text(value, table.decimal)
        rows.append(tuple(cells))
        lines.append(table.lines[first])
    return replace(table, rows=tuple(rows), lines=tuple(lines)), columns


def _text(value: float, decimal: str) -> str:
    """A number as text, with all its digits and `decimal` as its decimal sign."""
    return repr(float(value)).replace('.', decimal)
