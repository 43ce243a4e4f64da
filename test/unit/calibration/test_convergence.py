"""R-hat and effective sample size of autoregressive chains, whose effective size is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from remaster_ros.calibration.convergence import ess_bulk, ess_tail, r_hat
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
