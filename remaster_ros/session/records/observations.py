# SPDX-License-Identifier: Apache-2.0
"""observations.csv: format of its lines, and conversion of lines to checked columns.

The journal has the same lines (see `session_writer`). Errors name line and column.
"""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import LEVER_M, LIMIT_TOLERANCE_RAD, SerialChain
from remaster_ros.kinematics.transforms import inverse_poses
from remaster_ros.session.files import decode_text, refuse_utf16
from remaster_ros.session.records.observation_rules import (
    SPLITS,
    RowKeys,
    SequenceRules,
    row_keys,
    split_indices,
)
from remaster_ros.types import (
    FARTHEST_M,
    BoolArray,
    FloatArray,
    IntArray,
    Measurements,
    Observation,
)

log = logging.getLogger('remaster_ros')

MOVING = ('velocity', 'acceleration')
"""Fields of an observation whose columns sessions of a moving arm have, and no others."""
OPTIONAL = ('frame', 'orientation', 'effort', 'wanted', 'correction', *MOVING)
"""Fields of an observation whose columns are optional."""
OMITTABLE = ('from_q', 'std', 'samples', 'temperature_c')
"""Fields whose columns are always written, but are optional in files of other programs."""
STATES = ('off', 'on')
LENGTH_TOLERANCE = 1e-3
"""Largest accepted deviation of the length of a quaternion from 1."""
_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_NUMBER_CHARACTERS = re.compile(r'[0-9+\-.eE,]*')
_INTEGER_CHARACTERS = re.compile(r'[0-9+\-,]*')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')


