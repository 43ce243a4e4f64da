"""rosbag2 bags (MCAP) without a ROS installation: raw messages in, raw messages out.

Written unchunked and flushed message by message, so that a killed writer leaves every message it
wrote (with MCAP's default chunks, a kill loses the last megabyte). The price is that the file of a
killed writer has no index and no checksum until `recover_bag` finishes it; the bag is never the
only copy of an observation.
"""

from __future__ import annotations

import logging
import os
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from remaster_ros import __version__
from remaster_ros.core.errors import InputError
from remaster_ros.storage.bag_metadata import METADATA_FILE, TopicMetadata, metadata_text, qos_text
from remaster_ros.storage.files import (
    cannot_write,
    make_new_folder,
    reason,
    sync_folder,
    write_atomically,
)
from remaster_ros.storage.mcap_frames import CutOffError, frames, unchunked, without_zeros
from remaster_ros.storage.message_definitions import definition_of

log = logging.getLogger('remaster_ros')

LATCHED_TOPICS = frozenset(
    {'/remaster/joint_offsets', '/remaster/joint_offsets_std', '/remaster/registration'}
)


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


class BagWriter:
    """Write a rosbag2 folder; what `write` returned from survives a kill of this process.

    Parameters
    ----------
    folder
        New or empty; the bag's name is the folder's.
    latched
        Topics offered transient_local: who subscribes late still gets their last message.

    Raises
    ------
    InputError
        The folder holds files or cannot be written to.
    """

    def __init__(
        self, folder: str | os.PathLike[str], latched: Collection[str] = LATCHED_TOPICS
    ) -> None:
        self.folder = Path(folder)
        self._latched = latched
        self._topics: dict[str, TopicMetadata] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        make_new_folder(self.folder)
        self._path = self.folder / f'{self.folder.resolve().name}_0.mcap'
        try:
            self._file: IO[bytes] | None = self._path.open('xb')
            self._writer = Writer(
                self._file,
                compression=CompressionType.NONE,
                use_chunking=False,
                enable_data_crcs=True,
            )
            self._writer.start('ros2', f'remaster_ros-{__version__}')
            self._file.flush()
            self._write_metadata()
        except OSError as error:
            raise cannot_write(self._path, error) from None

    def write(self, topic: str, msgtype: str, cdr: bytes, stamp_ns: int) -> None:
        """Write one message.

        Stamps that run backwards (a clock was set) are stored as the latest stamp so far, because
        readers refuse an unindexed file out of order; the given stamp is kept as MCAP's
        ``publish_time``.

        Parameters
        ----------
        topic, msgtype
            Such as ``/joint_states`` and ``sensor_msgs/msg/JointState``.
        cdr
            The serialised message.
        stamp_ns
            When it was received, nanoseconds since the epoch.

        Raises
        ------
        InputError
            The message type is not one of ROS 2 Jazzy's, a topic changes its type, the stamp is
            no time, the bag is closed, or the disk does not take it.
        """
        if self._file is None:
            raise InputError(f'{self.folder}: the bag is closed; start a new one')
        if not 0 <= stamp_ns < 2**63:
            raise InputError(f'{topic}: {stamp_ns} ns is no time stamp; give ns since the epoch')
        try:
            if topic not in self._channels:
                self._add_topic(topic, msgtype)
            metadata = self._topics[topic]
            if metadata.msgtype != msgtype:
                raise InputError(
                    f'{topic}: {msgtype} after {metadata.msgtype}; a topic has one type'
                )
            self._last_ns = max(self._last_ns, stamp_ns)
            self._writer.add_message(
                channel_id=self._channels[topic],
                log_time=self._last_ns,
                data=cdr,
                publish_time=stamp_ns,
                sequence=metadata.count % 2**32,
            )
            self._file.flush()
        except OSError as error:
            raise cannot_write(self._path, error) from None
        metadata.count += 1
        if self._first_ns is None:
            self._first_ns = self._last_ns

    def close(self) -> None:
        """Finish the file and metadata.yaml, durable on return; closing again does nothing.

        Raises
        ------
        InputError
            The disk does not take it; what was written before remains readable.
        """
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            with file:
                self._writer.finish()
                file.flush()
                os.fsync(file.fileno())
            sync_folder(self.folder)
        except OSError as error:
            raise cannot_write(self._path, error) from None
        self._write_metadata()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _add_topic(self, topic: str, msgtype: str) -> None:
        definition, type_hash = definition_of(msgtype)
        if msgtype not in self._schemas:
            self._schemas[msgtype] = self._writer.register_schema(
                msgtype, 'ros2msg', definition.encode()
            )
        self._topics[topic] = TopicMetadata(topic, msgtype, type_hash, topic in self._latched)
        self._channels[topic] = self._writer.register_channel(
            topic,
            'cdr',
            self._schemas[msgtype],
            {
                'offered_qos_profiles': qos_text(topic in self._latched),
                'topic_type_hash': type_hash,
            },
        )
        # A player takes the topics from here, also those of a bag whose writer was killed.
        self._write_metadata()

    def _write_metadata(self) -> None:
        text = metadata_text(
            self._path.name, list(self._topics.values()), self._first_ns, self._last_ns
        )
        write_atomically(self.folder / METADATA_FILE, text)


