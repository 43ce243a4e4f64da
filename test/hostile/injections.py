# SPDX-License-Identifier: Apache-2.0
"""What can go wrong between a bridge and its arm, at random moments of a move under way.

Each injection is a function of the scene; it returns from when on the arm must receive nothing
(`SILENT`), where that is so. What is expected of the bridge stands in `hostile.campaign`.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

import numpy as np
from hostile.arm import Command
from hostile.bench import Bench
from hostile.lines import COMMANDS, INTRUDER, RELIABLE
from hostile.scene import ANSWER_S, HOME, SPREAD, Scene
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.types import FloatArray

STANDS_RAD_S = 1e-3
"""An arm that is no faster stands."""
MOST_OFF_RAD = 2e-3
"""`arrive_tolerance` of the bridge: an arm that is no further from its end has arrived."""


def control(s: Scene) -> None:
    """Nothing is wrong."""


def pauses(s: Scene) -> None:
    for _ in range(s.rng.integers(1, 4)):
        s.pause()
        s.wait(0.0, 0.5)
        s.bench.plan_state('running')
        s.wait(0.1, 0.8)


def pose_taken_back(s: Scene) -> None:
    moving = s.bench.on_its_way()
    asked = time.monotonic()
    s.bench.send([])
    if moving:
        came = s.bench.until(lambda: s.bench.commands_since(asked), ANSWER_S)
        first = s.bench.commands_since(asked)[0].arrival_s if came else np.inf
        s.latencies.append(first - asked)
    s.wait(0.3, 0.6)
    s.bench.send(s.solutions)


def planner_silent(s: Scene) -> None:
    s.bench.silent.add('pose_planner')
    s.wait(1.3, 2.0)
    s.bench.silent.clear()


def recorder_silent(s: Scene) -> None:
    s.bench.silent.add('recorder')
    s.wait(1.3, 2.0)
    s.bench.silent.clear()


def sensor_missing(s: Scene) -> None:
    s.bench.waiting_for = 'mocap'
    s.wait(0.3, 1.0)
    s.bench.waiting_for = ''


def _waits(s: Scene, pressed: bool) -> None:
    """A sensor is missing for longer than a program may go on after; then it is back."""
    bench = s.bench
    bench.waiting_for = 'mocap'
    s.wait(1.0, 1.3)
    if pressed:
        # Somebody goes to the arm, and is back before the sensor is.
        bench.arm.stop_by_brakes(time.monotonic())
        s.wait(0.3, 1.0)
        bench.arm.release(time.monotonic())
    s.wait(2.5, 3.0)
    bench.waiting_for = ''


def long_wait(s: Scene) -> None:
    """The robot reports all the time that nobody has stopped it."""
    _waits(s, pressed=False)


def emergency_in_a_wait(s: Scene) -> None:
    _waits(s, pressed=bool(s.rng.random() < 0.7))
    back = time.monotonic()
    s.wait(1.5, 2.5)
    s.alone = len(s.bench.commands_since(back))


def emergency_while_braking(s: Scene) -> None:
    """Pressed on the way of a stop, and released; a sensor was missing for a moment."""
    bench, asked = s.bench, time.monotonic()
    bench.waiting_for = 'mocap'
    if not bench.until(lambda: _stops(bench, asked), 1.5):
        s.expected, bench.waiting_for = 'any', ''
        return
    stop = _stops(bench, asked)[0]
    s.wait(0.0, max(stop.end_s - time.monotonic(), 0.0))
    pressed = time.monotonic()
    bench.arm.stop_by_brakes(pressed)
    s.wait(0.3, 1.5)
    off = np.max(np.abs(bench.arm.q - stop.q[-1]))
    s.note = f'{np.rad2deg(off):.2f} deg before the end of its stop'
    # Where it has as good as arrived nothing shows it.
    s.silent_from, s.expected = (pressed, '') if off > MOST_OFF_RAD else (None, 'any')
    bench.arm.release(time.monotonic())
    bench.waiting_for = ''


def _stops(bench: Bench, since_s: float) -> list[Command]:
    """Return the stops since a time: what ends before the command under way, or has no stamp."""
    found, before_s = [], np.inf
    for command in bench.commands_since(since_s - 2.0):
        if command.arrival_s > since_s and (
            command.begins_s is None or command.end_s < before_s - 0.01
        ):
            found.append(command)
        before_s = command.end_s
    return found


def named_twice(s: Scene) -> None:
    """Two arms merged without prefix."""
    s.bench.disturb(twice=True)
    s.maybe_pause(0.6)


def another_robots_joints(s: Scene) -> None:
    s.bench.disturb(prefix='other_')
    s.wait(1.3, 1.8)


def gripper_beside(s: Scene) -> None:
    """Its driver publishes its own joints, on its own clock."""
    publisher = s.bench.intruder.create_publisher(JointState, '/joint_states', RELIABLE)
    try:
        s.bench.until(lambda: publisher.get_subscription_count() > 0, 2.0)
        for _ in range(100):
            publisher.publish(JointState(name=['finger'], position=[0.01]))
            time.sleep(0.01)
    finally:
        s.bench.intruder.destroy_publisher(publisher)


def limit_raised(s: Scene) -> None:
    """It is refused while the arm moves; what is commanded is judged by the limit before."""
    s.note = s.bench.set_parameter('speed_share', 1.0)[:60]
    s.maybe_pause(0.6)


def lost_states(s: Scene) -> None:
    s.bench.disturb(loss=s.rng.uniform(0.2, 0.6))
    s.wait(0.5, 1.5)
    s.bench.disturb(loss=0.0)


def short_silence(s: Scene) -> None:
    s.bench.disturb(silent=True)
    s.wait(0.02, 0.12)
    s.bench.disturb(silent=False)


def a_little_late(s: Scene) -> None:
    s.bench.disturb(delay_s=s.rng.uniform(0.005, 0.05))
    s.maybe_pause(0.5)
    s.wait(0.2, 0.6)
    s.bench.disturb(delay_s=0.0)


def command_doubled(s: Scene) -> None:
    s.bench.disturb(command_double=True)
    s.maybe_pause(0.8)


def _emergency(s: Scene, silent: bool) -> None:
    s.silent_from = time.monotonic()
    s.bench.arm.stop_by_brakes(s.silent_from)
    if silent:
        s.bench.disturb(silent=True)


def emergency(s: Scene) -> None:
    _emergency(s, silent=False)
    s.maybe_pause(1.5)


def emergency_driver_silent(s: Scene) -> None:
    _emergency(s, silent=True)
    s.maybe_pause(1.5)


def emergency_released(s: Scene) -> None:
    """Pressed and released again before anybody looked."""
    _emergency(s, silent=bool(s.rng.random() < 0.5))
    s.wait(0.3, 1.2)
    s.bench.arm.release(time.monotonic())
    s.bench.disturb(silent=False)


def emergency_topic(s: Scene) -> None:
    _emergency(s, silent=bool(s.rng.random() < 0.5))
    s.bench.show_emergency(True)
    s.maybe_pause(1.0)


def emergency_topic_blinks(s: Scene) -> None:
    """The robot's own circuit shows it for a moment only."""
    _emergency(s, silent=False)
    s.bench.show_emergency(True)
    s.wait(0.1, 0.3)
    s.bench.arm.release(time.monotonic())
    s.bench.show_emergency(False)


