# SPDX-License-Identifier: Apache-2.0
"""Gross errors: rows that are far more likely to be mistakes than noise, named one by one.

A mixture: most rows have the noise of the others, a small share has an error many times as wide;
share and width are found by expectation maximisation (Dempster, Laird and Rubin 1977). A row is
compared with the other rows of its pose (the pose-common error), a whole pose with the other
poses. What is gross with a probability of `CERTAIN` is left out.

The standard deviations are robust: the larger of those by the median and by the 80 % quantile of
the errors, so that errors with more than Gaussian tails, which real robots have, are kept.
The mixture's limit then comes to lie between 6 and 7 of them: of Gaussian errors of known size it
calls fewer than one in 5 million gross. Their size is not known: errors are measured by it as by
an estimate with the degrees of freedom that rows and poses leave (`as_of_known_size`), or of
24 clean sessions of ten single readings one would lose a good one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtrc

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.noise import MEDIAN_LENGTH, RESOLUTION_M
from remaster_ros.errors import MisfitError
from remaster_ros.types import BoolArray, FloatArray

# A row is left out from this probability on.
CERTAIN = 0.99
# Prior of gross errors: their share as if so many of a hundred rows had been observed, and their
# least width in standard deviations.
PRIOR_GROSS = 0.1
PRIOR_ROWS = 100.0
NARROWEST = 20.0
# Where the share is larger, the model or the session is wrong.
LARGEST_SHARE = 0.1
_QUANTILES = (0.5, 0.8)
# The same quantiles of the length of a standard normal vector in three dimensions.
_EXPECTED = np.array([MEDIAN_LENGTH, 2.1544437046])
# The standard deviation by the 80 % quantile may be this many times that by the median; more than
# a fifth of gross errors makes it larger.
TAIL_LIMIT = 4.0
# Fits of other rows, until the same stay out.
MOST_REFITS = 20
# Of a sensor: its registration, its marker, a part of the offsets.
UNKNOWNS = 10
# With fewer rows the robust fit follows half of them closely, whatever they are, and their errors
# cannot be compared with the others'.
FEWEST_TO_JUDGE = 60


@dataclass(frozen=True, eq=False)
class Judgement:
    """What `judge` found, row by row in the order of `Rows`."""

    gross: BoolArray  # True where the row is to be left out, (n,)
    why: tuple[str, ...]  # The reason with its numbers; '' where kept, n strings


def find_outliers(
    rows: Rows,
    refit: Callable[[BoolArray], FloatArray],
    errors: FloatArray,
    sensor_names: Sequence[str],
    gross: BoolArray | None = None,
) -> Judgement:
    """Leave gross rows out and fit again until the same rows stay out.

    Where some look good once they are left out, and gross once they are not, they stay in: rows
    are judged by the others.

    Parameters
    ----------
    rows
        All rows, good and bad.
    refit
        Fits the rows that are True, (n,), and returns the errors of all, m, (n, 3).
    errors
        Errors of a first, robust fit, m, (n, 3).
    sensor_names
        For the messages.
    gross
        Which rows are gross to begin with, (n,); None where it is not known of any.

    Raises
    ------
    MisfitError
        When more than a tenth of a sensor's rows would be left out, or too many are gross to
        identify them.
    """
    _require_majority(rows, errors, sensor_names)
    gross = np.zeros(len(rows), dtype=bool) if gross is None else gross
    judgement = judge(rows, errors, gross)
    tried: list[Judgement] = []
    while not np.array_equal(judgement.gross, gross) and len(tried) < MOST_REFITS:
        gross = judgement.gross
        again = [np.array_equal(before.gross, gross) for before in tried]
        if any(again):
            judgement = min(tried[again.index(True) :], key=lambda before: before.gross.sum())
            break
        tried.append(judgement)
        judgement = judge(rows, refit(~gross), gross)
    _guard(rows, judgement.gross, sensor_names)
    return judgement


def judge(rows: Rows, errors: FloatArray, gross: BoolArray) -> Judgement:
    """Judge every row by the rows not yet called gross."""
    group = rows.group_of_row
    sensor = rows.group_sensor[group]
    good = ~gross
    count = rows.group_sum(good.astype(float))
    total = rows.group_sum(errors * good[:, None])
    sigma, pose_sigma = robust_noise(rows, errors, good)

    # The error that the pose has in common, by its other good rows.
    others = count[group] - good
    mean = (total[group] - errors * good[:, None]) / np.maximum(others, 1.0)[:, None]
    variance, common = sigma[sensor] ** 2, pose_sigma[sensor] ** 2
    share = others * common / (variance + others * common)
    spread = np.sqrt(variance + common * (1.0 - share))
    deviation = np.linalg.norm(errors - share[:, None] * mean, axis=1)
    sigmas = deviation / spread

    probability = np.zeros(len(rows))
    for index, span in rows.spans:
        poses = int(np.sum((rows.group_sensor == index) & (count > 0)))
        freedom = 3 * (int(good[span].sum()) - poses) or 3 * poses - UNKNOWNS
        probability[span] = gross_probability(as_of_known_size(sigmas[span], freedom))
    gross_now = probability > CERTAIN
    why = [
        f'residual {_size(d, i >= rows.points)}, {s:.0f} sigma; gross with probability '
        f'{_percent(p)}'
        if g
        else ''
        for i, (d, s, p, g) in enumerate(
            zip(deviation, sigmas, probability, gross_now, strict=True)
        )
    ]

    # A pose whose rows agree with each other, and with no other pose.
    pose_mean = total / np.maximum(count, 1.0)[:, None]
    pose_spread = np.sqrt(
        pose_sigma[rows.group_sensor] ** 2 + sigma[rows.group_sensor] ** 2 / np.maximum(count, 1.0)
    )
    pose_sigmas = np.linalg.norm(pose_mean, axis=1) / pose_spread
    off = np.zeros(len(count))
    for index, _ in rows.spans:
        mine = (rows.group_sensor == index) & (count > 1)
        freedom = 3 * int(mine.sum()) - UNKNOWNS
        off[mine] = gross_probability(as_of_known_size(pose_sigmas[mine], freedom))
    for index in np.flatnonzero(off > CERTAIN).tolist():
        start = int(rows.group_start[index])
        for row in range(start, start + rows.group_size[index]):
            gross_now[row] = True
            why[row] = (
                f'residual {_size(float(np.linalg.norm(errors[row])), row >= rows.points)}: the '
                f'whole pose is off by {pose_sigmas[index]:.0f} sigma; gross with probability '
                f'{_percent(off[index])}'
            )
    # A reading whose orientation is gross has no position to be relied on, nor the reverse.
    return Judgement(rows.whole(gross_now), tuple(why))


def as_of_known_size(sigmas: FloatArray, freedom: int) -> FloatArray:
    """Return lengths as rare among errors of known size as these are among those of estimated.

    The square of a length of three-dimensional errors in estimated standard deviations is three
    times F-distributed, in known ones chi-squared.

    ``sigmas``: in estimated standard deviations, (n,); ``freedom``: degrees of freedom of the
    estimate; with fewer than one it counts as one.
    Returns in known standard deviations, (n,).
    """
    rarity = fdtrc(3, max(freedom, 1), sigmas**2 / 3.0)
    known: FloatArray = np.sqrt(chdtri(3, np.maximum(rarity, np.finfo(float).tiny)))
    return known


def gross_probability(sigmas: FloatArray) -> FloatArray:
    """Return how probable it is that each of three-dimensional errors is gross.

    ``sigmas``: lengths of the errors in standard deviations of good ones, (n,).
    Returns (n,), under a mixture of two Gaussians whose share and width fit these errors.
    """
    square = sigmas**2
    share, excess = PRIOR_GROSS / PRIOR_ROWS, NARROWEST**2
    probability = np.zeros(len(square))
    for _ in range(100):
        before = probability
        log_odds = (
            np.log(share / (1.0 - share))
            - 1.5 * np.log1p(excess)
            + 0.5 * square * excess / (1.0 + excess)
        )
        probability = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -500.0, 500.0)))
        if np.max(np.abs(probability - before), initial=0.0) < 1e-6:
            break
        total = float(probability.sum())
        share = (total + PRIOR_GROSS) / (len(square) + PRIOR_ROWS)
        excess = float(probability @ (square / 3.0 - 1.0) + NARROWEST**2) / (total + 1.0)
        excess = max(excess, NARROWEST**2)
    return probability


def robust_noise(rows: Rows, errors: FloatArray, good: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Estimate sigma and pose_sigma of each sensor, m, (sensors,) each, unmoved by a few outliers.

    Where poses have one row each all of the error counts as sigma.
    """
    group = rows.group_of_row
    count = rows.group_sum(good.astype(float))
    mean = rows.group_sum(errors * good[:, None]) / np.maximum(count, 1.0)[:, None]
    # Deviations from the mean of n rows are smaller than sigma by (n - 1) / n in variance.
    inflation = np.sqrt(count / np.maximum(count - 1.0, 1.0))[group]
    deviation = np.linalg.norm(errors - mean[group], axis=1) * inflation
    sensors = len(rows.spans)
    sigma, pose_sigma = np.zeros(sensors), np.zeros(sensors)
    for index, span in rows.spans:
        paired = good[span] & (count[group[span]] > 1)
        poses = (rows.group_sensor == index) & (count > 0)
        pose_total = robust_scale(np.linalg.norm(mean[poses], axis=1))
        if not paired.any():
            sigma[index] = pose_total
            continue
        sigma[index] = robust_scale(deviation[span][paired])
        own = sigma[index] ** 2 * np.mean(1.0 / count[poses])
        pose_sigma[index] = np.sqrt(max(pose_total**2 - own, 0.0))
    return sigma, pose_sigma


