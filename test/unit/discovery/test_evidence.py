"""Fits of sets of cells: Gram matrices that are kept, noise that is settled later."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from discovery_scenes import residuals_of, session_with

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.families import visible
from remaster_ros.discovery.residuals import Residuals


@pytest.fixture(scope='module')
def scene() -> tuple[Any, list[Cell]]:
    session = session_with(5)
    data = residuals_of(session)
    cells = []
    for name in ('joint_compliance', 'joint_error_curve', 'link_length'):
        cells += visible(data, cells, list(EFFECTS[name].cells(data.context)))[:3]
    assert len(cells) == 9
    return session, cells


def test_gram_matrices_of_a_part_in_any_order_are_those_computed_for_it_alone(scene):
    session, cells = scene
    data = residuals_of(session)
    data.gram_matrices(cells)
    part = [cells[5], cells[0], cells[8], cells[3]]
    norms, grams = data.gram_matrices(part)
    fresh_norms, fresh_grams = residuals_of(session).gram_matrices(part)
    assert norms == pytest.approx(fresh_norms, rel=1e-12)
    size = np.sqrt(np.einsum('gii->gi', fresh_grams))
    error = np.abs(grams - fresh_grams) / (1e-300 + size[:, :, None] * size[:, None, :])
    assert error.max() < 1e-9


def test_what_a_caller_does_to_the_norms_stays_with_the_caller(scene):
    data = residuals_of(scene[0])
    norms, _ = data.gram_matrices(scene[1])
    kept = norms.copy()
    norms[:] = 0.0
    assert np.array_equal(data.gram_matrices(scene[1])[0], kept)


@pytest.mark.parametrize('dropped', range(6))
def test_the_evidence_with_the_noise_of_a_larger_set_is_at_most_that_with_its_own(scene, dropped):
    data: Residuals = residuals_of(scene[0])
    cells = scene[1][1:7]
    whole = solve(data, cells)
    rest = [cell for cell in cells if cell is not cells[dropped]]
    held, settled = solve(data, rest, whole, settled=False), solve(data, rest, whole)
    assert held is not None
    assert settled is not None
    assert whole is not None
    assert held.noise.sigma == pytest.approx(whole.noise.sigma, rel=1e-12)
    # ½ log N in place of a determinant: the maxima of evidence and likelihood differ a little.
    assert held.log_evidence < settled.log_evidence + 0.05
    again = solve(data, rest, held)
    assert again is not None
    assert again.log_evidence == pytest.approx(settled.log_evidence, abs=0.05)
