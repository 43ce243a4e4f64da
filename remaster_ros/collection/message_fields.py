# SPDX-License-Identifier: Apache-2.0
"""Arrays from ROS messages, by field names only: for rclpy's messages and for those of rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.types import FloatArray

WANTED = 'wanted/'
"""Prefix of joint names in remaster/settled for wanted positions, before a correction."""
CORRECTED = {'on': 'corrected/', 'off': 'uncorrected/'}
"""Prefixes of all joint names in remaster/joint_solutions, by whether commands are corrected. The
prefix is in the names, so that a bridge that ignores it finds none of its joints."""
LENGTH_TOLERANCE = 1e-3
"""Largest difference of a quaternion's length from 1: some drivers send single precision."""


def seconds(stamp: Any) -> float:
    """Stamp or duration (builtin_interfaces/Time, /Duration) in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def stamp_key(stamp: Any) -> str:
    """Stamp as exact text, SEC.NANOSEC with nine digits: the name of a pose in events."""
    return f'{stamp.sec}.{stamp.nanosec:09d}'


def temperature_topic(marker_topic: str) -> str:
    """Topic of a sensor's thermometer, next to that of its marker: a/marker -> a/temperature."""
    place, slash, _ = marker_topic.rpartition('/')
    return f'{place}{slash}temperature'


class JointOrder:
    """Joint positions in a wanted order, from messages that name the joints in any order.

    ``names``: wanted order.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        # None before the first message: a message without names is not the arm's.
        self._seen: tuple[str, ...] | None = None
        self._columns: list[int] = []

    def concerns(self, message: Any) -> bool:
        """Whether a message names any of the joints; another device's (a gripper's) does not."""
        names = tuple(message.name)
        return names == self._seen or not set(self.names).isdisjoint(names)

    def positions(self, message: Any) -> FloatArray:
        """Positions in the wanted order, rad or m, (k,); further joints are left out.

        Raises InputError, with its name, if a joint is missing or named more than once, or if
        there are not as many positions as names. NaN is returned as it is.
        """
        names = tuple(message.name)
        if names != self._seen:
            missing = [name for name in self.names if name not in names]
            if missing:
                raise InputError(
                    f'joint_states lacks {", ".join(missing)}; it has {", ".join(names)}: '
                    'does the cell file name the robot that is running?'
                )
            refuse_repeated(self.names, names, 'joint_states')
            self._columns = [names.index(name) for name in self.names]
            self._seen = names
        positions = message.position
        if len(positions) != len(names):
            raise InputError(f'joint_states has {len(positions)} positions for {len(names)} names')
        return np.array([positions[column] for column in self._columns])


def wanted_of(message: Any, joint_names: Sequence[str]) -> FloatArray | None:
    """Wanted joint positions, before a correction, in the message of a settled arm, rad, (k,).

    None if the message names no wanted joint, as no correction was applied. ``message``: joint
    states that name the wanted joints with a prefix; ``joint_names``: the arm's joints,
    without it, in the order of the result.

    Raises InputError as `JointOrder.positions`.
    """
    order = JointOrder([f'{WANTED}{name}' for name in joint_names])
    return order.positions(message) if order.concerns(message) else None


def refuse_repeated(wanted: Sequence[str], given: Sequence[str], topic: str) -> None:
    """Raise InputError, with the names, if `given` has a wanted joint more than once.

    ``wanted, given``: names of joints; ``topic``: for the message.
    """
    repeated = [name for name in wanted if list(given).count(name) > 1]
    if repeated:
        raise InputError(
            f'{topic} has {", ".join(repeated)} more than once: are two arms merged in it? Give '
            'the joints of each a prefix, or each arm a namespace'
        )


def correction_asked(message: Any) -> str:
    """Correction that joint solutions require: ``on``, ``off``, or '' for any.

    By the prefixes `CORRECTED`, if all joint names have the same one.
    """
    for state, prefix in CORRECTED.items():
        if message.joint_names and all(name.startswith(prefix) for name in message.joint_names):
            return state
    return ''


def solutions_of(message: Any, joint_names: Sequence[str]) -> FloatArray:
    """Joint solutions in remaster/joint_solutions, rad, (m, k); m = 0 for a stop.

    ``joint_names``: wanted order of joints. Raises InputError if the solutions are for other
    joints or name one twice, or a point does not have one position for each joint.
    """
    prefix = CORRECTED.get(correction_asked(message), '')
    given = [name.removeprefix(prefix) for name in message.joint_names]
    if not message.points:
        # A stop, whatever joints it names.
        return np.empty((0, len(joint_names)))
    if not set(joint_names) <= set(given):
        raise InputError(f'they are for {", ".join(given)}, the cell has {", ".join(joint_names)}')
    refuse_repeated(joint_names, given, 'joint_solutions')
    if any(len(point.positions) != len(given) for point in message.points):
        raise InputError(f'a point has not as many positions as joints, {len(given)}')
    columns = [given.index(name) for name in joint_names]
    return np.array([point.positions for point in message.points])[:, columns]


def unit_quaternion(turn: Any) -> FloatArray | None:
    """Quaternion of a message as x, y, z, w of length 1, (4,); None for another length."""
    xyzw = np.array([turn.x, turn.y, turn.z, turn.w], dtype=float)
    length = np.linalg.norm(xyzw)
    return xyzw / length if abs(length - 1.0) < LENGTH_TOLERANCE else None
