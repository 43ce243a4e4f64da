# SPDX-License-Identifier: Apache-2.0
"""The action of a controller in front of an arm that takes trajectories on a topic: a process."""

import contextlib

import rclpy
from rclpy.executors import ExternalShutdownException
from rigs.action_controller import ActionController
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

HOLD_NS = 10**8
"""How long an arm that is held takes to where it was reported last."""
LOOK_S = 0.02


def main():
    rclpy.init()
    node = rclpy.create_node('joint_trajectory_controller')
    commands = node.create_publisher(JointTrajectory, 'arm/joint_trajectory', 10)
    states = []

    def take(message):
        states[:] = [message]

    def hold():
        point = JointTrajectoryPoint(positions=states[0].position)
        point.velocities = [0.0] * len(point.positions)
        point.time_from_start.nanosec = HOLD_NS
        commands.publish(JointTrajectory(joint_names=states[0].name, points=[point]))

    node.create_subscription(JointState, 'joint_states', take, 10)
    controller = ActionController(
        node,
        'joint_trajectory_controller/follow_joint_trajectory',
        commands.publish,
        hold,
        lambda: node.get_clock().now().nanoseconds * 1e-9,
    )
    node.create_timer(LOOK_S, controller.look, clock=rclpy.clock.Clock())
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
