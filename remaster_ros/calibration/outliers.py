# SPDX-License-Identifier: Apache-2.0
"""Gross errors: rows that are far more probably mistakes than noise, each named with its reason.

A mixture: most rows have the noise of the others, a small share has an error many times as wide;
share and width are found by expectation maximisation (Dempster, Laird and Rubin 1977). A row is
compared with the other rows of its pose (the pose-common error), a whole pose with the other
poses. A row that is gross with a probability of `CERTAIN` is left out.

The standard deviations are robust: the larger of those by the median and by the 80 % quantile of
the errors, so that errors with more than Gaussian tails, which real robots have, are kept. The
limit of the mixture is then between 6 and 7 standard deviations: of Gaussian errors of known size
it calls fewer than one in 5 million gross. Their size is not known: the limit therefore counts the
degrees of freedom of rows and poses (`as_of_known_size`), without which one of 24 clean sessions
of ten single readings would lose a good row.
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

# Probability from which a row is left out.
CERTAIN = 0.99
# Prior of gross errors: their share, by a tenth of a row among a hundred, and their least width in
# standard deviations.
PRIOR_GROSS = 0.1
PRIOR_ROWS = 100.0
NARROWEST = 20.0
# Largest share of gross errors; above it the model or the session is wrong.
LARGEST_SHARE = 0.1
_QUANTILES = (0.5, 0.8)
# The same quantiles of the length of a standard normal vector in three dimensions.
_EXPECTED = np.array([MEDIAN_LENGTH, 2.1544437046])
# Largest ratio of the standard deviation by the 80 % quantile to that by the median; a share of
# gross errors above a fifth makes it larger.
TAIL_LIMIT = 4.0
# Largest number of refits until the same rows are left out.
MOST_REFITS = 20
# Number of unknowns of a sensor: its registration, its marker, a part of the offsets.
UNKNOWNS = 10
# Fewest rows of a judgement. With fewer the robust fit follows half of the rows closely, and the
# errors of the halves cannot be compared.
FEWEST_TO_JUDGE = 60


@dataclass(frozen=True, eq=False)
class Judgement:
    """Result of `judge` for each row, in the order of `Rows`."""

    gross: BoolArray  # True if the row is to be left out, (n,)
    why: tuple[str, ...]  # Reason with its numbers, '' for a kept row; n strings


def find_outliers(
    rows: Rows,
    refit: Callable[[BoolArray], FloatArray],
    errors: FloatArray,
    sensor_names: Sequence[str],
    gross: BoolArray | None = None,
) -> Judgement:
    """Gross rows, by repeated fits without them until the same rows are left out.

    If a row is good in a fit without it and gross in a fit with it, it is kept: rows are judged by
    the others. At most 20 refits. ``rows``: all rows; ``refit``: fits the rows that are True,
    (n,), and returns the errors of all, m, (n, 3); ``errors``: errors of a first, robust fit, m,
    (n, 3); ``sensor_names``: for the messages; ``gross``: rows that are known to be gross, (n,),
    or None. Raises MisfitError if more than a tenth of a sensor's rows would be left out, or too
    many are gross to identify them.
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
    """Judgement whether each row is a gross error, by the rows that are not gross yet.

    A row is compared with the other rows of its pose. The mean error of a pose with several
    rows is compared with those of the other poses; if it is gross, all rows of the pose are.
    Gross means a probability above 99 % (`CERTAIN`); a gross position makes the orientation of
    the same reading gross, and the reverse. ``errors``: m (rad), (n, 3); ``gross``: mask of
    rows that do not count, (n,).
    """
    group = rows.group_of_row
    sensor = rows.group_sensor[group]
    good = ~gross
    count = rows.group_sum(good.astype(float))
    total = rows.group_sum(errors * good[:, None])
    sigma, pose_sigma = robust_noise(rows, errors, good)

    # Error common to the rows of the pose, by the other good rows.
    other_count = count[group] - good
    mean = (total[group] - errors * good[:, None]) / np.maximum(other_count, 1.0)[:, None]
    variance, common = sigma[sensor] ** 2, pose_sigma[sensor] ** 2
    share = other_count * common / (variance + other_count * common)
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

    # A pose is gross if its rows agree with each other and with no other pose.
    pose_mean = total / np.maximum(count, 1.0)[:, None]
    pose_spread = np.sqrt(
        pose_sigma[rows.group_sensor] ** 2 + sigma[rows.group_sensor] ** 2 / np.maximum(count, 1.0)
    )
    pose_sigmas = np.linalg.norm(pose_mean, axis=1) / pose_spread
    off = np.zeros(len(count))
    for index, _ in rows.spans:
        selection = (rows.group_sensor == index) & (count > 1)
        freedom = 3 * int(selection.sum()) - UNKNOWNS
        off[selection] = gross_probability(as_of_known_size(pose_sigmas[selection], freedom))
    for index in np.flatnonzero(off > CERTAIN).tolist():
        start = int(rows.group_start[index])
        for row in range(start, start + rows.group_size[index]):
            gross_now[row] = True
            why[row] = (
                f'residual {_size(float(np.linalg.norm(errors[row])), row >= rows.points)}: the '
                f'whole pose is off by {pose_sigmas[index]:.0f} sigma; gross with probability '
                f'{_percent(off[index])}'
            )
    # A reading with a gross orientation has no reliable position, and the reverse.
    return Judgement(rows.whole(gross_now), tuple(why))


