"""Between ROS messages and arrays: stamps, joints by name, points, transforms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.errors import InputError
from remaster_ros.kinematics import transforms
from remaster_ros.types import FloatArray


def seconds(stamp: Time) -> float:
    """Return a stamp in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def stamp_of(time_s: float) -> Time:
    """Return a time in seconds as a stamp."""
    nanoseconds = round(time_s * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def stamp_key(stamp: Time) -> str:
    """Return a stamp as exact text, the name of a pose in events."""
    return f'{stamp.sec}.{stamp.nanosec:09d}'


def duration_of(time_s: float) -> Duration:
    """Return a duration in seconds as a message."""
    nanoseconds = round(time_s * 1e9)
    return Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def temperature_topic(marker_topic: str) -> str:
    """Return where a sensor that has a thermometer publishes it: beside its marker."""
    place, slash, _ = marker_topic.rpartition('/')
    return f'{place}{slash}temperature'


class JointOrder:
    """Take joint positions by name from messages that have them in any order.

    Parameters
    ----------
    names
        The wanted order.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self._seen: tuple[str, ...] = ()
        self._columns: list[int] = []

    def positions(self, message: JointState) -> FloatArray:
        """Return the positions in the wanted order, rad, (k,).

        Raises
        ------
        InputError
            If a joint is missing; names it.
        """
        names = tuple(message.name)
        if names != self._seen:
            missing = [name for name in self.names if name not in names]
            if missing:
                raise InputError(
                    f'joint_states lacks {", ".join(missing)}; it has {", ".join(names)}: '
                    'does the cell file name the robot that is running?'
                )
            self._columns = [names.index(name) for name in self.names]
            self._seen = names
        positions = message.position
        if len(positions) != len(names):
            raise InputError(f'joint_states has {len(positions)} positions for {len(names)} names')
        return np.array([positions[column] for column in self._columns])


def solutions_of(message: JointTrajectory, joint_names: Sequence[str]) -> FloatArray:
    """Return the joint solutions in remaster/joint_solutions, rad, (m, k); m = 0 for a stop.

    Parameters
    ----------
    joint_names
        The wanted order of joints.

    Raises
    ------
    InputError
        The solutions are for other joints, or a point has not one position for each.
    """
    given = list(message.joint_names)
    if not message.points:
        # A stop, whatever joints it names.
        return np.empty((0, len(joint_names)))
    if not set(joint_names) <= set(given):
        raise InputError(f'they are for {", ".join(given)}, the cell has {", ".join(joint_names)}')
    if any(len(point.positions) != len(given) for point in message.points):
        raise InputError(f'a point has not as many positions as joints, {len(given)}')
    columns = [given.index(name) for name in joint_names]
    return np.array([point.positions for point in message.points])[:, columns]


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
