# SPDX-License-Identifier: Apache-2.0
"""The faults of test/faults/observed.md that are tried on real nodes.

A row is one fault in the middle of a running collection (`faults.observation`).
"""

from __future__ import annotations

import copy
import json
import signal
import time
from collections.abc import Callable

import numpy as np
from faults.bench import SENSOR_OF, Bench
from faults.observation import Row, wait_until

from remaster_ros.collection.events import VERSION, SolutionSettled

# Faults of the robot


def robot(**numbers: float) -> Callable[[Bench], None]:
    """Return an injection into the fake robot."""
    return lambda bench: bench.inject(robot=numbers)


def then_pause(inject: Callable[[Bench], object]) -> Callable[[Bench], None]:
    """Return an injection that is followed by a person's pause."""

    def both(bench: Bench) -> None:
        inject(bench)
        wait_until(bench, time.monotonic() + 0.4)
        bench.call('pause')

    return both


def second_publisher(bench: Bench) -> None:
    """Report other joints beside the robot, then what is not a number."""
    from sensor_msgs.msg import JointState

    publisher = bench.foreign('joint_states', JointState)
    names = list(bench.world.chain.joint_names)
    until = time.monotonic() + 2.0
    while time.monotonic() < until:
        q, _ = bench.world.reported(bench.world.now())
        q = q + 0.5 if until - time.monotonic() > 1.0 else q * np.nan
        message = JointState(name=names, position=q.tolist())
        now = bench.world.now()
        message.header.stamp.sec, message.header.stamp.nanosec = int(now), int(now % 1 * 1e9)
        publisher.publish(message)
        time.sleep(0.02)


def strangers_leave(bench: Bench) -> None:
    """End the bench's own publishers."""
    for publisher in bench.strangers:
        bench.node.destroy_publisher(publisher)
    bench.strangers.clear()
    bench.inject()


def stranger_on(topic: str) -> Callable[[Bench], None]:
    """Return an injection: another publisher of poses or commands, who sends the arm elsewhere."""

    def publish(bench: Bench) -> None:
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        publisher = bench.foreign(topic, JointTrajectory)
        if topic == 'remaster/joint_solutions':
            time.sleep(0.5)
            message = JointTrajectory(joint_names=list(bench.world.chain.joint_names))
            point = JointTrajectoryPoint(positions=(bench.world.start_q + 0.2).tolist())
            message.points = [point]
            message.header.stamp.sec = 1
            publisher.publish(message)

    return publish


def paused_in_an_emergency(bench: Bench) -> None:
    """Stop the bridge's process; meanwhile the emergency stop is pressed."""
    bench.send('robot_bridge', signal.SIGSTOP)
    bench.inject(robot={'estop': 1})
    time.sleep(1.5)
    bench.send('robot_bridge', signal.SIGCONT)


# Faults of the nodes


def killed(name: str) -> Callable[[Bench], None]:
    """Return SIGKILL."""
    return lambda bench: bench.kill(name)


def started(name: str) -> Callable[[Bench], None]:
    """Return a new start."""
    return lambda bench: bench.start(name)


def restarted(name: str) -> Callable[[Bench], None]:
    """Return SIGKILL and a start at once, as launch does."""

    def again(bench: Bench) -> None:
        bench.kill(name)
        bench.start(name)

    return again


def paused(name: str) -> Callable[[Bench], None]:
    """Return SIGSTOP."""
    return lambda bench: bench.send(name, signal.SIGSTOP)


def resumed(name: str) -> Callable[[Bench], None]:
    """Return SIGCONT."""
    return lambda bench: bench.send(name, signal.SIGCONT)


def stutters(name: str) -> Callable[[Bench], None]:
    """Return a process that has half of the time."""
    return lambda bench: bench.stutter(name, 4.0)


def intermittent(name: str) -> Callable[[Bench], None]:
    """Return a process that stands still for 4 s, twice."""

    def twice(bench: Bench) -> None:
        bench.stutter(name, 8.5, on_s=1.0, off_s=4.0)

    return twice