def as_of_known_size(sigmas: FloatArray, freedom: int) -> FloatArray:
    """Lengths of errors in known standard deviations, as rare as the given ones, (n,).

    ``sigmas``: lengths of three-dimensional errors in standard deviations that are estimated,
    (n,); ``freedom``: degrees of freedom of the estimate, at least one. The square of such a
    length is three times F-distributed, in known standard deviations chi-squared.
    """
    rarity = fdtrc(3, max(freedom, 1), sigmas**2 / 3.0)
    known: FloatArray = np.sqrt(chdtri(3, np.maximum(rarity, np.finfo(float).tiny)))
    return known


def gross_probability(sigmas: FloatArray) -> FloatArray:
    """Probability (n,) that each of three-dimensional errors is gross.

    ``sigmas``: lengths of the errors in standard deviations of good errors, (n,). A mixture of two
    Gaussians, the wide one at least 20 times as wide (`NARROWEST`), whose share and width fit
    these errors by expectation maximisation.
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
    """Sigma and pose_sigma of each sensor, m, one for each of ``rows.spans``, robust to outliers.

    If poses have one good row each, all of the error counts as sigma. ``errors``: m, (n, 3);
    ``good``: mask of the rows that count, (n,).
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
        variance_of_mean = sigma[index] ** 2 * np.mean(1.0 / count[poses])
        pose_sigma[index] = np.sqrt(max(pose_total**2 - variance_of_mean, 0.0))
    return sigma, pose_sigma


def robust_scale(lengths: FloatArray) -> float:
    """Standard deviation per axis of three-dimensional errors of these lengths (n,), m.

    The larger of those by the median and by the 80 % quantile, plus 0.1 µm; at least one length.
    """
    return float(np.max(np.quantile(lengths, _QUANTILES) / _EXPECTED)) + RESOLUTION_M


def _require_majority(rows: Rows, errors: FloatArray, sensor_names: Sequence[str]) -> None:
    """Raise MisfitError if a sensor has too many gross errors to identify them.

    That is if the scale by the 80 % quantile is over 4 times (`TAIL_LIMIT`) that by the median;
    sensors with fewer than 60 rows (`FEWEST_TO_JUDGE`) are not judged.
    """
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
    """Raise MisfitError if over `LARGEST_SHARE` of a sensor's observations are gross.

    One gross error is always allowed.
    """
    names = _names(rows, sensor_names)
    for sensor, span in rows.spans:
        gross_count, count = int(gross[span].sum()), span.stop - span.start
        if gross_count > max(1.0, LARGEST_SHARE * count):
            raise MisfitError(
                f"sensor '{names[sensor]}': {gross_count} of {count} observations are gross "
                'errors, '
                'too many to leave out',
                'look for mixed-up markers or a sensor that was moved',
            )


def _names(rows: Rows, sensor_names: Sequence[str]) -> list[str]:
    """Names of the sensors, then '<sensor> (orientation)' of those with fitted orientations."""
    return [*sensor_names, *(f'{sensor_names[sensor]} (orientation)' for sensor in rows.turning)]


def _size(error: float, turned: bool) -> str:
    """Size of an error as text: '1.2 mm' for a length in m, '0.12 degrees' for an angle in rad.

    ``turned``: whether the error is an angle.
    """
    return f'{np.degrees(error):.2f} degrees' if turned else f'{error * 1e3:.1f} mm'


def _percent(probability: float) -> str:
    """Probability as text, never 100 %."""
    return f'{100.0 * probability:.1f} %' if probability < 0.999 else 'above 99.9 %'
