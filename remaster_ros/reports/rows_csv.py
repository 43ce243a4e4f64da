"""Files with one line for every row of a session: residuals.csv of a fit, and what they share."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.types import FloatArray, Session

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

RESIDUALS_FILE = 'residuals.csv'
AXES = 'xyz'
ROWS_LIMIT = 1024**3
IDENTITY = ('observation', 'pose', 'configuration', 'split', 'sensor', 'marker')
BEFORE, AFTER = (tuple(f'{side}_{axis}_m' for axis in AXES) for side in ('before', 'after'))


def rows_text(session: Session, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a file: which row of the session it is, then these columns."""
    m = session.measurements
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow((*IDENTITY, *columns))
    for i, row in enumerate(rows):
        writer.writerow(
            (
                m.observation[i],
                m.pose[i],
                m.configuration[i],
                'validation' if m.is_validation[i] else 'optimization',
                session.sensor_names[m.sensor[i]],
                session.marker_names[m.marker[i]],
                *row,
            )
        )
    return text.getvalue()


def residuals_text(result: FitResult) -> str:
    """Return residuals.csv: measured minus modelled position in the frame of the sensor, m.

    ``before`` with all offsets held at zero, ``after`` with the offsets; ``left_out`` is 1 for a
    gross error.
    """
    gross = {observation for observation, _ in result.left_out}
    residuals = np.concatenate((result.residuals_before, result.residuals_after), axis=1)
    rows = (
        (*(f'{value:.8f}' for value in row), int(observation in gross))
        for observation, row in zip(
            result.session.measurements.observation.tolist(), residuals, strict=True
        )
    )
    return rows_text(result.session, (*BEFORE, *AFTER, 'left_out'), rows)


def read_columns(path: Path, session: Session, columns: Sequence[str], verb: str) -> FloatArray:
    """Read columns of numbers of such a file, (n, columns), one line for each row of a session.

    Raises
    ------
    InputError
        One line naming file, line, column and remedy: no such file, or not of this session.
    """
    data = read_limited(path, ROWS_LIMIT, f'run "remaster {verb}" again, which writes it')
    reader = csv.DictReader(io.StringIO(decode_text(data, path)))
    missing = {'observation', *columns} - set(reader.fieldnames or ())
    if missing:
        raise InputError(f'{path}: has no column {sorted(missing)[0]!r}; {verb} again')
    expected = session.measurements.observation
    values = np.empty((len(expected), len(columns)))
    count = 0
    for row in reader:
        place = f'{path}, line {reader.line_num}'
        if count == len(expected) or row['observation'] != str(expected[count]):
            raise InputError(f'{place}: not the rows of this session; {verb} this session')
        for j, column in enumerate(columns):
            try:
                values[count, j] = float(row[column])
            except (TypeError, ValueError):
                values[count, j] = np.nan
            if not np.isfinite(values[count, j]):
                raise InputError(f'{place}: {column} is {row[column]!r}, no number; {verb} again')
        count += 1
    if count < len(expected):
        raise InputError(f'{path}: {count} rows of {len(expected)}; {verb} this session again')
    return values
