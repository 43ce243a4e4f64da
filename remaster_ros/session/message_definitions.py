"""Message definitions and type hashes of ROS 2 Jazzy, without ROS."""

from __future__ import annotations

from typing import Any

from remaster_ros.errors import InputError

_typestore: Any = None


def definition_of(msgtype: str) -> tuple[str, str]:
    """Return the message definition of one of Jazzy's types and its RIHS01 hash."""
    global _typestore
    from rosbags.typesys import Stores, get_typestore
    from rosbags.typesys.store import TypesysError

    if _typestore is None:
        _typestore = get_typestore(Stores.ROS2_JAZZY)
    try:
        definition, _ = _typestore.generate_msgdef(msgtype, ros_version=2)
        return definition, _typestore.hash_rihs01(msgtype)
    except (KeyError, TypesysError):
        raise InputError(
            f'{msgtype!r}: not a message type of ROS 2 Jazzy; '
            'write it as in sensor_msgs/msg/JointState'
        ) from None