class Table:
    """Cells of observations.csv as text, by column name; knows their lines for error messages."""

    def __init__(self, path: Path, names: list[str], lines: list[str], first_line: int) -> None:
        self.path = path
        self.first_line = first_line
        self.rows = len(lines)
        width = len(names)
        for number, line in enumerate(lines, start=first_line):
            # Without quotes, counting commas is counting columns.
            found = len(split_line(line, path, number)) if '"' in line else line.count(',') + 1
            if found != width:
                raise InputError(
                    f'{path}, line {number}: {found} columns instead of the {width} of the '
                    'header; give every column, empty where unknown'
                )
        text = ','.join(lines)
        # One flat list: millions of cells in a list per row would keep the garbage collector busy.
        cells = split_line(text, path, first_line) if '"' in text else text.split(',')
        self.cells = {name: cells[i::width] for i, name in enumerate(names)}

    def fault(self, row: int, column: str, problem: str) -> InputError:
        """Return the InputError for one cell: file, line, column, the cell's text and the problem.

        ``row``: from 0, without the header; ``problem``: end of the sentence.
        """
        cell = self.cells[column][row]
        shown = repr(cell if len(cell) <= 40 else cell[:40] + '…')
        line = self.first_line + row
        return InputError(f'{self.path}, line {line}, column {column}: {shown} {problem}')

    def refuse(self, wrong: BoolArray, problems: Mapping[str, str]) -> None:
        """Raise an InputError on the first wrong cell; nothing if there is none.

        ``wrong``: True for wrong cells, (n, columns); ``problems``: column name -> end of the
        sentence of the error, in the order of the columns of ``wrong``.
        """
        for row, column in np.argwhere(wrong)[:1]:
            name = list(problems)[column]
            raise self.fault(int(row), name, problems[name])

    def integers(self, column: str, least: int | None = None) -> IntArray:
        """Return a column of integers, (n,).

        With `least` the column is optional: integers from `least` (above -1) on, -1 for an empty
        cell. Raises InputError at the first other cell.
        """
        given = self.cells[column]
        cells = given if least is None else [cell or '-1' for cell in given]
        try:
            values = np.array(list(map(int, cells)), dtype=np.int64)
        except (ValueError, OverflowError):
            values = None
        # int() also reads 1_000, blanks and other scripts' digits.
        if values is None or not _INTEGER_CHARACTERS.fullmatch(','.join(cells)):
            row = next(i for i, cell in enumerate(cells) if not _INTEGER.fullmatch(cell))
            raise self.fault(row, column, 'is not an integer; correct it')
        if least is not None:
            few = (values < least) & (np.array(given) != '')
            self.refuse(
                few[:, None], {column: f'is less than {least}; leave it empty where unknown'}
            )
        return values

    def numbers(self, columns: Sequence[str], optional: bool = False) -> FloatArray:
        """Return columns of finite numbers, (n, len(columns)); NaN if optional and empty.

        Raises InputError at the first other cell.
        """
        result = np.empty((self.rows, len(columns)))
        for i, column in enumerate(columns):
            cells = self.cells[column]
            empty, blank = (cells.count(''), 'nan') if optional else (0, '')
            try:
                result[:, i] = [float(cell or blank) for cell in cells]
            except ValueError:
                raise self._not_a_number(column, optional) from None
            # float() also reads nan, inf, 1_000, blanks and other scripts' digits.
            plain = _NUMBER_CHARACTERS.fullmatch(','.join(cells))
            if not plain or np.count_nonzero(np.isfinite(result[:, i])) + empty < self.rows:
                raise self._not_a_number(column, optional)
        return result

    def whole_or_empty(self, columns: Sequence[str]) -> FloatArray:
        """Return optional columns, of which each row fills all or none (NaN), (n, len(columns)).

        Raises InputError at the first row that fills some, or the first cell that is no finite
        number.
        """
        values = self.numbers(columns, optional=True)
        unknown = np.isnan(values)
        problem = (
            f'is empty though others of {columns[0]} … {columns[-1]} are not; fill all of them or '
            'none'
        )
        self.refuse(unknown & ~unknown.all(axis=1, keepdims=True), dict.fromkeys(columns, problem))
        return values

    def choices(self, column: str, names: Sequence[str], remedy: str) -> IntArray:
        """Return the index of every cell among `names`, (n,).

        Raises InputError, with the remedy, at the first cell that is none of them.
        """
        index = {name: i for i, name in enumerate(names)}
        values = np.array([index.get(cell, -1) for cell in self.cells[column]], dtype=np.int64)
        self.refuse(values[:, None] < 0, {column: remedy})
        return values

    def _not_a_number(self, column: str, optional: bool) -> InputError:
        """Return the InputError of the first cell of a column that is not a finite number.

        With ``optional`` an empty cell is valid. There has to be such a cell.
        """
        row = next(
            row
            for row, cell in enumerate(self.cells[column])
            if not (optional and not cell)
            and not (_NUMBER.fullmatch(cell) and math.isfinite(float(cell)))
        )
        remedy = 'leave the field empty where unknown' if optional else 'leave the row out'
        return self.fault(row, column, f'is not a finite number; correct it or {remedy}')


def split_line(line: str, path: Path, number: int) -> list[str]:
    """Return the cells of one line; ``number``: of the line, for the message.

    Raises InputError if quotes are not closed.
    """
    if '"' not in line:
        return line.split(',')
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise InputError(f'{path}, line {number}: {error}; correct the quotes') from None


def column_names(
    joints: int, slides: Sequence[bool] | BoolArray | None = None, moving: bool = False
) -> dict[str, list[str]]:
    """Return the columns of each field of `Observation`, as written; joints count from 1.

    ``slides``: whether each joint is prismatic, (k,): its positions are in m, its efforts in N;
    ``moving``: with the `MOVING` fields.
    """
    lengths = [False] * joints if slides is None else list(slides)

    def of_joints(prefix: str, turning: str = 'rad', sliding: str = 'm') -> list[str]:
        return [
            f'{prefix}{i}_{sliding if length else turning}'
            for i, length in enumerate(lengths, start=1)
        ]

    single = ('observation', 'pose', 'configuration', 'split', 'stamp_s', 'sensor', 'marker')
    columns = {
        **{name: [name] for name in single},
        'q': of_joints('q'),
        'from_q': of_joints('from_q'),
        'position': ['x_m', 'y_m', 'z_m'],
        'std': ['std_x_m', 'std_y_m', 'std_z_m'],
        **{name: [name] for name in ('samples', 'temperature_c', 'frame')},
        'orientation': [f'orientation_{axis}' for axis in 'xyzw'],
        'effort': of_joints('effort', 'nm', 'n'),
        'wanted': of_joints('wanted'),
        'correction': ['correction'],
    }
    if moving:
        columns['velocity'] = of_joints('velocity', 'rad_s', 'm_s')
        columns['acceleration'] = of_joints('acceleration', 'rad_s2', 'm_s2')
    return columns