def _settle(s: Scene) -> bool:
    """Wait until the arm is being measured; the recorder does not answer."""
    s.bench.answers = False
    before = len(s.bench.seen.settled)
    return s.bench.until(lambda: len(s.bench.seen.settled) > before, s.left_s + 3.0)


def emergency_while_measuring(s: Scene) -> None:
    s.note = '' if _settle(s) else 'did not settle'
    _emergency(s, silent=True)
    s.wait(1.1, 1.6)
    s.bench.answers = True


def emergency_while_paused(s: Scene) -> None:
    s.bench.plan_state('paused')
    s.wait(0.4, 0.7)
    _emergency(s, silent=True)
    s.wait(1.2, 1.6)
    s.bench.plan_state('running')


def process_paused(s: Scene) -> None:
    s.bench.signal(signal.SIGSTOP)
    s.note = f'{s.wait(0.1, 2.5):.2f} s'
    if s.rng.random() < 0.5:
        s.bench.plan_state('paused')
    s.bench.signal(signal.SIGCONT)
    s.wait(0.2, 0.5)
    s.bench.plan_state('running')


def process_paused_emergency(s: Scene) -> None:
    s.bench.signal(signal.SIGSTOP)
    s.wait(0.02, 0.3)
    _emergency(s, silent=bool(s.rng.random() < 0.5))
    s.note = f'{s.wait(0.3, 2.5):.2f} s'
    s.bench.signal(signal.SIGCONT)
    s.maybe_pause(0.5)


def process_killed(s: Scene) -> None:
    s.bench.kill()
    s.wait(0.0, 0.6)
    restart(s.bench)
    s.bench.send(s.solutions)


