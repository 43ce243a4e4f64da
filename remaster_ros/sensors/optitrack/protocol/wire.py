"""The bricks of NatNet datagrams: bounds-checked reading and plain writing; no sockets.

Everything is little-endian and packed. Bytes from the network are never trusted: whatever is
wrong with them comes out as one `ProtocolError`, and nothing is allocated for a count that the
bytes left could not hold.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from struct import Struct
from typing import Any, Literal, TypeVar

Version = tuple[int, int]
"""NatNet bitstream version, (major, minor)."""

Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""

Item = TypeVar('Item')

OLDEST_VERSION: Version = (2, 6)
"""The first bitstream with the flags that tell a measured marker from a guessed one."""
NEWEST_VERSION: Version = (4, 3)
"""The last described layout; 4.4 and later 4.x are read as this one and fail where they differ."""

I16 = Struct('<h')
U16 = Struct('<H')
I32 = Struct('<i')
F32 = Struct('<f')
TWO_I32 = Struct('<2i')
VEC3 = Struct('<3f')
QUATERNION = Struct('<4f')

MAX_TEXT_BYTES = 256
"""Longest text on the wire, its final NUL included."""


class ProtocolError(Exception):
    """Bytes that are not what NatNet says they must be; the message tells where."""


def require_supported(version: Version) -> None:
    """Raise `ProtocolError` for a bitstream version that this decoder cannot read."""
    if not (OLDEST_VERSION <= version < (5, 0)):
        raise ProtocolError(
            f'NatNet {version[0]}.{version[1]} is unknown here: 2.6 to 4.3 can be read'
        )


class Reader:
    """A cursor over the bytes of one datagram that refuses to run past the end.

    Parameters
    ----------
    data
        The datagram's payload.
    """

    __slots__ = ('_data', 'end', 'offset')

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.offset = 0
        self.end = len(data)

    @property
    def left(self) -> int:
        """Bytes between the cursor and the end."""
        return self.end - self.offset

    def unpack(self, layout: Struct) -> tuple[Any, ...]:
        """Read one struct."""
        start = self.offset
        stop = start + layout.size
        if stop > self.end:
            raise ProtocolError(f'{layout.size} bytes wanted at byte {start}, {self.left} left')
        self.offset = stop
        return layout.unpack_from(self._data, start)

    def rows(self, layout: Struct, count: int) -> list[tuple[Any, ...]]:
        """Read `count` structs in a row."""
        start = self.offset
        stop = start + layout.size * count
        if stop > self.end:
            raise ProtocolError(
                f'{count} items of {layout.size} bytes wanted at byte {start}, {self.left} left'
            )
        self.offset = stop
        return list(layout.iter_unpack(memoryview(self._data)[start:stop]))

    def numbers(self, kind: Literal['i', 'f'], count: int) -> tuple[Any, ...]:
        """Read `count` numbers in a row: ``i`` for i32, ``f`` for f32."""
        start = self.offset
        stop = start + 4 * count
        if stop > self.end:
            raise ProtocolError(f'{count} numbers wanted at byte {start}, {self.left} bytes left')
        self.offset = stop
        return struct.unpack_from(f'<{count}{kind}', self._data, start)

    def integer(self) -> int:
        """Read one i32."""
        return self.unpack(I32)[0]

    def count(self, item_bytes: int) -> int:
        """Read an i32 count of items that take at least `item_bytes` each."""
        start = self.offset
        count = self.unpack(I32)[0]
        if count < 0 or count * item_bytes > self.left:
            raise ProtocolError(f'a count of {count} at byte {start} with {self.left} bytes left')
        return count

    def text(self) -> str:
        """Read UTF-8 text up to its NUL; bytes that are no UTF-8 become U+FFFD."""
        start = self.offset
        self.skip_text()
        return self._data[start : self.offset - 1].decode('utf-8', 'replace')

    def skip_text(self) -> None:
        """Step over text and its NUL."""
        start = self.offset
        stop = self._data.find(0, start, min(self.end, start + MAX_TEXT_BYTES))
        if stop < 0:
            raise ProtocolError(f'text at byte {start} has no end')
        self.offset = stop + 1

    def skip(self, size: int) -> None:
        """Step over `size` bytes."""
        if not 0 <= size <= self.left:
            raise ProtocolError(f'{size} bytes to skip at byte {self.offset}, {self.left} left')
        self.offset += size

    def items(self, read: Callable[[Reader], Item], item_bytes: int) -> tuple[Item, ...]:
        """Read a count and that many items with `read`."""
        return tuple(read(self) for _ in range(self.count(item_bytes)))

    def section(
        self, version: Version, read: Callable[[Reader], Item], item_bytes: int
    ) -> tuple[Item, ...]:
        """Read a section of a frame: count, byte size (4.1+), items of varying size.

        The byte size bounds the items, and whatever a newer server adds behind them is skipped.
        """
        if version < (4, 1):
            return self.items(read, item_bytes)
        count, size = self.unpack(TWO_I32)
        if count < 0 or not count * item_bytes <= size <= self.left:
            raise ProtocolError(f'a section of {count} items in {size} bytes, {self.left} left')
        with_tail, self.end = self.end, self.offset + size
        items = tuple(read(self) for _ in range(count))
        self.offset, self.end = self.end, with_tail
        return items

    def skip_section(
        self, version: Version, skip_item: Callable[[Reader], object], item_bytes: int
    ) -> None:
        """Step over a section of a frame: at once where it has a byte size (4.1+)."""
        if version < (4, 1):
            for _ in range(self.count(item_bytes)):
                skip_item(self)
            return
        count, size = self.unpack(TWO_I32)
        if count < 0 or not count * item_bytes <= size:
            raise ProtocolError(f'a section of {count} items in {size} bytes, {self.left} left')
        self.skip(size)

    def row_section(self, version: Version, layout: Struct) -> list[tuple[Any, ...]]:
        """Read a section of items of one size: count, byte size (4.1+), structs."""
        if version < (4, 1):
            return self.rows(layout, self.count(layout.size))
        count, size = self.unpack(TWO_I32)
        if count < 0 or size != count * layout.size:
            raise ProtocolError(
                f'a section of {count} items of {layout.size} bytes that claims {size} bytes'
            )
        return self.rows(layout, count)


def text(value: str) -> bytes:
    """Encode text with its NUL.

    Raises
    ------
    ValueError
        If it holds a NUL or is longer than 255 bytes.
    """
    data = value.encode('utf-8')
    if b'\0' in data or len(data) >= MAX_TEXT_BYTES:
        raise ValueError(f'NatNet cannot carry the text {value[:40]!r}: a NUL, or over 255 bytes')
    return data + b'\0'


def items(encoded: Iterable[bytes]) -> bytes:
    """Encode a count and the items."""
    parts = list(encoded)
    return I32.pack(len(parts)) + b''.join(parts)


def section(version: Version, encoded: Iterable[bytes]) -> bytes:
    """Encode a section of a frame: count, byte size (4.1+), items."""
    parts = list(encoded)
    body = b''.join(parts)
    if version < (4, 1):
        return I32.pack(len(parts)) + body
    return TWO_I32.pack(len(parts), len(body)) + body
