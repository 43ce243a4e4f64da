"""The model of several searches is the mean of those that explain nearly as much."""

from __future__ import annotations

from functools import cache

import numpy as np
from discovery_scenes import at_joint, session_with

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.discovery.combined_searches import WINDOW, combined, holds, searches_with
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import Search
from remaster_ros.discovery.to_extension import extension_of
from remaster_ros.types import Session

TRIED = ('encoder_eccentricity', 'encoder_scale', 'link_length', 'sensor_wander')
# Far below the noise: neither a set with it nor one without is excluded.
WAVE_RAD = 2e-5


@cache
def scene() -> tuple[Session, Estimate, Search]:
    session = session_with(
        81, lambda s: at_joint(4, WAVE_RAD * np.sin(s.measurements.q[:, 3])), poses=30
    )
    found = estimate(Problem.of(session))
    data = Residuals.of(found)
    cells = tuple(cell for name in TRIED for cell in EFFECTS[name].cells(data.context))
    rng = np.random.default_rng(5)
    return session, found, Search(data, cells, rng, lambda rows, _: rows, lambda _: None)


def cell(name: str, joint: int) -> Cell:
    return next(one for one in scene()[2].cells if one.name == name and one.joints == (joint,))


def solved(*cells: Cell) -> Solution:
    solution = scene()[2].fit(cells)
    assert solution is not None
    return solution


def sets() -> tuple[Solution, list[Solution]]:
    wave, scale, other = (cell('encoder_scale', joint) for joint in (4, 3, 5))
    return solved(wave), [solved(scale), solved(other), solved(wave)]


def test_its_predictions_are_the_mean_of_those_of_the_sets():
    chosen, others = sets()
    data = scene()[2].data
    both = combined(scene()[2], chosen, others)
    # A set that two searches found counts once.
    fits = [chosen, *others[:2]]
    evidence = [fit.log_evidence for fit in fits]
    print('log evidence', evidence)
    assert np.ptp(evidence) < WINDOW
    left = [data.unexplained(fit) for fit in fits]
    apart = np.abs(data.unexplained(both) - np.mean(left, axis=0)).max()
    between = np.std(left, axis=0).max()
    print('largest difference to the mean of the predictions', apart, 'between them', between)
    # Noise differs a little between the fits, and with it where the offsets go.
    assert apart < 0.05 * between
    for one, where in zip(both.cells, both.slices(), strict=True):
        (index,) = (i for i, fit in enumerate(fits) if one in fit.cells)
        np.testing.assert_allclose(
            both.parameters[where], fits[index].parameters / len(fits), rtol=1e-6
        )


def test_what_is_sampled_has_this_mean_and_the_mean_of_the_covariances():
    session, found, search = scene()
    chosen, others = sets()
    both = combined(search, chosen, others)
    extension = extension_of(search.data, both, found)
    fit = fit_session(session, rng=np.random.default_rng(3), extension=extension)
    std = np.sqrt(np.diag(both.covariance))
    print('deviations of the sampled from the mean, std', (fit.theta - both.parameters) / std)
    assert fit.sampler.converged
    assert np.abs(fit.theta - both.parameters).max() < 0.3 * std.max()
    np.testing.assert_allclose(fit.theta_std, std, rtol=0.2)
    own = [fit.covariance[0, 0] for fit in (chosen, *others[:2])]
    expected = np.sqrt(np.array(own) / len(own))
    np.testing.assert_allclose(std, expected, rtol=0.05)


def test_a_clear_cause_is_not_mixed_with_sets_that_miss_it():
    session = session_with(
        82, lambda s: at_joint(4, 1e-3 * np.sin(s.measurements.q[:, 3])), poses=30
    )
    data = Residuals.of(estimate(Problem.of(session)))
    cells = tuple(one for name in TRIED for one in EFFECTS[name].cells(data.context))
    search = Search(data, cells, np.random.default_rng(5), lambda rows, _: rows, lambda _: None)
    wave = next(one for one in cells if one.name == TRIED[0] and one.joints == (4,))
    length = next(one for one in cells if one.name == 'link_length' and one.joints == (5,))
    chosen, other = search.fit((wave,)), search.fit((length,))
    assert chosen is not None
    assert other is not None
    assert combined(search, chosen, [other] * 5) is chosen
    assert searches_with(wave, [chosen, other, chosen]) == 2


def test_the_same_answer_every_time_stays_as_it_is():
    chosen = solved(cell('encoder_eccentricity', 4), cell('link_length', 3))
    assert combined(scene()[2], chosen, [chosen] * 5) is chosen


def test_what_remembers_is_of_the_readings_of_one_search():
    search = scene()[2]
    wander = next(one for one in search.cells if one.name == 'sensor_wander')
    chosen = solved(cell('encoder_eccentricity', 4))
    other = search.fit((*chosen.cells, wander))
    assert other is not None
    assert combined(search, chosen, [other]) is chosen


def test_a_mean_that_the_model_itself_does_not_have_is_not_taken():
    session, found, search = scene()
    chosen, others = sets()
    both, data = combined(search, chosen, others), search.data
    extension = extension_of(data, both, found)
    fit = fit_session(session, rng=np.random.default_rng(3), extension=extension)
    assert holds(data, both, fit.residuals_after)
    worse = fit.residuals_after.copy()
    worse[data.rows.source] *= 1.2
    assert not holds(data, both, worse)
    # What is held out does not decide.
    held_out = fit.residuals_after.copy()
    held_out[session.measurements.is_validation] *= 10.0
    assert holds(data, both, held_out)
