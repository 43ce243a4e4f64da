"""R-hat and effective sample size, judged by arviz-stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from remaster_ros.calibration.convergence import ess_bulk, ess_tail, r_hat
from remaster_ros.errors import InsufficientDataError


def autoregressive(correlation: float, chains: int, draws: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((chains, draws))
    return lfilter([1.0], [1.0, -correlation], noise, axis=1)


@pytest.mark.parametrize('correlation', [-0.5, -0.2, 0.0, 0.3, 0.9])
@pytest.mark.parametrize(('chains', 'draws'), [(4, 500), (4, 501), (2, 1000)])
def test_arviz_finds_the_same(correlation: float, chains: int, draws: int) -> None:
    judge = pytest.importorskip('arviz_stats.base').array_stats
    x = autoregressive(correlation, chains, draws, seed=17)
    axes = {'chain_axis': 0, 'draw_axis': 1}
    assert r_hat(x) == pytest.approx(judge.rhat(x, **axes), rel=1e-9)
    assert ess_bulk(x) == pytest.approx(judge.ess(x, method='bulk', **axes), rel=1e-9)
    tail = judge.ess(x, method='tail', prob=0.05, **axes)
    assert ess_tail(x) == pytest.approx(tail, rel=1e-9)


def test_every_quantity_is_judged_on_its_own() -> None:
    first, second = (autoregressive(c, 4, 300, seed=1) for c in (0.0, 0.8))
    both = np.stack((first, second), axis=-1)
    for figure in (r_hat, ess_bulk, ess_tail):
        np.testing.assert_allclose(figure(both), [figure(first), figure(second)])


def test_the_effective_size_of_correlated_draws() -> None:
    """Known for an AR(1): n (1 - c) / (1 + c); 8000 draws estimate it to about 10 %."""
    x = autoregressive(0.6, 4, 2000, seed=3)
    assert ess_bulk(x) == pytest.approx(8000 * 0.4 / 1.6, rel=0.3)


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
