# SPDX-License-Identifier: Apache-2.0
"""A mocap driver or tracker driver of another package: a process that publishes positions alone.

    python -m rigs.foreign_source WORLD SENSOR MESSAGE_TYPE TOPIC [tool]

With ``tool`` it is a camera there, and publishes the pose of the board that stands.

It has no heartbeat, no events and no parameters of this package. It reads the hidden World for
where the marker is, as the other fakes do, and these of its faults: ``stopped``, ``slow``,
``late``, ``jumping``, ``frozen``, ``occluded`` (see `remaster_ros.simulation.faults`).
"""

import sys
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import qos_profile_sensor_data

from remaster_ros.kinematics.transforms import (
    inverse_poses,
    matrix_from_quaternion_xyzw,
    matrix_from_rpy,
    quaternion_xyzw,
)
from remaster_ros.nodes.messages import stamp_of
from remaster_ros.simulation.world import World

RATE_HZ = 10.0
SIGMA_M, SIGMA_RAD = 0.05e-3, 0.2e-3
# Of a camera's pose, at the lever of its distance.
CAMERA_RAD = 0.02e-3
JUMP_M = 0.02
R_T_B = matrix_from_rpy(np.array([0.4, -0.2, 1.1]))
"""How the axes of a measured body stand in the tool frame, which nobody is told."""


def main() -> None:
    """Publish until the signal comes."""
    folder, sensor, message_type, topic, *on_tool = sys.argv[1:]
    world = World.open(Path(folder))
    kind = {'PointStamped': PointStamped, 'PoseStamped': PoseStamped}[message_type.split('/')[-1]]
    rng = np.random.default_rng([world.seed, len(sensor)])
    rclpy.init(args=[])
    node = rclpy.create_node(f'vendor_{sensor}')
    publisher = node.create_publisher(kind, topic, qos_profile_sensor_data)
    frames, frozen = 0, None
    while rclpy.ok():
        due = world.now() + 1.0 / RATE_HZ
        world.kept_up(sensor, due)
        world.sleep_until(due)
        frames, faults, t = frames + 1, world.faults(sensor), world.now()
        if 'stopped' in faults or frames % int(faults.get('slow', 1)):
            continue
        in_sight = world.line_of_sight(sensor, t)
        # A mocap driver sends also while the marker is hidden; others send what they see.
        if not in_sight and kind is PointStamped:
            continue
        position = world.marker_in_sensor(sensor, t)
        xyzw = quaternion_xyzw(orientation(world, sensor, world.reported(t)[0]))
        if on_tool:
            position, xyzw = inverse_poses(position, xyzw)
        position = position + SIGMA_M * rng.standard_normal(3)
        position[2] += JUMP_M * ('jumping' in faults and frames % 4 == 0)
        frozen = None if 'frozen' not in faults else position if frozen is None else frozen
        position = position if frozen is None else frozen
        if not in_sight:
            position = np.full(3, np.nan)
        message = kind()
        message.header.stamp = stamp_of(t - faults.get('late', 0.0))
        message.header.frame_id = f'{sensor}_world'
        place = message.point if kind is PointStamped else message.pose.position
        place.x, place.y, place.z = map(float, position)
        if kind is PoseStamped:
            sigma = CAMERA_RAD if on_tool else SIGMA_RAD
            turn = matrix_from_rpy(sigma * rng.standard_normal(3))
            turned = message.pose.orientation
            xyzw = quaternion_xyzw(matrix_from_quaternion_xyzw(xyzw) @ turn)
            turned.x, turned.y, turned.z, turned.w = map(float, xyzw)
        publisher.publish(message)


def orientation(world: World, sensor: str, q: np.ndarray) -> np.ndarray:
    """Return R_N_B of the body at reported joint angles q, (..., 3, 3)."""
    truth = world.truth
    R_R_T = world.chain.forward(q + truth.joint_offsets)[..., :3, :3]
    return truth.sensors[sensor].T_R_N[:3, :3].T @ R_R_T @ R_T_B


if __name__ == '__main__':
    main()
