"""Effects drawn given the arm and the noise: from what the errors say, with an exact density."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_scenes import extension, one_tool_direction

from remaster_ros.calibration import conditional_proposal
from remaster_ros.calibration.conditional_proposal import ConditionalProposal
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.extension import Extension
from remaster_ros.calibration.importance import Weighted
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.linearisation import linearise
from remaster_ros.calibration.proposal import LaplaceProposal
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.types import Session

ORDERS = 4
# Of each coefficient of a wave, rad.
WAVE_STD = 1e-3


def waves(session: Session) -> Extension:
    """Waves of the angle readings of joints 2, 4 and 6, which a Gaussian prior bounds."""
    q = session.measurements.q
    n, joints = q.shape
    names, columns = [], []
    for joint in (1, 3, 5):
        for order in range(1, ORDERS + 1):
            # Faster than the small cube is wide, so that each order is another shape in it.
            for kind, values in (('sin', np.sin), ('cos', np.cos)):
                column = np.zeros((n, joints, 1))
                column[:, joint, 0] = values(4 * order * q[:, joint])
                columns.append(column)
                names.append(f'{kind}_{joint + 1}_{order}')
    m = len(names)
    return extension(
        names=tuple(names),
        units=('rad',) * m,
        joint=np.concatenate(columns, axis=2),
        displacement=np.zeros((n, 3, m)),
        displacement0=np.zeros((n, 3)),
        theta0=np.zeros(m),
        prior_precision=np.eye(m) / WAVE_STD**2,
    )


@pytest.fixture(scope='module')
def mode() -> Mode:
    """Of a session in which the tool hardly turns, so that its marker is known to millimetres."""
    session = one_tool_direction(5, turned=0.02)
    return estimate(Problem.of(session), waves(session)).mode


@pytest.fixture(scope='module')
def proposal(mode: Mode) -> ConditionalProposal:
    found = ConditionalProposal.of(mode)
    assert found is not None
    return found


def test_draws_come_with_their_density(proposal) -> None:
    points, log_density = proposal.sample(300, np.random.default_rng(1))
    np.testing.assert_allclose(proposal.log_density(points), log_density, rtol=0, atol=1e-6)
    shares = len(proposal.mode.linearisation.posterior.noise_model.shares)
    assert shares > 0
    assert np.all(points[:, -shares:] >= 0.0)


def test_the_density_is_normalised(proposal, mode) -> None:
    """Of two of them the mean ratio over draws of one is 1, to five standard errors."""
    points, _ = proposal.sample(500, np.random.default_rng(1))
    other = proposal.adapted(points, np.full(len(points), 1.0 / len(points)))
    points, log_density = proposal.sample(4000, np.random.default_rng(2))
    ratio = np.exp(other.log_density(points) - log_density)
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / np.sqrt(len(ratio))


def test_effects_are_where_a_linearisation_of_their_own_has_them(mode, monkeypatch) -> None:
    """Against the tangent there: what is left out is of third order, of the precision second.

    Also the axes that hardly matter are followed here, as they are not where time counts.
    """
    monkeypatch.setattr(conditional_proposal, 'NEGLIGIBLE', 0.0)
    proposal = ConditionalProposal.of(mode)
    posterior = mode.linearisation.posterior
    free, core = posterior.free, posterior.model.core
    c = int(np.sum(free < core))
    rng = np.random.default_rng(3)
    for _ in range(5):
        away = proposal.outer.factor @ rng.standard_normal(len(proposal.outer.mean))
        apart, moved = [], 0.0
        for distance in (1.0, 0.5):
            outside = proposal.outer.mean + distance * away
            outside[c:] = mode.eta
            z = mode.z.copy()
            z[free[:c]] += outside[:c]
            there = linearise(posterior, z).gram(mode.eta)
            precision, pull = there[c:-1, c:-1], there[c:-1, -1]
            expected = np.linalg.solve(precision, pull)
            half, factor = proposal._conditional(outside[None])
            mean = np.linalg.solve(factor[0].T, half[0])
            root = np.linalg.cholesky(precision).T
            apart.append(np.linalg.norm(root @ (mean * proposal.unit - expected)))
            moved = max(moved, float(np.linalg.norm(root @ expected)))
            scale = np.sqrt(np.diag(precision))
            ours = factor[0] @ factor[0].T / np.outer(proposal.unit * scale, proposal.unit * scale)
            np.testing.assert_allclose(ours, precision / np.outer(scale, scale), atol=0.002)
        print('effects moved, off', moved, apart)
        assert apart[0] < 0.03 * moved
        assert apart[1] < max(apart[0] / 6.0, 1e-3)


def test_it_is_worth_more_than_a_gaussian_of_all_parameters(proposal, mode) -> None:
    """Draws of both weighted by the same posterior, neither adapted."""
    posterior = mode.linearisation.posterior
    effective = []
    for one in (proposal, LaplaceProposal(mode)):
        points, log_proposal = one.sample(4000, np.random.default_rng(4))
        weighted = Weighted.of(points, posterior.log_density(points) - log_proposal, one)
        effective.append(weighted.effective)
    print('effective draws', effective)
    assert effective[0] > 3.0 * effective[1]


def test_the_sampler_uses_it_and_agrees_with_another_route(mode, monkeypatch) -> None:
    """Means and widths against what the sampler gives without this proposal.

    Five standard errors of 100 effective draws on either side.
    """
    options = {'chains': 4, 'precision': 0.1}
    found = sample_posterior(mode, rng=np.random.default_rng(5), **options)
    assert 'effects drawn given the other parameters' in found.name
    assert found.run.pareto_k < 0.7
    monkeypatch.setattr(ConditionalProposal, 'of', lambda mode: None)
    other = sample_posterior(mode, rng=np.random.default_rng(6), **options)
    assert 'effects drawn' not in other.name
    ours, theirs = (run.draws.reshape(-1, run.draws.shape[-1]) for run in (found.run, other.run))
    width = theirs.std(axis=0)
    assert np.max(np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) / width) < 5 * np.sqrt(2 / 100)
    assert np.max(np.abs(np.log(ours.std(axis=0) / width))) < 5 * np.sqrt(1 / 100)


def test_where_it_fails_the_sampler_does_without(mode, monkeypatch) -> None:
    """A draw so far out that rounding leaves an effect undetermined ends nothing."""

    def fails(self: ConditionalProposal, outside: np.ndarray) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(ConditionalProposal, '_conditional', fails)
    found = sample_posterior(mode, chains=4, precision=0.1, rng=np.random.default_rng(8))
    assert 'effects drawn' not in found.name
    assert np.all(np.isfinite(found.run.draws))


def test_axes_that_hardly_matter_cost_hardly_a_draw(proposal, mode, monkeypatch) -> None:
    """Effective draws with the axes that count and with all of them."""
    monkeypatch.setattr(conditional_proposal, 'NEGLIGIBLE', 0.0)
    every = ConditionalProposal.of(mode)
    assert len(proposal.axes) < len(every.axes)
    posterior = mode.linearisation.posterior
    effective = []
    for one in (proposal, every):
        points, log_proposal = one.sample(4000, np.random.default_rng(7))
        log_weight = posterior.log_density(points) - log_proposal
        effective.append(Weighted.of(points, log_weight, one).effective)
    print('effective draws', effective)
    assert effective[0] > 0.7 * effective[1]


def test_without_effects_or_with_too_many_there_is_none(mode, monkeypatch) -> None:
    bare = estimate(Problem.of(one_tool_direction(5, turned=0.02)))
    assert ConditionalProposal.of(bare.mode) is None
    monkeypatch.setattr(conditional_proposal, 'MOST_ENTRIES', 1000)
    assert ConditionalProposal.of(mode) is None
