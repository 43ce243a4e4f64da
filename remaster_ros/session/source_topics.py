"""Which topics of nodes that are not of this package a cell file may name as sensors."""

from __future__ import annotations

from remaster_ros.errors import did_you_mean

POSE = 'geometry_msgs/msg/PoseStamped'
MESSAGE_TYPES = ('geometry_msgs/msg/PointStamped', POSE, 'mocap4r2_msgs/msg/Markers')
"""`sensors.topic.driver.READERS` reads them."""


def source_problem(key: str, source: str, message_type: str, *, single_shot: bool) -> str:
    """Return what is wrong with the keys of such a sensor; '' where nothing is.

    Parameters
    ----------
    key
        Of the sensor, such as ``sensors.mocap``.
    source, message_type, single_shot
        As in `cell_sensor.CellSensor`.
    """
    if source and not message_type:
        return f'{key}.source is no key; write it as topic, and give its message_type'
    if message_type and message_type not in MESSAGE_TYPES:
        meant = did_you_mean(message_type, MESSAGE_TYPES)
        known = ', '.join(MESSAGE_TYPES)
        return f'{key}.message_type is {message_type!r}; it can be {known}{meant}'
    if message_type and single_shot:
        return f'{key}.single_shot is for instruments that measure on request; a topic streams'
    return ''
