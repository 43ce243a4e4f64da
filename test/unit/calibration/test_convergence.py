"""R-hat and effective sample size of autoregressive chains, whose effective size is known."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy.signal import lfilter

from remaster_ros.calibration.convergence import ess_bulk, ess_tail, r_hat
from remaster_ros.calibration.proposal import Weighted
from remaster_ros.errors import InsufficientDataError


def autoregressive(correlation: float, chains: int, draws: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((chains, draws))
    return lfilter([1.0], [1.0, -correlation], noise, axis=1)


@pytest.mark.parametrize(
    ('correlation', 'chains', 'draws', 'expected'),
    [
        (-0.5, 4, 501, (0.99939921994, 5374.47464544, 1681.19741276)),
        (0.0, 2, 1000, (1.00075338726, 1878.57794709, 1422.5277904)),
        (0.3, 4, 501, (1.00380385076, 808.94961177, 1222.92770373)),
        (0.9, 4, 500, (1.04873881391, 101.955822651, 252.903346963)),
    ],
)
def test_figures_are_those_of_another_implementation(correlation, chains, draws, expected) -> None:
    """Written from the equations of Vehtari et al. (2021), without arviz-stats."""
    x = autoregressive(correlation, chains, draws, seed=17)
    assert (r_hat(x), ess_bulk(x), ess_tail(x)) == pytest.approx(expected, rel=1e-9)


def test_figures_are_those_of_arviz() -> None:
    rng = np.random.default_rng(23)
    for trial in range(40):
        chains, length = rng.integers(2, 6), rng.integers(8, 900)
        x = rng.standard_normal((chains, length, 3))
        x = lfilter([1.0], [1.0, -rng.uniform(-0.9, 0.98)], x, axis=1)
        if trial % 3 == 0:
            x = np.round(x, 1)  # Draws that repeat themselves, as where proposals are refused.
        if trial % 5 == 0:
            x[0] += rng.standard_normal()
        axes = {'chain_axis': 0, 'draw_axis': 1}
        np.testing.assert_allclose(r_hat(x), array_stats.rhat(x, **axes), rtol=1e-8)
        bulk = array_stats.ess(x, method='bulk', **axes)
        np.testing.assert_allclose(ess_bulk(x), bulk, rtol=1e-8)
        tail = array_stats.ess(x, method='tail', prob=0.05, **axes)
        np.testing.assert_allclose(ess_tail(x), tail, rtol=1e-8)


def test_weights_are_smoothed_as_by_arviz() -> None:
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


@pytest.mark.parametrize('others', [-800.0, -700.0, -300.0, -np.inf])
def test_one_weight_that_is_all_of_them_stays_a_number(others: float) -> None:
    log_weight = np.append(0.0, np.full(999, others) + 1e-3 * np.arange(999))
    drawn = Weighted.of(np.zeros((1000, 1)), log_weight)
    assert np.isfinite(drawn.weight).all()
    assert drawn.effective == pytest.approx(1.0, abs=0.02)
    assert drawn.pareto_k > 0.7


def test_chains_that_stay_apart_have_no_finite_r_hat() -> None:
    x = np.repeat(np.arange(4.0)[:, None], 100, axis=1)
    assert not r_hat(x) < 10.0


def test_every_quantity_is_judged_on_its_own() -> None:
    first, second = (autoregressive(c, 4, 300, seed=1) for c in (0.0, 0.8))
    both = np.stack((first, second), axis=-1)
    for figure in (r_hat, ess_bulk, ess_tail):
        np.testing.assert_allclose(figure(both), [figure(first), figure(second)])


@pytest.mark.parametrize('correlation', [-0.3, 0.0, 0.3, 0.6, 0.9])
def test_the_effective_size_of_correlated_draws(correlation: float) -> None:
    """Known for the mean of an AR(1): n (1 - c) / (1 + c); 80,000 draws estimate it to 5 %."""
    x = autoregressive(correlation, 4, 20_000, seed=3)
    expected = 80_000 * (1.0 - correlation) / (1.0 + correlation)
    assert ess_bulk(x) == pytest.approx(expected, rel=0.15)


def test_a_chain_elsewhere_shows_in_r_hat() -> None:
    x = autoregressive(0.0, 4, 500, seed=5)
    assert r_hat(x) < 1.01
    x[0] += 1.0
    assert r_hat(x) > 1.05


def test_a_chain_that_is_wider_shows_too() -> None:
    x = autoregressive(0.0, 4, 500, seed=6)
    x[0] *= 5.0
    assert r_hat(x) > 1.05


def test_what_never_moves_has_no_figure() -> None:
    still = np.ones((4, 100))
    assert np.isnan([r_hat(still), ess_bulk(still), ess_tail(still)]).all()


def test_short_chains_are_refused_with_the_number() -> None:
    with pytest.raises(InsufficientDataError, match='chains of 7 draws'):
        r_hat(np.zeros((4, 7)))
