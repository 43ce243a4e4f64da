# SPDX-License-Identifier: Apache-2.0
"""Rows in SI of a table of points and a table of joints that belong together row by row."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Columns, Table
from remaster_ros.importing.headers import AXES
from remaster_ros.importing.raw_rows import RawRows, moving_markers
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.importing.values import joint_values, length_unit, numbers, refuse_far, times
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.observations import LENGTH_TOLERANCE
from remaster_ros.types import AngleUnit, BoolArray, FloatArray, IntArray

# With fewer configurations two equal times may be a coincidence.
_FEWEST_ALIKE = 4
_OTHERS = ('pose', 'configuration', 'split', 'sensor', 'marker')


@dataclass(frozen=True, eq=False)
class PairedTables:
    """Table of points and table of joints, which may be the same, with what was done to them."""

    points: Table
    joints: Table
    # Times of the rows by the clock of the joints, s, (n,); None to take those of the tables.
    stamp_s: FloatArray | None = None
    # How the files were read and joined, a line each, and warnings, a sentence each.
    description: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def noting(
        self, description: Iterable[str] = (), warnings: Iterable[str] = ()
    ) -> PairedTables:
        """Same tables, with lines added to the description and to the warnings."""
        return replace(
            self,
            description=(*self.description, *description),
            warnings=(*self.warnings, *warnings),
        )


@dataclass(frozen=True, eq=False)
class _Readings:
    """Points of the markers as written in a table of n rows, and which of them are used."""

    # (markers, n, 3); NaN where a marker was not seen.
    raw: FloatArray
    # Row of the table and index of the marker of each reading, (m,): rows first.
    row: IntArray
    marker: IntArray
    # Unit of length, and how it is known.
    unit: str
    unit_source: str
    # A sentence on each marker that is left out.
    warnings: tuple[str, ...]


def raw_rows(
    pair: PairedTables, chain: SerialChain, angles: str, length: str, has_times: bool
) -> RawRows:
    """Rows in SI from a table of points and a table of joints that belong together row by row.

    One for each marker seen in a row of the table. `angles`, `length`: units that the user
    stated, '' if none; `has_times`: whether the columns of times are used. Raises InputError
    for missing or faulty numbers, units that do not fit, or points beyond 200 m.
    """
    points, joints = pair.points, pair.joints
    table, columns = points
    q, units, scale = joint_values(*joints, chain, angles)
    readings = _readings(points, chain.forward(q)[:, :3, 3], length)
    row, marker = readings.row, readings.marker
    from_q = _previous_joints(joints, scale, q.shape)
    std, orientation = _stds_and_orientations(points, readings.unit)
    effort = _efforts(pair)
    stamp, time_notes = _stamps(pair, q, has_times)
    temperature = _optional_column(points, 'temperature')[row]
    samples = _optional_column(points, 'samples')[row]
    ambiguous, ambiguous_unit = _ambiguous_orientation(points, row)
    return RawRows(
        source=tuple(table.at(int(i)) for i in row),
        joint_columns=tuple(joints[0].names[i] for i in joints[1].joints),
        q=q[row],
        from_q=from_q[row],
        position=readings.raw[marker, row] * LENGTHS[readings.unit],
        std=std[marker, row],
        stamp_s=None if stamp is None else stamp[row],
        labels=_labels(pair, readings),
        temperature_c=temperature,
        samples=np.nan_to_num(samples, nan=-1.0),
        columns=_meanings_in_tables(pair, chain, units, readings),
        description=pair.description,
        warnings=(*pair.warnings, *readings.warnings, *time_notes),
        points={
            name: tuple(table.names[i] for i in marker_columns)
            for name, marker_columns in columns.points.items()
        },
        length_unit=readings.unit,
        angle_unit=cast(
            AngleUnit | None, next((unit for unit, _ in units if unit in ANGLES), None)
        ),
        reading=row if len(columns.points) > 1 else None,
        orientation=orientation[marker, row] if columns.orientations else None,
        ambiguous_orientation=ambiguous,
        ambiguous_unit=ambiguous_unit,
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


def _readings(points: Table, modelled: FloatArray, stated_unit: str) -> _Readings:
    """Readings of the markers that move with the arm, one for each marker seen in a row.

    `modelled`: positions of the nominal tool, m, (n, 3), by which the unit is guessed if
    neither the user (`stated_unit`) nor the table states it. Raises InputError for part of a
    point, headers with several units, or points beyond 200 m.
    """
    table, columns = points
    several = len(columns.points) > 1
    raw = np.array(
        [numbers(table, marker_columns, several) for marker_columns in columns.points.values()]
    )
    _refuse_part_of_a_point(table, columns, raw)
    # A row of the table for each marker that was seen in it.
    row, marker = np.nonzero(np.isfinite(raw[:, :, 0]).T)
    unit, source = length_unit(table, columns, stated_unit, raw[marker, row], modelled[row])
    refuse_far(table, columns, unit)
    omissions: tuple[str, ...] = ()
    if several:
        moved, omissions = _markers_on_arm(raw, list(columns.points), table)
        row, marker = row[moved[marker]], marker[moved[marker]]
    return _Readings(raw, row, marker, unit, source, omissions)


def _refuse_part_of_a_point(table: TextTable, columns: Columns, raw: FloatArray) -> None:
    """Raise InputError for the first point that has some of X, Y and Z, but not all three.

    Also if there are several markers, and none of them has a point in any row. Rows in which
    all three are empty are valid. `raw`: points by marker, NaN where empty, (markers, n, 3);
    `columns`: has the columns of each marker in `table`.
    """
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


def _markers_on_arm(
    raw: FloatArray, names: Sequence[str], table: TextTable
) -> tuple[BoolArray, tuple[str, ...]]:
    """Mask of the markers that move with the arm, (markers,), by `moving_markers`.

    Last result: a sentence on each other marker, whether unmoved or never seen. `raw`: points
    by marker, NaN where empty, (markers, n, 3); `names`: of the markers; `table`: for the
    sentences.
    """
    moved = moving_markers(raw)
    return moved, tuple(
        f'{table.path}: {name} stays in its place, so it is not on the arm; left out'
        if np.isfinite(marker_points[:, 0]).any()
        else f'{table.path}: {name} was never seen; left out'
        for name, is_moved, marker_points in zip(names, moved, raw)
        if not is_moved
    )


def _previous_joints(joints: Table, scale: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Joint positions from which the arm came, rad or m, of a shape (n, k).

    NaN where a cell is empty, and throughout if the table does not have k such columns.
    `scale`: unit of each joint's column in SI, (k,).
    """
    table, columns = joints
    if len(columns.from_joints) != shape[1]:
        return np.full(shape, np.nan)
    return numbers(table, columns.from_joints, optional=True) * scale


