"""ROS shell of the fake arm: joint_trajectory_controller, joint_states, and a clock.

The clock is relative like every name here: in a namespace, nodes that use it are started with the
remapping ``/clock:=clock`` (rclpy itself subscribes to /clock).
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.nodes.messages import seconds, stamp_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.session.workcell import read_cell
from remaster_ros.simulation.arm_motion import ServoPoint
from remaster_ros.simulation.robot import FakeArm
from remaster_ros.simulation.setup import (
    default_folder,
    make_private_folder,
    make_world,
    open_world,
)


@dataclass(frozen=True)
class Parameters:
    """Parameters of the fake arm."""

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
        40.0, 'clock messages per second of wall time', unit='Hz', low=10.0, high=1000.0
    )


class FakeRobotNode(RemasterNode):
    """The fake arm as ros2_control would run it."""

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
        self.create_subscription(
            JointTrajectory,
            'joint_trajectory_controller/joint_trajectory',
            self._on_trajectory,
            reliable,
        )
        # Threads of their own: a timer of rclpy costs several times what the message does.
        self._ending = threading.Event()
        self._threads = [
            threading.Thread(target=self._repeat, args=args, daemon=True)
            for args in (
                (self._publish_state, 1.0 / (self.p.joint_state_rate * self.world.rate)),
                (self._publish_clock, 1.0 / self.p.clock_rate),
            )
        ]
        for thread in self._threads:
            thread.start()

    def _repeat(self, publish: Callable[[], None], period_s: float) -> None:
        """Call `publish` every `period_s` of wall time; what comes too late is left out."""
        due = time.monotonic()
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            publish()
            due = max(due + period_s, time.monotonic())

    def _publish_clock(self) -> None:
        self._clock_publisher.publish(ClockMessage(clock=stamp_of(self.world.now())))

    def _publish_state(self) -> None:
        state = self.arm.joint_state()
        if state is None:
            return
        now, names, q, velocity = state
        message = JointState(name=names, position=q.tolist(), velocity=velocity.tolist())
        message.header.stamp = stamp_of(now)
        for _ in range(self.arm.copies):
            self._states.publish(message)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        points = [
            ServoPoint(
                point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec,
                np.array(point.positions),
                np.array(point.velocities) if point.velocities else None,
            )
            for point in message.points
        ]
        dropped = self.arm.command(message.joint_names, points, seconds(message.header.stamp))
        if dropped is not None:
            self.get_logger().error(f'trajectory dropped: {dropped}')

    def close(self) -> None:
        """End the threads; remove a World that was drawn here."""
        self._ending.set()
        for thread in self._threads:
            thread.join()
        self.world.close()
        if self._drawn is not None:
            shutil.rmtree(self._drawn, ignore_errors=True)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(FakeRobotNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
