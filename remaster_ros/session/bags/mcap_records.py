# SPDX-License-Identifier: Apache-2.0
"""Records of MCAP files, also of files that a killed writer or a power cut has left incomplete."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk

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

    ``file``: MCAP file, read from its present place, or an unpacked chunk; ``size``: its
    bytes; ``solid``: its bytes without trailing zeros; ``crc``: CRC-32 of the file's bytes
    before that place, None for a chunk, which has no record DataEnd and is read to its end.
    Raises CutOffError for a record that extends beyond the end or ends among trailing zeros;
    ValueError if the checksum of the data section does not match.
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
    """Yield records (opcode, content) with chunks, which other recorders write, unpacked.

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
    """Return the content of a chunk, packed by zstd, lz4 or not at all.

    Raises ValueError if it is packed otherwise, states over 256 MiB (`CHUNK_LIMIT`), has another
    size than stated or another checksum. A few packed megabytes of zeros are gigabytes: they are
    refused before they fill the memory.
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
