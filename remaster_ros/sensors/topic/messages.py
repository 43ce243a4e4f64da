"""From messages of other nodes to a marker's place; by their fields alone, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from remaster_ros.collection.message_fields import unit_quaternion
from remaster_ros.types import FloatArray


class Sighting(NamedTuple):
    """What a message holds of the marker.

    Attributes
    ----------
    stamp_s
        Of its header, s; 0 where the node that sent it has set none.
    frame
        Of its header.
    position
        m, (3,); None where the message has the marker without a measured place, or not at all.
    orientation
        Unit quaternion x, y, z, w, (4,); None where the message has none, or one of another
        length, as drivers send that do not measure it.
    """

    stamp_s: float
    frame: str
    position: FloatArray | None
    orientation: FloatArray | None = None


def _sighting(message: Any, place: Any, turn: Any = None) -> Sighting:
    stamp = message.header.stamp
    position = None
    if place is not None:
        measured = np.array([place.x, place.y, place.z], dtype=float)
        # What is out of sight is sent as no number, or as exactly the origin.
        position = measured if np.all(np.isfinite(measured)) and np.any(measured) else None
    return Sighting(
        stamp.sec + 1e-9 * stamp.nanosec,
        message.header.frame_id,
        position,
        None if turn is None else unit_quaternion(turn),
    )


def _marker(message: Any, marker: str) -> Any:
    for one in message.markers:
        if marker in (one.marker_name, str(one.marker_index)):
            return one.translation
    return None


POINT, POSE, MARKERS = (
    'geometry_msgs/msg/PointStamped',
    'geometry_msgs/msg/PoseStamped',
    'mocap4r2_msgs/msg/Markers',
)
READERS: dict[str, Callable[[Any, str], Sighting]] = {
    POINT: lambda message, marker: _sighting(message, message.point),
    POSE: lambda message, marker: _sighting(
        message, message.pose.position, message.pose.orientation
    ),
    MARKERS: lambda message, marker: _sighting(message, _marker(message, marker)),
}
"""Message type -> what reads it; the second argument is the name or the number of the marker."""
