"""The model of several searches is the mean of what they found."""

from __future__ import annotations

from functools import cache

import numpy as np
from discovery_scenes import at_joint, session_with

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.discovery.combined_searches import combined, holds, searches_with
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.to_extension import extension_of
from remaster_ros.types import FloatArray, Session

WAVE_RAD = 1e-3


@cache
def scene() -> tuple[Session, Estimate, Residuals]:
    session = session_with(
        81, lambda s: at_joint(4, WAVE_RAD * np.sin(s.measurements.q[:, 3])), poses=30
    )
    found = estimate(Problem.of(session))
    return session, found, Residuals.of(found)


def cell(name: str, joint: int) -> Cell:
    _, _, data = scene()
    return next(one for one in EFFECTS[name].cells(data.context) if one.joints == (joint,))


def solved(*cells: Cell) -> Solution:
    solution = solve(scene()[2], cells)
    assert solution is not None
    return solution


def sets() -> tuple[Solution, list[Solution]]:
    wave, curve = cell('encoder_eccentricity', 4), cell('joint_error_curve', 4)
    length, tilt = cell('link_length', 3), cell('joint_axis_tilt', 5)
    return solved(wave), [solved(wave, length), solved(curve), solved(wave, tilt, length)]


def mean_left(chosen: Solution, others: list[Solution]) -> FloatArray:
    data = scene()[2]
    mean: FloatArray = np.mean([data.unexplained(one) for one in (chosen, *others)], axis=0)
    return mean


def test_its_predictions_are_the_mean_of_those_of_the_searches():
    chosen, others = sets()
    both = combined(scene()[2], chosen, others)
    left = scene()[2].unexplained(both)
    apart = np.abs(left - mean_left(chosen, others)).max()
    between = np.std([scene()[2].unexplained(one) for one in (chosen, *others)], axis=0).max()
    print('largest difference to the mean of the predictions', apart, 'between them', between)
    # Noise differs a little between the fits, and with it where the offsets go.
    assert apart < 0.05 * between
    assert between > 1e-5


def test_a_cause_counts_nothing_where_it_was_not_found():
    chosen, others = sets()
    both = combined(scene()[2], chosen, others)
    assert both.cells[: len(chosen.cells)] == chosen.cells
    assert len(both.cells) == 4
    for one, where in zip(both.cells, both.slices(), strict=True):
        fits = [
            fit.parameters[at]
            for fit in (chosen, *others)
            for other, at in zip(fit.cells, fit.slices(), strict=True)
            if other is one
        ]
        assert searches_with(one, (chosen, *others)) == len(fits)
        np.testing.assert_allclose(both.parameters[where], np.sum(fits, axis=0) / 4.0, rtol=1e-6)


def test_what_is_sampled_has_this_mean():
    session, _, data = scene()
    chosen, others = sets()
    both = combined(data, chosen, others)
    fit = fit_session(session, rng=np.random.default_rng(3), extension=extension_of(data, both))
    std = np.sqrt(np.diag(both.covariance))
    deviation = (fit.theta - both.parameters) / std
    print('deviations of the sampled from the mean, std', np.abs(deviation).max())
    assert np.abs(deviation).max() < 0.3
    assert fit.sampler.converged


def test_the_fewer_found_it_the_less_of_its_size_is_left():
    data = scene()[2]
    wave, length = cell('encoder_eccentricity', 4), cell('link_length', 3)
    chosen = solved(wave)
    with_both = solved(wave, length)
    sizes, stds = [], []
    for count in range(1, 5):
        both = combined(data, chosen, [with_both] * count + [chosen] * (4 - count))
        where = both.slices()[both.cells.index(length)]
        sizes.append(np.linalg.norm(both.parameters[where]))
        stds.append(np.sqrt(np.trace(both.covariance[where, where])))
    assert np.all(np.diff(sizes) > 0.0)
    assert np.all(np.diff(stds) > 0.0)
    alone = with_both.slices()[1]
    assert stds[-1] < np.sqrt(np.trace(with_both.covariance[alone, alone]))


def test_the_same_answer_every_time_stays_as_it_is():
    chosen = solved(cell('encoder_eccentricity', 4), cell('link_length', 3))
    both = combined(scene()[2], chosen, [chosen] * 5)
    np.testing.assert_allclose(both.parameters, chosen.parameters, rtol=1e-3)
    np.testing.assert_allclose(np.diag(both.covariance), np.diag(chosen.covariance), rtol=0.01)


def test_what_remembers_is_of_the_readings_of_one_search():
    data = scene()[2]
    wander = next(iter(EFFECTS['sensor_wander'].cells(data.context)))
    chosen = solved(cell('encoder_eccentricity', 4))
    other = solve(data, (*chosen.cells, wander))
    assert other is not None
    assert combined(data, chosen, [other]).cells == chosen.cells


def test_a_mean_that_the_model_itself_does_not_have_is_not_taken():
    session, _, data = scene()
    chosen, others = sets()
    both = combined(data, chosen, others)
    fit = fit_session(session, rng=np.random.default_rng(3), extension=extension_of(data, both))
    assert holds(data, both, fit.residuals_after)
    worse = fit.residuals_after.copy()
    worse[data.rows.source] *= 1.2
    assert not holds(data, both, worse)
    # What is held out does not decide.
    held_out = fit.residuals_after.copy()
    held_out[session.measurements.is_validation] *= 10.0
    assert holds(data, both, held_out)
