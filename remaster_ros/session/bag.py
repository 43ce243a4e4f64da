"""Read rosbag2 bags (MCAP) without a ROS installation: raw messages, and one kind of error."""

from __future__ import annotations

import logging
import os
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC

from remaster_ros.errors import InputError
from remaster_ros.session.bag_metadata import FileMetadata, all_of
from remaster_ros.session.files import reason
from remaster_ros.session.manifest import check_file, read_manifest
from remaster_ros.session.mcap_frames import CutOffError, frames, unchunked, without_zeros

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


def live_name(topic: str) -> str:
    """Return the name that a topic of a bag had when it was recorded."""
    return _LIVE.get(topic, topic)


_LIVE = {recorded: live for live, recorded in RECORDED.items()}


class BagMessage(NamedTuple):
    """One recorded message.

    Attributes
    ----------
    topic, msgtype
        Such as ``/joint_states`` and ``sensor_msgs/msg/JointState``.
    cdr
        The serialised message, as it came off the wire.
    stamp_ns
        When it was recorded, nanoseconds since the epoch.
    """

    topic: str
    msgtype: str
    cdr: bytes
    stamp_ns: int


class BagReader:
    """Read a rosbag2 MCAP bag, a folder or one ``.mcap`` file; iterate for its messages.

    The whole bag is checked when it is opened, closed files also by their checksum in SHA256SUMS:
    no message of a damaged bag comes out. The bag of a killed writer is read as far as it goes,
    with a warning.

    Attributes
    ----------
    folder
        Where the files are.
    topics, counts
        Message type, and number of messages, of every topic.
    whole
        Stamps and number of the messages of all files.
    complete
        False where the writer was killed before it closed the bag.
    files
        The MCAP files with their numbers of messages, in the order recorded.
    torn_bytes
        How many bytes at the end are no whole message.

    Raises
    ------
    InputError
        No such bag, another storage, or damaged; nothing else comes out of a bad file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        paths = _mcap_files(self.path)
        self.files = [FileMetadata(path.name) for path in paths]
        self.folder = paths[0].parent
        sums = read_manifest(self.folder)
        for path in paths:
            check_file(sums, path)
        self.torn_bytes = 0
        self.topics: dict[str, str] = {}
        self.complete = True
        self.counts: Counter[str] = Counter()
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
        """Yield the messages in the order they were recorded."""
        for file in self.files:
            yield from self.messages_of(file)

    def messages_of(self, file: FileMetadata, first_look: bool = False) -> Iterator[BagMessage]:
        """Yield the messages of one of `files`; the first look also notes where it breaks off."""
        path = self.folder / file.name
        try:
            yield from self._messages_of(path, first_look)
        except InputError:
            raise
        except OSError as error:
            raise InputError(f'{path}: cannot be read ({reason(error)})') from None
        # The MCAP decoder raises whatever bad bytes lead to: KeyError, struct.error, …
        except Exception as error:
            raise _damaged(path, f'{type(error).__name__}: {error}') from None

    def _messages_of(self, path: Path, first_look: bool) -> Iterator[BagMessage]:
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
    what = ' '.join(what.split())[:120]
    return InputError(f'{path}: damaged ({what}); take another copy of the bag')
