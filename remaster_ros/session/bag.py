# SPDX-License-Identifier: Apache-2.0
"""Reader of rosbag2 bags (MCAP) without a ROS installation; all damage is an InputError."""

from __future__ import annotations

import logging
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.writer import MCAP0_MAGIC

from remaster_ros.errors import InputError
from remaster_ros.session.files import reason
from remaster_ros.session.manifest import check_file, read_manifest
from remaster_ros.session.strict_yaml import dump_yaml

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

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
    """A file of a bag in metadata.yaml; `first_ns` is None if it has no messages."""

    name: str
    first_ns: int | None = None
    last_ns: int = 0
    count: int = 0

    def add(self, stamp_ns: int) -> None:
        """Count a message."""
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
    """Return the metadata of several files, in the order recorded, as one nameless file."""
    filled = [file for file in files if file.count]
    if not filled:
        return FileMetadata('')
    count = sum(file.count for file in filled)
    return FileMetadata('', filled[0].first_ns, filled[-1].last_ns, count)


def metadata_text(files: list[FileMetadata], topics: Iterable[TopicMetadata]) -> str:
    """Return metadata.yaml for a bag of these MCAP files, in the order recorded."""
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
    """Return the QoS offered on a topic in the form of the MCAP channel's metadata."""
    return dump_yaml(_qos(latched))


def _qos(latched: bool) -> list[dict[str, Any]]:
    """Return the QoS offered on a topic as plain data."""
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


CHUNK_LIMIT = 256 * 1024**2
"""Bytes of an unpacked chunk: recorders begin a new one after one or a few megabytes, and only a
single larger message makes a larger one."""


class CutOffError(Exception):
    """A record extends beyond the end of the file."""


def without_zeros(file: IO[bytes], size: int) -> int:
    """Return the size of a file without trailing zeros, which a power cut may leave."""
    block = 1024 * 1024
    for start in range((size - 1) // block * block, -1, -block):
        file.seek(start)
        if solid := len(file.read(block if start + block < size else size - start).rstrip(b'\0')):
            return start + solid
    return 0


def frames(file: IO[bytes], size: int, crc: int | None, solid: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of every record up to the end of the data section.

    A record that ends among zeros, followed by more zeros, was not written completely, and raises
    CutOffError.
    """
    while True:
        head = file.read(9)
        if not head and crc is None:
            return
        if len(head) < 9:
            raise CutOffError
        opcode, length = struct.unpack('<BQ', head)
        end = file.tell() + length
        # MCAP has no opcodes 0 and 0x10 to 0x7f.
        known = 0x01 <= opcode <= 0x0F or opcode >= 0x80
        if not known or end > size or solid < end < size:
            raise CutOffError
        body = file.read(length)
        if opcode == Opcode.DATA_END:
            (stated,) = struct.unpack('<I', body)
            if stated and stated != crc:
                raise ValueError('its checksum does not match')
            return
        if crc is not None:
            crc = zlib.crc32(body, zlib.crc32(head, crc))
        yield opcode, body


def unchunked(records: Iterator[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
    """Yield records with chunks, which other recorders write, unpacked.

    Raises ValueError for a damaged chunk.
    """
    for opcode, body in records:
        if opcode != Opcode.CHUNK:
            yield opcode, body
            continue
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
        data = _unpacked(chunk)
        try:
            yield from frames(BytesIO(data), len(data), crc=None, solid=len(data))
        except CutOffError:
            raise ValueError('a record does not fit its chunk') from None


def _unpacked(chunk: Chunk) -> bytes:
    """Return the content of a chunk; raise an error if it exceeds its stated size.

    A few packed megabytes of zeros are gigabytes: they are refused before they fill the memory.
    """
    stated = chunk.uncompressed_size
    if stated > CHUNK_LIMIT:
        raise ValueError(f'a chunk states more than {CHUNK_LIMIT} bytes')
    # One byte more than stated, to detect longer content.
    if chunk.compression == 'zstd':
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(stated + 1)
    elif chunk.compression == 'lz4':
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=stated + 1)
    elif chunk.compression == '':
        data = chunk.data
    else:
        raise ValueError(f'a chunk is packed as {chunk.compression!r}, which is not known')
    if len(data) != stated:
        more = 'more' if len(data) > stated else 'less'
        raise ValueError(f'a chunk holds {more} than the {stated} bytes that it states')
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError('the checksum of a chunk does not match')
    return data


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
"""What moves an arm -> its name in bags. A controller obeys the one and a bridge the other,
whoever publishes it: a player that takes a bag as it is must not drive an arm."""


@cache
def jazzy_types() -> Typestore:
    """Return the message types of ROS 2 Jazzy."""
    # Imported here: it takes a quarter of a second.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def live_name(topic: str) -> str:
    """Return the name that a topic of a bag had when it was recorded."""
    return _LIVE.get(topic, topic)


_LIVE = {recorded: live for live, recorded in RECORDED.items()}


class BagMessage(NamedTuple):
    """One recorded message."""

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
        self._own_types: Typestore | None = None
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
        """Return the known types, with this one from its definition in the bag if necessary."""
        if msgtype in jazzy_types().types or msgtype not in self._definitions:
            return jazzy_types()
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        if self._own_types is None:
            self._own_types = get_typestore(Stores.ROS2_JAZZY)
        store = self._own_types
        if msgtype not in store.types:
            found = get_types_from_msg(self._definitions[msgtype], msgtype)
            store.register({name: own for name, own in found.items() if name not in store.types})
        return store

    def messages_of(self, file: FileMetadata, first_look: bool = False) -> Iterator[BagMessage]:
        """Yield the messages of one of `files`; the first look records where it is cut off.

        Raises InputError if the file is unreadable or damaged.
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
        """Yield the messages of a file; see `messages_of`."""
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
    """Return the MCAP files of a bag in the order recorded; raise InputError if none."""
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
    """Return the error for a damaged file."""
    what = ' '.join(what.split())[:120]
    return InputError(f'{path}: damaged ({what}); take another copy of the bag')
