# SPDX-License-Identifier: Apache-2.0
"""Gross errors: named with their numbers, neighbours and heavy tails left alone."""

import numpy as np
import pytest
from scipy.stats import chi

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.outliers import (
    CERTAIN,
    find_outliers,
    gross_probability,
    judge,
    robust_noise,
)
from remaster_ros.errors import InsufficientDataError

SIGMA, POSE_SIGMA = 0.2e-3, 0.8e-3


def rows_of(poses: int, solutions: int) -> Rows:
    n = poses * solutions
    return Rows(
        source=np.arange(n),
        q=np.zeros((n, 2)),
        marker=np.zeros(n, dtype=np.int64),
        target=np.zeros((n, 3)),
        spans=((0, slice(0, n)),),
        group_start=np.arange(0, n, solutions),
        group_size=np.full(poses, solutions),
        group_sensor=np.zeros(poses, dtype=np.int64),
    )


def errors_of(rows: Rows, seed: int) -> np.ndarray:
    print(f'errors seed {seed}')
    rng = np.random.default_rng(seed)
    common = POSE_SIGMA * rng.standard_normal((len(rows.group_start), 3))
    return common[rows.group_of_row] + SIGMA * rng.standard_normal((len(rows), 3))


def find(rows: Rows, errors: np.ndarray):
    return find_outliers(rows, lambda keep: errors, errors, ('mocap',))


def test_one_bad_row_is_named_and_its_neighbours_are_not() -> None:
    rows = rows_of(40, 5)
    errors = errors_of(rows, 1)
    errors[17] = [0.012, 0.0, 0.0]
    found = find(rows, errors)
    assert np.flatnonzero(found.gross).tolist() == [17]
    text = found.why[17]
    assert text.startswith('residual 1')
    assert text.endswith(' sigma; gross with probability above 99.9 %')
    assert not any(why for row, why in enumerate(found.why) if row != 17)


@pytest.mark.parametrize(
    ('poses', 'solutions', 'seed', 'off'),
    [
        (40, 5, 2, {20: [0.02, 0.0, 0.0], 22: [0.0, -0.03, 0.0]}),
        (100, 2, 3, {31: [0.0, 0.0, 0.02]}),
        (40, 4, 4, {row: [0.0, 0.02, 0.0] for row in range(8, 12)}),
    ],
    ids=['two of a pose of five', 'one of a pair', 'a whole pose'],
)
def test_bad_rows_of_a_pose_are_named_and_no_other(poses, solutions, seed, off) -> None:
    rows = rows_of(poses, solutions)
    errors = errors_of(rows, seed)
    for row, error in off.items():
        errors[row] += error
    found = find(rows, errors)
    assert np.flatnonzero(found.gross).tolist() == list(off)
    assert all('residual' in found.why[row] for row in off)


def test_good_rows_are_left_alone() -> None:
    """100 sets of 200 Gaussian rows, one in 5 million called gross: 1 in 250 seeds fails."""
    rows = rows_of(40, 5)
    assert not any(find(rows, errors_of(rows, seed)).gross.any() for seed in range(100))


def test_heavy_tails_are_not_eaten() -> None:
    """Student t errors of 5 degrees of freedom: nearly all of 2,000 rows stay."""
    rows = rows_of(1000, 2)
    rng = np.random.default_rng(5)
    mixing = np.sqrt(rng.chisquare(5.0, (2000, 1)) / 5.0)
    errors = 1e-3 * rng.standard_normal((2000, 3)) / mixing
    assert find(rows, errors).gross.mean() < 0.005


def test_bounded_errors_of_a_robot_are_not_eaten() -> None:
    """Systematic errors of 1 mm, uniform, neither Gaussian nor shared by the pose."""
    rows = rows_of(400, 2)
    errors = np.random.default_rng(6).uniform(-1e-3, 1e-3, (800, 3))
    assert not find(rows, errors).gross.any()


