# SPDX-License-Identifier: Apache-2.0
"""Versions of NatNet, and bounds-checked reading of a datagram; no sockets.

Everything is little-endian and packed. Bytes from the network may be anything: whatever is
wrong with them is raised as `ProtocolError`, and nothing is allocated for a count that the
bytes left could not hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from struct import Struct
from typing import Any

Version = tuple[int, int]
"""NatNet bitstream version, (major, minor)."""
Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""
OLDEST_VERSION: Version = (2, 6)
"""First bitstream with the flags that distinguish a measured marker from a model-filled one."""
NEWEST_VERSION: Version = (4, 3)
"""Last known layout; 4.4 and later 4.x are read with this layout and fail if they differ."""
MAX_TEXT_BYTES = 256
"""Longest text on the wire, its final NUL included."""
_I32 = Struct('<i')


class ProtocolError(Exception):
    """Bytes that are not NatNet; the message states the position."""


def require_supported(version: Version) -> None:
    """Raise ProtocolError for a bitstream version that is not read here: not 2.6 to 4.x."""
    if not (OLDEST_VERSION <= version < (5, 0)):
        raise ProtocolError(
            f'NatNet {version[0]}.{version[1]} is unknown here: 2.6 to 4.3 can be read'
        )


class Reader:
    """Cursor over the bytes of one datagram that refuses to go beyond the end.

    ``data``: the datagram's payload.
    """

    __slots__ = ('_data', 'end', 'offset')

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.offset = 0
        self.end = len(data)

    @property
    def remaining_bytes(self) -> int:
        """Number of bytes between the cursor and the end."""
        return self.end - self.offset

    def unpack(self, layout: Struct) -> tuple[Any, ...]:
        """Read one struct, and move behind it; ProtocolError beyond the end."""
        start = self.offset
        self.skip(layout.size)
        return layout.unpack_from(self._data, start)

    def rows(self, layout: Struct, count: int) -> list[tuple[Any, ...]]:
        """Read `count` structs in a row; ProtocolError beyond the end."""
        start = self.offset
        self.skip(layout.size * count)
        return list(layout.iter_unpack(memoryview(self._data)[start : self.offset]))

    def count(self, item_bytes: int) -> int:
        """Read an i32 count of items that take at least `item_bytes` each.

        Raises ProtocolError if it is negative, or the remaining bytes cannot hold as many.
        """
        start = self.offset
        (count,) = self.unpack(_I32)
        if count < 0 or count * item_bytes > self.remaining_bytes:
            raise ProtocolError(
                f'a count of {count} at byte {start} with {self.remaining_bytes} bytes left'
            )
        return count

    def text(self) -> bytes:
        """Read the bytes of a text, without its NUL, and move behind the NUL.

        Raises ProtocolError if there is none within `MAX_TEXT_BYTES`, or before the end.
        """
        start = self.offset
        stop = self._data.find(0, start, min(self.end, start + MAX_TEXT_BYTES))
        if stop < 0:
            raise ProtocolError(f'text at byte {start} has no end')
        self.offset = stop + 1
        return self._data[start:stop]

    def skip(self, size: int) -> None:
        """Skip `size` bytes; ProtocolError beyond the end or for a negative size."""
        stop = self.offset + size
        if not self.offset <= stop <= self.end:
            raise ProtocolError(
                f'{size} bytes wanted at byte {self.offset}, {self.remaining_bytes} left'
            )
        self.offset = stop

    @contextmanager
    def bounded(self, size: int) -> Iterator[None]:
        """Context in which the reader ends after the next `size` bytes; it is behind them at exit.

        Raises ProtocolError if fewer are left.
        """
        if not 0 <= size <= self.remaining_bytes:
            raise ProtocolError(
                f'{size} bytes wanted at byte {self.offset}, {self.remaining_bytes} left'
            )
        end, self.end = self.end, self.offset + size
        yield
        self.offset, self.end = self.end, end