class RowFormat:
    """Format of observations.csv of one session.

    ``sensors``, ``markers``: names in the order of session.yaml; ``optional``: the `OPTIONAL`
    fields of lines to be written; ``within_limits``: refuse joint angles outside the robot's
    limits; ``moving``: the columns of `MOVING` are there.
    """

    def __init__(
        self,
        path: Path,
        chain: SerialChain,
        sensors: Sequence[str],
        markers: Sequence[str],
        optional: Collection[str] = (),
        within_limits: bool = True,
        moving: bool = False,
    ) -> None:
        self._path, self._chain = path, chain
        self._sensors, self._markers = sensors, markers
        self._within_limits = within_limits
        self._columns = column_names(len(chain), chain.slides, moving)
        self._absent = [name for name in OPTIONAL if name not in optional]
        self._written = [
            name
            for field, names in self._columns.items()
            if field not in self._absent
            for name in names
        ]
        self._moving = moving

    @property
    def header(self) -> str:
        """The first line, with its end."""
        return ','.join(self._written) + '\n'

    def line(self, o: Observation) -> str:
        """Return an observation as a line without its end; numbers are exact, unknown ones empty.

        Optional fields that the format does not write are dropped.
        """
        joints = len(o.q)
        cells: dict[str, list[str]] = {
            'observation': [str(int(o.observation))],
            'pose': [str(int(o.pose))],
            'configuration': [str(int(o.configuration))],
            'split': [o.split],
            'stamp_s': _numbers([o.stamp_s], 1),
            'sensor': [o.sensor],
            'marker': [o.marker],
            'q': _numbers(o.q, joints),
            'from_q': _numbers(o.from_q, joints),
            'position': _numbers(o.position, 3),
            'std': _numbers(o.std, 3),
            'samples': ['' if o.samples is None else str(int(o.samples))],
            'temperature_c': _numbers(None if o.temperature_c is None else [o.temperature_c], 1),
            'frame': ['' if o.frame is None else str(int(o.frame))],
            'orientation': _numbers(o.orientation, 4),
            'effort': _numbers(o.effort, joints),
            'wanted': _numbers(o.wanted, joints),
            'correction': ['' if o.correction is None else STATES[o.correction]],
            'velocity': _numbers(o.velocity, joints),
            'acceleration': _numbers(o.acceleration, joints),
        }
        for field in self._absent:
            del cells[field]
        return ','.join(cell for of_field in cells.values() for cell in of_field)

    def text(self, m: Measurements) -> str:
        """Return all observations as the text of the file with its header, unchecked."""
        rows = observations_of(m, self._sensors, self._markers)
        return self.header + ''.join(f'{self.line(row)}\n' for row in rows)

    def parse(self, data: bytes) -> Measurements:
        """Read the bytes of the file; an InputError names file, line, column and remedy.

        Lines that were cut off are dropped with a warning: a last line without its end, and last
        lines with the zeros that a power cut leaves.
        """
        path = self._path
        # Before the zeros of UTF-16 are taken for those of a power cut.
        refuse_utf16(data, path)
        end = _whole_lines(data, most=len(self._sensors) * len(self._markers))
        if end < len(data):
            torn = data.count(b'\n', 0, end) + 1
            log.warning('%s, line %d: cut off while being written, and dropped', path, torn)
        lines = decode_text(data[:end], path).replace('\r\n', '\n').split('\n')[:-1]
        while lines and not lines[-1]:
            lines.pop()
        if not lines:
            raise InputError(f'{path}: no header line; the first line names the columns')
        _refuse_other_separators(lines[0], path)
        names = split_line(lines[0], path, 1)
        _check_names(names, self._columns, path)
        if len(lines) < 2:
            raise InputError(f'{path}: no observations below the header; measure before fitting')
        table = Table(path, names, lines[1:], first_line=2)
        for field in OMITTABLE:
            for name in self._columns[field]:
                table.cells.setdefault(name, [''] * table.rows)
        measurements = self._convert(table)
        self._accept(measurements, 2, SequenceRules())
        return measurements

    def check(self, rows: Sequence[str], first_line: int, rules: SequenceRules) -> list[RowKeys]:
        """Check lines to be written as a reader would; return their keys, [] for no lines.

        ``first_line``: line number of the first one; ``rules``: the rows are added to them. Raises
        InputError, naming file, line and column, at the first invalid one.
        """
        if not rows:
            return []
        table = Table(self._path, self._written, list(rows), first_line)
        return self._accept(self._convert(table), first_line, rules)

    def _accept(self, m: Measurements, first_line: int, rules: SequenceRules) -> list[RowKeys]:
        """Check rows against the rules, and add them; raise InputError at the first violation.

        Rows before a violation stay in the rules.
        """
        keys = list(row_keys(m, first_line))
        for row in keys:
            if problem := rules.problem(row):
                raise InputError(f'{self._path}, line {row.line}, {problem}')
            rules.accept(row)
        return keys

    def _convert(self, table: Table) -> Measurements:
        """Return the columns of a table, each checked by itself.

        Raises InputError for text that is no number or unknown name, a quaternion off length 1
        by over 0.001, a negative std, joints outside the limits (if these are checked), or a
        point with a coordinate beyond `FARTHEST_M`.
        """
        columns, chain = self._columns, self._chain

        def given(field: str) -> bool:
            return columns[field][0] in table.cells

        def of_motion(field: str) -> FloatArray | None:
            return table.whole_or_empty(columns[field]) if self._moving else None

        split = table.choices('split', SPLITS, f'is none of {", ".join(SPLITS)}; correct it')
        is_reference = split == SPLITS.index('reference')
        states = ('', *STATES)
        measurements = Measurements(
            observation=table.integers('observation'),
            pose=table.integers('pose'),
            configuration=table.integers('configuration'),
            is_validation=split == SPLITS.index('validation'),
            stamp_s=table.numbers(['stamp_s'])[:, 0],
            sensor=table.choices('sensor', self._sensors, _not_among('sensors', self._sensors)),
            marker=table.choices('marker', self._markers, _not_among('markers', self._markers)),
            q=table.numbers(columns['q']),
            from_q=table.whole_or_empty(columns['from_q']),
            position=table.numbers(columns['position']),
            std=table.whole_or_empty(columns['std']),
            samples=table.integers('samples', least=1),
            temperature_c=table.numbers(['temperature_c'], optional=True)[:, 0],
            effort=table.numbers(columns['effort'], optional=True) if given('effort') else None,
            is_reference=is_reference if is_reference.any() else None,
            frame=table.integers('frame', least=0) if given('frame') else None,
            orientation=table.whole_or_empty(columns['orientation'])
            if given('orientation')
            else None,
            wanted=table.whole_or_empty(columns['wanted']) if given('wanted') else None,
            correction=table.choices(
                'correction', states, 'is neither on nor off; leave it empty where unknown'
            )
            - 1
            if given('correction')
            else None,
            velocity=of_motion('velocity'),
            acceleration=of_motion('acceleration'),
        )
        if measurements.orientation is not None:
            length = np.linalg.norm(measurements.orientation, axis=1, keepdims=True)
            problem = 'and the three beside it are no quaternion of length 1; correct them'
            wrong = np.abs(length - 1.0) > LENGTH_TOLERANCE
            table.refuse(wrong, {columns['orientation'][0]: problem})
        negative = dict.fromkeys(columns['std'], 'is negative; correct it')
        table.refuse(measurements.std < 0, negative)
        words = {
            'rad': ('1 degree', 'radians'),
            'm': (f'{1e3 * LEVER_M * LIMIT_TOLERANCE_RAD:.1f} mm', 'metres'),
        }
        problems = [
            f'{unit} is more than {words[unit][0]} outside the limits of {joint} ({lower:.6g} to '
            f'{upper:.6g} {unit}); are the units {words[unit][1]}, the joints base to tip, and '
            'the limits of the URDF right?'
            for joint, lower, upper, unit in zip(
                chain.joint_names, chain.lower, chain.upper, chain.units
            )
        ]
        for field in ('q', 'from_q', 'wanted') if self._within_limits else ():
            if (q := getattr(measurements, field)) is not None:
                below = q < chain.lower - chain.limit_tolerance
                above = q > chain.upper + chain.limit_tolerance
                table.refuse(below | above, dict(zip(columns[field], problems)))
        far = f'm is further than {FARTHEST_M:g} m away, beyond any sensor; are the units metres?'
        outside = np.abs(measurements.position) > FARTHEST_M
        table.refuse(outside, dict.fromkeys(columns['position'], far))
        return measurements


