# SPDX-License-Identifier: Apache-2.0
"""R-hat, effective sample size and Pareto smoothing: those of arviz, and where they have none."""

import numpy as np
import pytest
from scipy.signal import lfilter

from remaster_ros.calibration.convergence import ess_bulk, ess_tail, r_hat
from remaster_ros.calibration.proposal import Weighted
from remaster_ros.errors import InsufficientDataError


@pytest.fixture(scope='module')
def array_stats():
    """Functions of arviz, whose import takes a second."""
    from arviz_stats.base import array_stats

    return array_stats


def test_figures_are_those_of_arviz(array_stats) -> None:
    """Of each quantity by itself."""
    rng = np.random.default_rng(23)
    for trial in range(40):
        chains, length = rng.integers(2, 6), rng.integers(8, 900)
        x = rng.standard_normal((chains, length, 3))
        x = lfilter([1.0], [1.0, -rng.uniform(-0.9, 0.98)], x, axis=1)
        if trial % 3 == 0:
            x = np.round(x, 1)  # Draws that repeat themselves, as where proposals are refused.
        if trial % 5 == 0:
            x[0] += rng.standard_normal()  # A chain that stays elsewhere.
        if trial % 7 == 0:
            x[0] *= 5.0  # One that is wider.
        axes = {'chain_axis': 0, 'draw_axis': 1}
        np.testing.assert_allclose(r_hat(x), array_stats.rhat(x, **axes), rtol=1e-8)
        bulk = array_stats.ess(x, method='bulk', **axes)
        np.testing.assert_allclose(ess_bulk(x), bulk, rtol=1e-8)
        tail = array_stats.ess(x, method='tail', prob=0.05, **axes)
        np.testing.assert_allclose(ess_tail(x), tail, rtol=1e-8)


def test_weights_are_smoothed_as_by_arviz(array_stats) -> None:
    rng = np.random.default_rng(24)
    for trial in range(40):
        count = rng.integers(30, 5000)
        log_weight = rng.uniform(0.01, 4.0) * rng.standard_normal(count)
        if trial % 2:
            log_weight = np.log(rng.standard_t(rng.uniform(0.7, 20.0), count) ** 2 + 1e-9)
        # It smooths the weights 1 / likelihood of a left-out observation: the sign turns.
        smoothed, pareto_k = array_stats.psislw(-log_weight)
        expected = np.exp(smoothed - np.max(smoothed))
        drawn = Weighted.of(np.zeros((count, 1)), log_weight)
        np.testing.assert_allclose(drawn.weight, expected / expected.sum(), rtol=1e-7)
        assert drawn.pareto_k == pytest.approx(pareto_k, abs=1e-9)
    alike = Weighted.of(np.zeros((100, 1)), np.zeros(100))
    np.testing.assert_allclose(alike.weight, 0.01)


@pytest.mark.parametrize('other_log_weight', [-800.0, -700.0, -300.0, -np.inf])
def test_one_weight_that_is_all_of_them_stays_a_number(other_log_weight: float) -> None:
    log_weight = np.append(0.0, np.full(999, other_log_weight) + 1e-3 * np.arange(999))
    drawn = Weighted.of(np.zeros((1000, 1)), log_weight)
    assert np.isfinite(drawn.weight).all()
    assert drawn.effective == pytest.approx(1.0, abs=0.02)
    assert drawn.pareto_k > 0.7


def test_chains_that_stay_apart_have_no_finite_r_hat() -> None:
    x = np.repeat(np.arange(4.0)[:, None], 100, axis=1)
    assert not r_hat(x) < 10.0


def test_what_never_moves_has_no_figure() -> None:
    still = np.ones((4, 100))
    assert np.isnan([r_hat(still), ess_bulk(still), ess_tail(still)]).all()


def test_short_chains_are_refused_with_the_number() -> None:
    with pytest.raises(InsufficientDataError, match='chains of 7 draws'):
        r_hat(np.zeros((4, 7)))
