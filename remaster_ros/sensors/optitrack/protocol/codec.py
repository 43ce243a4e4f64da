"""How NatNet's items lie in their bytes: one description to read, to write and to step over.

A codec is put together from smaller ones for one version of the protocol. What comes from the
network may be damaged: a count is checked before anything is allocated for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import chain
from struct import Struct
from typing import Any

from remaster_ros.sensors.optitrack.protocol.wire import MAX_TEXT_BYTES, ProtocolError, Reader

_COUNT = Struct('<i')
_COUNT_AND_SIZE = Struct('<2i')


class Codec(ABC):
    """Reads, writes and steps over one item.

    Attributes
    ----------
    least
        The fewest bytes that an item takes.
    """

    least: int

    @abstractmethod
    def read(self, reader: Reader) -> Any:
        """Read an item; `ProtocolError` where the bytes are not one."""

    @abstractmethod
    def skip(self, reader: Reader) -> None:
        """Step over an item, whose counts are checked and whose numbers are not looked at."""

    @abstractmethod
    def write(self, item: Any) -> bytes:
        """Write an item; `ValueError` or `struct.error` where it does not fit."""

    def read_many(self, reader: Reader, count: int) -> tuple[Any, ...]:
        """Read items that follow one another."""
        return tuple([self.read(reader) for _ in range(count)])

    def skip_many(self, reader: Reader, count: int) -> None:
        """Step over items that follow one another."""
        for _ in range(count):
            self.skip(reader)


def _same(item: Any) -> Any:
    return item


class Row(Codec):
    """Numbers of a fixed layout.

    Parameters
    ----------
    layout
        `struct` format, without the byte order.
    build
        Makes the items of rows of numbers.
    flatten
        Undoes it, for one item.
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
        """Read one row."""
        return self._build([reader.unpack(self.layout)])[0]

    def skip(self, reader: Reader) -> None:
        """Step over one row."""
        reader.skip(self.least)

    def write(self, item: Any) -> bytes:
        """Write one row."""
        return self.layout.pack(*self._flatten(item))

    def read_many(self, reader: Reader, count: int) -> tuple[Any, ...]:
        """Read rows at once."""
        return tuple(self._build(reader.rows(self.layout, count)))

    def skip_many(self, reader: Reader, count: int) -> None:
        """Step over rows at once."""
        reader.skip(self.least * count)


def number(layout: str) -> Row:
    """Return the codec of a single number."""
    return Row(layout, lambda rows: list(chain.from_iterable(rows)), lambda value: (value,))


class _Text(Codec):
    """UTF-8 text up to its NUL; bytes that are no UTF-8 become U+FFFD."""

    least = 1

    def read(self, reader: Reader) -> str:
        return reader.text().decode('utf-8', 'replace')

    def skip(self, reader: Reader) -> None:
        reader.text()

    def write(self, item: str) -> bytes:
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
    """Items of different kinds that follow one another.

    Parameters
    ----------
    build
        Makes the record of the items.
    parts
        Their codecs.
    flatten
        Undoes `build`; a named tuple is its own items.
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
        """Read the items in their order."""
        return self._build(*[part.read(reader) for part in self._parts])

    def skip(self, reader: Reader) -> None:
        """Step over the items."""
        for part in self._parts:
            part.skip(reader)

    def write(self, item: Any) -> bytes:
        """Write the items in their order."""
        values = self._flatten(item)
        return b''.join(part.write(value) for part, value in zip(self._parts, values))


class Columns(Codec):
    """A count, then so many items of the first kind, so many of the second, and so on.

    Read as a tuple of columns.
    """

    least = _COUNT.size

    def __init__(self, *kinds: Codec) -> None:
        self._kinds = kinds
        self._least_row = sum(kind.least for kind in kinds)

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the columns."""
        count = reader.count(self._least_row)
        return tuple([kind.read_many(reader, count) for kind in self._kinds])

    def skip(self, reader: Reader) -> None:
        """Step over the columns."""
        count = reader.count(self._least_row)
        for kind in self._kinds:
            kind.skip_many(reader, count)

    def write(self, item: Sequence[Sequence[Any]]) -> bytes:
        """Write the columns, which are equally long."""
        columns = [map(kind.write, column) for kind, column in zip(self._kinds, item)]
        return _COUNT.pack(len(item[0])) + b''.join(chain(*columns))


class List(Codec):
    """A count and so many items of one kind."""

    least = _COUNT.size

    def __init__(self, kind: Codec) -> None:
        self.kind = kind

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the items."""
        return self.kind.read_many(reader, reader.count(self.kind.least))

    def skip(self, reader: Reader) -> None:
        """Step over the items."""
        self.kind.skip_many(reader, reader.count(self.kind.least))

    def write(self, item: Sequence[Any]) -> bytes:
        """Write the items."""
        return _COUNT.pack(len(item)) + b''.join(map(self.kind.write, item))


class SizedList(List):
    """A count, the size in bytes of all items, and the items.

    The size bounds the items, and what a newer server adds behind them is skipped. Items of a
    fixed layout must fill the size: another size shows that the layout is not the known one.
    """

    least = _COUNT_AND_SIZE.size

    def _head(self, reader: Reader) -> tuple[int, int]:
        count, size = reader.unpack(_COUNT_AND_SIZE)
        if count < 0 or not count * self.kind.least <= size <= reader.left:
            raise ProtocolError(f'a section of {count} items in {size} bytes, {reader.left} left')
        return count, size

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the items."""
        count, size = self._head(reader)
        if isinstance(self.kind, Row):
            if size == count * self.kind.least:
                return self.kind.read_many(reader, count)
            raise ProtocolError(
                f'a section of {count} items of {self.kind.least} bytes that claims {size} bytes'
            )
        with reader.bounded(size):
            return self.kind.read_many(reader, count)

    def skip(self, reader: Reader) -> None:
        """Step over the items at once."""
        reader.skip(self._head(reader)[1])

    def write(self, item: Sequence[Any]) -> bytes:
        """Write the items."""
        body = b''.join(map(self.kind.write, item))
        return _COUNT_AND_SIZE.pack(len(item), len(body)) + body