def _refuse_other_separators(header: str, path: Path) -> None:
    """Raise InputError if a header has more semicolons, or more tabs, than commas."""
    for separator, name in ((';', 'semicolons'), ('\t', 'tabs')):
        if header.count(separator) > header.count(','):
            raise InputError(
                f'{path}, line 1: columns are separated by {name}; save it with commas between '
                'them, and with points in the numbers'
            )


def _whole_lines(data: bytes, most: int) -> int:
    """Return the number of bytes at the beginning that are whole lines, not torn by a crash.

    Behind them are a line without its end, or last lines with zeros, as a power cut leaves
    them. ``most``: largest number of rows of a configuration, which are written together:
    zeros in earlier rows are not the effect of a crash, and are kept for the reader to refuse.
    """
    end = data.rfind(b'\n') + 1
    zero = data.find(b'\0')
    if zero < 0 or data.count(b'\n', zero) > most:
        return end
    return data.rfind(b'\n', 0, zero) + 1


def observations_of(
    m: Measurements, sensors: Sequence[str], markers: Sequence[str]
) -> Iterator[Observation]:
    """Yield each row of measurements as an `Observation`, with None for NaN or -1.

    ``sensors, markers``: names by index.
    """

    def rows(values: FloatArray | None) -> Iterator[FloatArray | None]:
        if values is None:
            return repeat(None, len(m))
        return (None if np.isnan(row).all() else row for row in values)

    def counts(values: IntArray | None) -> Iterator[int | None]:
        if values is None:
            return repeat(None, len(m))
        return (value if value >= 0 else None for value in values.tolist())

    corrections = (None if flag is None else bool(flag) for flag in counts(m.correction))
    return map(
        Observation,
        *(m.observation.tolist(), m.pose.tolist(), m.configuration.tolist()),
        (SPLITS[split] for split in split_indices(m).tolist()),
        m.stamp_s.tolist(),
        (sensors[i] for i in m.sensor.tolist()),
        (markers[i] for i in m.marker.tolist()),
        *(m.q, m.position, rows(m.from_q), rows(m.std), counts(m.samples)),
        (None if value != value else value for value in m.temperature_c.tolist()),
        *(counts(m.frame), rows(m.orientation), rows(m.wanted), corrections, rows(m.effort)),
        *(rows(m.velocity), rows(m.acceleration)),
    )


