# SPDX-License-Identifier: Apache-2.0
"""The bridge's shell: the first move after a start, and who goes on after an interruption."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY, TARGET
from bridge_rig import HOME
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool

from remaster_ros.session.bridge_files import LastCommandFile

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]

EMERGENCY = 'robot/emergency_stop'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ASKED = 'the arm is not reported where the last command led: '


def commands_file(r):
    return LastCommandFile('/robot_bridge', r.names)


def collect(r):
    """The planner was told why nothing moves, and a person calls /remaster/collect."""
    r.say_planner('paused')
    r.run(1.5)
    r.say_planner('running')


def test_where_the_last_command_led_is_kept_for_the_next_bridge(rig):
    r = rig()
    r.settle(TARGET)
    r.bridge.close()
    last = commands_file(r).read(r.time_ns())
    assert last.end.tolist() == TARGET.tolist()
    assert last.age_s < 60.0


def test_a_bridge_that_is_started_again_moves_the_arm_only_from_where_it_was_led(rig):
    """The driver of another arm, or one that reports what was: it halts, and says by how much."""
    r = rig(ready=False)
    moved = HOME + np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    commands_file(r).write(moved, r.time_ns())
    r.end_bridge()
    r._open_bridge({})
    r.ready()
    r.plan(TARGET)
    r.run(5.0, r.halted)
    assert r.halted().startswith(f'{ASKED}joint_2 at 17.19 deg, -5.73 deg from there; compare ')
    assert not r.commands
    # The message was the question: the person has compared, and confirms.
    assert r.call_clear().success
    collect(r)
    r.run(8.0, lambda: r.commands)
    # Wherever the arm is, it is led to where it is reported no faster than it may.
    assert r.commands[0].times_s[-1] > 20.0
    assert any('it is not sure that it is there' in text for _, text in r.bridge.logged)


def test_the_first_move_of_all_is_slow(rig):
    r = rig(first=True)
    r.plan(TARGET)
    r.run(5.0, lambda: r.commands)
    assert r.commands[0].times_s[-1] > 20.0
    r.run(60.0, r.moves, dt=0.2)


@pytest.mark.parametrize('released', [False, True])
def test_who_goes_on_after_an_interruption(rig, released):
    """Without the robot's own report a person, who may have stood beside the arm meanwhile."""
    r = rig(ready=False, emergency_stop_topic=EMERGENCY if released else 'none')
    if released:
        publisher = r.peer.create_publisher(Bool, EMERGENCY, LATCHED)
        publisher.publish(Bool(data=False))
        r.wait(lambda: r.bridge.supervisor._interlocks.was_right('safety'), 'the release')
    r.ready()
    r.go(AWAY, speed=0.2)
    r.waiting_for = 'mocap'
    # Where nothing shows an emergency stop the shortest interruption is too long.
    r.run(6.5 if released else 0.5)
    assert not r.halted()
    r.waiting_for = ''
    sent = r.bridge.published
    r.run(4.0)
    assert (r.bridge.published > sent) == released
    if released:
        return
    _, text, values = r.summary()
    assert text == (
        'the collection was interrupted (waiting for mocap): /remaster/collect goes on'
    )
    assert values['asks_for_collect'] == text
    collect(r)
    r.run(5.0, lambda: r.bridge.published > sent)


@pytest.mark.parametrize('state', ['measuring', 'waiting', 'paused'])
def test_an_emergency_stop_of_an_arm_that_rests_begins_nothing_when_it_is_released(rig, state):
    """Pressed and released within seconds; the robot reports neither."""
    r = rig(emergency_stop_topic='none')
    r.settle(TARGET)
    named = f'{r.pose}.000000000'
    if state == 'waiting':
        r.answer(named, 0)
        r.plan(AWAY)
        r.run(5.0, lambda: r.arm.speed() > 0.2)
        r.waiting_for = 'mocap'
        r.run(2.0)
    elif state == 'paused':
        r.say_planner('paused')
    r.arm.stop_by_brakes(r.wall)
    # Its driver is silent meanwhile, as a robot's is whose controller is off.
    r.alive.discard('robot')
    r.run(0.8 if state == 'waiting' else 2.0)
    r.arm.release(r.wall)
    r.alive.add('robot')
    r.waiting_for = ''
    sent = r.bridge.published
    r.run(3.0)
    if state == 'measuring':
        r.answer(named, 0)
        r.plan(AWAY)
        r.run(3.0)
    assert r.bridge.published == sent
    assert r.halted() or r.summary()[2]['asks_for_collect'] or state == 'paused'


@pytest.mark.parametrize(('gone_s', 'goes_on'), [(2.0, True), (60.0, False)])
def test_a_bridge_that_was_away_in_a_run_for_long_waits_for_a_person(rig, gone_s, goes_on):
    r = rig(ready=False)
    r.end_bridge()
    commands_file(r).write(HOME, r.time_ns() - round(gone_s * 1e9))
    r._open_bridge({})
    r.ready() if goes_on else r.alone()
    r.plan(TARGET)
    r.run(4.0)
    assert bool(r.bridge.published) == goes_on
    if not goes_on:
        r.bridge._watch()
        collect(r)
        r.run(5.0, lambda: r.bridge.published)
