# SPDX-License-Identifier: Apache-2.0
"""ROS shell of the fake arm: joint_trajectory_controller, joint_states, safety circuit, a clock.

The clock is relative like every name here: in a namespace, nodes that use it are started with the
remapping ``/clock:=clock`` (rclpy itself subscribes to /clock).
"""

from __future__ import annotations

import math
import shutil
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Header
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.message_fields import seconds
from remaster_ros.nodes.messages import stamp_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.simulated_clock import LEADS, TAKEN, TAKEN_EVERY_S
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.arm_motion import ServoPoint
from remaster_ros.simulation.robot import FakeArm
from remaster_ros.simulation.setup import (
    default_folder,
    make_private_folder,
    make_world,
    open_world,
)
from remaster_ros.simulation.world_clock import POLL_WALL_S
from remaster_ros.simulation.world_pace import Pace

STANDING_CLOCK_WALL_S = 0.1
"""A clock that stands is published so often, s of wall time."""


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the fake arm."""

    world: str = parameter(
        '', 'folder of the hidden World; empty: draw one from cell and seed in the default folder'
    )
    cell: str = parameter('demo', 'cell file of a World that is drawn')
    seed: int = parameter(0, 'seed of a World that is drawn', low=0)
    rate: float = parameter(
        1.0, 'world time over wall time of a World that is drawn', low=0.1, high=20.0
    )
    joint_state_rate: float = parameter(
        50.0, 'joint_states per second of world time', unit='Hz', low=1.0, high=1000.0
    )
    clock_rate: float = parameter(
        100.0,
        'clock messages per second of wall time while the world runs at its rate',
        unit='Hz',
        low=10.0,
        high=1000.0,
    )


class FakeRobotNode(RemasterNode):
    """Node of a simulated arm, with the topics of ros2_control and the simulated clock."""

    def __init__(self) -> None:
        super().__init__('fake_robot')
        self.p = declare(self, Parameters)
        self._drawn: Path | None = None
        if self.p.world:
            self.world = open_world(self.p.world, self.get_namespace())
        else:
            folder = default_folder(self.get_namespace())
            make_private_folder(folder)
            self._drawn = folder
            self.world = make_world(self._drawn, read_cell(self.p.cell), self.p.seed, self.p.rate)
        rng = np.random.default_rng([self.world.seed, 2])
        self.arm = FakeArm(self.world, rng)
        reliable = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        self._states = self.create_publisher(JointState, 'joint_states', reliable)
        self._clock_publisher = self.create_publisher(ClockMessage, 'clock', 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._safety = self.create_publisher(Bool, 'emergency_stop', latched)
        self._reported_stop: bool | None = None
        self.create_subscription(
            JointTrajectory,
            'joint_trajectory_controller/joint_trajectory',
            self._on_trajectory,
            reliable,
        )
        self._pace = Pace(self.world.clock, TAKEN_EVERY_S)
        self.create_subscription(Header, TAKEN, self._on_taken, reliable)
        # A thread of its own: a timer of rclpy costs several times what the message does.
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Thread: publish joint states and clock, and let world time go on, until the node ends.

        Missed periods are skipped. While world time stands still, the clock is published every
        `STANDING_CLOCK_WALL_S`.
        """
        state_s, clock_s = 1.0 / self.p.joint_state_rate, self.world.rate / self.p.clock_rate
        state_due = clock_due = self.world.now()
        clock_wall, wait_s, moved = 0.0, 0.0, False
        # What world time is ahead of the wall clock's.
        ahead_s = self.world.now() - time.monotonic()
        while not self._ending.wait(wait_s):
            if (now := self.world.now()) >= state_due:
                self._publish_state()
                state_due = _next_due(state_due, state_s, now)
            wall = time.monotonic()
            # Also where time stands, for a node that has just been started.
            if now >= clock_due or wall - clock_wall > STANDING_CLOCK_WALL_S:
                self._clock_publisher.publish(ClockMessage(clock=stamp_of(now)))
                clock_due, clock_wall = _next_due(clock_due, clock_s, now), wall
            moved = moved or self.world.has_moved
            self._pace.go_on(math.inf if moved else wall + ahead_s)
            left_s = min(state_due, clock_due) - self.world.now()
            wait_s = max(left_s / self.world.rate, POLL_WALL_S)

    def _on_taken(self, message: Header) -> None:
        """Record up to which stamp a process has processed messages.

        World time waits for it. ``message``: the stamp, and as ``frame_id`` the process id,
        followed by `LEADS` if that process leads the arm. A message with a malformed id is
        ignored. See `Pace`.
        """
        pid, _, what = message.frame_id.partition(' ')
        if pid.isdecimal():
            self._pace.took(int(pid), seconds(message.stamp), leads=what == LEADS)

    def _publish_state(self) -> None:
        """Publish a changed protective stop, and the joint states if the arm reports any.

        Each report is published `FakeArm.copies` times: twice if the World simulates doubled
        reports.
        """
        if self.arm.reports_stop != self._reported_stop:
            self._reported_stop = self.arm.reports_stop
            self._safety.publish(Bool(data=self._reported_stop))
        state = self.arm.joint_state()
        if state is None:
            return
        now, names, q, velocity = state
        message = JointState(name=names, position=q.tolist(), velocity=velocity.tolist())
        message.header.stamp = stamp_of(now)
        self._pace.published(seconds(message.header.stamp))
        for _ in range(self.arm.copies):
            self._states.publish(message)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Give a trajectory to the simulated arm; log why, if the arm drops it."""
        points = [
            ServoPoint(
                seconds(point.time_from_start),
                np.array(point.positions),
                np.array(point.velocities) if point.velocities else None,
            )
            for point in message.points
        ]
        dropped = self.arm.command(message.joint_names, points, seconds(message.header.stamp))
        if dropped is not None:
            self.get_logger().error(f'trajectory dropped: {dropped}')

    def close(self) -> None:
        """End the thread and close the World; delete the World's folder if this node made it."""
        self._ending.set()
        self._thread.join()
        self.world.close()
        if self._drawn is not None:
            shutil.rmtree(self._drawn, ignore_errors=True)


def _next_due(due: float, period: float, now: float) -> float:
    """First time `due` + n `period` after `now`, s, n >= 0; `due` itself if that is to come.

    Missed periods are skipped, not made up for.
    """
    return due + period * max(math.floor((now - due) / period) + 1, 0)


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    return run(FakeRobotNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