def bridge_killed(s: Scene) -> None:
    """Nobody sends a stop any more: what the controller has ends by itself."""
    killed = time.monotonic()
    s.bench.kill()
    s.bench.until(lambda: s.bench.arm.speed() < STANDS_RAD_S, 20.0)
    s.after_kill_s = time.monotonic() - killed
    s.note = f'{s.after_kill_s:.2f} s'
    restart(s.bench)
    s.bench.send(s.solutions)


def hostile_values(s: Scene) -> None:
    """Messages without sense on every topic of the bridge, and parameters of the wrong kind."""
    node, made = s.bench.intruder, []
    topics = [
        ('/remaster/joint_waypoints', JointTrajectory),
        ('/remaster/events', String),
        ('/robot_description', String),
        ('/joint_states', JointState),
    ]
    try:
        for topic, kind in topics:
            made.append(node.create_publisher(kind, topic, RELIABLE))
        s.bench.until(
            lambda: all(topic_publisher.get_subscription_count() for topic_publisher in made), 2.0
        )
        for publisher, (_, kind) in zip(made, topics):
            texts = (String(data=''), String(data='x' * 2**20), String(data='{"version": 1e300'))
            odd = texts if kind is String else (kind(),)
            for message in odd:
                publisher.publish(message)
            publisher.publish(b'\x00\x01\x00\x00' + b'\xff' * 64)
        for value in (1e-300, float('nan'), -1.0):
            s.bench.set_parameter('cartesian_speed_limit_m_s', value)
        s.maybe_pause(0.5)
    finally:
        for publisher in made:
            node.destroy_publisher(publisher)


def stopped_while_it_rests(s: Scene) -> None:
    """An emergency stop of an arm that waits, released within seconds; no topic shows it."""
    bench = s.bench
    bench.waiting_for = 'mocap'
    bench.until(lambda: bench.arm.speed() < STANDS_RAD_S, 5.0)
    s.wait(0.2, 0.5)
    bench.arm.stop_by_brakes(time.monotonic())
    s.wait(0.3, 1.0)
    bench.arm.release(time.monotonic())
    back = time.monotonic()
    bench.waiting_for = ''
    s.wait(1.5, 2.0)
    s.alone = len(bench.commands_since(back))


def killed_while_halted(s: Scene) -> None:
    _emergency(s, silent=False)
    s.bench.until(lambda: s.bench.seen.halted(s.silent_from), 4.0)
    s.wait(0.0, 0.3)
    s.bench.kill()
    s.bench.arm.release(time.monotonic())
    restart(s.bench)
    s.bench.send(s.solutions)
    # Nothing that was shown before the kill counts.
    s.note = 'restarted'


def restart(bench: Bench) -> None:
    """Start the bridge again and wait until it is there."""
    bench.start()
    bench.until(lambda: np.isfinite(bench.up_since_s) and bench.can_clear(), 15.0)


def late_states(s: Scene) -> None:
    delay = s.rng.uniform(0.4, 2.0)
    s.note = f'{delay:.2f} s'
    s.bench.disturb(delay_s=delay)
    s.maybe_pause(delay + 0.5)
    s.wait(0.8, 1.2)


def somewhat_late(s: Scene) -> None:
    delay = s.rng.uniform(0.1, 0.4)
    s.note = f'{delay:.2f} s'
    s.bench.disturb(delay_s=delay)
    s.maybe_pause(0.8)


def late_from_the_start(s: Scene) -> None:
    """A bridge that never had them in time, as if the clocks of two hosts were apart."""
    delay = s.rng.uniform(0.2, 2.0)
    s.note = f'{delay:.2f} s'
    s.bench.kill()
    s.bench.plan_state('stopped')
    s.bench.disturb(delay_s=delay)
    restart(s.bench)
    s.wait(2.5, 3.0)
    since = time.monotonic()
    s.bench.plan_state('running')
    s.bench.send([s.another_goal()])
    if s.bench.until(lambda: s.bench.commands_since(since) and s.bench.arm.speed() > 0.1, 4.0):
        s.maybe_pause(2.0)


def early_stamps(s: Scene) -> None:
    s.bench.disturb(clock_s=s.bench.calm.clock_s + s.rng.uniform(0.3, 2.0))
    s.maybe_pause(0.6)


def clock_set_back(s: Scene) -> None:
    s.bench.disturb(clock_s=s.bench.calm.clock_s - s.rng.uniform(0.3, 2.0))
    s.maybe_pause(0.6)


def doubled_states(s: Scene) -> None:
    s.bench.disturb(double=1.0)
    s.maybe_pause(0.6)
    s.wait(0.2, 0.5)


