"""Sessions whose posterior is nearly singular: they end, and the open direction is named."""

from __future__ import annotations

import numpy as np
import pytest
from worlds.calibration_scenes import one_tool_direction

from remaster_ros.calibration import sampling
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.posterior import Posterior
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
    assert sampler.method == 'laplace'
    assert not sampler.converged
    assert not sampler.wandering
    assert 'hardly determine registration.mocap.z (+1.00) and joint_2' in sampler.message
    assert f'Pareto k of the proposals {sampler.pareto_k:.2f}' in sampler.message
    assert np.all(np.isnan(sampler.r_hat))


@pytest.mark.qualify
def test_the_allowance_does_not_depend_on_the_machine(session, monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 2_000_000)
    first, second = (fit_session(session, rng=np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first.draws, second.draws)