def _stds_and_orientations(points: Table, unit: str) -> tuple[FloatArray, FloatArray]:
    """Standard deviations, m, (markers, n, 3), and quaternions x, y, z, w, (markers, n, 4).

    NaN if unknown. `unit`: of the deviations. Raises InputError for a quaternion whose length is
    not 1.
    """
    table, columns = points
    std = np.full((len(columns.points), len(table.rows), 3), np.nan)
    turns = np.full((len(columns.points), len(table.rows), 4), np.nan)
    for i, name in enumerate(columns.points):
        if name in columns.stds:
            std[i] = numbers(table, columns.stds[name], optional=True) * LENGTHS[unit]
        if name in columns.orientations:
            turns[i] = numbers(table, columns.orientations[name], optional=True)
            _refuse_non_unit_quaternions(table, columns.orientations[name], turns[i])
    return std, turns


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


def _ambiguous_orientation(points: Table, row: IntArray) -> tuple[FloatArray | None, str]:
    """Orientation of unknown convention in the rows used, (m, 3) or (m, 4), and its unit.

    Three angles or four numbers of a quaternion, NaN where empty; unit '' if the header has
    none. None and '' if there are no such columns. `row`: indices of the m rows used.
    """
    table, columns = points
    if not columns.ambiguous_orientation:
        return None, ''
    values = numbers(table, columns.ambiguous_orientation, optional=True)[row]
    return values, columns.units.get(columns.ambiguous_orientation[0], '')


def _efforts(pair: PairedTables) -> FloatArray | None:
    """Measured joint torques, N m, (n, k), NaN where empty; None if the table has no such columns.

    None also if the rows are means over standstills (`PairedTables.stamp_s` is set).
    """
    table, columns = pair.joints
    # Of a stream the torques are those of one moment, and no mean over a standstill.
    if columns.efforts and pair.stamp_s is None:
        return numbers(table, columns.efforts, optional=True)
    return None


def _stamps(
    pair: PairedTables, q: FloatArray, has_times: bool
) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Times of the rows, s, (n,), and a sentence (a tuple of one) if they are unusable.

    Those of `PairedTables.stamp_s`; else, if `has_times`, of the points' table or of the
    joints' table. None if there are none, or if over half of the configurations share one
    time; only the latter has a sentence, else ().
    """
    stamp = pair.stamp_s
    if stamp is None and has_times:
        stamp = times(*pair.points)
        if stamp is None and pair.joints[0] is not pair.points[0]:
            stamp = times(*pair.joints)
    if stamp is not None and (equal := _shared_time_note(stamp, q)):
        return None, (equal,)
    return stamp, ()


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


def _labels(pair: PairedTables, readings: _Readings) -> dict[str, list[str]]:
    """Label of each reading by kind: pose, configuration, split, sensor, marker.

    Only kinds that have a column, in the points' table or else in the joints'. If the points'
    table has columns of several markers, the label 'marker' is the name of the reading's
    marker.
    """
    given: dict[str, list[str]] = {}
    for kind in _OTHERS:
        for text_table, found in (pair.points, pair.joints):
            column = found.first_of_kind(kind)
            if column is not None and kind not in given:
                given[kind] = [text_table.rows[i][column] for i in readings.row]
    names = list(pair.points[1].points)
    if len(names) > 1:
        given['marker'] = [names[i] for i in readings.marker]
    return given


def _meanings_in_tables(
    pair: PairedTables,
    chain: SerialChain,
    units: Sequence[tuple[str, str]],
    readings: _Readings,
) -> dict[str, str]:
    """Meaning of each column in words, by its name; 'not used' if it has none.

    If there are two files, by 'file: name'. `units`: unit of each joint, and how it is known.
    """
    points, joints = pair.points, pair.joints
    table, columns = points
    meanings: dict[str, str] = {}
    both = [points] if joints[0].path == table.path else [points, joints]
    for text_table, found in both:
        prefix = f'{text_table.path.name}: ' if len(both) > 1 else ''
        is_joints, is_points = found is joints[1], found is columns
        meaning = _column_meanings(
            found if is_joints else replace(found, joints=(), from_joints=(), efforts=()),
            chain,
            tuple(f'{unit} ({how})' for unit, how in units),
            f'{readings.unit} ({readings.unit_source})' if is_points else '',
        )
        meanings |= {
            f'{prefix}{name}': meaning.get(i, 'not used')
            for i, name in enumerate(text_table.names)
        }
    return meanings


def _column_meanings(
    columns: Columns, chain: SerialChain, units: Sequence[str], length: str
) -> dict[int, str]:
    """Meaning of each used column in words, by column index from 0.

    `units`: unit of each joint as text; `length`: unit of the points as text, '' to leave out
    their columns.
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
