"""Turn the status messages of bags of older versions into the records of `collection.events`."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from remaster_ros.collection.events import encode
from remaster_ros.collection.old_events import record_of


def records_of(data: bytes) -> list[String]:
    """Return the records in a serialised DiagnosticArray, as messages on ``remaster/events``."""
    found = []
    for status in deserialize_message(data, DiagnosticArray).status:
        record = record_of(
            status.name, status.message, {pair.key: pair.value for pair in status.values}
        )
        if record is not None:
            found.append(String(data=encode(record)))
    return found