def optional_of(m: Measurements) -> list[str]:
    """Return the `OPTIONAL` fields that are not None in measurements, in that order."""
    return [name for name in OPTIONAL if getattr(m, name) is not None]


def stacked(parts: Sequence[Measurements]) -> Measurements:
    """Return the rows of all parts, one after the other.

    Fields that only some parts have are unknown (NaN, -1 or False) in the others, fields that none
    has stay None. At least one part.
    """
    columns: dict[str, Any] = {}
    for name in vars(parts[0]):
        values = [getattr(part, name) for part in parts]
        known = next((value for value in values if value is not None), None)
        columns[name] = (
            None
            if known is None
            else np.concatenate(
                [
                    _unknown(known, len(part)) if value is None else value
                    for part, value in zip(parts, values, strict=True)
                ]
            )
        )
    return Measurements(**columns)


def _unknown(like: NDArray[Any], count: int) -> NDArray[Any]:
    """Return a column of unknown values, (count, ...): NaN, -1 or False, by its type."""
    fill = {'f': np.nan, 'i': -1, 'b': False}[like.dtype.kind]
    return np.full((count, *like.shape[1:]), fill, dtype=like.dtype)


def _check_names(names: list[str], columns: Mapping[str, list[str]], path: Path) -> None:
    """Raise InputError for a missing or repeated column, or one in a wrong unit.

    ``names``: of the header; ``columns``: of `column_names`. Unknown columns are only logged.
    """
    where = f'{path}, line 1'
    for name in names:
        if names.count(name) > 1:
            raise InputError(f'{where}: column {name[:40]!r} is given twice; keep one')
    axes = columns['orientation']
    turned = [name for name in axes if name in names]
    if turned and len(turned) < len(axes):
        raise InputError(
            f'{where}: of the columns {", ".join(axes)} only {", ".join(turned)} are '
            'there; give all or none'
        )
    for field in ('q', 'from_q', 'effort', 'wanted', *MOVING):
        if field not in columns:
            continue
        wanted = columns[field]
        prefix, suffix = wanted[0].split('1', 1)
        pattern = re.compile(f'({prefix}[0-9]+)_(rad|m|nm|n)(_s2?)?')
        found = [name for name in names if pattern.fullmatch(name)]
        by_number = {pattern.sub(r'\1', name): name for name in wanted}
        for name in found:
            right = by_number.get(pattern.sub(r'\1', name), name)
            if name != right:
                slides = pattern.sub(r'\2', right) in ('m', 'n')
                raise InputError(
                    f'{where}: column {name}: joint {right[len(prefix) :].partition("_")[0]} of '
                    f'the URDF {"slides" if slides else "turns"}, so its '
                    f'column is {right}; write it so, in that unit, or correct the URDF'
                )
        if set(found) != set(wanted) and (found or field in ('q', *MOVING)):
            raise InputError(
                f'{where}: {len(found)} columns {prefix}…{suffix} for the {len(wanted)} joints '
                f'of the robot between its base_link and tip_link; give {wanted[0]} to '
                f'{wanted[-1]}, or the right URDF and links in session.yaml'
            )
    needed = [field for field in columns if field not in (*OPTIONAL, *OMITTABLE)]
    missing = [name for field in needed for name in columns[field] if name not in names]
    if missing:
        raise InputError(
            f'{where}: column {", ".join(missing)} is missing; add it (docs/session-format.md), '
            'or let "remaster import" make a session of this table'
        )
    known = set().union(*columns.values())
    unknown = [name for name in names if name not in known]
    if unknown:
        log.warning('%s: unknown columns are not used: %s', where, ', '.join(map(repr, unknown)))


