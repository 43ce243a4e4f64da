"""observations.csv: text to checked columns and back, every fault named by line and column."""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.chain import SerialChain
from ..core.errors import InputError
from ..core.types import BoolArray, FloatArray, IntArray, Measurements, Observation
from .files import decode_text

log = logging.getLogger('remaster_ros')

LIMIT_TOLERANCE_RAD = math.radians(1.0)
SPLITS = ('optimization', 'validation')

_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_NUMBER_CHARACTERS = re.compile(r'[0-9+\-.eE,]*')
_INTEGER_CHARACTERS = re.compile(r'[0-9+\-,]*')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')


@dataclass(frozen=True)
class Columns:
    """The column names of a session with k joints, in the order this package writes them."""

    joints: int

    @property
    def q(self) -> list[str]:
        """Reported joint positions."""
        return [f'q{i}_rad' for i in range(1, self.joints + 1)]

    @property
    def from_q(self) -> list[str]:
        """Joint positions the arm came from."""
        return [f'from_q{i}_rad' for i in range(1, self.joints + 1)]

    @property
    def effort(self) -> list[str]:
        """Measured joint torques; these columns are optional."""
        return [f'effort{i}_nm' for i in range(1, self.joints + 1)]

    position = ('x_m', 'y_m', 'z_m')
    std = ('std_x_m', 'std_y_m', 'std_z_m')

    def names(self, with_effort: bool = False) -> list[str]:
        """Return every column's name."""
        return [
            *('observation', 'pose', 'configuration', 'split', 'stamp_s', 'sensor', 'marker'),
            *(*self.q, *self.from_q, *self.position, *self.std, 'samples', 'temperature_c'),
            *(self.effort if with_effort else ()),
        ]


class _Table:
    """Cells as text by column name, with what an error message needs to name a place."""

    def __init__(self, path: Path, names: list[str], lines: list[str], first_line: int) -> None:
        self.path = path
        self.first_line = first_line
        self.rows = len(lines)
        width = len(names)
        for number, line in enumerate(lines, start=first_line):
            # Without quotes, counting commas is counting columns.
            found = len(_fields(line, path, number)) if '"' in line else line.count(',') + 1
            if found != width:
                raise InputError(
                    f'{path}, line {number}: {found} columns instead of the {width} of the '
                    'header; give every column, empty where unknown'
                )
        text = ','.join(lines)
        # One flat list: millions of cells in a list per row would keep the garbage collector busy.
        cells = _fields(text, path, first_line) if '"' in text else text.split(',')
        self.cells = {name: cells[i::width] for i, name in enumerate(names)}

    def fault(self, row: int, column: str, problem: str) -> InputError:
        """Return the error for one cell."""
        cell = self.cells[column][row]
        shown = repr(cell if len(cell) <= 40 else cell[:40] + '…')
        line = self.first_line + row
        return InputError(f'{self.path}, line {line}, column {column}: {shown} {problem}')

    def integers(self, column: str, optional: bool = False) -> IntArray:
        """Return a column of integers; -1 stands for an empty cell of an optional column."""
        cells = self.cells[column]
        if optional:
            cells = [cell or '-1' for cell in cells]
        try:
            values = np.array(list(map(int, cells)), dtype=np.int64)
        except (ValueError, OverflowError):
            values = None
        # int() also reads 1_000, blanks and other scripts' digits.
        if values is None or not _INTEGER_CHARACTERS.fullmatch(','.join(cells)):
            row = next(i for i, cell in enumerate(cells) if not _INTEGER.fullmatch(cell))
            raise self.fault(row, column, 'is not an integer; correct it')
        return values

    def numbers(self, columns: Sequence[str], optional: bool = False) -> FloatArray:
        """Return columns of finite numbers, (n, len(columns)); NaN where optional and empty."""
        result = np.empty((self.rows, len(columns)))
        for i, column in enumerate(columns):
            cells = self.cells[column]
            empty = 0
            try:
                if optional:
                    values = [float(cell) if cell else math.nan for cell in cells]
                    empty = cells.count('')
                else:
                    values = list(map(float, cells))
                result[:, i] = values
            except ValueError:
                raise self._not_a_number(column, optional) from None
            # float() also reads nan, inf, 1_000, blanks and other scripts' digits.
            plain = _NUMBER_CHARACTERS.fullmatch(','.join(cells))
            if not plain or np.count_nonzero(np.isfinite(result[:, i])) + empty < self.rows:
                raise self._not_a_number(column, optional)
        return result

    def whole_or_empty(self, columns: Sequence[str]) -> FloatArray:
        """Return optional columns of which a row fills all or none."""
        values = self.numbers(columns, optional=True)
        unknown = np.isnan(values)
        partial = np.flatnonzero(unknown.any(axis=1) & ~unknown.all(axis=1))
        if len(partial):
            row = int(partial[0])
            column = columns[int(np.argmax(unknown[row]))]
            raise self.fault(
                row, column, f'is empty though others of {columns[0]} … {columns[-1]} are not; '
                'fill all of them or none'
            )  # fmt: skip
        return values

    def choices(self, column: str, names: Sequence[str], remedy: str) -> IntArray:
        """Return the index of every cell among `names`."""
        index = {name: i for i, name in enumerate(names)}
        values = np.array([index.get(cell, -1) for cell in self.cells[column]], dtype=np.int64)
        if (values < 0).any():
            raise self.fault(int(np.argmin(values)), column, remedy)
        return values

    def _not_a_number(self, column: str, optional: bool) -> InputError:
        row = next(
            row
            for row, cell in enumerate(self.cells[column])
            if not (optional and not cell)
            and not (_NUMBER.fullmatch(cell) and math.isfinite(float(cell)))
        )
        remedy = 'leave the field empty where unknown' if optional else 'leave the row out'
        return self.fault(row, column, f'is not a finite number; correct it or {remedy}')


