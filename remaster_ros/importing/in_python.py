# SPDX-License-Identifier: Apache-2.0
"""Sessions from Python: of arrays or a data frame, or of files as the command reads them."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.importing.arguments import in_python, remedy
from remaster_ros.importing.assemble import (
    SessionOptions,
    assemble,
    refuse_outside_limits,
    with_controller_coupling,
    without_whole_turns,
)
from remaster_ros.importing.frames import is_frame, tables_of
from remaster_ros.importing.makers.named import first_names
from remaster_ros.importing.raw_rows import RawRows
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.importing.sense import check_sense
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.turns import with_orientation
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, Session

log = logging.getLogger('remaster_ros')


@dataclass(frozen=True)
class Choices:
    """Options of an import from Python, and the argument names of the function that was called."""

    table: TableOptions
    corrections: SessionOptions
    arguments: tuple[str, ...]
    never_mastered: bool = False
    seed: int = 0


def of_arrays(
    joints: Any, points: Any, robot: tuple[str, SerialChain], choices: Choices
) -> Session:
    """Session from joints, (n, k), and points, (n, 3), that belong together row by row.

    Arrays, or data frames or dicts with named columns; in rad and m unless the options state
    units. Two data frames are joined as tables. Rows with NaN are left out, with a warning in
    the log. Raises InputError for other shapes or numbers of rows, infinite values, or joints
    beyond their limits, and InsufficientDataError if the rows do not fit the robot. `robot`:
    URDF text and arm.
    """
    urdf, chain = robot
    if is_frame(joints) and is_frame(points):
        with _with_argument_names(choices.arguments):
            tables = tables_of((joints, points), ('joints', 'points'))
        return of_tables(tables, robot, choices)
    options = choices.table
    q = _number_array(joints, 'joints', chain.joint_names) * ANGLES[options.angles or 'rad']
    position = _number_array(points, 'points', ('x', 'y', 'z')) * LENGTHS[options.length or 'm']
    if len(q) != len(position):
        raise InputError(f'joints have {len(q)} rows, points {len(position)}; give a point each')
    known = np.isfinite(q).all(axis=1) & np.isfinite(position).all(axis=1)
    at = np.flatnonzero(known)
    dropped = [str(row) for row in np.flatnonzero(~known)]
    n = len(at)
    rows = RawRows(
        source=tuple(f'row {i}' for i in at),
        joint_columns=chain.joint_names,
        q=q[at],
        from_q=np.full((n, len(chain)), np.nan),
        position=position[at],
        std=np.full((n, 3), np.nan),
        stamp_s=None,
        labels={},
        temperature_c=np.full(n, np.nan),
        samples=np.full(n, -1.0),
        columns={},
        description=(),
        warnings=(f'row{"s" * (len(dropped) > 1)} {first_names(dropped)}: not a number, left out',)
        * bool(dropped),
    )
    return _checked_session(rows, urdf, chain, choices, 'from arrays')


def of_files(files: Sequence[Any], robot: tuple[str, SerialChain], choices: Choices) -> Session:
    """Session from one or two files or data frames; `robot`: URDF text and arm.

    Raises as `of_tables`, and InputError for data frames with an index label that is there
    twice.
    """
    frames = [file for file in files if is_frame(file)]
    names = ['frame'] if len(frames) == 1 else [f'frame {i + 1}' for i in range(len(frames))]
    with _with_argument_names(choices.arguments):
        read = iter(tables_of(frames, names))
    return of_tables(
        [next(read) if is_frame(file) else Path(file) for file in files], robot, choices
    )


def of_tables(
    files: Sequence[Path | TextTable], robot: tuple[str, SerialChain], choices: Choices
) -> Session:
    """Session from one table, or from a table of joints and one of points that are joined.

    `robot`: URDF text and arm. Raises InputError for a table that cannot be read or understood
    or joints beyond their limits, and InsufficientDataError if the table does not fit the
    robot; messages name arguments of the Python function, not options of the command.
    """
    urdf, chain = robot
    with _with_argument_names(choices.arguments):
        rows = read_rows(files, chain, choices.table).in_order()
        rows = with_orientation(rows, chain, choices.corrections)
    named = [file.path if isinstance(file, TextTable) else file for file in files]
    notes = f'imported from {", ".join(path.name for path in named)}'
    return _checked_session(rows, urdf, chain, choices, notes)


@contextlib.contextmanager
def _with_argument_names(arguments: Collection[str]) -> Iterator[None]:
    """Context in which errors name a function's arguments in place of the command's options.

    An InputError or InsufficientDataError of the body is raised again with the new text, as
    the same type; other errors pass. `arguments`: names of the function's arguments.
    """
    try:
        yield
    except (InputError, InsufficientDataError) as error:
        words = in_python(str(error), arguments)
        if words == str(error):
            raise
        kind = InputError if isinstance(error, InputError) else InsufficientDataError
        raise kind(words) from None


def _checked_session(
    rows: RawRows, urdf: str, chain: SerialChain, choices: Choices, notes: str
) -> Session:
    """Session of the rows, once these are found to fit the robot; warnings are logged.

    Whole turns of joints are taken off. Raises InsufficientDataError, with a remedy, if the
    rows do not fit, and InputError if joints are beyond their limits. `notes`: of the session.
    """
    with _with_argument_names(choices.arguments):
        options, _ = with_controller_coupling(rows, chain, choices.corrections)
        rng = np.random.default_rng(choices.seed)
        session, _ = assemble(rows, urdf, chain, options, rng, notes)
        sense = check_sense(session, rows, lambda *_: None, choices.never_mastered)
        if not sense.fits:
            sentence = in_python(sense.sentence, choices.arguments)
            help_with = remedy(sense.options, choices.arguments)
            raise InsufficientDataError('; '.join(filter(None, (sentence, help_with))))
        for warning in (*rows.warnings, *filter(None, [sense.warning])):
            log.warning('%s', warning)
        session, _ = without_whole_turns(session, chain)
        refuse_outside_limits(rows, chain, session.measurements.q)
    return session


def _number_array(given: Any, what: str, names: Sequence[str]) -> FloatArray:
    """Array (n, len(names)) of an array, or of the named columns of a data frame or dict.

    NaN is kept. Raises InputError for a missing column, text, another shape or infinite values;
    `what`: name in the message.
    """
    columns = getattr(given, 'columns', None)
    if columns is None and isinstance(given, dict):
        columns = given.keys()
    if columns is not None:
        absent = [name for name in names if name not in [*columns]]
        if absent:
            raise InputError(
                f'{what}: there is no column {absent[0]!r}; it has {", ".join(map(str, columns))}'
            )
        given = np.column_stack([np.asarray(given[name], dtype=float) for name in names])
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f'{what}: not an array of numbers') from None
    if values.ndim != 2 or values.shape[1] != len(names):
        raise InputError(f'{what}: {values.shape} is not (rows, {len(names)}): {", ".join(names)}')
    if np.isinf(values).any():
        row = int(np.flatnonzero(np.isinf(values).any(axis=1))[0])
        raise InputError(f'{what}: row {row} is infinite; leave it out of joints and points')
    return values