def inverted_readings(m: Measurements, sensors: Sequence[int], where: str) -> Measurements:
    """Return rows in which the poses measured by sensors on the tool are inverted.

    ``sensors``: indices of these sensors. Poses of a fixed body in the sensor's frame become
    poses of the sensor in the body's frame, and these become those again. Without rows of
    these sensors the same object is returned, else a copy. Raises InputError, which begins
    with ``where``, if one of their rows has no orientation.
    """
    mine = np.flatnonzero(np.isin(m.sensor, sensors))
    if len(mine) == 0:
        return m
    if m.orientation is None or np.isnan(m.orientation[mine]).any():
        unknown = [] if m.orientation is None else mine[np.isnan(m.orientation[mine, 0])]
        row = int(m.observation[unknown[0] if len(unknown) else mine[0]])
        raise InputError(
            f'{where}: observation {row} has no orientation, without which a reading of a sensor '
            'on the tool tells nothing; leave the row out'
        )
    position, orientation = m.position.copy(), m.orientation.copy()
    position[mine], orientation[mine] = inverse_poses(position[mine], orientation[mine])
    return replace(m, position=position, orientation=orientation)


def _not_among(key: str, names: Sequence[str]) -> str:
    """Return the end of the message for a name that session.yaml does not have under ``key``."""
    return f'is not among the {key} of session.yaml ({", ".join(names)}); correct either'


def _numbers(values: FloatArray | Sequence[float] | None, count: int) -> list[str]:
    """Return numbers as cells of text, exact; '' for NaN. For None ``count`` empty cells."""
    if values is None:
        return [''] * count
    numbers = np.asarray(values, float).tolist()
    return [repr(number) if number == number else '' for number in numbers]