def robust_scale(lengths: FloatArray) -> float:
    """Return the standard deviation per axis of three-dimensional errors of these lengths."""
    return float(np.max(np.quantile(lengths, _QUANTILES) / _EXPECTED)) + RESOLUTION_M


def _require_majority(rows: Rows, errors: FloatArray, sensor_names: Sequence[str]) -> None:
    """Refuse data with so many gross errors that they cannot be identified."""
    names = _names(rows, sensor_names)
    for sensor, span in rows.spans:
        turned = span.start >= rows.points
        if span.stop - span.start < FEWEST_TO_JUDGE:
            continue
        half, most = np.quantile(np.linalg.norm(errors[span], axis=1), _QUANTILES)
        if most / _EXPECTED[1] > TAIL_LIMIT * (half / _EXPECTED[0] + RESOLUTION_M):
            raise MisfitError(
                f"sensor '{names[sensor]}': half of the observations agree within "
                f'{_size(half, turned)}, but a fifth is off by more than {_size(most, turned)}: '
                'too many gross errors to name them',
                'look for mixed-up markers or a sensor that was moved',
            )


def _guard(rows: Rows, gross: BoolArray, sensor_names: Sequence[str]) -> None:
    names = _names(rows, sensor_names)
    for sensor, span in rows.spans:
        out, of = int(gross[span].sum()), span.stop - span.start
        if out > max(1.0, LARGEST_SHARE * of):
            raise MisfitError(
                f"sensor '{names[sensor]}': {out} of {of} observations are gross errors, "
                'too many to leave out',
                'look for mixed-up markers or a sensor that was moved',
            )


def _names(rows: Rows, sensor_names: Sequence[str]) -> list[str]:
    """Return the names of the sensors, then those of their orientations."""
    return [*sensor_names, *(f'{sensor_names[sensor]} (orientation)' for sensor in rows.turning)]


def _size(error: float, turned: bool) -> str:
    """Return an error in m, or one of an orientation in rad, as text."""
    return f'{np.degrees(error):.2f} degrees' if turned else f'{error * 1e3:.1f} mm'


def _percent(probability: float) -> str:
    """Return a probability as text, never as 100 %."""
    return f'{100.0 * probability:.1f} %' if probability < 0.999 else 'above 99.9 %'