class RowKeys(NamedTuple):
    """What the rules between rows are about, of one row."""

    line: int
    observation: int
    pose: int
    configuration: int
    is_validation: bool
    stamp_s: float


class SequenceRules:
    """What must hold between rows, given in their order.

    Observation numbers are unique and grow with time, time never runs backwards, a pose belongs
    to one split and a configuration to one pose.
    """

    def __init__(self) -> None:
        self._last: RowKeys | None = None
        self._of_observation: dict[int, RowKeys] = {}
        self._of_pose: dict[int, RowKeys] = {}
        self._of_configuration: dict[int, RowKeys] = {}

    def problem(self, row: RowKeys) -> str:
        """Return '' or what is wrong with the next row: "column …: …; remedy"."""
        same = self._of_observation.get(row.observation)
        if same is not None:
            return (
                f'column observation: {row.observation} is already on line {same.line}; '
                'number every row once'
            )
        last = self._last
        if last is not None and row.observation < last.observation:
            return (
                f'column observation: {row.observation} comes after {last.observation}; '
                'number the rows in the order measured'
            )
        if last is not None and row.stamp_s < last.stamp_s:
            return (
                f'column stamp_s: {row.stamp_s} is before the row above it ({last.stamp_s}): '
                'time runs backwards; give the rows in the order measured'
            )
        same = self._of_pose.get(row.pose)
        if same is not None and same.is_validation != row.is_validation:
            return (
                f'column split: pose {row.pose} is {SPLITS[same.is_validation]} on line '
                f'{same.line} and {SPLITS[row.is_validation]} here; give a pose one split'
            )
        same = self._of_configuration.get(row.configuration)
        if same is not None and same.pose != row.pose:
            return (
                f'column configuration: {row.configuration} belongs to pose {same.pose} on line '
                f'{same.line} and to pose {row.pose} here; give a configuration one pose'
            )
        return ''

    def accept(self, row: RowKeys) -> None:
        """Take a row without a problem as the last one."""
        self._last = row
        self._of_observation[row.observation] = row
        self._of_pose.setdefault(row.pose, row)
        self._of_configuration.setdefault(row.configuration, row)


