# SPDX-License-Identifier: Apache-2.0
"""The null directions of an LWR 4+ that sensors watch: found, named, fixed."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN, scene
from worlds.measured_rows import predict_in_sensor

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.identifiability import Gauge, find_gauge
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.types import BasePrior, Session


def gauge_of(session: Session) -> Gauge:
    return estimate(Problem.of(session)).gauge


def test_one_sensor_leaves_the_first_and_the_last_joint() -> None:
    gauge = gauge_of(scene(21, poses=15)[0])
    base, tool = gauge.directions
    assert base.combination == pytest.approx({'joint_1': 1.0, 'registration.mocap.rz': -1.0})
    assert base.fixed_by == 'joint_1 = 0'
    assert 'joint_1 offset = a rotation of the mocap registration about the base axis' in base.why
    assert tool.combination['joint_7'] == 1.0
    # The marker 100 mm from the axis moves against the turn: 1.745 mm per degree.
    assert tool.combination['marker.sir.y'] == pytest.approx(-0.1, abs=2e-3)
    assert 'joint_7 offset = the marker sir moved tangentially, 1.7' in tool.why
    assert 'mm per degree' in tool.why
    assert tool.fixed_by == 'the prior on marker sir, 0.5 mm per axis'
    assert gauge.held.tolist() == [0]
    assert [bool(why) for why in gauge.why] == [True, *[False] * 5, True]


@pytest.mark.parametrize('open_deg', [0.5, 2.0])
def test_an_offset_that_is_known_only_to_degrees_is_not_identifiable(open_deg: float) -> None:
    """Whatever the data alone determine, if what the model leaves out moves it so far."""
    session = scene(21, poses=15)[0]
    moves = np.zeros((estimate(Problem.of(session)).model.size, 1))
    moves[4] = np.radians(open_deg)
    result = fit_session(session, rng=np.random.default_rng(1), draws=400, unmodelled=moves)
    assert result.joint_offsets_std[4] == pytest.approx(np.radians(open_deg), rel=0.1)
    assert result.identifiable[4] == (open_deg < 1.0)
    assert ('it is known only to 2.0 deg' in result.why[4]) == (open_deg > 1.0)
    assert np.all(result.identifiable[[1, 2, 3, 5]])


def test_two_sensors_turn_together() -> None:
    gauge = gauge_of(scene(22, poses=15, sensor_count=2)[0])
    base, tool = gauge.directions
    assert base.combination == pytest.approx(
        {'joint_1': 1.0, 'registration.mocap.rz': -1.0, 'registration.tracker.rz': -1.0}
    )
    assert 'mocap and tracker' in base.why
    assert tool.combination['marker.sir.y'] == pytest.approx(-0.1, abs=2e-3)
    assert tool.combination['marker.smr.y'] == pytest.approx(0.1, abs=2e-3)


def test_no_prediction_moves_along_a_direction() -> None:
    """Each direction, applied to natural parameters as documented, moves no marker."""
    found = estimate(Problem.of(scene(23, poses=10, sensor_count=2)[0]))
    model, measured = found.model, found.problem.measurements
    # Corrections about the origin of R, as the combinations have them.
    model = replace(model, centroid=np.zeros_like(model.centroid))
    x = model.vector(np.full(7, 0.002), found.problem.markers)
    here = predict_in_sensor(CHAIN, measured, model.offsets(x), model.T_R_N(x), model.markers(x))
    for direction in found.gauge.directions:
        step = 1e-5 * np.array([direction.combination.get(name, 0.0) for name in model.names])
        assert np.any(step)
        y = x + step
        there = predict_in_sensor(
            CHAIN, measured, model.offsets(y), model.T_R_N(y), model.markers(y)
        )
        # Of a motion of 1e-5 rad: nothing but the second order and the scene's own geometry.
        assert np.abs(there - here).max() < 1e-7


def test_a_known_base_frame_fixes_the_first_joint() -> None:
    session, truth = scene(24, poses=15)
    T = truth.sensors['mocap'].T_R_N
    prior = BasePrior(T[:3, 3], quaternion_xyzw(T[:3, :3]), 2e-3, 2e-3)
    gauge = gauge_of(replace(session, base_prior={'mocap': prior}))
    assert gauge.directions[0].fixed_by == 'the prior on the base frame of mocap'
    assert gauge.held.tolist() == []
    assert gauge.why[0]


def test_a_badly_known_marker_cannot_fix_the_last_joint() -> None:
    gauge = gauge_of(scene(25, poses=15, marker_std_m=0.1)[0])
    assert gauge.directions[1].fixed_by == 'joint_7 = 0'
    assert gauge.held.tolist() == [0, 6]


def test_a_joint_that_hardly_moves_anything_is_not_identifiable() -> None:
    """The marker on the axis of the last joint: no data at all about it."""
    session, _ = scene(26, poses=15, marker_std_m=0.0)
    on_axis = {name: np.array([0.0, 0.0, 0.1]) for name in session.markers}
    measured = session.measurements
    problem = Problem.of(session)
    points = CHAIN.positions(measured.q, on_axis['sir'], np.full(7, 0.001))
    noise = 1e-4 * np.random.default_rng(1).standard_normal(points.shape)
    problem = replace(
        problem,
        session=replace(session, markers=on_axis),
        markers=np.array([on_axis[name] for name in problem.marker_names]),
        measurements=replace(problem.measurements, position=points + noise),
    )
    gauge = estimate(problem).gauge
    assert gauge.held.tolist() == [0, 6]
    assert 'joint_7' in gauge.why[6]


def test_registrations_that_nothing_fixes_are_an_error() -> None:
    found = estimate(Problem.of(scene(27, poses=15)[0]))
    model, rows = found.model, found.posterior.rows
    one_point = replace(
        rows,
        q=np.repeat(rows.q[:1], len(rows), axis=0),
        target=np.repeat(rows.target[:1], len(rows), axis=0),
    )
    with pytest.raises(InsufficientDataError, match=r'do not determine .*registration'):
        find_gauge(model, model.natural(found.mode.z), one_point, ())


def test_a_joint_that_is_hardly_seen_is_named() -> None:
    """Joint 4 within 0.02 degrees, the others everywhere: it moves like the parts next to it."""
    session, _ = scene(28, poses=15)
    rng = np.random.default_rng(1)
    measured = session.measurements
    q = 0.5 * rng.uniform(CHAIN.lower, CHAIN.upper, measured.q.shape)
    # An arm that is nearly straight: joints 3 and 5 turn about nearly one axis.
    q[:, 3] = 5e-3 + 1e-3 * rng.standard_normal(len(q))
    points = CHAIN.positions(q, session.markers['sir'], np.full(7, 0.001))
    points += 1e-4 * rng.standard_normal(points.shape)
    session = replace(session, measurements=replace(measured, q=q, position=points))
    gauge = gauge_of(session)
    weak = [d for d in gauge.directions if d.fixed_by.startswith('the data, though')]
    assert len(weak) == 1
    assert abs(weak[0].combination['joint_3']) > 0.5
    assert weak[0].combination['joint_5'] == pytest.approx(
        -weak[0].combination['joint_3'], rel=0.2
    )
    assert 'hardly change the observations' in weak[0].why
    assert 'would separate them' in weak[0].why
    # It is seen all the same, if badly: no reason why it could not be.
    assert gauge.held.tolist() == [0]
    assert [bool(why) for why in gauge.why] == [True, *[False] * 5, True]
