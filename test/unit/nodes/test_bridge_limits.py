# SPDX-License-Identifier: Apache-2.0
"""What parameters, cell and offsets make of the limits that the robot bridge keeps."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY, POST, TARGET, correction, turned
from bridge_rig import CHAIN, HOME
from rclpy.parameter import Parameter
from worlds.simple_cells import write_cell

from remaster_ros.collection.events import ArmStopped
from remaster_ros.errors import InputError
from remaster_ros.motion.joint_units import TURNING
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.path_check import PointSpeeds
from remaster_ros.session.cells.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]


# Parameters


def test_parameters_reach_the_limits_and_the_rules(rig, tmp_path):
    acceleration = [2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0]
    cell = write_cell(tmp_path / 'cell.yaml', acceleration_limit_rad_s2=acceleration)
    r = rig(
        ready=False,
        cell=cell,
        speed_share=0.4,
        cartesian_speed_limit_m_s=0.15,
        limit_margin_deg=2.0,
        settle_s=0.7,
        heartbeat_s=4.0,
        emergency_stop_topic='none',
    )
    bridge = r.bridge
    limits = bridge.supervisor.gate.limits
    wanted = MotionLimits.of(
        CHAIN, 0.4, None, np.array(acceleration), 0.15, float(np.deg2rad(2.0))
    )
    for name in ('lower', 'upper', 'velocity', 'acceleration', 'tool_speed', 'margin'):
        np.testing.assert_array_equal(getattr(limits, name), getattr(wanted, name), name)
    assert limits.names == CHAIN.joint_names
    assert bridge.supervisor.rules == bridge.p.rules(TURNING)
    assert bridge.supervisor.rules.settle.settle_s == 0.7
    # Nothing shows that an arm was stopped while it stood: every interruption is too long.
    assert bridge.supervisor.rules.resume_alone_s == 0.0
    assert bridge._emergency._silence_s == 4.0
    assert bridge._emergency.topic == ''
    assert not r.logged()


def test_without_a_cartesian_limit_it_says_so(rig):
    r = rig(ready=False, cartesian_speed_limit_m_s=0.0)
    assert r.bridge.supervisor.gate.limits.tool_speed == np.inf
    assert r.logged() == [
        (
            'warning',
            'no Cartesian speed limit (cartesian_speed_limit_m_s is 0): the joints alone '
            'limit the speed of the arm',
        )
    ]


def test_without_a_cell_file_it_does_not_start(rig):
    with pytest.raises(InputError) as error:
        rig(ready=False, cell='')
    assert str(error.value) == (
        'robot_bridge: parameter cell is empty; give the cell file of this arm (demo, the '
        'shipped one, is for the fakes)'
    )


def test_without_a_word_on_the_safety_circuit_it_does_not_start(rig):
    with pytest.raises(InputError) as error:
        rig(ready=False, emergency_stop_topic='')
    assert str(error.value) == (
        'robot_bridge: parameter emergency_stop_topic is empty; give the topic (std_msgs/Bool) '
        "that is true while the robot's own safety stops it, or none if there is no such topic: "
        'then /remaster/collect is needed after every interruption'
    )


def test_bodies_that_are_never_looked_at_are_named(rig):
    bridge = rig(ready=False).bridge
    left_out = bridge._search._model.left_out
    assert left_out
    assert bridge.logged == [('info', f'collisions: {pair}') for pair in left_out]


def test_other_speeds_are_taken_while_it_runs(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    values = {'speed_share': 0.25, 'cartesian_speed_limit_m_s': 0.125}
    answers = r.bridge.set_parameters([Parameter(name, value=v) for name, v in values.items()])
    assert all(answer.successful for answer in answers)
    r.flush()
    limits = r.bridge.supervisor.gate.limits
    np.testing.assert_allclose(limits.velocity, 0.25 * CHAIN.velocity_limits)
    assert limits.tool_speed == 0.125
    assert (r.bridge.p.speed_share, r.bridge.p.cartesian_speed_limit_m_s) == (0.25, 0.125)
    assert [stop.reason for stop in r.named(ArmStopped)] == ['other limits']
    text = 'speed_share is 0.25, cartesian_speed_limit_m_s 0.125'
    assert ('info', text) in r.logged()
    r.run(30.0, lambda: r.settled)
    _, v, _ = r.commands[-1].spline().sample()
    assert np.all(np.abs(v) <= 0.25 * CHAIN.velocity_limits * 1.001)


RAISED = [('speed_share', 0.5, 0.4), ('cartesian_speed_limit_m_s', 0.0, 0.2)]


@pytest.mark.parametrize(('name', 'higher', 'lower'), RAISED)
def test_a_limit_is_raised_at_an_idle_bridge_alone(rig, name, higher, lower):
    """Refused in a run; in a pause it is taken, and the run that comes then is a person's."""
    r = rig(speed_share=0.45, cartesian_speed_limit_m_s=0.25)
    r.go(AWAY, speed=0.1)
    before, sent = r.bridge.p, r.bridge.published
    other = next(values for values in RAISED if values[0] != name)
    # A lower one beside it does not help.
    wanted = [Parameter(name, value=higher), Parameter(other[0], value=other[2])]
    answer = r.bridge.set_parameters_atomically(wanted)
    assert not answer.successful
    assert answer.reason == (
        f'robot_bridge: {name} can be lowered while a collection runs, not raised; call '
        '/remaster/pause, set it when the arm stands, then call /remaster/collect'
    )
    assert r.bridge.p == before
    assert r.bridge.published == sent
    r.say_planner('paused')
    # It brakes still.
    assert not r.bridge.set_parameters([Parameter(name, value=higher)])[0].successful
    r.run(3.0, lambda: r.arm.speed() < 1e-6)
    r.run(1.0)
    assert r.bridge.set_parameters([Parameter(name, value=higher)])[0].successful
    r.run(0.5)
    assert r.bridge.supervisor.asks_for_collect.startswith('a limit was raised')
    r.say_planner('running')
    r.run(20.0, lambda: r.settled)
    assert getattr(r.bridge.p, name) == higher