def reordered_states(s: Scene) -> None:
    s.bench.disturb(jitter_s=s.rng.uniform(0.015, 0.1))
    s.maybe_pause(0.6)
    s.wait(0.2, 0.5)


def silence(s: Scene) -> None:
    """The driver is silent, and the arm goes on."""
    s.silent_from = time.monotonic()
    s.bench.disturb(silent=True)
    s.wait(1.3, 1.8)


def wrapped_once(s: Scene) -> None:
    turn = s.turn()
    s.bench.once(lambda q: q + turn)
    if s.rng.random() < 0.7:
        # With the message before the next one: that is when the bridge believes it.
        time.sleep(s.bench.period_s)
        s.bench.plan_state('paused')
        s.wait(0.1, 0.4)
        s.bench.plan_state('running')


def wrapped(s: Scene) -> None:
    s.bench.disturb(wrap=s.turn())
    s.maybe_pause(0.6)


def nan_once(s: Scene) -> None:
    joint = int(s.rng.integers(len(HOME)))
    s.bench.once(lambda q: np.where(np.arange(len(q)) == joint, np.nan, q))
    s.maybe_pause(0.3)


def nan_states(s: Scene) -> None:
    s.bench.disturb(nan=int(s.rng.integers(len(HOME))))
    s.maybe_pause(0.6)


def frozen_states(s: Scene) -> None:
    s.bench.disturb(frozen=True)
    s.maybe_pause(1.0)


def stopped_stamps(s: Scene) -> None:
    s.bench.disturb(stopped_stamps=True)
    s.maybe_pause(0.8)


def _foreign_states(s: Scene, draw: Callable[[], FloatArray]) -> None:
    publisher = s.bench.intruder.create_publisher(JointState, '/joint_states', RELIABLE)
    try:
        s.bench.until(lambda: publisher.get_subscription_count() > 0, 2.0)
        end = time.monotonic() + s.rng.uniform(0.3, 1.2)
        paused = end - 0.25 if s.rng.random() < 0.67 else np.inf
        while time.monotonic() < end:
            q = draw()
            publisher.publish(s.bench.state_message(q, np.zeros_like(q), s.bench.calm.clock_s))
            if time.monotonic() > paused:
                s.bench.plan_state('paused')
                paused = np.inf
            time.sleep(0.01)
        if s.rng.random() < 0.5:
            q = np.full(len(HOME), np.nan)
            publisher.publish(s.bench.state_message(q, np.zeros_like(q)))
            time.sleep(0.1)
        s.bench.plan_state('running')
        s.wait(0.2, 0.4)
    finally:
        s.bench.intruder.destroy_publisher(publisher)


def foreign_states(s: Scene) -> None:
    """Another robot's: plausible values."""
    q = HOME + SPREAD * s.rng.uniform(-1.0, 1.0, len(HOME))
    _foreign_states(s, lambda: q)


def foreign_garbage(s: Scene) -> None:
    _foreign_states(s, lambda: s.rng.uniform(-50.0, 50.0, len(HOME)))


def foreign_commands(s: Scene) -> None:
    """Somebody else commands the arm to hold where it is."""
    publisher = s.bench.intruder.create_publisher(JointTrajectory, COMMANDS, RELIABLE)
    try:
        s.bench.until(lambda: publisher.get_subscription_count() > 0, 2.0)
        message = JointTrajectory(joint_names=s.bench.names)
        message.header.frame_id = INTRUDER
        end = s.bench.arm.q + 0.2 * s.bench.arm.v
        point = JointTrajectoryPoint(positions=end.tolist(), velocities=[0.0] * len(HOME))
        point.time_from_start.nanosec = 400_000_000
        message.points = [point]
        if s.rng.random() < 0.5:
            publisher.publish(message)
        s.maybe_pause(0.6)
        # A bridge that has the graph's word only now and then must still see it.
        s.wait(1.0, 1.5)
    finally:
        s.bench.intruder.destroy_publisher(publisher)


def commands_late(s: Scene) -> None:
    """From the next command on: the stop, and the move after it."""
    s.bench.disturb(command_delay_s=s.rng.uniform(0.05, 0.4))
    s.bench.plan_state('paused')
    s.wait(0.1, 0.8)
    s.bench.plan_state('running')
    s.wait(0.2, 0.8)
    s.maybe_pause(0.3)


def commands_lost(s: Scene) -> None:
    s.bench.disturb(command_loss=float(s.rng.choice([0.5, 1.0])))
    for _ in range(2):
        s.bench.plan_state('paused')
        s.wait(0.1, 0.5)
        s.bench.plan_state('running')
        s.wait(0.2, 0.8)
