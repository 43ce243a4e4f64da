"""Gain by the causes: on held-out poses, against the noise, metric by metric."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy
from msgspec import Struct

from remaster_ros.calibration.accuracy import accuracy_of
from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray, FloatArray

# A row with an error of so many standard deviations of all its noise is gross.
GROSS = 7.0


class Gain(Struct, frozen=True):
    """RMS of the 3-D error over all validation rows, before and after, as discovery.json has it.

    The errors are None without such rows.
    """

    # With offsets only, and with the effects
    held_out_rms_before_m: float | None
    held_out_rms_after_m: float | None
    noise_floor_m: float  # What the estimated noise alone leaves
    # How many held-out rows are single gross errors: so far off with and without the effects that
    # neither is judged by them
    held_out_gross: int = 0
    # The same RMS without these
    held_out_kept_before_m: float | None = None
    held_out_kept_after_m: float | None = None


def gain_of(
    found: Estimate,
    data: Residuals,
    solution: Solution,
    fit: FitResult,
    rng: np.random.Generator,
) -> tuple[Gain, Mapping[str, Any]]:
    """Return the errors of held-out rows before and after the sampled fit, and their metrics.

    ``found``: the fit with offsets only (before); ``solution``: gives the noise floor;
    ``fit``: the sampled fit (after). Without held-out rows both errors are None. The metrics
    are 'relative' and 'post_registration' as in fit.json; {} without held-out rows.
    """
    measurements = found.problem.measurements
    held_out = measurements.is_validation
    noise = data.noise_model.sensor_noise(solution.noise)
    variance = 3.0 * noise.total**2
    rows = held_out if held_out.any() else ~held_out
    floor = float(np.sqrt(np.mean(variance[measurements.sensor[rows]])))
    if not held_out.any():
        return Gain(None, None, floor), {}
    errors_before = residuals_of(found)
    before = measurements.position - errors_before
    after = measurements.position - fit.residuals_after
    none = np.arange(0)
    metrics = accuracy_of(measurements, none, before, after, None, rng)['validation']
    assert metrics is not None
    limit = GROSS * noise.total[measurements.sensor]
    lengths = [np.linalg.norm(errors, axis=1) for errors in (errors_before, fit.residuals_after)]
    gross = held_out & np.all(np.array(lengths) > limit, axis=0)
    if gross.sum() > max(1.0, LARGEST_SHARE * held_out.sum()):
        # So many are no single errors: something changed there, or the model does not hold.
        gross[:] = False
    kept = held_out & ~gross
    gain = Gain(
        rms(errors_before, held_out),
        rms(fit.residuals_after, held_out),
        floor,
        int(gross.sum()),
        rms(errors_before, kept),
        rms(fit.residuals_after, kept),
    )
    return gain, {name: metrics[name] for name in ('relative', 'post_registration')}


def residuals_of(found: Estimate) -> FloatArray:
    """Return measured minus modelled position of every row at an estimate's mode, m, (n, 3)."""
    predicted = predicted_rows(found.problem, found.model, found.mode.z)
    return found.problem.measurements.position - predicted


def rms(errors: FloatArray, rows: BoolArray) -> float:
    """Return the RMS of the 3-D error of the given rows, m.

    ``errors``: m, (n, 3); ``rows``: mask, (n,), with at least one row.
    """
    return float(np.sqrt(np.mean(np.sum(errors[rows] ** 2, axis=1))))


def pose_common_fraction(data: Residuals, solution: Solution) -> float:
    """Return the share of the noise's variance that is common to all rows of a pose.

    Of the noise of ``solution``, over all sensors.
    """
    noise = data.noise_model.sensor_noise(solution.noise)
    common = np.sum(noise.pose_sigma**2)
    return float(common / np.sum(noise.total**2))


def noise_by_range(data: Residuals, solution: Solution) -> dict[str, dict[str, float]]:
    """Compare the errors of near and far rows of each sensor.

    Returns sensor -> ``near_m`` and ``far_m``, the quartiles of the distance;
    ``far_over_near``, the RMS error at or above the upper quartile over that at or below the
    lower; ``p_value`` of the rank correlation of distance and error.
    """
    rows = data.rows
    length = np.linalg.norm(data.left(solution), axis=1)
    found = {}
    for sensor, span in rows.spans:
        distance = data.part.range_m[span]
        low, high = np.quantile(distance, (0.25, 0.75))
        near_errors, far_errors = length[span][distance <= low], length[span][distance >= high]
        p_value = _p_value_ranks(distance, length[span]) if np.ptp(distance) > 0.0 else 1.0
        found[data.context.sensor_names[sensor]] = {
            'near_m': float(low),
            'far_m': float(high),
            'far_over_near': float(np.sqrt(np.mean(far_errors**2) / np.mean(near_errors**2))),
            'p_value': p_value,
        }
    return found


def _p_value_ranks(x: FloatArray, y: FloatArray) -> float:
    """Return the p-value of a rank correlation (Spearman), two-sided; 1 for under 3 rows.

    By Student's t, as SciPy has it, whose statistics take 0.4 s to import.
    """
    freedoms = len(x) - 2
    if freedoms < 1:
        return 1.0
    r = np.corrcoef(_ranks(x), _ranks(y))[0, 1]
    return float(scipy.special.betainc(0.5 * freedoms, 0.5, 1.0 - min(1.0, r**2)))


def _ranks(values: FloatArray) -> FloatArray:
    """Return the rank of each value, from 1; equal values share their mean rank."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: FloatArray = (np.cumsum(counts) - 0.5 * (counts - 1))[which]
    return ranks
