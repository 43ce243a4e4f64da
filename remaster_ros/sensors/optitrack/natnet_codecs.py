# SPDX-License-Identifier: Apache-2.0
"""Codecs of NatNet's items: one description to read, to write and to step over.

A codec is put together from smaller ones for one version of the protocol. What comes from the
network may be damaged: a count is checked before anything is allocated for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import chain
from struct import Struct
from typing import Any

from remaster_ros.sensors.optitrack.natnet_bytes import MAX_TEXT_BYTES, ProtocolError, Reader

_COUNT = Struct('<i')
_COUNT_AND_SIZE = Struct('<2i')


class Codec(ABC):
    """Reader and writer of one kind of item in a NatNet datagram."""

    least: int  # Fewest bytes of an item

    @abstractmethod
    def read(self, reader: Reader) -> Any:
        """Read an item, and move behind it; raises `ProtocolError` for invalid bytes."""

    @abstractmethod
    def skip(self, reader: Reader) -> None:
        """Skip an item; its counts are checked, its numbers are not."""

    @abstractmethod
    def write(self, item: Any) -> bytes:
        """Bytes of an item; raises `ValueError` or `struct.error` if it does not fit."""

    def read_many(self, reader: Reader, count: int) -> tuple[Any, ...]:
        """Read `count` consecutive items, a tuple of them; ProtocolError for invalid bytes."""
        return tuple([self.read(reader) for _ in range(count)])

    def skip_many(self, reader: Reader, count: int) -> None:
        """Skip `count` consecutive items, each as by `skip`."""
        for _ in range(count):
            self.skip(reader)


def _same(item: Any) -> Any:
    """Return the item itself."""
    return item


def stepped_over(*_: Any) -> None:
    """Return None for any arguments: the `build` of a `Record` whose items are not kept.

    Such items are only skipped and written.
    """


class Row(Codec):
    """Codec of numbers of a fixed layout.

    ``layout``: `struct` format, without the byte order; ``build``: from rows of numbers to
    items; ``flatten``: from one item to its numbers.
    """

    def __init__(
        self,
        layout: str,
        build: Callable[[list[tuple]], Sequence[Any]] = _same,
        flatten: Callable[[Any], Sequence[Any]] = _same,
    ) -> None:
        self.layout = Struct('<' + layout)
        self.least = self.layout.size
        self._build, self._flatten = build, flatten

    def read(self, reader: Reader) -> Any:
        """Read one item; ProtocolError beyond the end."""
        return self._build([reader.unpack(self.layout)])[0]

    def skip(self, reader: Reader) -> None:
        """Skip one item; ProtocolError beyond the end."""
        reader.skip(self.least)

    def write(self, item: Any) -> bytes:
        """Bytes of one item; struct.error if a number does not fit."""
        return self.layout.pack(*self._flatten(item))

    def read_many(self, reader: Reader, count: int) -> tuple[Any, ...]:
        """Read `count` consecutive items, a tuple of them; ProtocolError beyond the end."""
        return tuple(self._build(reader.rows(self.layout, count)))

    def skip_many(self, reader: Reader, count: int) -> None:
        """Skip `count` consecutive items at once; ProtocolError beyond the end."""
        reader.skip(self.least * count)


def number(layout: str) -> Row:
    """Codec of a single number.

    ``layout``: one format character of `struct`.
    """
    return Row(layout, lambda rows: list(chain.from_iterable(rows)), lambda value: (value,))


class _Text(Codec):
    """Codec of a UTF-8 text with its final NUL."""

    least = 1

    def read(self, reader: Reader) -> str:
        """Read a text; bytes that are not UTF-8 become U+FFFD, ProtocolError without a NUL."""
        return reader.text().decode('utf-8', 'replace')

    def skip(self, reader: Reader) -> None:
        """Skip a text with its NUL; ProtocolError without one."""
        reader.text()

    def write(self, item: str) -> bytes:
        """Bytes of a text, UTF-8 with final NUL; ValueError for a NUL or over 255 bytes."""
        data = item.encode('utf-8')
        if b'\0' in data or len(data) >= MAX_TEXT_BYTES:
            raise ValueError(
                f'NatNet cannot carry the text {item[:40]!r}: a NUL, or over 255 bytes'
            )
        return data + b'\0'


TEXT = _Text()
I32 = number('i')
F32 = number('f')
VEC3 = Row('3f')
QUATERNION = Row('4f')


class Record(Codec):
    """Codec of consecutive items of different kinds.

    ``build``: from the items to the record; ``parts``: codecs of the items; ``flatten``: from
    the record to the items; a named tuple is its own items.
    """

    def __init__(
        self,
        build: Callable[..., Any],
        *parts: Codec,
        flatten: Callable[[Any], Sequence[Any]] = _same,
    ) -> None:
        self._build, self._parts, self._flatten = build, parts, flatten
        self.least = sum(part.least for part in parts)

    def read(self, reader: Reader) -> Any:
        """Read the items in their order; return the record that `_build` makes of the items."""
        return self._build(*[part.read(reader) for part in self._parts])

    def skip(self, reader: Reader) -> None:
        """Skip the items, each by its codec."""
        for part in self._parts:
            part.skip(reader)

    def write(self, item: Any) -> bytes:
        """Bytes of the record's items in their order; raises as `Codec.write`."""
        values = self._flatten(item)
        return b''.join(part.write(value) for part, value in zip(self._parts, values))


