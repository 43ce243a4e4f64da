# SPDX-License-Identifier: Apache-2.0
"""Looks at a test while data come in: the error rate of all of them together is held."""

import numpy as np
import pytest
from scipy.stats import binomtest, chi2, norm

from remaster_ros.calibration.group_sequential import p_value_limits, spent

RATE = 0.01
SEED = 5


def test_a_single_look_has_all_of_the_error_rate():
    assert p_value_limits((1.0,), RATE) == pytest.approx((RATE,), rel=1e-4)


def test_early_looks_spend_next_to_nothing_and_the_last_one_nearly_all():
    limits = p_value_limits(tuple((np.arange(12) + 1) / 12), RATE)
    assert limits[0] < 1e-12
    assert np.all(np.diff(limits) > 0)
    assert 0.5 * RATE < limits[-1] < RATE
    assert spent(np.array([1.0]), RATE) == pytest.approx(RATE)


@pytest.mark.parametrize('freedom', [1, 12])
def test_the_error_rate_is_held_for_a_mean_and_for_a_sum_of_squares(freedom):
    """A false failure in less than 1 of 1,000 seeds where the rate is exactly 1 %."""
    print('seed', SEED)
    rng = np.random.default_rng(SEED)
    looks, sessions = 12, 20_000
    shares = (np.arange(looks) + 1) / looks
    limits = np.array(p_value_limits(tuple(shares), RATE))
    sums = rng.standard_normal((sessions, freedom, looks)).cumsum(axis=-1) * np.sqrt(1 / looks)
    z = sums / np.sqrt(shares)
    p = norm.sf(z[:, 0]) if freedom == 1 else chi2.sf(np.sum(z**2, axis=1), freedom)
    claims = int(np.sum(np.any(p < limits, axis=1)))
    assert binomtest(claims, sessions, RATE, alternative='greater').pvalue > 1e-3
    # Nor is it given away: at each look alone it is far more than the rate.
    assert claims > 0.4 * RATE * sessions
    assert np.mean(np.any(p < RATE, axis=1)) > 2.5 * RATE
