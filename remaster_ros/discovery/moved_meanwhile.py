"""Held-out rows of a sensor that are far off: too many to be gross errors one by one.

Steps among the fitted rows are found by the search. Where held-out poses were measured last, as
in many protocols, what was bumped between the two shows in held-out rows alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from remaster_ros.calibration.moved_since import moved_since
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.gain import rms
from remaster_ros.discovery.guard import Unexplained
from remaster_ros.types import BoolArray, FloatArray

# Of careful measurements; for the p-value.
USUAL_GROSS = 0.01


def far_off(context: Context, errors: FloatArray, gross: BoolArray) -> Iterator[Unexplained]:
    """Give each sensor of whose held-out rows more than a tenth are gross errors.

    Parameters
    ----------
    context
        All n rows.
    errors
        Measured minus modelled positions in the sensor frames, m, (n, 3).
    gross
        Rows with gross errors whose reason is not known yet, (n,).
    """
    held_out = context.measurements.is_validation
    for index, sensor in enumerate(context.sensor_names):
        rows = np.flatnonzero(held_out & (context.sensor == index))
        count = int(gross[rows].sum())
        if count <= LARGEST_SHARE * len(rows):
            continue
        size = rms(errors, np.isin(np.arange(len(gross)), rows[gross[rows]]))
        moved = moved_text(context, errors, index)
        yield Unexplained(
            where='held_out_poses',
            driver='time' if moved else 'unknown',
            size_m=size,
            p_value=float(scipy.stats.binom.sf(count - 1, len(rows), USUAL_GROSS)),
            next=moved
            or (
                f'{count} of the {len(rows)} held-out readings of {sensor} are off by '
                f'{1e3 * size:.1f} mm (RMS): too many to be single gross errors. Compare where '
                'and how they were measured with the others.'
            ),
        )


def moved_text(context: Context, errors: FloatArray, sensor: int) -> str:
    """Return from when on a sensor's errors (n, 3), m, are others than before; '' if not."""
    rows = np.flatnonzero(context.sensor == sensor)
    moved = moved_since(context.measurements, rows, errors[rows]) if context.has_time else None
    if moved is None:
        return ''
    x, y, z = 1e3 * moved.shift
    return (
        f'From about observation {moved.observation} on, the readings of '
        f'{context.sensor_names[sensor]} are off by ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm in its '
        'frame: the sensor or its marker was moved then. Fasten both, and measure the session '
        'again, or remove what was measured from there on.'
    )
