# SPDX-License-Identifier: Apache-2.0
"""Moment from which the readings of a sensor are shifted: sensor or marker moved, or a drift.

Errors that grow with temperature, or that differ between regions, also have other means late in a
session than early. A step is claimed only if it is more probable than all drifts and fields, and
if the positions before and after it cover the same region.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy
from numpy.polynomial import legendre

from remaster_ros.types import FloatArray, IntArray, Measurements

FEWEST_POSES = 8
# Probability of a false step, over all moments at which a step is tried.
SIGNIFICANCE = 1e-3
# Time constants of a warm-up that are tried, as shares of the session.
WARM_UP = 0.03, 0.1, 0.3
# Moments at which a drift may begin or end, as shares of the session.
BENDS = np.arange(0.1, 1.0, 0.1)
# Largest share of a step's variance that the positions explain. Above it a step cannot be told
# from a difference between regions: early and late poses are in different places.
SEPARATED = 0.5


class Moved(NamedTuple):
    """Change of the readings of a sensor in time."""

    observation: int  # First observation after the change, approximately
    shift: FloatArray  # Mean of the readings after the change less that before, m, (3,)
    is_step: bool  # Whether a drift is ruled out


def moved_since(measurements: Measurements, rows: IntArray, errors: FloatArray) -> Moved | None:
    """Change of the readings in time; None if time does not explain their errors.

    The moment divides the means of the poses best. A step is tested by F over all moments
    (Bonferroni, 0.1 %), and against drifts and positions by the Bayesian information criterion
    (Schwarz 1978): it has to be 1 / `SIGNIFICANCE` times as probable. None also with fewer than 8
    poses, without times, or if early and late poses are in different places.

    ``rows``: rows of one sensor in any order, (n,); ``errors``: measured minus modelled positions
    of these rows in any one frame, m, (n, 3).
    """
    order = np.argsort(measurements.stamp_s[rows], kind='stable')
    rows, errors = rows[order], errors[order]
    if len(rows) == 0 or measurements.stamp_s[rows[0]] == measurements.stamp_s[rows[-1]]:
        return None
    _, first, pose = np.unique(measurements.pose[rows], return_index=True, return_inverse=True)
    # Poses in the order of their first row.
    index, poses = np.argsort(np.argsort(first))[pose], len(first)
    if poses < FEWEST_POSES:
        return None
    means = _of_poses(errors, index)
    before = np.arange(1, poses)[:, None]
    after = poses - before
    sums = np.cumsum(means, axis=0)
    step = (sums[-1] - sums[:-1]) / after - sums[:-1] / before
    explained = (before * after / poses)[:, 0] * np.sum(step**2, axis=1)
    at = int(np.argmax(explained))
    unexplained = max(float(np.sum((means - means.mean(axis=0)) ** 2) - explained[at]), 1e-30)
    freedom = 3 * (poses - 2)
    ratio = explained[at] / 3.0 / (unexplained / freedom)
    p_value = scipy.special.fdtrc(3, freedom, ratio) * len(step)
    if p_value > SIGNIFICANCE:
        return None
    time = _of_poses(measurements.stamp_s[rows][:, None], index)[:, 0]
    place = _standardised(_of_poses(measurements.position[rows], index))
    is_late = (np.arange(poses) > at).astype(float)
    if 1.0 - _unexplained(is_late[:, None], place) / float(poses * np.var(is_late)) > SEPARATED:
        return None
    # The moment is a parameter too.
    step_criterion = _criterion(unexplained, 2 + 1 / 3, poses) + 2.0 * np.log(1.0 / SIGNIFICANCE)
    drifts = [_criterion_of(means, columns) for columns in _drifts(time)]
    places = [_criterion_of(means, columns) for columns in _places(time, place)]
    if min(places, default=np.inf) < min(step_criterion, *drifts):
        return None
    is_step = step_criterion < min(drifts)
    return Moved(int(measurements.observation[rows[index > at][0]]), step[at], is_step)


def _of_poses(values: FloatArray, index: IntArray) -> FloatArray:
    """Means (poses, m) of the rows (n, m) of each pose; ``index``: pose of a row, from 0, (n,)."""
    count = np.bincount(index)
    return np.column_stack([np.bincount(index, axis) / count for axis in values.T])


def _standardised(values: FloatArray) -> FloatArray:
    """Values (n, m) less their means, over one standard deviation of all columns together."""
    centred = values - values.mean(axis=0)
    return centred / max(float(np.std(centred)), 1e-9)


def _drifts(time: FloatArray) -> Iterator[FloatArray]:
    """Yield the columns (n, p) of each drift over times (n,), s, without the constant.

    Polynomials of degree 1 to 3, warm-ups with three time constants, and drifts that begin or
    end at one of nine times.
    """
    share = (time - time.min()) / np.ptp(time)
    polynomials = _polynomials(time)
    for degree in range(1, polynomials.shape[1] + 1):
        yield polynomials[:, :degree]
    for constant in WARM_UP:
        yield np.exp(-share / constant)[:, None]
    for bend in BENDS:
        yield np.maximum(share - bend, 0.0)[:, None]
        yield np.minimum(share - bend, 0.0)[:, None]


def _places(time: FloatArray, place: FloatArray) -> Iterator[FloatArray]:
    """Yield the columns (n, p) of each polynomial of positions, alone and growing with time.

    First and second degree, of ``place`` (n, 3), standardised, and ``time`` (n,); those with
    half as many columns as n or more are left out.
    """
    first, second = np.triu_indices(3)
    fields = place, np.concatenate((place, place[:, first] * place[:, second]), axis=1)
    drift = _polynomials(time)[:, :1]
    # Growth is an error along the place that increases with time.
    for field in (*fields, *(np.concatenate((f, drift, drift * place), axis=1) for f in fields)):
        if field.shape[1] < len(time) // 2:
            yield field


def _polynomials(time: FloatArray) -> FloatArray:
    """Legendre polynomials of degrees 1 to 3 over the range of times (n,), (n, 3)."""
    share = (time - time.min()) / np.ptp(time)
    return legendre.legvander(2.0 * share - 1.0, 3)[:, 1:]


def _unexplained(values: FloatArray, columns: FloatArray) -> float:
    """Sum of squares of values (n, m) that a constant and columns (n, p) leave; at least 1e-30."""
    columns = np.column_stack((np.ones(len(values)), columns))
    fitted = columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return max(float(np.sum((values - fitted) ** 2)), 1e-30)


def _criterion_of(means: FloatArray, columns: FloatArray) -> float:
    """Criterion of means (n, 3) explained by columns (n, p) and a constant; smaller is better."""
    return _criterion(_unexplained(means, columns), columns.shape[1] + 1, len(means))


def _criterion(unexplained: float, columns: float, poses: int) -> float:
    """Bayesian information criterion of three axes with common noise; less is more probable.

    ``unexplained``: sum of squares, m²; ``columns``: parameters per axis; ``poses``: number of
    means.
    """
    count = 3 * poses
    return float(count * np.log(unexplained / count) + 3 * columns * np.log(count))
