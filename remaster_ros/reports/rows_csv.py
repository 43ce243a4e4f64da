# SPDX-License-Identifier: Apache-2.0
"""Files with a line for each row: residuals.csv of `fit`, predictions.csv of `discover`."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from remaster_ros.calibration.predictions import Predictions
from remaster_ros.errors import InputError
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.types import FloatArray, Measurements, Session

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

RESIDUALS_FILE = 'residuals.csv'
AXES = 'xyz'
ROWS_LIMIT = 1024**3
IDENTITY = ('observation', 'pose', 'configuration', 'split', 'sensor', 'marker')
BEFORE, AFTER = (tuple(f'{side}_{axis}_m' for axis in AXES) for side in ('before', 'after'))
PREDICTIONS_FILE = 'predictions.csv'
# The upper triangle of the covariance, row by row.
PAIRS = tuple((a, b) for a in range(3) for b in range(a, 3))
MEASURED, PREDICTED = (tuple(f'{what}{axis}_m' for axis in AXES) for what in ('', 'predicted_'))
PREDICTION_COLUMNS = (
    *MEASURED,
    *PREDICTED,
    *(f'cov_{AXES[a]}{AXES[b]}_m2' for a, b in PAIRS),
    'held_out',
    'left_out',
    'inside95',
)
"""``held_out``: never fitted; ``left_out``: a gross error; ``inside95``: in its 95 % region."""


def rows_text(session: Session, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return the text of a CSV file with a line for each row of a session.

    First the row's identity (`IDENTITY`), then ``columns``. ``rows``: values of these, in the
    order of the measurements.
    """
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


def lengths_mm(errors: FloatArray) -> FloatArray:
    """3-D error of each row, mm, (n,), from errors in m, (n, 3)."""
    return np.asarray(1e3 * np.linalg.norm(errors, axis=1))


def residuals_text(result: FitResult) -> str:
    """Return the text of residuals.csv: measured minus modelled position, sensor frame, m.

    ``before`` with all offsets at zero, ``after`` with the offsets; ``left_out`` is 1 for a
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


def predictions_text(session: Session, predictions: Predictions, left_out: set[int]) -> str:
    """Return the text of predictions.csv: measured and predicted positions, sensor frame, m.

    With covariance, and held out, left out, and inside the 95 % region as 1 (yes) or 0.
    ``left_out``: ``observation`` of the gross errors.
    """
    m: Measurements = session.measurements
    upper = predictions.covariance[:, [a for a, _ in PAIRS], [b for _, b in PAIRS]]
    numbers = np.concatenate((m.position, predictions.position), axis=1)
    rows = (
        (
            *(f'{value:.7f}' for value in numbers[i]),
            *(f'{value:.6e}' for value in upper[i]),
            int(m.is_validation[i]),
            int(m.observation[i] in left_out),
            int(predictions.inside[i]),
        )
        for i in range(len(m))
    )
    return rows_text(session, PREDICTION_COLUMNS, rows)


def read_columns(path: Path, session: Session, columns: Sequence[str], verb: str) -> FloatArray:
    """Read columns of numbers of residuals.csv or predictions.csv, (n, columns).

    Raises InputError if the file lacks a column, is of another session, or a number is
    missing. ``verb``: command that writes the file.
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
