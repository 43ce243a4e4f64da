# SPDX-License-Identifier: Apache-2.0
"""The paper's three measures of accuracy, section V of Van Wyk et al.

The first two are free of the gauge: the relative error compares distances; the absolute one
compares points in the sensor's frame, in which a rotation of joint 1 and of the registration
cancel. There are two versions of the third, see `theoretical`. Means and the 2.5 and 97.5 %
quantiles are over configurations (and draws), in mm, as in Tables III to VIII.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from remaster_ros.calibration.orientation_accuracy import (
    ToolOrientations,
    orientation_accuracy,
)
from remaster_ros.calibration.predictive_accuracy import (
    RANDOM_CONFIGURATIONS,
    Distances,
    Predictive,
    random_configurations,
    theoretical_distances,
)
from remaster_ros.types import FloatArray, IntArray, Measurements

# Largest number of pairs of solutions; of more (100,000 rows at three dozen poses have 1e8) this
# number is drawn.
MOST_PAIRS = 200_000
THEORETICAL = ('theoretical', 'paper_theoretical')


def summary(errors: FloatArray) -> dict[str, Any]:
    """Mean and 95 % interval of errors (n,), m, as ``mean_mm`` and ``interval95_mm``, in mm.

    The interval is from the 2.5 to the 97.5 % quantile. At least one error is needed.
    """
    low, high = np.quantile(errors, (0.025, 0.975)) * 1e3
    return {'mean_mm': float(np.mean(errors) * 1e3), 'interval95_mm': [float(low), float(high)]}


def unavailable(names: Sequence[str], why: str) -> dict[str, Any]:
    """Entry of a metric without numbers: None for each of the names, and the reason as ``why``.

    ``names``: keys that the metric would have, such as 'before' and 'after'.
    """
    return {**dict.fromkeys(names), 'why': why}


def solution_pairs(measurements: Measurements, rng: np.random.Generator) -> IntArray:
    """Pairs (i, j), i < j, of rows that are different joint solutions of the same pose, (m, 2).

    Rows by the same sensor on the same marker, over which eq. 17 of Van Wyk et al. sums. Rows
    of one configuration make no pair; those of a session measured in motion make none at all.
    At most 200,000 pairs, drawn at random from more.
    """
    if measurements.velocity is not None:
        # Rows of a moving arm's segment are no solutions of one pose.
        return np.zeros((0, 2), np.int64)
    key = (measurements.pose, measurements.marker, measurements.sensor)
    order = np.lexsort((np.arange(len(measurements)), *key))
    changes = np.any([np.diff(column[order]) != 0 for column in key], axis=0)
    start = np.concatenate(([0], np.flatnonzero(changes) + 1))
    size = np.diff(np.append(start, len(measurements)))
    count = size * (size - 1) // 2
    total = int(count.sum())
    number = np.arange(total) if total <= MOST_PAIRS else rng.integers(total, size=MOST_PAIRS)
    # The number of a pair: its cluster, and its place in the list (0,1) (0,2) (1,2) (0,3) ….
    cluster = np.searchsorted(np.cumsum(count), number, side='right')
    place = number - (np.cumsum(count) - count)[cluster]
    second = ((1.0 + np.sqrt(1.0 + 8.0 * place)) / 2.0).astype(np.int64)
    first = place - second * (second - 1) // 2
    pairs = order[start[cluster, None] + np.stack((first, second), axis=1)]
    configuration = measurements.configuration
    return pairs[configuration[pairs[:, 0]] != configuration[pairs[:, 1]]]


def relative_errors(
    measurements: Measurements, predicted: FloatArray, pairs: IntArray
) -> FloatArray:
    """Absolute difference of measured and modelled distances between solutions (eq. 17), m, (m,).

    ``measurements``: n observations; ``predicted``: modelled markers in any one frame per sensor,
    m, (n, 3); ``pairs``: of `solution_pairs`, (m, 2).
    """
    first, second = pairs.T
    measured = np.linalg.norm(measurements.position[first] - measurements.position[second], axis=1)
    modelled = np.linalg.norm(predicted[first] - predicted[second], axis=1)
    return np.abs(measured - modelled)


def accuracy_of(
    measurements: Measurements,
    fitted: IntArray,
    predicted_before: FloatArray,
    predicted_after: FloatArray,
    predictive: tuple[Predictive, FloatArray] | None,
    rng: np.random.Generator,
    modelled: ToolOrientations | None = None,
) -> dict[str, Any]:
    """Metrics of accuracy with the offsets at zero and as estimated, as fit.json has them.

    By split ('optimization', 'validation'), None for one without rows: relative, position,
    theoretical and the paper's theoretical error, the latter two also over the whole
    workspace. Each has the keys 'before' (offsets at zero) and 'after' (as estimated). A
    metric that is not available has None for its numbers and the reason as ``why``.

    Parameters
    ----------
    measurements
        n observations.
    fitted
        Indices of the optimization rows that were not left out. A split without rows gives None;
        the validation split has all validation rows.
    predicted_before, predicted_after
        Modelled markers in the sensors' frames with offsets at zero and as estimated, m, (n, 3).
    predictive
        For the theoretical metrics: the posterior, and the pinned parameters of the fit with
        offsets at zero; without it these are not available.
    rng
        For the theoretical metric.
    modelled
        Modelled orientations if full poses were measured: the metrics then include their errors.
    """
    at_random: dict[str, Any] = {}
    if predictive is not None:
        bare = predictive[0].without_extension()
        rows = random_configurations(bare.model, measurements, RANDOM_CONFIGURATIONS, rng)
        everywhere = np.arange(RANDOM_CONFIGURATIONS)
        both = theoretical_distances(bare, predictive[1], rows, everywhere, rng)
        at_random = _theoretical(both, suffix='_random')
    result: dict[str, Any] = {}
    validation = np.flatnonzero(measurements.is_validation)
    for name, chosen in (('optimization', fitted), ('validation', validation)):
        if len(chosen) == 0:
            result[name] = None
            continue
        pairs = chosen[solution_pairs(measurements.select(chosen), rng)]
        result[name] = _measured(measurements, predicted_before, predicted_after, chosen, pairs)
        if modelled is not None:
            result[name] |= orientation_accuracy(measurements, modelled, fitted, chosen, pairs)
        if predictive is None:
            missing = unavailable(Distances._fields, 'it needs draws of the posterior')
            result[name] |= {key + s: missing for s in ('', '_random') for key in THEORETICAL}
        else:
            both = theoretical_distances(*predictive, measurements, chosen, rng)
            result[name] |= _theoretical(both) | at_random
    return result


def _measured(
    measurements: Measurements,
    predicted_before: FloatArray,
    predicted_after: FloatArray,
    chosen: IntArray,
    pairs: IntArray,
) -> dict[str, Any]:
    """Metrics of eq. 17 and 18 with the offsets at zero and as estimated: dict for fit.json.

    Keys: 'relative', over ``pairs`` (m, 2), and 'post_registration', over ``chosen`` (c,);
    both arrays are indices of measurements. Each has 'before' (from ``predicted_before``,
    modelled markers with offsets at zero, m, (n, 3)) and 'after'. Without pairs 'relative' has
    None for both, and the reason as ``why``.
    """
    predicted = {'before': predicted_before, 'after': predicted_after}
    if len(pairs) > 0:
        relative = {
            side: summary(relative_errors(measurements, points, pairs))
            for side, points in predicted.items()
        }
    else:
        relative = unavailable(
            ('before', 'after'),
            'the arm moved: no pose is reached by two joint solutions'
            if measurements.velocity is not None
            else 'no pose has two joint solutions seen by the same sensor on the same marker',
        )
    absolute = {
        side: summary(np.linalg.norm((measurements.position - points)[chosen], axis=1))
        for side, points in predicted.items()
    }
    return {'relative': relative, 'post_registration': absolute}


def _theoretical(both: Sequence[Distances], suffix: str = '') -> dict[str, Any]:
    """Theoretical metrics as fit.json has them: `summary` of each field of two `Distances`.

    ``both``: distances of the invariant version, then of the paper's
    (`theoretical_distances`); their keys are 'theoretical' and 'paper_theoretical', each with
    the suffix.
    """
    return {
        name + suffix: {side: summary(values) for side, values in distances._asdict().items()}
        for name, distances in zip(THEORETICAL, both, strict=True)
    }
