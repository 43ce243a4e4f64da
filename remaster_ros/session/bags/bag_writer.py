# SPDX-License-Identifier: Apache-2.0
"""Writer of rosbag2 bags (MCAP) without a ROS installation, and recovery of unfinished bags.

Written unchunked and flushed message by message, so that a killed writer leaves every message it
wrote (with MCAP's default chunks, a kill loses the last megabyte). The price is that the file of a
killed writer has no index and no checksum until `recover_bag` finishes it; the bag is never the
only copy of an observation.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from mcap.writer import CompressionType, Writer

from remaster_ros.errors import DiskError, InputError
from remaster_ros.session.bags.bag import LATCHED_TOPICS, BagReader, jazzy_types
from remaster_ros.session.bags.bag_metadata import (
    METADATA_FILE,
    FileMetadata,
    TopicMetadata,
    metadata_text,
    qos_text,
)
from remaster_ros.session.files import (
    PatientFile,
    make_new_folder,
    remove_leftovers,
    sync_folder,
    write_atomically,
    writing,
)
from remaster_ros.session.manifest import add_to_manifest, read_manifest
from remaster_ros.version import __version__

WAITING_LIMIT = 64 * 1024**2
"""Most bytes kept in memory while the disk is full; later messages are refused."""
_WORK = '.recovery'


@cache
def definition_of(msgtype: str) -> tuple[str, str]:
    """Return the message definition of one of Jazzy's types, and its RIHS01 hash.

    ``msgtype``: as in 'sensor_msgs/msg/JointState'. Raises InputError for another message type.
    """
    from rosbags.typesys.store import TypesysError

    types = jazzy_types()
    try:
        definition, _ = types.generate_msgdef(msgtype, ros_version=2)
        return definition, types.hash_rihs01(msgtype)
    except (KeyError, TypesysError):
        raise InputError(
            f'{msgtype!r}: not a message type of ROS 2 Jazzy; '
            'write it as in sensor_msgs/msg/JointState'
        ) from None


class BagWriter:
    """Writer of a rosbag2 folder; messages survive a kill of this process once `write` returns.

    If the disk is full, messages are kept in memory and written later.

    Parameters
    ----------
    folder
        New or empty; the bag has the folder's name.
    resume
        Continue the bag in the folder: finish the file of a killed writer, and begin the next
        file, as rosbag2 does when it splits a bag.

    Raises
    ------
    InputError
        If the folder holds files, with `resume` a damaged bag, or cannot be written to.
    """

    def __init__(self, folder: str | os.PathLike[str], *, resume: bool = False) -> None:
        self.folder = Path(folder)
        self._topics: dict[str, TopicMetadata] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._files: list[FileMetadata] = []
        self._last_ns = self._shift_ns = 0
        if resume and any(self.folder.glob('*.mcap')):
            recover_bag(self.folder)
            reader = BagReader(self.folder)
            self._files, self._last_ns = reader.files, reader.whole.last_ns
            self._topics = _topics_of(reader)
        else:
            if resume:
                _remove_beginnings(self.folder)
            make_new_folder(self.folder)
        name = f'{self.folder.resolve().name}_{len(self._files)}.mcap'
        self._path = self.folder / name
        self._own = FileMetadata(name)
        self._files.append(self._own)
        self._file: PatientFile | None = PatientFile(self._path)
        try:
            self._writer = Writer(
                # MCAP's writer calls no more than write and tell.
                self._file,  # type: ignore[arg-type]
                compression=CompressionType.NONE,
                use_chunking=False,
                enable_data_crcs=True,
            )
            self._writer.start('ros2', f'remaster_ros-{__version__}')
            self._file.flush()
            self._write_metadata()
        except BaseException:
            self._file.close()
            raise
        self._metadata_waits = False

    def write(self, topic: str, msgtype: str, cdr: bytes, stamp_ns: int) -> None:
        """Write one message.

        A stamp before the latest one so far (the clock was set back) is stored as the latest
        one, because readers refuse an unindexed file out of order; the given stamp is stored
        as MCAP's ``publish_time``. If the first stamp of a file is before the last one of the
        previous file, all stamps of the new file are shifted, so that it begins a second after
        that one.

        Parameters
        ----------
        topic, msgtype
            Such as ``/joint_states`` and ``sensor_msgs/msg/JointState``.
        cdr
            The serialised message.
        stamp_ns
            Time of reception, nanoseconds since the epoch.

        Raises
        ------
        InputError
            If the message type is not one of ROS 2 Jazzy's, a topic changes its type, the stamp is
            invalid, or the bag is closed.
        DiskError
            If the disk is full and `WAITING_LIMIT` is reached: this message is lost.
        """
        if self._file is None:
            raise InputError(f'{self.folder}: the bag is closed; start a new one')
        if not 0 <= stamp_ns < 2**63:
            raise InputError(f'{topic}: {stamp_ns} ns is no time stamp; give ns since the epoch')
        if self._file.waiting > WAITING_LIMIT:
            self._file.flush()
        if topic not in self._channels:
            self._add_topic(topic, msgtype)
        metadata = self._topics[topic]
        if metadata.msgtype != msgtype:
            raise InputError(f'{topic}: {msgtype} after {metadata.msgtype}; a topic has one type')
        if not self._own.count and stamp_ns < self._last_ns:
            self._shift_ns = self._last_ns + 10**9 - stamp_ns
        self._last_ns = max(self._last_ns, stamp_ns + self._shift_ns)
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=self._last_ns,
            data=cdr,
            publish_time=stamp_ns,
            sequence=metadata.count % 2**32,
        )
        if self._metadata_waits and not self._file.waiting:
            self._list_topics()
        metadata.count += 1
        self._own.add(self._last_ns)

    def close(self) -> None:
        """Finish file, metadata.yaml and checksums durably; a second call does nothing.

        Raises DiskError if the disk is full; the messages written so far remain readable.
        """
        if self._file is None:
            return
        file, self._file = self._file, None
        self._writer.finish()
        file.close()
        with writing(self._path):
            sync_folder(self.folder)
        self._write_metadata()
        add_to_manifest(self.folder, self._path.name)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _add_topic(self, topic: str, msgtype: str) -> None:
        """Register a topic in the file and list it in metadata.yaml.

        Raises InputError if its type is not one of ROS 2 Jazzy's.
        """
        definition, type_hash = definition_of(msgtype)
        if msgtype not in self._schemas:
            self._schemas[msgtype] = self._writer.register_schema(
                msgtype, 'ros2msg', definition.encode()
            )
        offered = qos_text(topic in LATCHED_TOPICS)
        self._topics.setdefault(topic, _described(topic, msgtype))
        about = {'offered_qos_profiles': offered, 'topic_type_hash': type_hash}
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[msgtype], about
        )
        self._list_topics()

    def _list_topics(self) -> None:
        """Write metadata.yaml with the topics so far: players need them also of an unclosed bag.

        If the disk is full, it is written later (``_metadata_waits``).
        """
        try:
            self._write_metadata()
            self._metadata_waits = False
        except DiskError:
            self._metadata_waits = True

    def _write_metadata(self) -> None:
        """Write metadata.yaml with the files and topics so far; raise DiskError if that fails."""
        text = metadata_text(self._files, self._topics.values())
        write_atomically(self.folder / METADATA_FILE, text)


def recover_bag(folder: str | os.PathLike[str]) -> str:
    """Finish the bag of a killed writer, so that every MCAP and rosbag2 reader opens it.

    The last file is written anew up to its last whole message; metadata.yaml and SHA256SUMS
    are completed. Returns what was lost, as text; '' for nothing. A bag whose files are all
    complete and in SHA256SUMS is unchanged. Raises InputError if there is no bag or it is
    damaged, DiskError if the folder cannot be written to.
    """
    folder = Path(folder)
    remove_leftovers(folder)
    _remove_work(folder)
    reader = BagReader(folder)
    last = reader.files[-1]
    path = folder / last.name
    if not reader.complete:
        work = folder / _WORK
        with BagWriter(work) as writer:
            for message in reader.messages_of(last):
                writer.write(*message)
        with writing(path):
            os.replace(writer._path, path)
            sync_folder(folder)
        _remove_work(folder)
    listed = read_manifest(folder)
    unlisted = [file.name for file in reader.files if file.name not in listed]
    if unlisted:
        topics = _topics_of(reader)
        write_atomically(folder / METADATA_FILE, metadata_text(reader.files, topics.values()))
    for name in unlisted:
        add_to_manifest(folder, name)
    if not reader.torn_bytes:
        return ''
    return f'{path}: its last {reader.torn_bytes} bytes were no whole message and are dropped'


def _topics_of(reader: BagReader) -> dict[str, TopicMetadata]:
    """Return the metadata of a bag's topics, with their numbers of messages, by name.

    Raises InputError for a message type that is not one of ROS 2 Jazzy's.
    """
    return {
        topic: _described(topic, msgtype, reader.counts[topic])
        for topic, msgtype in reader.topics.items()
    }


def _described(topic: str, msgtype: str, count: int = 0) -> TopicMetadata:
    """Return the metadata of a topic with `count` messages: type, type hash, whether latched.

    Raises InputError for a message type that is not one of ROS 2 Jazzy's.
    """
    _, type_hash = definition_of(msgtype)
    return TopicMetadata(topic, msgtype, type_hash, topic in LATCHED_TOPICS, count)


def _remove_work(folder: Path) -> None:
    """Remove the temporary folder of a recovery, if there is one: it is finished, or was killed.

    Raises DiskError if that fails.
    """
    work = folder / _WORK
    with writing(work):
        if work.is_dir():
            for file in work.iterdir():
                os.unlink(file)
            os.rmdir(work)
            sync_folder(folder)


def _remove_beginnings(folder: Path) -> None:
    """Remove the files of a writer that was killed before its first file was complete.

    Temporary files (.*.tmp), and then metadata.yaml if nothing else is in the folder. Nothing
    happens if there is no such folder.
    """
    if folder.is_dir():
        remove_leftovers(folder)
        if [path.name for path in folder.iterdir()] == [METADATA_FILE]:
            os.unlink(folder / METADATA_FILE)