class BagReader:
    """Read a rosbag2 MCAP bag, a folder or one ``.mcap`` file; iterate for its messages.

    The whole bag is checked when it is opened: no message of a damaged bag comes out. The bag of
    a killed writer is read as far as it goes, with a warning.

    Attributes
    ----------
    topics
        Message type of every topic.
    message_count
        Messages in the bag.
    start_ns, end_ns
        Stamps of the first and last message, 0 where there is none.
    complete
        False where the writer was killed before it closed the bag.

    Raises
    ------
    InputError
        No such bag, another storage, or damaged; nothing else comes out of a bad file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._files = _mcap_files(self.path)
        self.topics: dict[str, str] = {}
        self.message_count = 0
        self.start_ns = self.end_ns = 0
        self.complete = True
        for message in self._messages(warn=True):
            known = self.topics.setdefault(message.topic, message.msgtype)
            if known != message.msgtype:
                raise InputError(
                    f'{self.path}: topic {message.topic} is {known} and {message.msgtype}; '
                    'record the topics with one type each'
                )
            if not self.message_count:
                self.start_ns = message.stamp_ns
            self.end_ns = message.stamp_ns
            self.message_count += 1

    def __iter__(self) -> Iterator[BagMessage]:
        """Yield the messages in the order they were recorded."""
        return self._messages(warn=False)

    def _messages(self, warn: bool) -> Iterator[BagMessage]:
        for path in self._files:
            try:
                yield from self._messages_of(path, warn)
            except InputError:
                raise
            except OSError as error:
                raise InputError(f'{path}: cannot be read ({reason(error)})') from None
            # The MCAP decoder raises whatever bad bytes lead to: KeyError, struct.error, …
            except Exception as error:
                raise _damaged(path, f'{type(error).__name__}: {error}') from None

    def _messages_of(self, path: Path, warn: bool) -> Iterator[BagMessage]:
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
                    if warn:
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


def recover_bag(folder: str | os.PathLike[str]) -> int:
    """Finish the bag of a killed writer, so that every MCAP and rosbag2 reader opens it.

    Returns
    -------
    int
        How many messages it holds. A bag that was closed is left as it is.

    Raises
    ------
    InputError
        No such bag, damaged, or not writable.
    """
    folder = Path(folder)
    reader = BagReader(folder)
    if reader.complete:
        return reader.message_count
    path = reader._files[-1]
    work = folder / '.recovery'
    try:
        if work.is_dir():  # left by a recovery that was itself killed
            for file in work.iterdir():
                file.unlink()
        with BagWriter(work) as writer:
            for message in reader:
                writer.write(*message)
        writer._path.replace(path)
        for file in work.iterdir():
            file.unlink()
        work.rmdir()
        sync_folder(folder)
    except OSError as error:
        raise cannot_write(path, error) from None
    write_atomically(
        folder / METADATA_FILE,
        metadata_text(path.name, list(writer._topics.values()), writer._first_ns, writer._last_ns),
    )
    return reader.message_count


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