def over(bench: Bench) -> None:
    """End the faults of the devices."""
    bench.inject()


def nothing(bench: Bench) -> None:
    """Be over already."""


# What a node tells, spoiled on its way


def spoiled(name: str, spoil: Callable, *, now: bool = False) -> Callable[[Bench], None]:
    """Return a relay that changes a node's messages; with `now` it repeats the last one."""

    def begin(bench: Bench) -> None:
        bench.relays[name].spoil = spoil
        if now:
            bench.relays[name].say_again()

    return begin


def later(name: str, seconds: float) -> Callable[[Bench], None]:
    """Return a relay that hands on late."""
    return lambda bench: setattr(bench.relays[name], 'delay_s', seconds)


def honest(name: str) -> Callable[[Bench], None]:
    """Return a relay that hands on what it gets."""

    def end(bench: Bench) -> None:
        bench.relays[name].spoil, bench.relays[name].delay_s = None, 0.0

    return end


def in_solutions(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    def spoil(message):
        message = copy.deepcopy(message)
        for point in message.points:
            point.positions = change(np.array(point.positions)).tolist()
        return message

    return spoil


def in_settled(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    def spoil(message):
        message = copy.deepcopy(message)
        message.position = change(np.array(message.position)).tolist()
        return message

    return spoil


def in_point(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    def spoil(message):
        message = copy.deepcopy(message)
        point = message.point
        point.x, point.y, point.z = map(float, change(np.array([point.x, point.y, point.z])))
        return message

    return spoil


class Frozen:
    """Repeats the first position it gets."""

    def __init__(self) -> None:
        self.seen: np.ndarray | None = None

    def __call__(self, place: np.ndarray) -> np.ndarray:
        """Return that position."""
        self.seen = place if self.seen is None else self.seen
        return self.seen


FAR = np.deg2rad([0.0, 400.0, 0.0, 0.0, 0.0, 0.0, 0.0])
BESIDE = np.array([0.2, 0.0, 0.0])


def frozen_points(name: str) -> Callable[[Bench], None]:
    """Return a relay that repeats one position for ever."""
    return lambda bench: spoiled(name, in_point(Frozen()))(bench)


def answers(**wrong: object) -> Callable[[Bench], None]:
    """Return answers in the recorder's name, each time the arm has settled."""

    def begin(bench: Bench) -> None:
        from std_msgs.msg import String

        publisher = bench.foreign('remaster/events', String)
        time.sleep(0.3)
        until, answered = time.monotonic() + 6.0, 0.0
        while time.monotonic() < until:
            for at, event in bench.observer.find(SolutionSettled, since_s=answered):
                answered = max(answered, at)
                body = {
                    'kind': 'configuration', 'stamp': event.stamp, 'solution': event.solution,
                    'result': 'recorded', **wrong,
                }  # fmt: skip
                record = {'version': VERSION, 'node': '/recorder', 'body': body}
                publisher.publish(String(data=json.dumps(record)))
            time.sleep(0.01)

    return begin


FIVE = (
    Row('robot', 'emergency stop pressed and driver silent', robot(estop=1, off=1)),
    Row(
        'robot_bridge',
        'its process is paused (SIGSTOP), and the emergency stop is pressed meanwhile',
        paused_in_an_emergency,
        lasts_s=4.0,
        times=True,
    ),
    *(
        Row(
            'robot',
            f'joint_states come {late:g} s late, then a pause',
            then_pause(robot(late=late)),
            lasts_s=2.5,
            times=True,
        )
        for late in (0.5, 1.0, 2.0)
    ),
    Row(
        'robot',
        'one message on joint_states off by 2π, then a pause',
        then_pause(robot(wrapped_once=1)),
        lasts_s=2.5,
    ),
    Row(
        'robot',
        'a second publisher on joint_states, then NaN',
        second_publisher,
        strangers_leave,
        lasts_s=3.0,
        times=True,
    ),
)
BEFORE = {
    FIVE[0].fault: '37° onward, 197 %',
    FIVE[1].fault: '31°, 161 %, then commands again, no halt',
    FIVE[2].fault: 'back, 76 %',
    FIVE[3].fault: 'back, 171 %',
    FIVE[4].fault: 'back by up to 54°, 305 %',
    FIVE[5].fault: '361°, 1977 %, outside the limits',
    FIVE[6].fault: '2871°, all joints outside the limits, then a move planned from there',
}
"""What the bridge commanded in these situations before there was a motion gate."""

ROBOT = (
    Row('robot', 'emergency stop', robot(estop=1)),
    Row('robot', 'emergency stop while a marker is measured', robot(estop=1), during='reading'),
    Row('robot', 'drops its commands', robot(dropped=1), lasts_s=8.0),
    Row('robot', 'arrives elsewhere', robot(elsewhere=0.02), lasts_s=8.0),
    Row('robot', 'moves at a third of its speed', robot(slow=3.0), lasts_s=8.0),
    Row('robot', 'drifts while settling', robot(drift=1e-3), lasts_s=22.0),
    Row('robot', 'stops publishing', robot(off=1), lasts_s=6.0, times=True),
    Row('robot', 'switched off and on', robot(off=1), robot(reordered=1), lasts_s=6.0, times=True),
    Row('robot', 'publishes every other 4 s', robot(intermittent=4.0), lasts_s=9.0,
        times=True),
    Row('robot', 'publishes what was commanded as measured', robot(copy=1), lasts_s=8.0),
    Row('robot', 'reports NaN', robot(nan=1)),
    Row('robot', 'joints renamed', robot(renamed=1)),
    Row('robot', 'joints in another order each time', robot(reordered=1)),
    Row('robot', 'clock jumps an hour ahead', robot(clock=3600.0), times=True),
    Row('robot', 'clock jumps an hour back', robot(clock=-3600.0), times=True),
    Row('robot', 'joint_states come 1 s late', robot(late=1.0), times=True),
    Row('robot', 'joint_states stamped 1 s early', robot(clock=1.0), times=True),
    Row('robot', 'two of three joint_states lost', robot(lost=3)),
    Row('robot', 'each of joint_states doubled', robot(doubled=1)),
    Row('robot', 'the same joint_states again and again', robot(repeated=1), times=True),
    Row('robot', 'joint_states frozen, with new stamps', robot(frozen=1), times=True),
    Row('robot', 'a joint off by 2π for good', robot(wrapped=1)),
    Row('robot', 'a joint off by 2π in one message', robot(wrapped_once=1)),
    Row('robot', 'emergency_stop_topic says true', lambda b: setattr(b, 'pressed', True),
        lambda b: setattr(b, 'pressed', False), bench='emergency'),
    Row('robot', 'emergency_stop_topic falls silent', lambda b: setattr(b, 'pressed', None),
        lambda b: setattr(b, 'pressed', False), lasts_s=6.0, bench='emergency'),
    Row('pose_planner', 'a second publisher of its poses',
        stranger_on('remaster/joint_solutions'), strangers_leave, lasts_s=2.0),
    Row('robot_bridge', 'a second publisher of its commands',
        stranger_on('joint_trajectory_controller/joint_trajectory'), strangers_leave,
        lasts_s=2.0),
)  # fmt: skip


def _common(name: str) -> tuple[Row, ...]:
    rows = (
        ('off', 'killed, and started after 6 s', killed(name), started(name), 6.0),
        ('restarted', 'killed, and started at once', restarted(name), nothing, 5.0),
        ('stuck', 'stands still (SIGSTOP) for 5 s', paused(name), resumed(name), 5.0),
        ('delayed', 'stands still for 1 s', paused(name), resumed(name), 1.0),
        ('slow', 'has half of its time, in pieces of 60 ms', stutters(name), nothing, 0.0),
        ('intermittent', 'stands still for 4 s, twice', intermittent(name), nothing, 0.0),
    )
    return tuple(
        Row(
            name,
            fault,
            inject,
            end,
            lasts_s,
            times=name == 'robot_bridge',
        )
        for kind, fault, inject, end, lasts_s in rows
    )


def _relayed() -> tuple[Row, ...]:
    planner, bridge = 'pose_planner', 'robot_bridge'
    rows = [
        (planner, 'solutions outside the limits', spoiled(planner, in_solutions(lambda q: q + FAR),
         now=True), 4.0),
        (planner, 'solutions that are not numbers',
         spoiled(planner, in_solutions(lambda q: q * np.nan), now=True), 4.0),
        (planner, 'its poses come 1 s late', later(planner, 1.0), 8.0),
        (bridge, 'says that it settled elsewhere', spoiled(bridge, in_settled(lambda q: q + 0.5)),
         10.0),
        (bridge, 'says that it settled at NaN', spoiled(bridge, in_settled(lambda q: q * np.nan)),
         10.0),
        (bridge, 'says 1 s late that it settled', later(bridge, 1.0), 8.0),
    ]  # fmt: skip
    for name in SENSOR_OF:
        rows += [
            (name, 'another marker: 0.2 m beside', spoiled(name, in_point(lambda p: p + BESIDE)),
             6.0),
            (name, 'the same reading again and again', frozen_points(name), 8.0),
            (name, 'readings that are not numbers', spoiled(name, in_point(lambda p: p * np.nan)),
             8.0),
            (name, 'readings come 1 s late', later(name, 1.0), 8.0),
        ]  # fmt: skip
    return tuple(
        Row(who, fault, inject, honest(who), lasts_s, bench='relays')
        for who, fault, inject, lasts_s in rows
    )


RECORDER = (
    Row('recorder', 'answers to another pose', answers(stamp='1.000000000'), strangers_leave,
        lasts_s=0.0),
    Row('recorder', 'answers in no number', answers(solution='garbage'), strangers_leave,
        lasts_s=0.0),
)  # fmt: skip
DEVICES = (
    Row('optitrack_markers', 'its bar stops streaming',
        lambda bench: bench.inject(mocap={'stopped': 1}), lasts_s=6.0),
    Row('optitrack_markers', 'its marker is hidden',
        lambda bench: bench.inject(mocap={'occluded': 1}), lasts_s=6.0),
    Row('laser_tracker_markers', 'its instrument is switched off',
        lambda bench: bench.inject(tracker={'off': 1}), lasts_s=6.0),
    Row('laser_tracker_markers', 'its reflector is hidden',
        lambda bench: bench.inject(tracker={'occluded': 1}), lasts_s=6.0),
    Row('laser_tracker_markers', 'killed for good, and `require` is the bar alone',
        killed('laser_tracker_markers'), nothing, lasts_s=6.0, bench='bar alone'),
    Row('laser_tracker_markers', 'killed for good, and `require` is any',
        killed('laser_tracker_markers'), nothing, lasts_s=6.0, bench='any sensor'),
    *(Row(who, fault, lambda bench, faults=faults: bench.inject(**faults), end, lasts_s=lasts_s,
          bench='several markers')
      for who, fault, faults, end, lasts_s in (
          ('optitrack_markers', 'one of its three markers is hidden',
           {'mocap': {'hidden': 2}}, over, 4.0),
          ('optitrack_markers', 'two of its three markers are taken for each other',
           {'mocap': {'exchanged': 2}}, over, 8.0),
          ('laser_tracker_markers', 'one of its two reflectors is hidden',
           {'tracker': {'hidden': 2}}, over, 4.0),
          ('optitrack_markers', 'one of its three markers is gone for good',
           {'mocap': {'hidden': 3}}, nothing, 30.0),
      )),
)  # fmt: skip

ROWS = (*FIVE, *ROBOT, *(row for name in (
    'pose_planner', 'robot_bridge', 'recorder', *SENSOR_OF) for row in _common(name)),
    *RECORDER, *DEVICES, *_relayed())  # fmt: skip
