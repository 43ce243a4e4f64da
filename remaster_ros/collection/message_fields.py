# SPDX-License-Identifier: Apache-2.0
"""From ROS messages to arrays, by their fields alone: of rclpy's messages and of rosbags'."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.types import FloatArray


def seconds(stamp: Any) -> float:
    """Return a stamp or duration (builtin_interfaces/Time, /Duration) in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def stamp_key(stamp: Any) -> str:
    """Return a stamp as exact text, the name of a pose in events."""
    return f'{stamp.sec}.{stamp.nanosec:09d}'


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
        # None before the first: a message without names is none of the arm's.
        self._seen: tuple[str, ...] | None = None
        self._columns: list[int] = []

    def concerns(self, message: Any) -> bool:
        """Whether a message names any of the joints; another device's (a gripper's) does not."""
        names = tuple(message.name)
        return names == self._seen or not set(self.names).isdisjoint(names)

    def positions(self, message: Any) -> FloatArray:
        """Return the positions in the wanted order, rad, (k,).

        Raises
        ------
        InputError
            If a joint is missing or named more than once; names it.
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


WANTED = 'wanted/'
"""Before the name of a joint in remaster/settled: where it was wanted, before a correction."""


def wanted_of(message: Any, joint_names: Sequence[str]) -> FloatArray | None:
    """Return what was wanted where an arm has settled, rad, (k,); None without a correction.

    Raises
    ------
    InputError
        As `JointOrder.positions`.
    """
    order = JointOrder([f'{WANTED}{name}' for name in joint_names])
    return order.positions(message) if order.concerns(message) else None


def refuse_repeated(wanted: Sequence[str], given: Sequence[str], topic: str) -> None:
    """Refuse a message in which a wanted joint stands twice: which value is right is not known.

    Raises
    ------
    InputError
        Names the joints.
    """
    repeated = [name for name in wanted if list(given).count(name) > 1]
    if repeated:
        raise InputError(
            f'{topic} has {", ".join(repeated)} more than once: are two arms merged in it? Give '
            'the joints of each a prefix, or each arm a namespace'
        )


CORRECTED = {'on': 'corrected/', 'off': 'uncorrected/'}
"""Before the names of all joints in remaster/joint_solutions: whether what is commanded has to be
corrected. In the names, so that a bridge that does not heed it finds none of its joints."""


def correction_asked(message: Any) -> str:
    """Return whether joint solutions are asked for with a correction ``on`` or ``off``; ''."""
    for state, prefix in CORRECTED.items():
        if message.joint_names and all(name.startswith(prefix) for name in message.joint_names):
            return state
    return ''


def solutions_of(message: Any, joint_names: Sequence[str]) -> FloatArray:
    """Return the joint solutions in remaster/joint_solutions, rad, (m, k); m = 0 for a stop.

    Parameters
    ----------
    joint_names
        The wanted order of joints.

    Raises
    ------
    InputError
        The solutions are for other joints or name one twice, or a point has not one position
        for each.
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


LENGTH_TOLERANCE = 1e-3
"""By so much the length of a quaternion may differ from 1: some drivers send single precision."""


def unit_quaternion(turn: Any) -> FloatArray | None:
    """Return a geometry_msgs/Quaternion as x, y, z, w of length 1, (4,); None where it is none."""
    xyzw = np.array([turn.x, turn.y, turn.z, turn.w], dtype=float)
    length = np.linalg.norm(xyzw)
    return xyzw / length if abs(length - 1.0) < LENGTH_TOLERANCE else None