def test_robust_noise_finds_both_parts_despite_outliers() -> None:
    rows = rows_of(60, 5)
    errors = errors_of(rows, 7)
    errors[::29] += 0.05
    sigma, pose_sigma = robust_noise(rows, errors, np.ones(len(rows), dtype=bool))
    # Contaminated poses widen both somewhat; the flagged rows are then taken out.
    assert 0.8 * SIGMA < sigma[0] < 3.0 * SIGMA
    assert 0.7 * POSE_SIGMA < pose_sigma[0] < 2.0 * POSE_SIGMA


def test_single_rows_are_judged_by_the_total() -> None:
    rows = rows_of(200, 1)
    errors = errors_of(rows, 8)
    errors[3] += [0.02, 0.0, 0.0]
    found = judge(rows, errors, np.zeros(200, dtype=bool))
    assert np.flatnonzero(found.gross).tolist() == [3]
    assert robust_noise(rows, errors, ~found.gross)[1][0] == 0.0


@pytest.mark.parametrize(
    ('share', 'message'), [(0.15, 'gross errors, too many'), (0.4, 'half of the')]
)
def test_too_many_gross_errors_are_an_error(share: float, message: str) -> None:
    rows = rows_of(200, 1)
    errors = errors_of(rows, 9)
    bad = np.random.default_rng(10).random(200) < share
    errors[bad] += [0.05, 0.0, 0.0]
    with pytest.raises(InsufficientDataError, match=message):
        find(rows, errors)


def test_the_limit_of_good_rows_is_the_documented_one() -> None:
    """Of good errors with one more at x: the x from which on it is gross, by chi's quantiles."""
    for count in (30, 200, 5000):
        good = chi.ppf((np.arange(count) + 0.5) / count, 3)
        lengths = np.linspace(5.0, 8.0, 301)
        called = [gross_probability(np.append(good, x))[-1] > CERTAIN for x in lengths]
        limit = lengths[np.argmax(called)]
        assert called == [x >= limit for x in lengths]
        assert chi.sf(limit, 3) < 2e-7
        assert limit < 7.0


def test_the_mixture_finds_share_and_kind_of_each_row() -> None:
    """5 % of 2,000 errors 30 times as wide: nearly all are found, in line with their length."""
    rng = np.random.default_rng(11)
    lengths = np.linalg.norm(rng.standard_normal((2000, 3)), axis=1)
    bad = np.arange(2000) < 100
    lengths[bad] *= 30.0
    probability = gross_probability(lengths)
    assert not np.any(probability[~bad] > CERTAIN)
    # An error 30 times as wide is shorter than 6.5 in fewer than 1 of 100 cases.
    assert np.sum(probability[bad] > CERTAIN) >= 94
    assert np.all(np.diff(probability[np.argsort(lengths)]) >= 0.0)


def test_two_thirds_of_a_pose_masked_by_each_other() -> None:
    """Two rows of a pose of three, both off the same way: the pose is named, none is missed."""
    rows = rows_of(40, 3)
    errors = errors_of(rows, 12)
    errors[[30, 31]] += [0.02, 0.0, 0.0]
    found = np.flatnonzero(find(rows, errors).gross)
    assert {30, 31} <= set(found.tolist()) <= {30, 31, 32}


def test_rows_that_come_and_go_stay_in() -> None:
    """A fit without them calls them good, one with them gross: here a whole pose of five."""
    pose = [15, 16, 17, 18, 19]
    rows = rows_of(40, 5)
    errors = errors_of(rows, 12)
    off = errors.copy()
    off[17] = [0.012, 0.0, 0.0]
    fits = []

    def refit(keep: np.ndarray) -> np.ndarray:
        fits.append(np.flatnonzero(~keep).tolist())
        return off if keep.all() else errors

    found = find_outliers(rows, refit, off, ('mocap',))
    assert not found.gross.any()
    assert not any(found.why)
    assert fits == [pose, []]


def test_what_is_known_to_be_gross_is_not_sought_again() -> None:
    rows = rows_of(40, 5)
    errors = errors_of(rows, 13)
    errors[17] = [0.012, 0.0, 0.0]
    known = np.arange(len(rows)) == 17

    def never(keep: np.ndarray) -> np.ndarray:
        raise AssertionError('nothing is to be fitted')

    found = find_outliers(rows, never, errors, ('mocap',), known)
    np.testing.assert_array_equal(found.gross, known)
