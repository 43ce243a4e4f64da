"""The paper's three measures of accuracy, section V of Van Wyk et al.

All are free of the gauge: the relative error compares distances; the absolute ones compare points
in the sensor's frame, where a turn of joint 1 and of the registration cancel. Means and the 2.5
and 97.5 % quantiles are over configurations (and draws), in mm, as in Tables III to VIII.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from remaster_ros.core.types import FloatArray, IntArray, Measurements

THEORETICAL_DRAWS = 2000
# Of more configurations the theoretical measure takes this many at random: its means and
# quantiles are those of a sample anyway.
THEORETICAL_CONFIGURATIONS = 2000
_BLOCK_ROWS = 40_000


class Predictive(NamedTuple):
    """What the theoretical measure is computed from.

    Attributes
    ----------
    predict
        Parameters (draws, p) to predicted markers (draws, n, 3) in one rigid frame.
    before, after
        The parameters with offsets at zero and with the estimate, (p,).
    draws
        Joint draws of the posterior, (draws, p).
    sigma, pose_sigma
        The noise of each draw for each row, m, (draws, n).
    group
        Rows of one sensor at one pose have the same number here, (n,).
    """

    predict: Callable[[FloatArray], FloatArray]
    before: FloatArray
    after: FloatArray
    draws: FloatArray
    sigma: FloatArray
    pose_sigma: FloatArray
    group: IntArray


def summary(errors: FloatArray) -> dict[str, Any]:
    """Return mean and 95 % interval of errors in m as ``mean_mm`` and ``interval95_mm``."""
    low, high = np.quantile(errors, (0.025, 0.975)) * 1e3
    return {'mean_mm': float(np.mean(errors) * 1e3), 'interval95_mm': [float(low), float(high)]}


def unavailable(names: Sequence[str], why: str) -> dict[str, Any]:
    """Return a metric that the session does not allow, with the reason."""
    return {**dict.fromkeys(names), 'why': why}


def solution_pairs(measurements: Measurements) -> IntArray:
    """Return the rows i < j seen by the same sensor on the same marker at the same pose, (m, 2).

    The sums of eq. 17 of Van Wyk et al.; rows of one configuration are the same solution and make
    no pair.
    """
    order = np.lexsort(
        (
            np.arange(len(measurements)),
            measurements.pose,
            measurements.marker,
            measurements.sensor,
        )
    )
    key = np.stack((measurements.sensor, measurements.marker, measurements.pose), axis=1)[order]
    cuts = np.flatnonzero(np.any(np.diff(key, axis=0) != 0, axis=1)) + 1
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for cluster in np.split(order, cuts):
        first, second = np.triu_indices(len(cluster), 1)
        pairs.append(np.stack((cluster[first], cluster[second]), axis=1))
    found = np.concatenate(pairs)
    configuration = measurements.configuration
    return found[configuration[found[:, 0]] != configuration[found[:, 1]]]


def relative_errors(measurements: Measurements, predicted: FloatArray) -> FloatArray:
    """Return the difference of measured and modelled distances between solutions (eq. 17).

    Parameters
    ----------
    measurements
        n observations.
    predicted
        Where the model has the markers, in any one frame per sensor, m, (n, 3).

    Returns
    -------
    ndarray
        m, one per pair of `solution_pairs`.
    """
    first, second = solution_pairs(measurements).T
    measured = np.linalg.norm(measurements.position[first] - measurements.position[second], axis=1)
    modelled = np.linalg.norm(predicted[first] - predicted[second], axis=1)
    return np.abs(measured - modelled)


def theoretical_errors(
    predictive: Predictive, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the distances of section V-C: from the applied model to what the posterior allows.

    For every draw and configuration the marker's place by the drawn parameters, with the drawn
    noise added, against its place by the model without and with offsets. As the registrations
    are drawn too, the places are compared in the sensor's frame.

    Returns
    -------
    before, after, after_offsets_only
        m, (draws x n,) each; the last without the noise.
    """
    group = predictive.group
    n = len(group)
    reference_before = predictive.predict(predictive.before[None])
    reference_after = predictive.predict(predictive.after[None])
    parts: tuple[list[FloatArray], ...] = ([], [], [])
    block = max(1, _BLOCK_ROWS // n)
    for start in range(0, len(predictive.draws), block):
        chosen = slice(start, start + block)
        places = predictive.predict(predictive.draws[chosen])
        count = len(places)
        # The pose-common part is one draw per sensor and pose.
        common = rng.standard_normal((count, int(group.max()) + 1, 3))[:, group]
        noisy = (
            places
            + predictive.pose_sigma[chosen, :, None] * common
            + predictive.sigma[chosen, :, None] * rng.standard_normal((count, n, 3))
        )
        for part, a, b in zip(
            parts,
            (noisy, noisy, places),
            (reference_before, reference_after, reference_after),
            strict=True,
        ):
            part.append(np.linalg.norm(a - b, axis=-1).ravel())
    before, after, offsets_only = (np.concatenate(part) for part in parts)
    return before, after, offsets_only


def accuracy_of(
    measurements: Measurements,
    predicted_before: FloatArray,
    predicted_after: FloatArray,
    predictive: Predictive | None,
    rng: np.random.Generator,
) -> dict[str, Any] | None:
    """Return the three metrics before and after on these observations, as fit.json has them.

    Parameters
    ----------
    measurements
        n observations; with none the result is None.
    predicted_before, predicted_after
        Modelled markers in the sensors' frames with offsets at zero and as estimated, m, (n, 3).
    predictive
        For the theoretical metric; None where no posterior is at hand.
    """
    if len(measurements) == 0:
        return None
    result: dict[str, Any] = {}
    if len(solution_pairs(measurements)) > 0:
        result['relative'] = {
            'before': summary(relative_errors(measurements, predicted_before)),
            'after': summary(relative_errors(measurements, predicted_after)),
        }
    else:
        result['relative'] = unavailable(
            ('before', 'after'),
            'no pose has two joint solutions seen by the same sensor on the same marker',
        )
    result['post_registration'] = {
        'before': summary(np.linalg.norm(measurements.position - predicted_before, axis=1)),
        'after': summary(np.linalg.norm(measurements.position - predicted_after, axis=1)),
    }
    names = ('before', 'after', 'after_offsets_only')
    if predictive is None:
        result['theoretical'] = unavailable(names, 'it needs draws of the posterior')
    else:
        errors = theoretical_errors(predictive, rng)
        result['theoretical'] = {
            name: summary(values) for name, values in zip(names, errors, strict=True)
        }
    return result
