"""Message definitions and type hashes of ROS 2 Jazzy, without ROS."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from remaster_ros.errors import InputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


@cache
def _jazzy() -> Typestore:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@cache
def definition_of(msgtype: str) -> tuple[str, str]:
    """Return the message definition of one of Jazzy's types and its RIHS01 hash."""
    from rosbags.typesys.store import TypesysError

    types = _jazzy()
    try:
        definition, _ = types.generate_msgdef(msgtype, ros_version=2)
        return definition, types.hash_rihs01(msgtype)
    except (KeyError, TypesysError):
        raise InputError(
            f'{msgtype!r}: not a message type of ROS 2 Jazzy; '
            'write it as in sensor_msgs/msg/JointState'
        ) from None