def parse_observations(
    data: bytes,
    path: Path,
    chain: SerialChain,
    sensors: Sequence[str],
    markers: Sequence[str],
) -> Measurements:
    """Read observations.csv.

    A last line without its line end was cut while it was written: it is dropped with a warning.

    Parameters
    ----------
    data
        The file's bytes.
    path
        Its name, for messages.
    chain
        The robot, for the number of joints and their limits.
    sensors, markers
        The names in session.yaml, in their order.

    Raises
    ------
    InputError
        One line naming file, line, column and remedy.
    """
    end = data.rfind(b'\n') + 1
    if end < len(data):
        torn = data.count(b'\n') + 1
        log.warning('%s, line %d: cut off while being written, and dropped', path, torn)
    lines = decode_text(data[:end], path).replace('\r\n', '\n').split('\n')[:-1]
    while lines and not lines[-1]:
        lines.pop()
    if not lines:
        raise InputError(f'{path}: no header line; the first line names the columns')
    names = _fields(lines[0], path, 1)
    columns = Columns(len(chain))
    with_effort = _check_names(names, columns, path)
    if len(lines) < 2:
        raise InputError(f'{path}: no observations below the header; measure before fitting')
    table = _Table(path, names, lines[1:], first_line=2)
    measurements = _columns(table, columns, chain, sensors, markers, with_effort)
    if not _keeps_the_rules(measurements):
        rules = SequenceRules()
        for row in _row_keys(measurements, first_line=2):
            if problem := rules.problem(row):
                raise InputError(f'{path}, line {row.line}, {problem}')
            rules.accept(row)
    return measurements


def check_row(
    text: str,
    line: int,
    path: Path,
    chain: SerialChain,
    sensors: Sequence[str],
    markers: Sequence[str],
    rules: SequenceRules,
) -> RowKeys:
    """Hold one row about to be written to what the reader will demand of it.

    Raises
    ------
    InputError
        As `parse_observations`.
    """
    columns = Columns(len(chain))
    table = _Table(path, columns.names(), [text.rstrip('\n')], first_line=line)
    measurements = _columns(table, columns, chain, sensors, markers, with_effort=False)
    row = next(_row_keys(measurements, first_line=line))
    if problem := rules.problem(row):
        raise InputError(f'{path}, line {line}, {problem}')
    return row


def format_header(joints: int, with_effort: bool = False) -> str:
    """Return the header line of observations.csv."""
    return ','.join(Columns(joints).names(with_effort)) + '\n'


def format_observation(observation: Observation) -> str:
    """Return one observation as a line of the file; numbers survive the round trip exactly."""
    o = observation
    unknown = [''] * len(o.q)
    cells = [
        *(str(int(o.observation)), str(int(o.pose)), str(int(o.configuration)), o.split),
        *(_text(o.stamp_s), o.sensor, o.marker),
        *map(_text, o.q),
        *(unknown if o.from_q is None else map(_text, o.from_q)),
        *map(_text, o.position),
        *([''] * 3 if o.std is None else map(_text, o.std)),
        '' if o.samples is None else str(int(o.samples)),
        '' if o.temperature_c is None else _text(o.temperature_c),
    ]
    return ','.join(cells) + '\n'


def format_measurements(m: Measurements, sensors: Sequence[str], markers: Sequence[str]) -> str:
    """Return all observations as the text of the file, header included."""

    def numbers(values: FloatArray) -> list[list[str]]:
        return [
            [repr(number) if number == number else '' for number in column]
            for column in values.T.tolist()
        ]

    cells = [
        *(list(map(str, ids.tolist())) for ids in (m.observation, m.pose, m.configuration)),
        [SPLITS[split] for split in m.is_validation.tolist()],
        *numbers(m.stamp_s[:, None]),
        [sensors[sensor] for sensor in m.sensor.tolist()],
        [markers[marker] for marker in m.marker.tolist()],
        *(column for values in (m.q, m.from_q, m.position, m.std) for column in numbers(values)),
        [str(samples) if samples >= 0 else '' for samples in m.samples.tolist()],
        *numbers(m.temperature_c[:, None]),
        *(numbers(m.effort) if m.effort is not None else ()),
    ]
    lines = map(','.join, zip(*cells, strict=True))
    return format_header(m.q.shape[1], m.effort is not None) + ''.join(f'{row}\n' for row in lines)


def _fields(line: str, path: Path, number: int) -> list[str]:
    if '"' not in line:
        return line.split(',')
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise InputError(f'{path}, line {number}: {error}; correct the quotes') from None


