# SPDX-License-Identifier: Apache-2.0
"""A bag that goes on after a kill, or is damaged: one bag of several files, or refused."""

import os
import shutil
import subprocess

import numpy as np
import pytest
from foreign.bag_messages import abandon, messages, part
from rosbags.rosbag2 import Reader

from remaster_ros.errors import InputError
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.bags.bag_metadata import METADATA_FILE
from remaster_ros.session.bags.bag_writer import BagWriter, recover_bag
from remaster_ros.session.manifest import MANIFEST


# What these readers import warns of its own age.
@pytest.mark.filterwarnings('ignore::DeprecationWarning')
def test_a_resumed_bag_is_one_bag_of_several_files(tmp_path):
    folder = tmp_path / 'bag'
    abandon(folder, 0, 15)
    abandon(folder, 15, 15, resume=True)
    abandon(folder, 15, 31, resume=True)
    with BagWriter(folder, resume=True) as writer:
        part(writer, 31, 40)
    files = [f'bag_{i}.mcap' for i in range(4)]
    assert sorted(p.name for p in folder.iterdir()) == [MANIFEST, *files, METADATA_FILE]
    reader = BagReader(folder)
    assert reader.complete
    assert [file.count for file in reader.files] == [15, 0, 16, 9]
    wanted = list(messages())
    assert list(reader) == wanted
    with Reader(folder) as other:
        assert other.message_count == 40
        assert other.start_time == wanted[0][3]
        assert [bytes(raw) for _, _, raw in other.messages()] == [m[2] for m in wanted]
        counts = {c.topic: c.msgcount for c in other.connections}
    assert counts == reader.counts
    check = subprocess.run(
        ['sha256sum', '--check', '--strict', MANIFEST], cwd=folder, capture_output=True, text=True
    )
    assert check.returncode == 0, check.stderr
    assert check.stdout.count(': OK') == 4


def test_a_clock_begun_anew_shifts_the_next_file(tmp_path):
    topic, kind, data, stamp_ns = next(iter(messages()))
    for _ in range(2):
        with BagWriter(tmp_path / 'bag', resume=True) as writer:
            for i in range(3):
                writer.write(topic, kind, data, stamp_ns + i * 10**8)
    stamps = [message.stamp_ns - stamp_ns for message in BagReader(tmp_path / 'bag')]
    assert stamps == [0, 10**8, 2 * 10**8, 12 * 10**8, 13 * 10**8, 14 * 10**8]


def test_a_kill_at_any_step_of_a_recovery_is_recovered(tmp_path, monkeypatch):
    """Stop before each change of a file in turn; the next recovery always gets there."""
    original = tmp_path / 'whole'
    abandon(original, 0, 15)
    steps = 0
    while True:
        steps += 1
        folder = tmp_path / str(steps) / 'bag'
        shutil.copytree(original, folder)
        (folder / 'whole_0.mcap').rename(folder / 'bag_0.mcap')
        remaining = steps

        def stop(function):
            def count(*args, **kwargs):
                nonlocal remaining
                remaining -= 1
                if remaining == 0:
                    raise KeyboardInterrupt
                return function(*args, **kwargs)

            return count

        with monkeypatch.context() as patch:
            for name in ('replace', 'unlink', 'rmdir', 'fsync'):
                patch.setattr(os, name, stop(getattr(os, name)))
            try:
                recover_bag(folder)
            except KeyboardInterrupt:
                stopped = True
            else:
                stopped = False
        recover_bag(folder)
        reader = BagReader(folder)
        assert reader.complete
        assert list(reader) == list(messages())[:15]
        assert sorted(p.name for p in folder.iterdir()) == [
            MANIFEST, 'bag_0.mcap', METADATA_FILE,
        ]  # fmt: skip
        if not stopped:
            break
    assert steps > 10


def spoilt(data, rng, kind):
    """Return bytes with a flipped bit, with some replaced, cut out or doubled, or with a tail."""
    data, i = bytearray(data), int(rng.integers(len(data)))
    span = slice(i, i + int(rng.integers(1, 50)))
    if kind == 'flipped':
        data[i] ^= 1 << rng.integers(8)
    elif kind == 'replaced':
        data[i] = rng.integers(256)
    elif kind == 'filled':
        data[i : i + 8] = b'\xff' * 8
    elif kind == 'doubled':
        data[i:i] = data[span]
    elif kind == 'cut out':
        del data[span]
    elif kind == 'cut off':
        del data[i:]
    else:
        data += rng.bytes(int(rng.integers(1, 50)))
    return bytes(data)


@pytest.mark.parametrize('kind', ['flipped', 'cut off', 'longer'])
def test_a_closed_bag_is_itself_or_refused(bag, kind):
    """With its checksum nothing else than the bag comes out."""
    seed = 11
    print('seed', seed)
    rng = np.random.default_rng(seed)
    path = bag / 'bag_0.mcap'
    data = path.read_bytes()
    for _ in range(40):
        path.write_bytes(spoilt(data, rng, kind))
        with pytest.raises(InputError, match=r'bag_0\.mcap'):
            BagReader(bag)


@pytest.mark.parametrize('kind', ['flipped', 'replaced', 'filled', 'doubled', 'cut out'])
def test_without_its_checksum_a_bag_gives_the_one_error_or_no_other_message(bag, kind):
    """A flip of the summary leaves all messages; other damage may look like a killed writer."""
    seed = 12
    print('seed', seed)
    rng = np.random.default_rng(seed)
    (bag / MANIFEST).unlink()
    path = bag / 'bag_0.mcap'
    data, wanted = path.read_bytes(), list(messages())
    refused = 0
    for _ in range(120):
        path.write_bytes(spoilt(data, rng, kind))
        try:
            read = list(BagReader(bag))
        except InputError:
            refused += 1
        else:
            assert read == (wanted if kind == 'flipped' else wanted[: len(read)])
    assert refused > 40
