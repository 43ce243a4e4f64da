# SPDX-License-Identifier: Apache-2.0
"""A fit with further physical effects: the truth comes back, next to the core parameters."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN, extension, scene

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.extension import Extension, Start, Term
from remaster_ros.calibration.fit import fit_session
from remaster_ros.errors import InputError

COMPLIANCE = np.array([2e-5, 4e-5])  # rad/(N m), of joints 2 and 4
GROWTH = 1e-3  # of all measured positions, per m of the point's place in R


@pytest.fixture(scope='module')
def sagging():
    """A session whose arm sags at joints 2 and 4 and grows: the arrays of what is added."""
    session, truth = scene(31, poses=20)
    measured = session.measurements
    torque = CHAIN.gravity_torque(measured.q)
    n = len(measured)
    joint = np.zeros((n, 7, 3))
    joint[:, 1, 0], joint[:, 3, 1] = torque[:, 1], torque[:, 3]
    points = CHAIN.positions(measured.q, session.markers['sir'])
    displacement = np.zeros((n, 3, 3))
    displacement[:, :, 2] = points
    moved = CHAIN.positions(
        measured.q, session.markers['sir'], joint[:, :, :2] @ COMPLIANCE
    ) - CHAIN.positions(measured.q, session.markers['sir'])
    moved += GROWTH * points
    to_sensor = truth.sensors['mocap'].T_R_N[:3, :3]
    session = replace(
        session, measurements=replace(measured, position=measured.position + moved @ to_sensor)
    )
    return session, {
        'names': ('compliance_2', 'compliance_4', 'growth'),
        'units': ('rad/(N m)', 'rad/(N m)', '1'),
        'joint': joint,
        'displacement': displacement,
        'displacement0': np.zeros((n, 3)),
        'theta0': np.zeros(3),
        'prior_precision': np.diag([1e4**2, 1e4**2, 0.0]),
    }


def test_effects_come_back_with_their_uncertainty(sagging) -> None:
    """Within 4.5 standard deviations: wrong in 1 of 50,000 seeds."""
    session, arrays = sagging
    given = extension(**arrays)
    result = fit_session(session, rng=np.random.default_rng(1), draws=400, extension=given)
    assert result.theta_names == given.names
    assert result.theta_draws.shape == (*result.draws.shape[:2], 3)
    assert 'effect.growth' in result.parameter_names
    truth = np.array([*COMPLIANCE, GROWTH])
    assert np.all(np.abs(result.theta - truth) < 4.5 * result.theta_std)
    assert np.all(result.theta_std < np.array([2e-5, 2e-5, 5e-4]))
    np.testing.assert_allclose(
        result.theta, result.theta_draws.reshape(-1, 3).mean(axis=0), rtol=1e-6
    )
    without = fit_session(session, rng=np.random.default_rng(1), draws=400)
    assert without.theta.shape == (0,)
    errors = [np.sqrt(np.mean(r.residuals_after**2)) for r in (without, result)]
    assert errors[1] < 0.9 * errors[0]


def test_the_mode_is_the_same_from_where_the_effects_were_searched(sagging) -> None:
    """From the truth, but for 0.3 degrees, 30 mm, and markers 5 mm away."""
    session, arrays = sagging
    given = extension(**arrays)
    problem = Problem.of(session)
    found = estimate(problem, given)
    x = found.model.natural(found.mode.z)
    offsets = found.model.offsets(x) + np.radians(0.3) * np.array([0.0, 1, -1, 1, -1, 1, 0.0])
    T_R_N = found.model.T_R_N(x).copy()
    T_R_N[:, :3, 3] += 0.03
    start = Start(offsets, T_R_N, found.model.markers(x) + 5e-3, np.zeros(0, np.int64))
    again = estimate(problem, replace(given, start=start))
    std = np.sqrt(np.diag(found.mode.covariance))
    free = found.posterior.free
    np.testing.assert_array_equal(again.posterior.free, free)
    # The reference of the registrations is another one: what does not depend on it.
    same = free[(free < found.model.joints) | (free >= found.model.core - 3)]
    difference = again.model.natural(again.mode.z)[same] - x[same]
    assert np.max(np.abs(difference) / std[np.isin(free, same)]) < 0.02
    assert again.mode.log_evidence == pytest.approx(found.mode.log_evidence, abs=0.01)
    assert again.left_out == found.left_out


def test_offsets_at_zero_are_compared_where_that_is_asked_for(sagging) -> None:
    session, arrays = sagging
    result, other = (
        fit_session(
            session, rng=np.random.default_rng(3), draws=400, extension=extension(**arrays)
        )
        for _ in range(2)
    )
    accuracy = result.accuracy
    assert result.accuracy is accuracy
    assert replace(result, left_out=()).accuracy is accuracy
    assert other.accuracy == accuracy
    np.testing.assert_array_equal(result.draws, other.draws)
    # With the effects alone the offsets are missing.
    before, after = (
        np.sqrt(np.mean(errors**2)) for errors in (result.residuals_before, result.residuals_after)
    )
    assert before > 2.0 * after


def test_a_prior_on_effects_pulls_them_to_zero(sagging) -> None:
    session, arrays = sagging
    tight = replace(extension(**arrays), prior_precision=np.diag([1e8**2, 1e8**2, 1e6**2]))
    found = estimate(Problem.of(session), tight)
    theta = found.model.theta(found.mode.z)
    assert np.all(np.abs(theta) < [1e-7, 1e-7, 1e-5])


def test_what_only_its_prior_determines_is_as_wide_as_the_prior(sagging) -> None:
    """A spline beyond the data, beside an effect whose unit is six decades smaller."""
    session, arrays = sagging
    nothing = np.zeros_like(arrays['joint'][:, :, :1])
    displacement = arrays['displacement']
    drift = 1e6 * displacement[:, :, 2:] * session.measurements.q[:, None, 1:2]
    beyond = extension(
        names=(*arrays['names'], 'edge', 'drift'),
        units=(*arrays['units'], 'rad', 'm/s'),
        joint=np.concatenate((arrays['joint'], nothing, nothing), axis=2),
        displacement=np.concatenate((displacement, 0.0 * drift, drift), axis=2),
        displacement0=arrays['displacement0'],
        theta0=np.zeros(5),
        prior_precision=np.diag([1e4**2, 1e4**2, 0.0, 3e-4**-2, 1e-9**-2]),
    )
    result = fit_session(session, rng=np.random.default_rng(2), draws=800, extension=beyond)
    # 3,000 effective draws: a std to 1.3 %, six times that.
    assert result.theta_std[3] == pytest.approx(3e-4, rel=0.08)
    assert not any('edge' in direction.fixed_by for direction in result.gauge)


def test_an_effect_that_is_a_zero_offset_in_disguise_is_held_and_named(sagging) -> None:
    session, arrays = sagging
    joint = arrays['joint'].copy()
    joint[:, 2, 0], joint[:, 1, 0] = 1.0, 0.0
    twin = extension(**{**arrays, 'joint': joint, 'prior_precision': np.zeros((3, 3))})
    gauge = estimate(Problem.of(session), twin).gauge
    direction = next(d for d in gauge.directions if 'effect.compliance_2' in d.combination)
    assert direction.combination['joint_3'] == pytest.approx(-1.0, abs=1e-6)
    assert direction.fixed_by == 'effect.compliance_2 = 0'
    assert 'effect.compliance_2' in gauge.why[2]
    assert 'moves no marker' not in gauge.why[2]
    # With a prior on its size it need not be held, and leaves the offset as uncertain as it is.
    known = replace(twin, prior_precision=np.diag([1e3**2, 0.0, 0.0]))
    found = estimate(Problem.of(session), known)
    assert found.gauge.held.tolist() == [0]
    assert not any('effect.compliance_2' in d.combination for d in found.gauge.directions)
    assert found.gauge.why[2] == ''


@pytest.mark.parametrize('std_deg', [0.5, 2.0])
def test_an_offset_that_an_effect_leaves_open_stays_where_the_effects_were_searched(
    sagging, std_deg
) -> None:
    session, arrays = sagging
    joint = arrays['joint'].copy()
    joint[:, 2, 0], joint[:, 1, 0] = 1.0, 0.0
    twin = extension(**{**arrays, 'joint': joint, 'prior_precision': np.diag([1.0, 0.0, 0.0])})
    free = estimate(Problem.of(session), twin)
    searched = free.model.offsets(free.mode.z) + np.radians(3.0)
    anchored_extension = replace(twin, joint_offsets=searched, step_std=np.radians(std_deg))
    found = estimate(Problem.of(session), anchored_extension)
    # The effect, of 1 rad, takes up what the offset does not.
    index = int(np.flatnonzero(found.posterior.free == 2)[0])
    std = np.sqrt(found.mode.covariance[index, index])
    assert std == pytest.approx(np.radians(std_deg), rel=0.02)
    assert found.model.offsets(found.mode.z)[2] == pytest.approx(searched[2], abs=0.05 * std)
    # It is no knowledge of the arm: what no data determine is held as before.
    assert found.gauge.held.tolist() == free.gauge.held.tolist() == [0]


def test_the_paper_s_model_takes_no_effects(sagging) -> None:
    session, arrays = sagging
    with pytest.raises(InputError, match='fast sampler'):
        fit_session(
            session, rng=np.random.default_rng(1), sampler='paper', extension=extension(**arrays)
        )


def test_two_effects_at_one_joint_add_their_angles() -> None:
    rng = np.random.default_rng(5)
    first, second, other = (
        rng.normal(size=(9, 2)),
        rng.normal(size=(9, 1)),
        rng.normal(size=(9, 1)),
    )
    terms = (
        Term(slice(0, 2), 3, first),
        Term(slice(2, 3), 3, second),
        Term(slice(3, 4), 0, other),
        Term(slice(4, 5), None, rng.normal(size=(9, 3, 1))),
    )
    given = Extension(('',) * 5, ('',) * 5, terms, np.zeros((9, 3)), np.zeros(5), np.eye(5))
    theta, rows = rng.normal(size=(6, 5)), np.array([1, 4, 7])
    turns = given.turns(theta, rows)
    assert sorted(turns) == [0, 3]
    expected = theta[:, :2] @ first[rows].T + theta[:, 2:3] @ second[rows].T
    np.testing.assert_allclose(turns[3], expected)
    np.testing.assert_allclose(turns[0], theta[:, 3:4] @ other[rows].T)
