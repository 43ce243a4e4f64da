"""Sessions whose posterior is nearly singular: they end, and the open direction is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import CHAIN, extension, one_tool_direction, scene

from remaster_ros.calibration import laplace, sampling
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.laplace import find_mode
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import FloatArray, Session


@pytest.fixture(scope='module')
def session() -> Session:
    return one_tool_direction(3)


def test_a_nearly_singular_session_ends_with_its_direction_named(session, monkeypatch) -> None:
    evaluated = 0
    density = Posterior._log_density

    def counted(self: Posterior, points: FloatArray) -> FloatArray:
        nonlocal evaluated
        evaluated += len(points) * len(self.rows)
        return density(self, points)

    monkeypatch.setattr(Posterior, '_log_density', counted)
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 5_000_000)
    result = fit_session(session, rng=np.random.default_rng(1))
    sampler = result.sampler
    assert evaluated < sampling.EVALUATED_ROWS
    assert sampler.method in ('importance', 'laplace')
    assert not sampler.converged
    assert not sampler.wandering
    assert 'hardly determine registration.mocap.z (+1.00) and joint_2' in sampler.message
    assert f'Pareto k of the importance weights {sampler.pareto_k:.2f}' in sampler.message
    assert np.all(np.isnan(sampler.r_hat))


@pytest.mark.qualify
def test_the_allowance_does_not_depend_on_the_machine(session, monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 2_000_000)
    first, second = (fit_session(session, rng=np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first.draws, second.draws)


@pytest.mark.parametrize('least', [0.0, 1.1])
def test_chains_are_begun_only_where_enough_of_their_proposals_would_be_taken(
    session, monkeypatch, least
) -> None:
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 500_000)
    monkeypatch.setattr(sampling, 'HOPELESS_WEIGHTS', least)
    monkeypatch.setattr(sampling, 'DENSITY_ERROR_LIMIT', -1.0)
    begun = []
    independent = sampling._Task.independent

    def counted(task, *arguments):
        begun.append(arguments)
        return independent(task, *arguments)

    monkeypatch.setattr(sampling._Task, 'independent', counted)
    mode = estimate(Problem.of(session)).mode
    sampling.sample_posterior(mode, chains=4, rng=np.random.default_rng(2))
    assert len(begun) == (1 if least == 0.0 else 0)


def test_hopeless_weights_leave_the_gaussian_about_the_mode(session, monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 1_000_000)
    monkeypatch.setattr(sampling, 'FEWEST_EFFECTIVE', np.inf)
    mode = estimate(Problem.of(session)).mode
    run, name = sampling.sample_posterior(mode, chains=4, rng=np.random.default_rng(2))
    assert run.method == 'laplace'
    assert name.startswith('Gaussian about the mode')
    draws = run.draws.reshape(-1, run.draws.shape[-1])
    free = len(mode.linearisation.posterior.free)
    # Tails of a Student t in a twentieth of the draws.
    std = np.sqrt(np.diag(mode.covariance))
    np.testing.assert_allclose(draws[:, :free].std(axis=0), std, rtol=0.4)


def test_chains_hold_no_more_numbers_than_memory_allows(monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'LARGEST_CHAINS', 70_000)
    session = scene(43, poses=12)[0]
    result = fit_session(session, rng=np.random.default_rng(6), precision=0.005)
    size = result.draws.shape[-1]
    assert result.draws.shape[0] * result.draws.shape[1] * size <= 70_000
    assert not result.sampler.converged
    assert not result.sampler.wandering


def test_an_offset_known_only_to_a_degree_is_not_measured() -> None:
    """The tool turned the same way, the second joint against height: named, not applied."""
    session = one_tool_direction(4, turned=0.002, noise_m=1.5e-3)
    found = estimate(Problem.of(session))
    open_joints = [i for i, why in enumerate(found.gauge.why) if 'determine it only to' in why]
    assert open_joints
    std = np.sqrt(np.diag(found.mode.covariance))
    for joint in open_joints:
        name = CHAIN.joint_names[joint]
        assert f'{name} (' in found.gauge.why[joint]
        # By data and the prior on it; 1 degree by the data alone.
        assert np.degrees(std[list(found.posterior.free).index(joint)]) > 0.8


def test_what_does_not_settle_is_named() -> None:
    """The first and the last joint move nothing, and nothing is known of them."""
    found = estimate(Problem.of(scene(11, poses=12)[0]))
    posterior = replace(
        found.posterior, priors=(), free=np.append(found.posterior.free, 0), reference=found.mode.z
    )
    with pytest.raises(
        InsufficientDataError, match=r'determine joint_\d .* and joint_\d .*, which'
    ):
        find_mode(posterior)


def test_a_posterior_that_cannot_be_factored_is_one_clear_error(monkeypatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError('Matrix is not positive definite')

    monkeypatch.setattr('remaster_ros.calibration.fit.sample_posterior', fails)
    session = scene(11, poses=12)[0]
    with pytest.raises(InsufficientDataError, match=r'hardly determine .*; measure more poses'):
        fit_session(session, rng=np.random.default_rng(1))


def test_effects_that_do_not_hold_are_blamed_not_the_units() -> None:
    """Displacements of a metre that no measurement shows."""
    session = scene(12, poses=12)[0]
    n = len(session.measurements)
    rng = np.random.default_rng(7)
    given = extension(
        names=('growth',),
        units=('1',),
        joint=np.zeros((n, 7, 1)),
        displacement=rng.standard_normal((n, 3, 1)),
        displacement0=rng.standard_normal((n, 3)),
        theta0=np.ones(1),
        prior_precision=np.zeros((1, 1)),
    )
    with pytest.raises(InsufficientDataError, match='further effects do not hold') as caught:
        estimate(Problem.of(session), given)
    assert 'units' not in str(caught.value)


def test_a_bend_is_what_a_step_leaves_to_second_order(session) -> None:
    mode = estimate(Problem.of(session)).mode
    posterior = mode.linearisation.posterior
    free = posterior.free
    values, vectors = np.linalg.eigh(mode.covariance)
    # Ten standard deviations along what is known worst.
    step = 10.0 * np.sqrt(values[-1]) * vectors[:, -1]
    bend = laplace._bend(mode.linearisation, step, mode.eta)

    def density(share: float, bent: float) -> float:
        point = mode.z[free] + share * step + bent * share**2 * bend
        return float(posterior.log_density(np.concatenate((point, mode.eta))[None])[0])

    for share in (0.25, 0.5, 1.0):
        assert density(share, 1.0) > max(density(share, 0.0), density(share, 2.0))
