# SPDX-License-Identifier: Apache-2.0
"""Orientations in the fit: derivative, gauge, coverage, gross errors, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from rigs.parallel import in_parallel
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from worlds.oriented_sessions import KINDS, Problem, estimate, make_session, one_session
from worlds.sliding_cells import LWR, rail, telescope

from remaster_ros.calibration.fit import fit_session
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.result_lines import fit_lines

ERROR_RATE = 1e-3
# What slides is the first joint, one amid the arm, and the last one.
SLIDING = {
    'rail': rail(),
    'telescope': telescope(),
    'last': LWR.replace('name="joint_7" type="revolute"', 'name="joint_7" type="prismatic"'),
}


def result_of_session(seed_and_kind):
    """Return what one session showed; at module level, for other processes."""
    seed, kind = seed_and_kind
    return one_session(seed, kind)


@pytest.mark.parametrize(
    ('kind', 'arm'), [*((kind, None) for kind in KINDS), ('tracker', 'rail'), ('tracker', 'last')]
)
def test_the_derivative_is_that_of_the_prediction(kind, arm):
    given = {'arm': SLIDING[arm]} if arm else {}
    made = make_session(kind, np.random.default_rng(1), poses=8, **given)
    found = estimate(Problem.of(made.session))
    model, rows = found.model, found.posterior.rows
    assert len(rows) == 2 * rows.points
    # Far from the mode, where nothing is small.
    z = found.mode.z + 0.1 * np.random.default_rng(2).standard_normal(model.size)
    steps = 1e-6 * np.eye(model.size)
    for predict, jacobian in (
        (lambda x: model.predict(x, rows), model.jacobian(z, rows)),
        (lambda x: model.predict(model.pinned(x), rows), model.natural_jacobian(z, rows)),
    ):
        numeric = np.stack([(predict(z + e) - predict(z - e)) / 2e-6 for e in steps], axis=-1)
        np.testing.assert_allclose(jacobian, numeric, atol=1e-7)
    np.testing.assert_allclose(model.natural(model.pinned(z)), z, atol=1e-12)
    batch = model.predict(np.stack((z, 0.5 * z)), rows)
    np.testing.assert_allclose(batch[0], model.predict(z, rows), atol=1e-12)
    blocks = [model.jacobian(z, rows.of_groups(*run)) for run in rows.blocks(5)]
    np.testing.assert_allclose(np.concatenate(blocks), model.jacobian(z, rows), atol=1e-12)


@pytest.mark.parametrize('kind', KINDS)
def test_the_outer_joints_stay_a_gauge_and_the_last_takes_the_body_along(kind):
    made = make_session(kind, np.random.default_rng(3), poses=20)
    gauge = estimate(Problem.of(made.session)).gauge
    names = made.session.measurements.q.shape[1]
    assert gauge.held.tolist() == [0, names - 1]
    last = gauge.directions[-1].combination
    assert any(name.startswith('body.body.') for name in last)
    assert any(name.startswith('marker.body.') for name in last)
    assert not any(name.startswith('registration') for name in last)
    assert 'turned on the tool about the axis of' in gauge.why[-1]


@pytest.mark.parametrize('arm', SLIDING)
@pytest.mark.parametrize('sessions', [4, pytest.param(100, marks=pytest.mark.qualify)])
def test_intervals_of_an_arm_that_slides_hold_as_often_as_they_say(arm, sessions):
    found = [
        one_session(seed, 'tracker', arm=SLIDING[arm]) for seed in range(9500, 9500 + sessions)
    ]
    inside = np.concatenate([result.inside for result in found])
    low, high = binom.ppf((0.5 * ERROR_RATE, 1.0 - 0.5 * ERROR_RATE), len(inside) // 2, 0.95)
    assert low <= inside.mean() * (len(inside) // 2) <= high
    assert np.abs(np.concatenate([result.scaled for result in found])).max() < 4.5


@pytest.mark.parametrize('sessions', [2, pytest.param(200, marks=pytest.mark.qualify)])
@pytest.mark.parametrize('kind', KINDS)
def test_intervals_hold_as_often_as_they_say(kind, sessions):
    print(f'session seeds 9000 to {9000 + sessions - 1}')
    jobs = [(seed, kind) for seed in range(9000, 9000 + sessions)]
    found = list(in_parallel(result_of_session, jobs, 2 if sessions > 4 else 1))
    inside = np.concatenate([result.inside for result in found])
    # The offsets of one session hang together: as if they were half as many.
    count = len(inside) // 2
    low, high = binom.ppf((0.5 * ERROR_RATE, 1.0 - 0.5 * ERROR_RATE), count, 0.95) / count
    assert low <= inside.mean() <= high
    assert sum(result.gross for result in found) <= 0.01 * 90 * sessions
    # Orientations add to what the positions tell, and disagree no more often than by chance.
    gain = [np.divide(result.std_deg, result.without_deg) for result in found]
    assert np.median(np.concatenate(gain)) < 1.0
    disagree = sum(result.p_value < 0.01 for result in found)
    assert disagree <= binom.ppf(1.0 - ERROR_RATE, sessions, 0.02)


def test_without_orientations_it_is_the_same_fit_to_the_last_bit():
    session = make_session('tracker', np.random.default_rng(4), poses=12).session
    m = session.measurements
    few = np.full_like(m.orientation, np.nan)
    few[:3] = m.orientation[:3]
    plain_fit, other = (
        fit_session(replace(session, measurements=replace(m, orientation=turned)), rng=rng)
        for turned, rng in ((None, np.random.default_rng(0)), (few, np.random.default_rng(0)))
    )
    np.testing.assert_array_equal(plain_fit.draws, other.draws)
    assert plain_fit.orientations is None
    assert 'fewer than 4' in other.orientations_in_words


def test_gross_orientations_take_their_reading_along():
    session = make_session('tracker', np.random.default_rng(5), common=0.0).session
    m = session.measurements
    turned = m.orientation.copy()
    wrong = [7, 30, 61]
    # The two ways in which a board can be seen from afar.
    turned[wrong] = (Rotation.from_quat(turned[wrong]) * Rotation.from_euler('x', 0.2)).as_quat()
    found = estimate(Problem.of(replace(session, measurements=replace(m, orientation=turned))))
    assert [row for row, _ in found.left_out] == wrong
    assert all('degrees' in why for _, why in found.left_out)
    assert not np.isin(wrong, found.kept).any()


def fitted(session):
    return fit_session(session, rng=np.random.default_rng(0), draws=400)


def test_another_order_of_the_quaternion_is_named_and_the_positions_are_fitted():
    session = make_session('tracker', np.random.default_rng(6)).session
    m = session.measurements
    mixed = replace(session, measurements=replace(m, orientation=m.orientation[:, [3, 0, 1, 2]]))
    fit = fitted(mixed)
    plain_fit = fitted(session.positions_alone())
    assert 'order x, y, z, w' in fit.orientations_in_words
    np.testing.assert_array_equal(fit.joint_offsets, plain_fit.joint_offsets)
    content = fit_content(fit)
    assert content.orientation.fitted is False
    assert content.orientation.why


def test_orientations_that_ask_for_other_offsets_widen_the_intervals():
    made = make_session('tracker', np.random.default_rng(7), common=0.0)
    m = made.session.measurements
    # As if joint 4 were off by 0.1 degrees more, which the positions do not show.
    chain = estimate(Problem.of(made.session)).problem.chain
    true = m.q + made.joint_offsets
    here, there = (
        Rotation.from_matrix(chain.forward(q)[:, :3, :3])
        for q in (true, true + np.radians(0.1) * np.eye(7)[3])
    )
    body = Rotation.from_matrix(made.R_T_B)
    moved = body.inv() * here.inv() * there * body
    turned = (Rotation.from_quat(m.orientation) * moved).as_quat()
    fit = fitted(replace(made.session, measurements=replace(m, orientation=turned)))
    (test,) = (test for test in fit.structure.tests if test.driver == 'orientation')
    assert test in fit.structure.found
    assert fit.other_errors
    low, high = fit.joint_offsets_interval95[3]
    assert low < made.joint_offsets[3] < high
    assert not fitted(made.session).other_errors


def test_report_and_file_tell_that_they_were_used_and_how_sure():
    made = make_session('tracker', np.random.default_rng(8))
    fit = fitted(made.session)
    content = fit_content(fit)
    found = content.orientation
    assert found.fitted
    assert found.count == 90
    sigma = found.noise['sensor'].sigma_deg
    assert sigma == pytest.approx(0.05, rel=0.2)
    (body,) = found.bodies.values()
    # Up to the last joint's offset, which is held at 0.
    chain = fit.chain
    axis = chain.T_fixed[-1][:3, :3].T @ chain.axes[-1]
    turn = Rotation.from_rotvec(axis * made.joint_offsets[-1]).as_matrix() @ made.R_T_B
    angle = (Rotation.from_matrix(turn).inv() * Rotation.from_quat(body.rotation_xyzw)).magnitude()
    assert np.degrees(angle) < 4.0 * np.linalg.norm(body.std_deg)
    assert 'orientations are fitted' in '\n'.join(fit_lines(fit_content(fit)))
    assert all(
        found.std_positions_deg[row.joint] > 0.9 * row.std_if_exactly_drawn_deg
        for row in content.joint_offsets
        if row.identifiable
    )