def _check_names(names: list[str], columns: Columns, path: Path) -> bool:
    """Hold the header against the format; return whether the file has effort columns."""
    where = f'{path}, line 1'
    for name in names:
        if names.count(name) > 1:
            raise InputError(f'{where}: column {name[:40]!r} is given twice; keep one')
    for prefix, wanted in (
        ('q', columns.q),
        ('from_q', columns.from_q),
        ('effort', columns.effort),
    ):
        suffix = '_nm' if prefix == 'effort' else '_rad'
        pattern = re.compile(f'{prefix}[0-9]+{suffix}')
        found = [name for name in names if pattern.fullmatch(name)]
        if set(found) != set(wanted) and (found or prefix != 'effort'):
            raise InputError(
                f'{where}: {len(found)} columns {prefix}…{suffix} for the {columns.joints} joints '
                f'of the robot between its base_link and tip_link; give {wanted[0]} to '
                f'{wanted[-1]}, or the right URDF and links in session.yaml'
            )
    missing = [name for name in columns.names() if name not in names]
    if missing:
        raise InputError(
            f'{where}: column {", ".join(missing)} is missing; add it, with empty fields where '
            'the format lets a value be unknown'
        )
    unknown = [name for name in names if name not in columns.names(with_effort=True)]
    if unknown:
        log.warning('%s: unknown columns are not used: %s', where, ', '.join(map(repr, unknown)))
    return columns.effort[0] in names


def _columns(
    table: _Table,
    columns: Columns,
    chain: SerialChain,
    sensors: Sequence[str],
    markers: Sequence[str],
    with_effort: bool,
) -> Measurements:
    """Convert and check every column by itself."""
    split = table.choices('split', SPLITS, f'is neither {SPLITS[0]} nor {SPLITS[1]}; correct it')
    measurements = Measurements(
        observation=table.integers('observation'),
        pose=table.integers('pose'),
        configuration=table.integers('configuration'),
        is_validation=split.astype(bool),
        stamp_s=table.numbers(['stamp_s'])[:, 0],
        sensor=table.choices('sensor', sensors, _not_among('sensors', sensors)),
        marker=table.choices('marker', markers, _not_among('markers', markers)),
        q=table.numbers(columns.q),
        from_q=table.whole_or_empty(columns.from_q),
        position=table.numbers(columns.position),
        std=table.whole_or_empty(columns.std),
        samples=table.integers('samples', optional=True),
        temperature_c=table.numbers(['temperature_c'], optional=True)[:, 0],
        effort=table.numbers(columns.effort, optional=True) if with_effort else None,
    )
    too_few = np.flatnonzero(
        (measurements.samples < 1)
        & np.array([cell != '' for cell in table.cells['samples']], dtype=bool)
    )
    if len(too_few):
        raise table.fault(
            int(too_few[0]), 'samples', 'is less than 1; leave it empty where unknown'
        )
    negative = np.argwhere(measurements.std < 0)
    if len(negative):
        row, column = negative[0]
        raise table.fault(int(row), columns.std[column], 'is negative; correct it')
    for names, q in ((columns.q, measurements.q), (columns.from_q, measurements.from_q)):
        outside = np.argwhere(
            (q < chain.lower - LIMIT_TOLERANCE_RAD) | (q > chain.upper + LIMIT_TOLERANCE_RAD)
        )
        if len(outside):
            row, joint = outside[0]
            raise table.fault(
                int(row),
                names[joint],
                f'rad is more than 1 degree outside the limits of {chain.joint_names[joint]} '
                f'({chain.lower[joint]:.6g} to {chain.upper[joint]:.6g} rad); are the units '
                'radians, the joints base to tip, and the limits of the URDF right?',
            )
    return measurements


def _not_among(key: str, names: Sequence[str]) -> str:
    return f'is not among the {key} of session.yaml ({", ".join(names)}); correct either'


def _keeps_the_rules(m: Measurements) -> bool:
    """Return whether `SequenceRules` would find no problem, in one look at all rows."""

    def belongs(part: IntArray, whole: IntArray | BoolArray) -> bool:
        _, first, group = np.unique(part, return_index=True, return_inverse=True)
        return bool((whole[first][group] == whole).all())

    return bool(
        (np.diff(m.observation) > 0).all()
        and (np.diff(m.stamp_s) >= 0).all()
        and belongs(m.pose, m.is_validation)
        and belongs(m.configuration, m.pose)
    )


def _row_keys(m: Measurements, first_line: int) -> Iterator[RowKeys]:
    lines = range(first_line, first_line + len(m))
    columns = (m.observation, m.pose, m.configuration, m.is_validation, m.stamp_s)
    # Plain Python numbers: dictionaries of NumPy scalars are slow.
    return map(RowKeys, lines, *(column.tolist() for column in columns))


def _text(number: float) -> str:
    return repr(float(number))
