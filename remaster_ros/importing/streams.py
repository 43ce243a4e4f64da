"""Tables that are streams (a take, a log of joints) as tables of standstills, one row each."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.arrangement import linear_fit
from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Columns
from remaster_ros.importing.standstills import (
    SWING_S,
    Standstills,
    Stream,
    between,
    is_stream,
    joint_standstills,
    match,
    point_standstills,
    reading_of,
    refuse_sliding,
    some,
)
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.importing.values import angle_unit, length_unit, numbers, times
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray

# Reports of a table at one standstill, at least: two equal rows may be two shots.
FEWEST_REPORTS = 3
Table = tuple[TextTable, Columns]


@dataclass(frozen=True, eq=False)
class Stopped:
    """Two tables, a row a standstill, that belong together row by row.

    Attributes
    ----------
    points, joints
        Tables and their columns.
    stamp_s
        When each was measured, or the standstill ended, by the clock of the joints, s, (n,).
    description, warnings
        How, and what was left out, a sentence each.
    """

    points: Table
    joints: Table
    stamp_s: FloatArray
    description: tuple[str, ...]
    warnings: tuple[str, ...]


def stopped(
    points: Table,
    joints: Table,
    chain: SerialChain,
    angles: str = '',
    length: str = '',
    clock_offset_s: float | None = None,
) -> Stopped | None:
    """Return tables of which one is a stream of joints, a row a standstill; None for others.

    Raises
    ------
    InputError
        A stream that never stands still, or standstills that do not match.
    """
    reported = times(*joints)
    if reported is None or not is_stream(reported):
        return None
    same = points[0] is joints[0]
    when = reported if same else times(*points)
    if when is None:
        return None
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
    markers = {
        name: Stream.of(when, numbers(points[0], columns, optional=True))
        for name, columns in points[1].points.items()
    }
    first = max(markers.values(), key=lambda stream: _extent(stream.values))
    if not len(first.stamps):
        raise InputError(f'{points[0].path}: it has no point that was measured')
    dense = same or is_stream(first.stamps)
    names = points[0].path.name, joints[0].path.name
    # Where the points are in the time of their own table, for each standstill of the joints.
    windows = np.column_stack((still.begin, still.end))
    how = f'{len(still)} standstills'
    if not same:
        seen = (
            point_standstills(first) if dense else Standstills.of_shots(first.stamps, first.values)
        )

        def error_of(i: IntArray, j: IntArray) -> float:
            return float(linear_fit(chain, still.mean[j][None], seen.mean[i])[0][0])

        matching = match(seen, still, names, error_of, clock_offset_s)
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


def _unpaired(
    points: Table, kept: IntArray, when: FloatArray, span: FloatArray, offset: float | None
) -> tuple[str, ...]:
    """Return which shots belong to no standstill; `span` is that of the joints' record, s."""
    lost = np.setdiff1d(np.flatnonzero(np.isfinite(when)), kept)
    clock = when[lost] + (offset or 0.0)
    inside = (clock >= span[0]) & (clock <= span[-1])
    notes = []
    for rows, why in (
        (lost[inside], 'measured while the arm moved'),
        (lost[~inside], 'measured before or after the record of the joints'),
    ):
        if len(rows):
            lines = some([str(points[0].lines[row]) for row in rows])
            notes.append(f'{points[0].path}, line {lines}: {why}, left out')
    return tuple(notes)


def _lost(count: int, kept: IntArray, name: str) -> tuple[str, ...]:
    lost = count - len(np.unique(kept))
    return (f'{lost} standstills of {name} without a point were left out',) * bool(lost)


def _extent(values: FloatArray) -> float:
    return float(np.ptp(values, axis=0).max()) if len(values) else 0.0


def _rows_of(stamps: FloatArray, when: FloatArray) -> IntArray:
    """Return the row of each stamp; equal ones are different rows."""
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
    told: str,
    stream: Stream,
    windows: FloatArray,
    still: Standstills,
) -> float:
    """Return the unit of the points, m."""
    parts = [stream.values[between(stream, *window)] for window in windows]
    seen = [j for j, part in enumerate(parts) if len(part)]
    if not seen:
        return 1.0
    raw = np.array([np.median(parts[j], axis=0) for j in seen])
    modelled = chain.forward(still.mean[seen])[:, :3, 3]
    return LENGTHS[length_unit(*points, told, raw, modelled)[0]]


def _means(
    points: Table, when: FloatArray, windows: FloatArray, scale: float
) -> tuple[IntArray, Table, int]:
    """Return the standstills with a point, their table, and how many readings were unsteady."""
    table, columns = points
    spread = {
        name: tuple(range(len(table.names) + 3 * i, len(table.names) + 3 * i + 3))
        for i, name in enumerate(columns.points)
    }
    width = len(table.names) + 3 * len(spread)
    streams = {}
    for name, own in columns.points.items():
        both = numbers(table, (*own, *columns.orientations.get(name, ())), optional=True)
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
            mean, std, kept = reading
            if not cells:
                first = int(values[kept[0], -1])
                blank = {*columns.point, *columns.others.get('samples', ())}
                cells = ['' if i in blank else cell for i, cell in enumerate(table.rows[first])]
                cells += [''] * (width - len(cells)) + [str(len(kept))]
                lines.append(table.lines[first])
            turned = columns.orientations.get(name, ())
            for column, value in (
                *zip(columns.points[name], mean / scale),
                *zip(spread[name], std / scale),
                *zip(turned, _mean_turn(values[kept, 3:-1]) if turned else ()),
            ):
                cells[column] = '' if np.isnan(value) else _text(value, table.decimal)
        if cells:
            at.append(j)
            rows.append(tuple(cells))
    names = [f'std {axis} of {name or "the point"}' for name in spread for axis in 'xyz']
    others = {kind: list(of) for kind, of in columns.others.items()}
    others['samples'] = [width]
    return (
        np.array(at, dtype=np.int64),
        (
            replace(
                table,
                names=(*table.names, *names, 'samples of the mean'),
                rows=tuple(rows),
                lines=tuple(lines),
            ),
            replace(columns, stds=spread, others=defaultdict(list, others)),
        ),
        unsteady,
    )


def _mean_turn(turns: FloatArray) -> FloatArray:
    """Return the mean of quaternions that are near each other, (4,)."""
    mean = (turns * np.where(turns @ turns[0] < 0.0, -1.0, 1.0)[:, None]).mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _at_rest(
    joints: Table, still: Standstills, at: IntArray, reported: FloatArray, unit: float
) -> Table:
    """Return the joints' table with a row for each of these standstills, the mean of it."""
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
    return f'{value:.12g}'.replace('.', decimal)