def test_the_fastest_point_keeps_the_cartesian_limit(rig):
    r = rig(cartesian_speed_limit_m_s=0.1)
    r.settle(HOME + np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    (move,) = r.moves()
    q, v, _ = move.spline().sample(20)
    model = read_cell('demo').collision_model(CHAIN)
    fastest = np.max(PointSpeeds(CHAIN, model.extent_points).fastest(q, v))
    assert 0.09 < fastest < 0.1002


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_offsets_in_use_shift_the_limits(rig, tmp_path, sign):
    """True angle = reported + offset: with +2 degrees the upper stop comes 2 degrees earlier."""
    file, _ = correction(tmp_path, {'joint_2': 1.9 * sign})
    r = rig(ready=False, compensation=file, limit_margin_deg=0.0)
    limits = r.bridge.supervisor.gate.limits
    lower, upper = CHAIN.lower.copy(), CHAIN.upper.copy()
    if sign > 0:
        upper[1] -= np.deg2rad(1.9)
    else:
        lower[1] += np.deg2rad(1.9)
    np.testing.assert_allclose(limits.lower, lower)
    np.testing.assert_allclose(limits.upper, upper)


@pytest.mark.parametrize(('sign', 'free'), [(1.0, False), (-1.0, True)])
def test_paths_are_checked_where_the_arm_is_with_its_offsets(rig, tmp_path, sign, free):
    """A post on the left: an arm that is further to the left than it reports reaches it."""
    file, _ = correction(tmp_path, {'joint_1': 1.9 * sign})
    cell = write_cell(tmp_path / 'cell.yaml', obstacles={'post': POST})
    nominal = read_cell(cell).collision_model(CHAIN, np.deg2rad(0.1))
    turns = np.linspace(-0.8, 0.0, 161)
    touching = next(turn for turn in turns if nominal.trouble(turned(turn)))
    q = turned(touching - np.deg2rad(1.0))
    assert not nominal.trouble(q)
    bridge = rig(ready=False, cell=cell, compensation=file).bridge
    assert bool(bridge._search._model.trouble(q)) != free
    # So are the speeds of its points.
    v, offsets = np.ones(7), np.deg2rad([1.9 * sign, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    at = PointSpeeds(CHAIN, nominal.extent_points).fastest(q[None] + offsets, v[None])
    np.testing.assert_allclose(bridge._search._speeds.fastest(q[None], v[None]), at)
    np.testing.assert_allclose(bridge.supervisor.gate._speeds.fastest(q[None], v[None]), at)


@pytest.mark.parametrize(('known', 'unknown_deg'), [((), 0.1), (6 * (True,) + (False,), 1.0)])
def test_the_clearance_covers_what_is_still_unknown(rig, tmp_path, known, unknown_deg):
    file, _ = correction(tmp_path, {'joint_1': 1.5}, known)
    bridge = rig(ready=False, compensation=file).bridge
    assert bridge._search._model.unknown_offset == pytest.approx(np.deg2rad(unknown_deg))


def test_a_compensation_of_another_arm_or_by_another_name_is_refused_at_the_start(rig, tmp_path):
    file, _ = correction(tmp_path, {'joint_1': 1.0})
    cell = write_cell(tmp_path / 'cell.yaml')
    (tmp_path / 'other.urdf').write_text(read_cell('demo').urdf_text + '<!-- another -->')
    text = cell.read_text()
    urdf = next(line for line in text.splitlines() if line.strip().startswith('urdf:'))
    indent = urdf[: len(urdf) - len(urdf.lstrip())]
    cell.write_text(text.replace(urdf, f'{indent}urdf: other.urdf'))
    with pytest.raises(InputError, match='is of another URDF'):
        rig(ready=False, cell=cell, compensation=file)
    with pytest.raises(InputError, match="unknown parameter 'offsets'"):
        rig(ready=False, offsets=tmp_path / 'fit.json')


def test_without_offsets_the_clearance_is_the_cell_files(rig):
    bridge = rig(ready=False).bridge
    assert bridge._search._model.unknown_offset == np.deg2rad(1.0)
    assert bridge._search._model.chain is bridge.chain
    np.testing.assert_array_equal(bridge.supervisor.gate.limits.upper, CHAIN.upper)


def test_reports_are_judged_by_the_limits_of_the_robot(rig):
    """By its own, not by the share of them that is used."""
    reports = rig(ready=False, speed_share=0.1).bridge.supervisor.reports
    np.testing.assert_allclose(reports._lower, CHAIN.lower - 0.05)
    np.testing.assert_allclose(reports._upper, CHAIN.upper + 0.05)
    np.testing.assert_allclose(reports._speed, 1.5 * CHAIN.velocity_limits)


@pytest.mark.parametrize('value', [1e-300, 1e-4, -1.0, float('nan'), 20.0])
def test_a_limit_of_next_to_nothing_is_none(rig, value):
    """Lowered is not always slower: no time fits a message at such a speed."""
    r = rig()
    (answer,) = r.bridge.set_parameters([Parameter('cartesian_speed_limit_m_s', value=value)])
    assert not answer.successful
    assert r.bridge.p.cartesian_speed_limit_m_s == 0.5
    r.settle(TARGET)
    assert not r.halted()
