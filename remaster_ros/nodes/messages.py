# SPDX-License-Identifier: Apache-2.0
"""Stamps, transforms and waypoints as ROS messages; others: `collection.message_fields`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.message_fields import refuse_repeated
from remaster_ros.errors import InputError
from remaster_ros.kinematics import transforms
from remaster_ros.types import FARTHEST_M, FloatArray

if TYPE_CHECKING:
    # It loads all of the planning.
    from remaster_ros.planning.tour_order import PoseVisit


SHARES = 999_999_998
"""The share of a curve that a waypoint has is told in so many parts, as nanoseconds less one."""
LARGEST_PART = 1e6
"""The largest part of a quaternion is no larger, nor smaller than the reciprocal: any program
leaves it nearer to 1, and the squares are numbers."""


def stamp_of(time_s: float) -> Time:
    """Return a time in seconds as a stamp, rounded to nanoseconds."""
    nanoseconds = round(time_s * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def duration_of(time_s: float) -> Duration:
    """Return a duration in seconds as a message, rounded to nanoseconds."""
    nanoseconds = round(time_s * 1e9)
    return Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def write_place(T: FloatArray, position: Any, turn: Any) -> None:
    """Write a transform (4, 4) into the two halves of a Pose or Transform message.

    Both are changed in place; ``turn``: the quaternion x, y, z, w.
    """
    position.x, position.y, position.z = map(float, T[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, transforms.quaternion_xyzw(T[:3, :3]))


def read_place(position: Any, turn: Any) -> FloatArray:
    """Read a transform (4, 4) from the two halves of a Pose or Transform message.

    ``turn``: quaternion x, y, z, w of any length, since others do not normalise exactly. Raises
    InputError: the quaternion's largest part is beyond `LARGEST_PART`, or below its reciprocal; or
    a position is not finite or farther than `FARTHEST_M`.
    """
    place = np.array([position.x, position.y, position.z])
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if not np.all(np.abs(place) <= FARTHEST_M):
        raise InputError(f'a place at {place.tolist()} m is none')
    # Of any length: others do not give it as exactly as this package does.
    if not 1.0 / LARGEST_PART <= np.max(np.abs(quaternion)) <= LARGEST_PART:
        raise InputError(f'the quaternion {quaternion.tolist()} is no rotation')
    return transforms.transform(transforms.matrix_from_quaternion_xyzw(quaternion), place)


def transform_message(parent: str, child: str, T_parent_child: FloatArray) -> TransformStamped:
    """Return a transform as a message, of the frame `child` in the frame `parent`.

    ``T_parent_child``: (4, 4), m; the stamp of the message is 0.
    """
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    write_place(T_parent_child, message.transform.translation, message.transform.rotation)
    return message


def transform_array(message: TransformStamped) -> FloatArray:
    """Return the transform of a message, (4, 4). Raises InputError as `read_place`."""
    return read_place(message.transform.translation, message.transform.rotation)


def message_class(type_name: str) -> Any:
    """Class of a message type, as ``sensor_msgs/msg/JointState``; InputError if there is none."""
    package, _, name = type_name.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError, TypeError, ValueError):
        raise InputError(f'this machine has no message type {type_name}') from None


def waypoints_message(
    stop: PoseVisit, joint_names: Sequence[str], header: Header
) -> JointTrajectory:
    """Return the message remaster/joint_waypoints with the paths of a pose visit.

    It has the configurations to go through before each joint solution, in order. Of each,
    ``time_from_start.sec`` is 1 + the index of the solution it leads to, as in
    joint_solutions; ``nanosec`` is 0 for a corner of straight lines, and for a point of a
    curve 1 + `SHARES` times the curve's parameter there (0 at its begin, 1 at its end). No
    points if all paths are straight lines.
    """
    message = JointTrajectory(joint_names=list(joint_names))
    message.header = header
    for i, (path, shares) in enumerate(zip(stop.paths, stop.shares, strict=True)):
        marks = 1 + np.round(shares * SHARES).astype(int) if len(shares) else [0] * len(path)
        message.points += [
            JointTrajectoryPoint(
                positions=q.tolist(), time_from_start=Duration(sec=i + 1, nanosec=int(mark))
            )
            for q, mark in zip(path, marks, strict=True)
        ]
    return message


def curves_by_solution(message: JointTrajectory) -> dict[int, FloatArray]:
    """Return the parameters of the points of curves in a message remaster/joint_waypoints.

    Index of the solution to which the curve leads, from 0 -> curve parameter at each of its
    waypoints, (n,), n >= 2, ascending from 0 to below 1 (1 at the solution). Solutions reached
    by straight lines are left out. Raises InputError for other parameters.
    """
    marks: dict[int, list[int]] = {}
    for point in message.points:
        time = point.time_from_start
        marks.setdefault(time.sec - 1, []).append(time.nanosec)
    found = {}
    for index, of_points in marks.items():
        if not any(of_points):
            continue
        shares = (np.array(of_points) - 1) / SHARES
        ascends = bool(np.all(np.diff(shares) > 0.0))
        if len(shares) < 2 or shares[0] != 0.0 or not ascends or shares[-1] >= 1.0:
            raise InputError(
                f'joint_waypoints: the shares of the curve to solution {index} must ascend from 0 '
                f'to below 1, of two points and more; they are {shares.tolist()[:5]}'
            )
        found[index] = shares
    return found


def waypoints_by_solution(
    message: JointTrajectory, joint_names: Sequence[str]
) -> dict[int, FloatArray]:
    """Group remaster/joint_waypoints by the solution that they lead to.

    Returns index of the solution, from 0 -> configurations to go through before it, rad or m, (n,
    k), n >= 1, joints in the order of `joint_names`; solutions with a straight way are left out,
    {} if all are. Further joints of the message are ignored.

    Raises InputError: joints that are missing or named twice, points of the wrong length, not
    finite or out of order.
    """
    if not message.points:
        return {}
    names = list(message.joint_names)
    missing = [name for name in joint_names if name not in names]
    if missing:
        raise InputError(f'joint_waypoints: {missing[0]} is missing; it has {", ".join(names)}')
    refuse_repeated(joint_names, names, 'joint_waypoints')
    columns = [names.index(name) for name in joint_names]
    found: dict[int, list[FloatArray]] = {}
    last = 0
    for point in message.points:
        index = point.time_from_start.sec - 1
        positions = np.array(point.positions, dtype=float)
        if positions.shape != (len(names),) or not np.all(np.isfinite(positions)):
            raise InputError(f'joint_waypoints: a point {point.positions} for {len(names)} joints')
        if index < last:
            raise InputError(f'joint_waypoints: solution {index} after solution {last}')
        last = index
        found.setdefault(index, []).append(positions[columns])
    return {index: np.array(points) for index, points in found.items()}
