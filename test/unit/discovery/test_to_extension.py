# SPDX-License-Identifier: Apache-2.0
"""From a search to the model that is sampled: where the zero-offsets may go beside its effects."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import one_tool_direction
from worlds.discovery_scenes import at_joint, session_with

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.priors import OFFSET_STD, STEP_STD
from remaster_ros.discovery import unmodelled
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.to_extension import extension_of, offsets_of
from remaster_ros.discovery.unmodelled import Unmodelled


def searched(marker_std_m: float) -> tuple[Estimate, Residuals, Solution]:
    """A fit of which the last joint is known as well as the marker, 100 mm beside its axis."""
    session = replace(session_with(7, poses=15), marker_std_m=marker_std_m)
    found = estimate(Problem.of(session))
    residuals = Residuals.of(found)
    nothing = solve(residuals, ())
    assert nothing is not None
    return found, residuals, nothing


def test_offsets_stay_near_those_of_the_search():
    found, residuals, nothing = searched(0.5e-3)
    extension = extension_of(residuals, nothing, found)
    offsets, std = offsets_of(found)
    # Joint 1 is held.
    assert np.isnan(std[0])
    assert offsets[0] == 0.0
    np.testing.assert_array_equal(extension.joint_offsets, offsets)
    assert extension.step_std == STEP_STD


@pytest.mark.parametrize('marker_std_m', [0.5e-3, 5e-3])
def test_an_offset_that_only_a_prior_determines_is_known_no_better_for_it(marker_std_m):
    """As well as by the marker, or by what is known of any mastering."""
    found, data, nothing = searched(marker_std_m)
    std = offsets_of(found)[1][6]
    print('std by the fit, deg', np.degrees(std))
    moves = Unmodelled.of(found, data, nothing).by_open_offsets()
    data_std = (std**-2.0 + STEP_STD**-2.0 - OFFSET_STD**-2.0) ** -0.5
    if data_std > 0.95 * std:
        assert moves.shape[1] == 0
        return
    (move,) = moves.T
    assert np.hypot(data_std, move[6]) == pytest.approx(std, rel=0.02)
    # The marker goes along, so that it is seen where it was.
    model = found.model
    marker = model.natural(found.mode.z)[model.marker(0)]
    lever = np.hypot(*marker[:2])
    assert np.linalg.norm(move[model.marker(0)]) == pytest.approx(lever * abs(move[6]), rel=0.05)


def test_all_else_goes_along_with_an_open_offset():
    """A marker of unknown place on a tool that is always turned the same way."""
    found = estimate(Problem.of(one_tool_direction(3)))
    data = Residuals.of(found)
    nothing = solve(data, ())
    assert nothing is not None
    moves = Unmodelled.of(found, data, nothing).by_open_offsets()
    predict, rows = found.model.predict, found.posterior.rows
    before = predict(found.mode.z, rows)
    x = found.model.natural(found.mode.z)
    inner = [move for move in moves.T if np.argmax(np.abs(move[:7])) < 6]
    assert inner
    for move in inner:
        offset_step = np.where(np.arange(len(move)) == np.argmax(np.abs(move[:7])), move, 0.0)
        by_itself, together = (
            np.abs(predict(found.model.pinned(x + step), rows) - before).max()
            for step in (offset_step, move)
        )
        print('largest change, m: the offset by itself', by_itself, 'with all else', together)
        assert together < 0.2 * by_itself


def test_an_offset_that_the_data_determine_beside_the_causes_needs_no_more():
    """However little the fit without them knew of it, by the noise that it took them for."""
    session = session_with(7, lambda s: at_joint(4, 2e-2 * np.sin(3.0 * s.measurements.q[:, 3])))
    found = estimate(Problem.of(session))
    data = Residuals.of(found)
    waves = [
        candidate
        for candidate in EFFECTS['gear_periodic'].candidates(data.context)
        if candidate.joints == (4,)
    ]
    (wave,) = (candidate for candidate in waves if candidate.parameters[0] == 'sin3_4')
    solution = solve(data, (wave,))
    assert solution is not None
    std = offsets_of(found)[1][1:6]
    print('std without the cause, deg', np.degrees(std))
    assert Unmodelled.of(found, data, solution).by_open_offsets().shape[1] == 0


def test_what_other_models_have_is_the_variance_among_them():
    found, data, nothing = searched(0.5e-3)
    other = replace(nothing, base=nothing.base + 1e-4)
    (move,) = Unmodelled.of(found, data, nothing).by_models([(other, 0.25)]).T
    columns = data.full_jacobian[data.rows.source]
    free = found.posterior.free
    shift = columns[:, :, free] @ move[free]
    expected = 0.5 * (data.base @ (other.base - nothing.base))
    np.testing.assert_allclose(shift, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize('block_rows', [7, 40])
def test_what_moves_the_fit_does_not_depend_on_blocks_of_rows(monkeypatch, block_rows):
    found, data, nothing = searched(0.5e-3)
    at_once = Unmodelled.of(found, data, nothing)
    monkeypatch.setattr(unmodelled, 'BLOCK_ROWS', block_rows)
    by_blocks = Unmodelled.of(found, data, nothing)
    # The products are summed in another order.
    for moves in (Unmodelled.by_open_offsets, lambda equations: equations.by_drawing(())):
        np.testing.assert_allclose(
            by_blocks.std_of_offsets([moves(by_blocks)]),
            at_once.std_of_offsets([moves(at_once)]),
            rtol=1e-6,
        )


def test_the_rows_of_a_large_session_that_were_not_searched_count():
    found, data, nothing = searched(0.5e-3)
    part = data.only(data.rows.source[::2])
    every = Unmodelled.of(found, data, nothing)
    again = Unmodelled.of(found, part, nothing, data.rows.source)
    for equations in (every, again):
        assert len(equations.fitted) == len(data)
    np.testing.assert_allclose(
        again.std_of_offsets([again.by_open_offsets()]),
        every.std_of_offsets([every.by_open_offsets()]),
        rtol=1e-6,
    )


def test_the_tolerance_of_a_drawing_widens_offsets_beside_what_is_named():
    found, data, nothing = searched(0.5e-3)
    equations = Unmodelled.of(found, data, nothing)
    drawn = equations.by_drawing(())
    lengths = list(EFFECTS['link_length'].candidates(data.context))
    fewer = equations.by_drawing(lengths)
    known = ~np.isnan(offsets_of(found)[1])
    every, less = (equations.std_of_offsets([moves])[known] for moves in (drawn, fewer))
    exact = equations.std_of_offsets([])[known]
    assert (every >= less).all()
    assert (less >= exact).all()
    assert (every > 2.0 * exact).any()
