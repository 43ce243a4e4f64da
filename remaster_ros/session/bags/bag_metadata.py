# SPDX-License-Identifier: Apache-2.0
"""metadata.yaml of rosbag2 bags, and the QoS of their topics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from remaster_ros.session.strict_yaml import dump_yaml

METADATA_FILE = 'metadata.yaml'

# Values that rosbag2 writes for the start of an empty bag, and for an infinite QoS duration.
_NEVER_NS = 2**63 - 1
LATCHED_DEPTH = 10
"""History depth of latched topics, equal to that of the nodes' publishers."""
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}


@dataclass
class TopicMetadata:
    """A topic in metadata.yaml; ``count`` is the number of its messages so far."""

    topic: str
    msgtype: str
    type_hash: str
    latched: bool
    count: int = 0


@dataclass
class FileMetadata:
    """Name, first and last stamp and number of messages of a bag's file, as in metadata.yaml."""

    name: str
    first_ns: int | None = None
    last_ns: int = 0
    count: int = 0

    def add(self, stamp_ns: int) -> None:
        """Count a message, and set the last stamp to ``stamp_ns``, ns since the epoch.

        The first call sets the first stamp, too. An earlier stamp than the last one is taken
        as it is.
        """
        if self.first_ns is None:
            self.first_ns = stamp_ns
        self.last_ns = stamp_ns
        self.count += 1

    def span(self) -> dict[str, Any]:
        """Return start, duration and number of messages in the form of metadata.yaml."""
        first = self.first_ns
        return {
            'starting_time': {'nanoseconds_since_epoch': _NEVER_NS if first is None else first},
            'duration': {'nanoseconds': 0 if first is None else self.last_ns - first},
            'message_count': self.count,
        }


def all_of(files: list[FileMetadata]) -> FileMetadata:
    """Metadata of several files, in the order recorded, as one nameless file.

    Files without messages are left out; the result is empty if none has messages.
    """
    filled = [file for file in files if file.count]
    if not filled:
        return FileMetadata('')
    count = sum(file.count for file in filled)
    return FileMetadata('', filled[0].first_ns, filled[-1].last_ns, count)


def metadata_text(files: list[FileMetadata], topics: Iterable[TopicMetadata]) -> str:
    """Return the text of metadata.yaml (rosbag2 version 9) for a bag of MCAP files.

    ``files``: in the order recorded; ``topics``: with their numbers of messages.
    """
    information: dict[str, Any] = {
        'version': 9,
        'storage_identifier': 'mcap',
        **all_of(files).span(),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.topic,
                    'type': topic.msgtype,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': _qos(topic.latched),
                    'type_description_hash': topic.type_hash,
                },
                'message_count': topic.count,
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [{'path': file.name, **file.span()} for file in files],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }
    return dump_yaml({'rosbag2_bagfile_information': information})


def qos_text(latched: bool) -> str:
    """Return the QoS offered on a topic as YAML, in the form of the MCAP channel's metadata.

    Reliable, depth 10; ``latched``: transient local, else volatile.
    """
    return dump_yaml(_qos(latched))


def _qos(latched: bool) -> list[dict[str, Any]]:
    """Return the QoS offered on a topic as plain data, a list of one profile.

    ``latched``: transient local, else volatile.
    """
    return [
        {
            'history': 'keep_last',
            # As the publishers offer it: a late subscriber gets the registration of every sensor.
            'depth': LATCHED_DEPTH if latched else 10,
            'reliability': 'reliable',
            'durability': 'transient_local' if latched else 'volatile',
            # Copies: YAML would write a shared object as an alias.
            'deadline': dict(_FOREVER),
            'lifespan': dict(_FOREVER),
            'liveliness': 'automatic',
            'liveliness_lease_duration': dict(_FOREVER),
            'avoid_ros_namespace_conventions': False,
        }
    ]
