# SPDX-License-Identifier: Apache-2.0
"""Fits of sets of cells: Gram matrices that are kept, cells taken out, noise that is settled."""

from typing import Any

import numpy as np
import pytest
from worlds.discovery_scenes import residuals_of, session_with

from remaster_ros.discovery import evidence, packed
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.residuals import Residuals, units
from remaster_ros.discovery.solution import Solution


@pytest.fixture(scope='module')
def scene() -> tuple[Any, list[Candidate]]:
    session = session_with(5)
    data = residuals_of(session)
    candidates = []
    for name in ('joint_compliance', 'joint_error_curve', 'link_length'):
        added = 0
        for candidate in EFFECTS[name].candidates(data.context):
            if added < 3 and solve(data, (*candidates, candidate)) is not None:
                candidates.append(candidate)
                added += 1
    assert len(candidates) == 9
    return session, candidates


def assert_near(grams, expected, size):
    """Packed Gram matrices agree to rounding, in units of their columns."""
    unit = np.sqrt(expected[:, packed.diagonal(size)])
    i, j = np.tril_indices(size)
    assert np.max(np.abs(grams - expected) / (1e-300 + unit[:, i] * unit[:, j])) < 1e-9


@pytest.mark.parametrize(
    ('known', 'wanted'),
    [(range(9), [5, 0, 8, 3]), (range(5), [6, 1, 4, 7])],
    ids=['a part', 'with other cells'],
)
def test_gram_matrices_beside_known_ones_are_those_computed_for_them_alone(scene, known, wanted):
    session, candidates = scene
    data = residuals_of(session)
    data.gram_matrices([candidates[i] for i in known])
    part = [candidates[i] for i in wanted]
    norms, grams = data.gram_matrices(part)
    fresh_norms, fresh_grams = residuals_of(session).gram_matrices(part)
    assert norms == pytest.approx(fresh_norms, rel=1e-12)
    assert_near(grams, fresh_grams, len(norms))


def test_gram_matrices_are_of_columns_in_their_units(scene):
    data, candidates = residuals_of(scene[0]), scene[1]
    norms, grams = data.gram_matrices(candidates)
    joined = np.concatenate((data.base, data.columns(candidates), data.errors[:, :, None]), axis=2)
    assert norms == pytest.approx(np.sqrt(np.sum(joined**2, axis=(0, 1))))
    unit = np.ones(len(norms))
    unit[data.base.shape[2] : -1] = units(candidates, norms[data.base.shape[2] : -1])
    joined = joined / unit
    plain = data.noise_model.gram(lambda _, where: joined[where], len(norms))
    assert_near(grams, packed.of_rows(plain, 0), len(norms))


def test_a_column_without_rows_has_the_unit_of_its_spline_or_one(scene):
    curve = next(candidate for candidate in scene[1] if candidate.penalty is not None)
    plain = next(candidate for candidate in scene[1] if candidate.penalty is None)
    norms = np.zeros(plain.size + curve.size)
    assert np.array_equal(units((plain, curve), norms), np.ones(len(norms)))
    norms[-2] = 4.0
    assert np.array_equal(units((plain, curve), norms)[plain.size :], np.full(curve.size, 4.0))


@pytest.mark.parametrize('count', [0, 2, 8])
def test_what_a_caller_does_to_norms_and_matrices_stays_with_the_caller(scene, count):
    data = residuals_of(scene[0])
    candidates = scene[1][:count]
    given = data.gram_matrices(candidates)
    kept = [values.copy() for values in given]
    for values in given:
        # What is not a copy is kept, and cannot be written to.
        if values.flags.writeable:
            values[:] = 0.0
    for values, before in zip(data.gram_matrices(candidates), kept, strict=True):
        assert np.array_equal(values, before)


def test_noise_and_smoothness_are_where_no_small_step_raises_the_likelihood(scene):
    data: Residuals = residuals_of(scene[0])
    systems: list[Any] = []
    solve_with = evidence.System.solution

    def kept(system: Any, start: Solution | None, prior: float) -> Solution:
        found = solve_with(system, start, prior)
        systems.append((system, system._last[0]))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evidence.System, 'solution', kept)
        assert solve(data, scene[1]) is not None
    ((system, eta),) = systems
    most = system.value(eta)
    for step in 0.3 * np.eye(len(eta)):
        assert system.value(eta + step) < most + 2.0 * evidence.GAIN
        assert system.value(eta - step) < most + 2.0 * evidence.GAIN
