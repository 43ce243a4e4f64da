# SPDX-License-Identifier: Apache-2.0
"""Reader of rosbag2 bags (MCAP) without a ROS installation; all damage is an InputError."""

from __future__ import annotations

import logging
import os
import zlib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC

from remaster_ros.errors import InputError
from remaster_ros.session.bags.bag_metadata import FileMetadata, all_of
from remaster_ros.session.bags.mcap_records import CutOffError, frames, unchunked, without_zeros
from remaster_ros.session.files import reason
from remaster_ros.session.manifest import check_file, read_manifest

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

log = logging.getLogger('remaster_ros')

LATCHED_TOPICS = frozenset(
    {'/remaster/joint_offsets', '/remaster/joint_offsets_std', '/remaster/registration'}
)

RECORDED = {
    f'/{name}': f'/remaster/recorded/{name.rpartition("/")[2]}'
    for name in (
        'joint_trajectory_controller/joint_trajectory',
        'remaster/joint_solutions',
        'remaster/joint_waypoints',
    )
}
"""Topic that moves an arm -> its name in bags: a controller or bridge obeys whoever publishes the
former, and a player that publishes a bag unchanged must not drive an arm."""

_LIVE = {recorded: live for live, recorded in RECORDED.items()}


@cache
def jazzy_types() -> Typestore:
    """Return the message types of ROS 2 Jazzy."""
    # Imported here: it takes a quarter of a second.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def live_name(topic: str) -> str:
    """Return the name that a topic of a bag had when it was recorded.

    Three topics that move an arm are recorded under other names (`RECORDED`); others are
    unchanged.
    """
    return _LIVE.get(topic, topic)


class BagMessage(NamedTuple):
    """One recorded message: topic, type, serialised bytes, and time of recording."""

    # Such as ``/joint_states`` and ``sensor_msgs/msg/JointState``.
    topic: str
    msgtype: str
    # As it came off the wire.
    cdr: bytes
    # When it was recorded, nanoseconds since the epoch.
    stamp_ns: int


