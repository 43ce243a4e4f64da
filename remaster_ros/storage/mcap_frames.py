"""The records of an MCAP file one by one, also where its writer was killed or the power cut."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream

CHUNK_LIMIT = 1024**3


class CutOffError(Exception):
    """A record reaches past the end of the file."""


def without_zeros(file: IO[bytes], size: int) -> int:
    """Return the size of a file without the zeros at its end, which a power cut may leave."""
    block = 1024 * 1024
    for start in range((size - 1) // block * block, -1, -block):
        file.seek(start)
        if kept := len(file.read(block if start + block < size else size - start).rstrip(b'\0')):
            return start + kept
    return 0


def frames(file: IO[bytes], size: int, crc: int | None, solid: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of every record up to the end of the data section.

    A record that ends among zeros, with more zeros behind it, was not all written.
    """
    while True:
        head = file.read(9)
        if not head and crc is None:
            return
        if len(head) < 9:
            raise CutOffError
        opcode, length = struct.unpack('<BQ', head)
        end = file.tell() + length
        # MCAP knows no opcodes 0 and 0x10 to 0x7f.
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
    """Unpack the chunks that other recorders write."""
    for opcode, body in records:
        if opcode != Opcode.CHUNK:
            yield opcode, body
            continue
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
        if max(chunk.uncompressed_size, _zstd_size(chunk)) > CHUNK_LIMIT:
            raise ValueError(f'a chunk says it holds more than {CHUNK_LIMIT} bytes')
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        try:
            yield from frames(BytesIO(stream.read(length)), length, crc=None, solid=length)
        except CutOffError:
            raise ValueError('a record does not fit its chunk') from None


def _zstd_size(chunk: Chunk) -> int:
    """Return the size that a zstd frame announces, which may differ from what the chunk says."""
    if chunk.compression != 'zstd':
        return 0
    import zstandard

    return zstandard.frame_content_size(chunk.data)
