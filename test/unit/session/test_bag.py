# SPDX-License-Identifier: Apache-2.0
"""Other people's readers open our bags; a killed writer leaves all it wrote; damage is refused."""

import logging
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from foreign import bag_messages
from foreign.bag_messages import START_NS, STORE, TOPICS, joint_state, messages, part
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from remaster_ros.errors import DiskError, InputError
from remaster_ros.session.bags import bag_writer
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.bags.bag_metadata import LATCHED_DEPTH, METADATA_FILE
from remaster_ros.session.bags.bag_writer import BagWriter, recover_bag
from remaster_ros.session.manifest import MANIFEST


def test_what_is_written_is_read(bag):
    reader = BagReader(bag)
    assert list(reader) == list(messages())
    assert list(reader) == list(messages())
    assert reader.complete
    assert reader.whole.count == 40
    assert (reader.whole.first_ns, reader.whole.last_ns) == (START_NS, START_NS + 390_000_000)
    assert reader.topics == {topic: make(0)[0] for topic, make in TOPICS.items()}
    assert list(BagReader(bag / 'bag_0.mcap')) == list(messages())


def test_rosbags_reads_equal_values_and_the_latched_topics(bag):
    wanted = list(messages())
    with AnyReader([bag]) as reader:
        read = list(reader.messages())
        assert len(read) == len(wanted)
        for (connection, stamp, raw), (topic, msgtype, cdr, stamp_ns) in zip(
            read, wanted, strict=True
        ):
            assert (connection.topic, connection.msgtype, stamp) == (topic, msgtype, stamp_ns)
            assert bytes(raw) == cdr
            ours = STORE.deserialize_cdr(cdr, msgtype)
            assert repr(reader.deserialize(raw, msgtype)) == repr(ours)
    with Reader(bag) as reader:
        durability = {
            c.topic: [profile.durability.name for profile in c.ext.offered_qos_profiles]
            for c in reader.connections
        }
        depths = {
            c.topic: [profile.depth for profile in c.ext.offered_qos_profiles]
            for c in reader.connections
        }
        assert reader.message_count == 40
        assert reader.duration == 390_000_001
        assert all(c.digest == STORE.hash_rihs01(c.msgtype) for c in reader.connections)
    assert durability.pop('/remaster/joint_offsets') == ['TRANSIENT_LOCAL']
    # Who joins a replay late gets what the node's own publisher would give: more than the last.
    assert depths['/remaster/joint_offsets'] == [LATCHED_DEPTH]
    assert LATCHED_DEPTH >= 2
    assert set(map(tuple, durability.values())) == {('VOLATILE',)}


def decoders():
    """Return the judge that decodes messages, of PyPI mcap-ros2-support."""
    reason = 'needs the judge: pip install mcap-ros2-support'
    return [pytest.importorskip('mcap_ros2.decoder', reason=reason).DecoderFactory()]


def decoded(reader):
    for _, channel, raw, message in reader.iter_decoded_messages():
        yield channel.topic, raw.log_time, message


def test_mcap_ros2_reads_equal_values(bag):
    with (bag / 'bag_0.mcap').open('rb') as file:
        read = list(decoded(make_reader(file, decoder_factories=decoders())))
    assert len(read) == 40
    for (topic, stamp, message), (i, wanted) in zip(read, enumerate(messages()), strict=True):
        assert (topic, stamp) == (wanted[0], wanted[3])
        assert message.header.frame_id == f'frame_{i}'
        if topic == '/joint_states':
            np.testing.assert_array_equal(message.position, joint_state(i)[1].position)
            np.testing.assert_array_equal(message.effort, joint_state(i)[1].effort)


def test_bags_of_other_recorders_are_read(tmp_path):
    """Chunked and zstd-compressed, as `ros2 bag record` writes them."""
    with RosbagsWriter(tmp_path / 'a', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, msgtype, cdr, stamp in messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=STORE)
            writer.write(connections[topic], stamp, cdr)
    assert list(BagReader(tmp_path / 'a')) == list(messages())
    for compression in (CompressionType.ZSTD, CompressionType.LZ4):
        path = tmp_path / f'{compression.name}.mcap'
        with path.open('wb') as file:
            writer = Writer(file, chunk_size=1000, compression=compression)
            writer.start('ros2')
            ids = {}
            for topic, msgtype, cdr, stamp in messages():
                if topic not in ids:
                    schema = writer.register_schema(msgtype, 'ros2msg', b'')
                    ids[topic] = writer.register_channel(topic, 'cdr', schema)
                writer.add_message(ids[topic], stamp, cdr, stamp)
            writer.finish()
        assert list(BagReader(path)) == list(messages())


KILLED = """
import sys
sys.path.insert(0, {tests!r})
from foreign.bag_messages import messages
from remaster_ros.session.bags.bag_writer import BagWriter
writer = BagWriter({folder!r})
for i, message in enumerate(messages()):
    writer.write(*message)
    print(i, flush=True)
sys.stdin.read()
"""


