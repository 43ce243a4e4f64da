"""predictions.csv: where every measurement was predicted, with covariance, and where it was."""

from __future__ import annotations

import csv
import io

import numpy as np

from remaster_ros.calibration.predictions import Predictions
from remaster_ros.types import Measurements, Session

PREDICTIONS_FILE = 'predictions.csv'
AXES = 'xyz'
# The upper triangle of the covariance, row by row.
PAIRS = tuple((a, b) for a in range(3) for b in range(a, 3))
COLUMNS = (
    'observation',
    'pose',
    'configuration',
    'split',
    'sensor',
    'marker',
    *(f'{axis}_m' for axis in AXES),
    *(f'predicted_{axis}_m' for axis in AXES),
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
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    upper = predictions.covariance[:, [a for a, _ in PAIRS], [b for _, b in PAIRS]]
    numbers = np.concatenate((m.position, predictions.position), axis=1)
    for i in range(len(m)):
        held_out = bool(m.is_validation[i])
        writer.writerow(
            [
                m.observation[i],
                m.pose[i],
                m.configuration[i],
                'validation' if held_out else 'optimization',
                session.sensor_names[m.sensor[i]],
                session.marker_names[m.marker[i]],
                *(f'{value:.7f}' for value in numbers[i]),
                *(f'{value:.6e}' for value in upper[i]),
                int(held_out),
                int(m.observation[i] in left_out),
                int(predictions.inside[i]),
            ]
        )
    return text.getvalue()
