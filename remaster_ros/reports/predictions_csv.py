"""predictions.csv: where every measurement was predicted, with covariance, and where it was."""

from __future__ import annotations

import numpy as np

from remaster_ros.calibration.predictions import Predictions
from remaster_ros.reports.rows_csv import AXES, rows_text
from remaster_ros.types import Measurements, Session

PREDICTIONS_FILE = 'predictions.csv'
# The upper triangle of the covariance, row by row.
PAIRS = tuple((a, b) for a in range(3) for b in range(a, 3))
MEASURED, PREDICTED = (tuple(f'{what}{axis}_m' for axis in AXES) for what in ('', 'predicted_'))
COLUMNS = (
    *MEASURED,
    *PREDICTED,
    *(f'cov_{AXES[a]}{AXES[b]}_m2' for a, b in PAIRS),
    'held_out',
    'left_out',
    'inside95',
)
"""``held_out``: never fitted; ``left_out``: a gross error; ``inside95``: in its 95 % region."""


def predictions_text(session: Session, predictions: Predictions, left_out: set[int]) -> str:
    """Return the file: positions in the frame of the row's sensor, m; 1 is yes and 0 no.

    Parameters
    ----------
    session
        All n rows.
    predictions
        Of the same rows.
    left_out
        ``observation`` of the gross errors.
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
    return rows_text(session, COLUMNS, rows)