class BagReader:
    """Reader of a rosbag2 MCAP bag, a folder or one ``.mcap`` file; iterates over its messages.

    The whole bag is checked when it is opened, closed files also by their checksum in SHA256SUMS:
    a damaged bag raises InputError, and none of its messages is returned. The bag of a killed
    writer is read up to its last whole message, with a warning.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        paths = _mcap_files(self.path)
        self.files = [FileMetadata(path.name) for path in paths]
        self.folder = paths[0].parent
        sums = read_manifest(self.folder)
        for path in paths:
            check_file(sums, path)
        self.torn_bytes = 0  # At the end, of no whole message
        self.complete = True  # False where the writer was killed before it closed the bag
        # Message type, and number of messages, of every topic
        self.topics: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self._definitions: dict[str, str] = {}  # Message type -> its text, and what it uses
        self._bag_types: Typestore | None = None
        for file in self.files:
            for message in self.messages_of(file, first_look=True):
                known = self.topics.setdefault(message.topic, message.msgtype)
                if known != message.msgtype:
                    raise InputError(
                        f'{self.path}: topic {message.topic} is {known} and {message.msgtype}; '
                        'record the topics with one type each'
                    )
                self.counts[message.topic] += 1
                file.add(message.stamp_ns)
        self.whole = all_of(self.files)

    def __iter__(self) -> Iterator[BagMessage]:
        """Yield the messages in the order recorded."""
        for file in self.files:
            yield from self.messages_of(file)

    def decoded(self, msgtype: str, cdr: bytes) -> Any:
        """Return a decoded message; raise InputError, which names the bag, for invalid bytes."""
        try:
            return self._types(msgtype).deserialize_cdr(cdr, msgtype)
        # rosbags raises various errors for invalid bytes.
        except Exception as error:
            what = ' '.join(str(error).split())[:120]
            raise InputError(
                f'{self.path}: a damaged message ({type(error).__name__}: {what}); take another '
                'copy of the bag'
            ) from None

    def _types(self, msgtype: str) -> Typestore:
        """Return a type store with a message type: Jazzy's, or Jazzy's and the bag's definitions.

        The latter if the type is none of Jazzy's and the bag defines it. A type that neither
        knows gives Jazzy's store, which lacks it.
        """
        if msgtype in jazzy_types().types or msgtype not in self._definitions:
            return jazzy_types()
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        if self._bag_types is None:
            self._bag_types = get_typestore(Stores.ROS2_JAZZY)
        store = self._bag_types
        if msgtype not in store.types:
            types = get_types_from_msg(self._definitions[msgtype], msgtype)
            store.register(
                {name: definition for name, definition in types.items() if name not in store.types}
            )
        return store

    def messages_of(self, file: FileMetadata, first_look: bool = False) -> Iterator[BagMessage]:
        """Yield the messages of one of `files`, in the order recorded.

        `complete` becomes False for a file that a killed writer left; with ``first_look`` the
        number of bytes cut off at the end of that file is added to `torn_bytes`, with a
        warning. Raises InputError if the file is unreadable or damaged.
        """
        path = self.folder / file.name
        try:
            yield from self._messages_of(path, first_look)
        except InputError:
            raise
        except OSError as error:
            raise InputError(f'{path}: cannot be read ({reason(error)})') from None
        # The MCAP decoder raises various errors for invalid bytes: KeyError, struct.error, …
        except Exception as error:
            raise _damaged(path, f'{type(error).__name__}: {error}') from None

    def _messages_of(self, path: Path, first_look: bool) -> Iterator[BagMessage]:
        """Yield the messages of a file; arguments and effects as of `messages_of`.

        Raises InputError for damage that is no cut-off end; other errors come as the decoder
        raises them.
        """
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[str, str]] = {}
        size = path.stat().st_size
        with path.open('rb') as file:
            begin = file.read(len(MCAP0_MAGIC))
            if begin != MCAP0_MAGIC:
                if not MCAP0_MAGIC.startswith(begin):
                    raise _damaged(path, 'it does not begin as an MCAP file')
                self.complete = False  # killed before the first bytes were out
                return
            file.seek(max(0, size - len(MCAP0_MAGIC)))
            closed = size > len(MCAP0_MAGIC) and file.read() == MCAP0_MAGIC
            solid = size if closed else without_zeros(file, size)
            file.seek(len(MCAP0_MAGIC))
            records = unchunked(frames(file, size, zlib.crc32(MCAP0_MAGIC), solid))
            while True:
                good = file.tell()
                try:
                    opcode, body = next(records)
                except StopIteration:
                    return
                except CutOffError:
                    if closed:
                        raise _damaged(path, f'a record at byte {good} does not fit') from None
                    self.complete = False
                    if first_look:
                        self.torn_bytes += size - good
                        log.warning(
                            '%s: its writer was killed; the last %d bytes are no whole message '
                            'and are not used',
                            path,
                            size - good,
                        )
                    return
                stream = ReadDataStream(BytesIO(body))
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(stream)
                    schemas[schema.id] = schema
                    if schema.encoding == 'ros2msg':
                        self._definitions[schema.name] = schema.data.decode()
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(stream)
                    if channel.message_encoding != 'cdr':
                        raise InputError(
                            f'{path}: topic {channel.topic!r} is encoded as '
                            f'{channel.message_encoding!r}; record it with ROS 2 (cdr)'
                        )
                    channels[channel.id] = channel.topic, schemas[channel.schema_id].name
                elif opcode == Opcode.MESSAGE:
                    message = Message.read(stream, len(body))
                    topic, msgtype = channels[message.channel_id]
                    yield BagMessage(topic, msgtype, message.data, message.log_time)


def _mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag, bag_2 before bag_10; a path may be such a file itself.

    Raises InputError if there is no such folder, or it has no .mcap file.
    """
    if path.is_file() and path.suffix == '.mcap':
        return [path]
    if not path.is_dir():
        raise InputError(
            f'{path}: no such bag; give the folder of metadata.yaml, or an .mcap file'
        )
    # bag_2 before bag_10
    files = sorted(path.glob('*.mcap'), key=lambda file: (len(file.name), file.name))
    if not files:
        raise InputError(
            f'{path}: no .mcap file in it; convert other storages with "ros2 bag convert"'
        )
    return files


def _damaged(path: Path, what: str) -> InputError:
    """Return the InputError for a damaged file; ``what``: the damage, cut to 120 characters."""
    what = ' '.join(what.split())[:120]
    return InputError(f'{path}: damaged ({what}); take another copy of the bag')