def test_a_killed_writer_leaves_all_it_wrote(tmp_path, caplog):
    folder = tmp_path / 'bag'
    script = KILLED.format(tests=str(Path(bag_messages.__file__).parents[1]), folder=str(folder))
    with subprocess.Popen(
        [sys.executable, '-c', script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        written = [process.stdout.readline() for _ in range(25)]
        process.send_signal(signal.SIGKILL)
    assert written[-1] == '24\n'
    with caplog.at_level(logging.WARNING, 'remaster_ros'):
        reader = BagReader(folder)
    assert not reader.complete
    assert 'killed' in caplog.text
    read = list(reader)
    assert len(read) >= 25
    assert read == list(messages())[: len(read)]

    # A third party that streams needs no index; it complains only where the file ends.
    third_party = []

    def stream():
        with (folder / 'bag_0.mcap').open('rb') as file:
            reader = NonSeekingReader(file, decoder_factories=decoders())
            for _, channel, raw in reader.iter_messages(log_time_order=False):
                third_party.append((channel.topic, raw.data, raw.log_time))

    with pytest.raises(EndOfFile):
        stream()
    assert third_party == [(m.topic, m.cdr, m.stamp_ns) for m in read]

    # Once recovered, everybody opens it, and a second recovery changes nothing.
    lost = recover_bag(folder)
    assert ('no whole message' in lost) == bool(reader.torn_bytes)
    assert list(BagReader(folder)) == read
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert recover_bag(folder) == ''
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    with AnyReader([folder]) as other:
        assert [bytes(raw) for _, _, raw in other.messages()] == [m.cdr for m in read]
    assert sorted(p.name for p in folder.iterdir()) == [
        MANIFEST, 'bag_0.mcap', METADATA_FILE,
    ]  # fmt: skip


def test_a_cut_at_any_byte_loses_only_what_is_behind_it(bag, tmp_path):
    data = (bag / 'bag_0.mcap').read_bytes()
    wanted = list(messages())
    path = tmp_path / 'cut.mcap'
    counts = []
    rng = np.random.default_rng(3)
    for cut in np.sort(rng.integers(0, len(data), 300)):
        path.write_bytes(data[:cut])
        reader = BagReader(path)
        read = list(reader)
        assert read == wanted[: len(read)]
        counts.append(len(read))
    assert counts == sorted(counts)
    assert counts[0] < 5
    assert counts[-1] == 40


def test_garbage_is_refused(tmp_path):
    path = tmp_path / 'garbage.mcap'
    for data in (bytes(100), b'SQLite format 3', b'\x89MCAP0\r\n' + b'\xff' * 100 + MCAP0_MAGIC):
        path.write_bytes(data)
        with pytest.raises(InputError, match='damaged'):
            BagReader(path)


def test_zeros_after_a_power_cut_are_no_messages(bag, tmp_path):
    data = (bag / 'bag_0.mcap').read_bytes()
    path = tmp_path / 'zeros.mcap'
    wanted = list(messages())
    counts = set()
    for cut in range(len(data) // 2, len(data) // 2 + 400, 5):
        path.write_bytes(data[:cut] + bytes(5000))
        reader = BagReader(path)
        assert not reader.complete
        assert list(reader) == wanted[: reader.whole.count]
        counts.add(reader.whole.count)
    assert len(counts) > 1


def test_missing_bags_are_named(tmp_path):
    for path in (tmp_path / 'none', tmp_path):
        with pytest.raises(InputError, match=str(path)):
            BagReader(path)


def test_the_writer_refuses_what_no_reader_would_understand(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/clock', 'std_msgs/msg/Empty', b'\0\1\0\0\0', 0)
        for arguments, problem in [
            (('/a', 'no_msgs/msg/Such', b'', 6), 'not a message type'),
            (('/clock', 'sensor_msgs/msg/JointState', b'', 6), 'one type'),
            (('/clock', 'std_msgs/msg/Empty', b'', -1), 'no time stamp'),
        ]:
            with pytest.raises(InputError, match=problem):
                writer.write(*arguments)
    with pytest.raises(InputError, match='closed'):
        writer.write('/clock', 'std_msgs/msg/Empty', b'\0\1\0\0\0', 7)
    with pytest.raises(InputError, match='already holds files'):
        BagWriter(tmp_path / 'bag')
    assert BagReader(tmp_path / 'bag').whole.count == 1


def test_a_clock_set_back_leaves_a_bag_in_order(tmp_path):
    first, second, third, *_ = messages()
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write(*second)
        writer.write(*first)
        writer.write(*third)
    read = list(BagReader(tmp_path / 'bag'))
    assert [m.cdr for m in read] == [second[2], first[2], third[2]]
    assert [m.stamp_ns for m in read] == [second[3], second[3], third[3]]
    with AnyReader([tmp_path / 'bag']) as reader:
        assert len(list(reader.messages())) == 3


def test_a_full_disk_delays_messages_until_memory_is_full_too(tmp_path, full_disk, monkeypatch):
    monkeypatch.setattr(bag_writer, 'WAITING_LIMIT', 3000)
    given = list(messages())
    with BagWriter(tmp_path / 'bag') as writer:
        part(writer, 0, 2)
        with full_disk(room=100):
            with pytest.raises(DiskError, match='No space left'):
                part(writer, 2, 39)
            kept = writer._own.count
        writer.write(*given[-1])
    assert 10 < kept < 39
    reader = BagReader(tmp_path / 'bag')
    assert reader.complete
    assert list(reader) == [*given[:kept], given[-1]]
    with AnyReader([tmp_path / 'bag']) as any_reader:
        assert {connection.topic for connection in any_reader.connections} == set(TOPICS)