class Columns(Codec):
    """Codec of a count, then that number of items of the first kind, of the second, and so on.

    Read as a tuple of columns.
    """

    least = _COUNT.size

    def __init__(self, *kinds: Codec) -> None:
        self._kinds = kinds
        self._least_row = sum(kind.least for kind in kinds)

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the number of rows, then that many items of each kind; one tuple for each kind.

        Raises ProtocolError if the bytes cannot hold so many.
        """
        count = reader.count(self._least_row)
        return tuple([kind.read_many(reader, count) for kind in self._kinds])

    def skip(self, reader: Reader) -> None:
        """Skip the number of rows and the columns; ProtocolError beyond the end."""
        count = reader.count(self._least_row)
        for kind in self._kinds:
            kind.skip_many(reader, count)

    def write(self, item: Sequence[Sequence[Any]]) -> bytes:
        """Bytes of the number of rows and of the columns, one after the other.

        Not checked: there is a column, and all are equally long. IndexError without one.
        """
        columns = [map(kind.write, column) for kind, column in zip(self._kinds, item)]
        return _COUNT.pack(len(item[0])) + b''.join(chain(*columns))


class List(Codec):
    """Codec of a count and that number of items of one kind."""

    least = _COUNT.size

    def __init__(self, kind: Codec) -> None:
        self.kind = kind

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the count and that many items; return the items, a tuple.

        Raises ProtocolError if the bytes cannot hold so many.
        """
        return self.kind.read_many(reader, reader.count(self.kind.least))

    def skip(self, reader: Reader) -> None:
        """Skip the count and the items; ProtocolError if the bytes cannot hold so many."""
        self.kind.skip_many(reader, reader.count(self.kind.least))

    def write(self, item: Sequence[Any]) -> bytes:
        """Bytes of the count and the items; raises as `Codec.write` of the kind."""
        return _COUNT.pack(len(item)) + b''.join(map(self.kind.write, item))


class SizedList(List):
    """Codec of a count, the size in bytes of all items, and the items.

    Additions of a newer server after skipped items are skipped as well. Items that are read
    have a fixed layout and must fill the size: another size means another layout.
    """

    least = _COUNT_AND_SIZE.size

    def _head(self, reader: Reader) -> tuple[int, int]:
        """Read the number of items and their size in bytes, and check both.

        Raises ProtocolError if the count is negative, the size is more than the remaining
        bytes, or it is less than so many of the smallest items take.
        """
        count, size = reader.unpack(_COUNT_AND_SIZE)
        if count < 0 or not count * self.kind.least <= size <= reader.remaining_bytes:
            raise ProtocolError(
                f'a section of {count} items in {size} bytes, {reader.remaining_bytes} left'
            )
        return count, size

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the items, a tuple; ProtocolError if they do not fill the size exactly."""
        count, size = self._head(reader)
        if size != count * self.kind.least:
            raise ProtocolError(
                f'a section of {count} items of {self.kind.least} bytes that claims {size} bytes'
            )
        return self.kind.read_many(reader, count)

    def skip(self, reader: Reader) -> None:
        """Skip count, size and items at once, by the size: no item is read.

        Raises ProtocolError as `_head`.
        """
        reader.skip(self._head(reader)[1])

    def write(self, item: Sequence[Any]) -> bytes:
        """Bytes of count, size and items; raises as `Codec.write` of the kind."""
        body = b''.join(map(self.kind.write, item))
        return _COUNT_AND_SIZE.pack(len(item), len(body)) + body
