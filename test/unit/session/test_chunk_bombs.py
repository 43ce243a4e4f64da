# SPDX-License-Identifier: Apache-2.0
"""Chunks that unpack to more than they state are refused before they are in memory."""

import struct
import subprocess
import sys

import lz4.frame
import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from remaster_ros.errors import InputError
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.bags.mcap_records import CHUNK_LIMIT

REALLY = 3 * 1024**3
"""What a bomb unpacks to, bytes."""
PIECE = bytes(1 << 24)
READ = """
import re, sys
from pathlib import Path
from remaster_ros.errors import InputError
from remaster_ros.session.bags.bag import BagReader
try:
    BagReader(sys.argv[1])
except InputError as error:
    print(error)
# Not ru_maxrss: a child inherits that of the process which started it.
print(int(re.search(r'VmHWM:\\s+(\\d+) kB', Path('/proc/self/status').read_text())[1]) // 1024)
"""


def packed(compression):
    """Pack zeros piece by piece, so that no size stands in the frame."""
    if compression == 'lz4':
        packer = lz4.frame.LZ4FrameCompressor()
        parts = [packer.begin(), *(packer.compress(PIECE) for _ in range(REALLY // len(PIECE)))]
    else:
        packer = zstandard.ZstdCompressor().compressobj()
        parts = [packer.compress(PIECE) for _ in range(REALLY // len(PIECE))]
    return b''.join([*parts, packer.flush()])


def bag_of(chunk, stated, compression):
    """Return an MCAP file of one chunk."""
    name = compression.encode()
    body = struct.pack('<QQQII', 0, 0, stated, 0, len(name)) + name
    body += struct.pack('<Q', len(chunk)) + chunk
    header = struct.pack('<II', 0, 0)
    return b''.join(
        [
            MCAP0_MAGIC,
            struct.pack('<BQ', 1, len(header)) + header,
            struct.pack('<BQ', 6, len(body)) + body,
            struct.pack('<BQI', 15, 4, 0),
            MCAP0_MAGIC,
        ]
    )


@pytest.mark.timeout(120)
@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
def test_a_bomb_is_refused_before_memory_goes(tmp_path, compression):
    """A bag of 12 MB took 3.3 GB."""
    chunk = packed(compression)
    path = tmp_path / 'bomb.mcap'
    for stated, most_mib in ((0, 200), (2**20, 200), (CHUNK_LIMIT, 200 + 2 * CHUNK_LIMIT / 2**20)):
        path.write_bytes(bag_of(chunk, stated, compression))
        child = subprocess.run(
            [sys.executable, '-c', READ, str(path)], capture_output=True, text=True, check=True
        )
        said, peak_mib = child.stdout.splitlines()
        print(f'{compression}: {len(chunk)} bytes that state {stated}: {peak_mib} MiB')
        assert f'holds more than the {stated} bytes' in said
        assert int(peak_mib) < most_mib


@pytest.mark.parametrize('compression', [CompressionType.ZSTD, CompressionType.LZ4])
def test_one_large_message_is_read(tmp_path, compression):
    """Only a message that is larger than recorders' chunks makes a large chunk."""
    path = tmp_path / 'large.mcap'
    cloud = bytes(range(256)) * (40 * 2**20 // 256)
    with path.open('wb') as file:
        writer = Writer(file, compression=compression)
        writer.start('ros2')
        schema = writer.register_schema('std_msgs/msg/ByteMultiArray', 'ros2msg', b'')
        channel = writer.register_channel('/cloud', 'cdr', schema)
        writer.add_message(channel, 5, cloud, 5)
        writer.finish()
    (message,) = BagReader(path)
    assert message.cdr == cloud


@pytest.mark.parametrize(
    ('chunk', 'stated', 'compression', 'said'),
    [
        (b'', CHUNK_LIMIT + 1, 'lz4', f'more than {CHUNK_LIMIT} bytes'),
        (b'abc', 2, '', 'holds more than the 2 bytes'),
        (b'abc', 4, '', 'holds less than the 4 bytes'),
        (zstandard.compress(b'abc'), 4, 'zstd', 'holds less than the 4 bytes'),
        (lz4.frame.compress(b'abc'), 4, 'lz4', 'holds less than the 4 bytes'),
        (b'abc', 3, 'zip', "packed as 'zip'"),
    ],
)
def test_what_a_chunk_states_must_be_so(tmp_path, chunk, stated, compression, said):
    path = tmp_path / 'odd.mcap'
    path.write_bytes(bag_of(chunk, stated, compression))
    with pytest.raises(InputError, match=said):
        BagReader(path)
