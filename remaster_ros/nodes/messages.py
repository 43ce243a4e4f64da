"""Stamps and transforms as ROS messages; what reads messages is `collection.message_fields`."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import TransformStamped

from remaster_ros.kinematics import transforms
from remaster_ros.types import FloatArray


def stamp_of(time_s: float) -> Time:
    """Return a time in seconds as a stamp."""
    nanoseconds = round(time_s * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def duration_of(time_s: float) -> Duration:
    """Return a duration in seconds as a message."""
    nanoseconds = round(time_s * 1e9)
    return Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def transform_message(parent: str, child: str, T_parent_child: FloatArray) -> TransformStamped:
    """Return a transform (4, 4) as a message."""
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = map(float, T_parent_child[:3, 3])
    quaternion = transforms.quaternion_xyzw(T_parent_child[:3, :3])
    rotation.x, rotation.y, rotation.z, rotation.w = map(float, quaternion)
    return message


def transform_array(message: TransformStamped) -> FloatArray:
    """Undo `transform_message`; returns (4, 4)."""
    translation, rotation = message.transform.translation, message.transform.rotation
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    return transforms.transform(
        transforms.matrix_from_quaternion_xyzw(quaternion),
        np.array([translation.x, translation.y, translation.z]),
    )
