"""Faults of robot, nodes and messages, as functions of the bench that inject them."""

from __future__ import annotations

import copy
import json
import signal
import time
from collections.abc import Callable

import numpy as np
from fault_bench import Bench
from fault_observation import wait_until

from remaster_ros.collection.events import (
    VERSION,
    SolutionSettled,
)

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
