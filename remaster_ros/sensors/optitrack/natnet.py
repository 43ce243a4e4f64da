# SPDX-License-Identifier: Apache-2.0
"""NatNet, OptiTrack's streaming protocol: datagrams to events and back; no sockets.

A client decodes with `decode_message` and encodes with the ``encode_…_request`` functions; a
server decodes with `decode_request` and encodes with `encode_message` and related functions.
Invalid bytes raise one exception, `ProtocolError`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, partial
from itertools import chain
from struct import Struct
from typing import Any, NamedTuple

# The versions of NatNet, and bounds-checked reading of a datagram; no sockets.
#
# Everything is little-endian and packed. Bytes from the network may be anything: whatever is
# wrong with them is raised as `ProtocolError`, and nothing is allocated for a count that the
# bytes left could not hold.


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
        """Context with the end after the next `size` bytes; the cursor is behind them afterwards.

        Raises ProtocolError if fewer are left.
        """
        if not 0 <= size <= self.remaining_bytes:
            raise ProtocolError(
                f'{size} bytes wanted at byte {self.offset}, {self.remaining_bytes} left'
            )
        end, self.end = self.end, self.offset + size
        yield
        self.offset, self.end = self.end, end


# How NatNet's items lie in their bytes: one description to read, to write and to step over.
#
# A codec is put together from smaller ones for one version of the protocol. What comes from the
# network may be damaged: a count is checked before anything is allocated for it.


_COUNT = Struct('<i')
_COUNT_AND_SIZE = Struct('<2i')


class Codec(ABC):
    """Reader and writer of one kind of item."""

    least: int  # Fewest bytes of an item

    @abstractmethod
    def read(self, reader: Reader) -> Any:
        """Read an item; raises `ProtocolError` for invalid bytes."""

    @abstractmethod
    def skip(self, reader: Reader) -> None:
        """Skip an item; its counts are checked, its numbers are not."""

    @abstractmethod
    def write(self, item: Any) -> bytes:
        """Bytes of an item; raises `ValueError` or `struct.error` if it does not fit."""

    def read_many(self, reader: Reader, count: int) -> tuple[Any, ...]:
        """Read consecutive items."""
        return tuple([self.read(reader) for _ in range(count)])

    def skip_many(self, reader: Reader, count: int) -> None:
        """Skip consecutive items."""
        for _ in range(count):
            self.skip(reader)


def _same(item: Any) -> Any:
    """Return the item itself."""
    return item


def _stepped_over(*_: Any) -> None:
    """No value, for items that are written and skipped, but never kept."""


class Row(Codec):
    """Numbers of a fixed layout.

    ``layout``: `struct` format, without the byte order; ``build``: from rows of numbers to items;
    ``flatten``: from one item to its numbers.
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
        """Read one row; ProtocolError beyond the end."""
        return self._build([reader.unpack(self.layout)])[0]

    def skip(self, reader: Reader) -> None:
        """Skip one row."""
        reader.skip(self.least)

    def write(self, item: Any) -> bytes:
        """Bytes of one row; struct.error if a number does not fit."""
        return self.layout.pack(*self._flatten(item))

    def read_many(self, reader: Reader, count: int) -> tuple[Any, ...]:
        """Read rows at once."""
        return tuple(self._build(reader.rows(self.layout, count)))

    def skip_many(self, reader: Reader, count: int) -> None:
        """Skip rows at once."""
        reader.skip(self.least * count)


def number(layout: str) -> Row:
    """Codec of a single number.

    ``layout``: one format character of `struct`.
    """
    return Row(layout, lambda rows: list(chain.from_iterable(rows)), lambda value: (value,))


class _Text(Codec):
    """UTF-8 text up to its NUL; bytes that are not UTF-8 become U+FFFD."""

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
    """Consecutive items of different kinds.

    ``build``: from the items to the record; ``parts``: codecs of the items; ``flatten``: from the
    record to the items; a named tuple is its own items.
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
        """Skip the items."""
        for part in self._parts:
            part.skip(reader)

    def write(self, item: Any) -> bytes:
        """Write the items in their order."""
        values = self._flatten(item)
        return b''.join(part.write(value) for part, value in zip(self._parts, values))


class Columns(Codec):
    """Count, then that number of items of the first kind, of the second kind, and so on.

    Read as a tuple of columns.
    """

    least = _COUNT.size

    def __init__(self, *kinds: Codec) -> None:
        self._kinds = kinds
        self._least_row = sum(kind.least for kind in kinds)

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the number of rows, then that many items of each kind; one tuple for each kind."""
        count = reader.count(self._least_row)
        return tuple([kind.read_many(reader, count) for kind in self._kinds])

    def skip(self, reader: Reader) -> None:
        """Skip the columns."""
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
    """Count and that number of items of one kind."""

    least = _COUNT.size

    def __init__(self, kind: Codec) -> None:
        self.kind = kind

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the items."""
        return self.kind.read_many(reader, reader.count(self.kind.least))

    def skip(self, reader: Reader) -> None:
        """Skip the items."""
        self.kind.skip_many(reader, reader.count(self.kind.least))

    def write(self, item: Sequence[Any]) -> bytes:
        """Write the items."""
        return _COUNT.pack(len(item)) + b''.join(map(self.kind.write, item))


class SizedList(List):
    """Count, size in bytes of all items, and the items.

    Additions of a newer server after skipped items are skipped as well. Items that are read have a
    fixed layout and must fill the size: another size means another layout.
    """

    least = _COUNT_AND_SIZE.size

    def _head(self, reader: Reader) -> tuple[int, int]:
        """Number of items and their size in bytes; ProtocolError if the rest is too short.

        Also raised if the size is below that of so many of the smallest items.
        """
        count, size = reader.unpack(_COUNT_AND_SIZE)
        if count < 0 or not count * self.kind.least <= size <= reader.remaining_bytes:
            raise ProtocolError(
                f'a section of {count} items in {size} bytes, {reader.remaining_bytes} left'
            )
        return count, size

    def read(self, reader: Reader) -> tuple[Any, ...]:
        """Read the items; ProtocolError if they do not fill the size exactly."""
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
        """Write the items."""
        body = b''.join(map(self.kind.write, item))
        return _COUNT_AND_SIZE.pack(len(item), len(body)) + body


# FRAMEOFDATA, the message that carries marker positions, NatNet 2.6 to 4.3.
#
# Lengths are metres in the axes chosen in Motive. A position counts only where its item claims to
# be measured: see the flags of `LabeledMarker` and `RigidBody`.


OCCLUDED = 1 << 0
MEASURED = 1 << 1
"""Position solved from the cameras' rays (the point cloud)."""
MODEL_FILLED = 1 << 2
"""Position inferred from the asset's other markers."""
HAS_MODEL = 1 << 3
UNLABELED = 1 << 4
TRACKING_VALID = 1 << 0
RECORDING = 1 << 0
MODEL_LIST_CHANGED = 1 << 1
NOT_LIVE = 1 << 2
"""Motive plays a recording (Edit mode)."""
BITSTREAM_CHANGED = 1 << 3


class LabeledMarker(NamedTuple):
    """Entry of the labelled list, which holds every marker, strays too."""

    # ``asset id << 16 | member`` (member from 1) for a marker of an asset; arbitrary otherwise
    id: int
    position: Vec3  # m, (3,). Not measured if `params` has `OCCLUDED` or `MODEL_FILLED`.
    size: float  # Diameter, m
    params: int  # Flags above; NatNet 2 has the first three only
    residual: float | None = None  # Metres per ray; None before NatNet 3


class RigidBody(NamedTuple):
    """Pose of a body or bone; stale or zero unless `params` has `TRACKING_VALID`."""

    id: int
    position: Vec3
    orientation_xyzw: Quaternion
    mean_error: float
    params: int
    # Position, id and size of each marker of the body; only NatNet 2 sends these
    markers: tuple[tuple[Vec3, int, float], ...] = ()


@dataclass(frozen=True)
class Frame:
    """One frame of data."""

    number: int  # Frame number; starts again with the stream, loops in Edit mode
    timestamp: float  # Seconds since Motive, or the recording, started
    labeled_markers: tuple[LabeledMarker, ...] = ()
    software_latency: float = 0.0  # Seconds, before 3.0 only
    # Server clock ticks (3.0+); `mid_exposure` is 0 if the cameras have no such clock
    mid_exposure: int = 0
    data_received: int = 0
    transmitted: int = 0
    params: int = 0  # `RECORDING`, `MODEL_LIST_CHANGED`, `NOT_LIVE`, `BITSTREAM_CHANGED`
    # Written by a server and skipped by a client, each in its wire format
    rigid_bodies: tuple[RigidBody, ...] = ()
    # Names and positions, m; the set called ``all`` repeats the others
    marker_sets: tuple[tuple[str, tuple[Vec3, ...]], ...] = ()
    # Unlabelled positions, m (deprecated by OptiTrack; also in `labeled_markers`)
    other_markers: tuple[Vec3, ...] = ()
    skeletons: tuple[tuple[int, tuple[RigidBody, ...]], ...] = ()  # Ids and bones
    # Trained marker sets (4.1+): ids, bones and markers
    assets: tuple[tuple[int, tuple[RigidBody, ...], tuple[LabeledMarker, ...]], ...] = ()
    # Ids, and the samples of each channel
    force_plates: tuple[tuple[int, tuple[tuple[float, ...], ...]], ...] = ()
    devices: tuple[tuple[int, tuple[tuple[float, ...], ...]], ...] = ()


def decode_frame(payload: bytes, version: Version) -> Frame:
    """Labelled markers and times of a FRAMEOFDATA datagram, decoded to its end tag.

    ``payload``: bytes after the 4-byte header; ``version``: the server's bitstream version. All
    other sections are skipped: every count is checked, but not the numbers. Raises ProtocolError
    if the version is unknown, the bytes end early or late, a count does not fit, or a number that
    must be finite is not. Positions of occluded markers may be anything.
    """
    require_supported(version)
    layout = _layout(min(version, NEWEST_VERSION))
    reader = Reader(payload)
    frame = {'number': I32.read(reader)}
    for name, codec in layout.sections.items():
        if name == 'labeled_markers':
            frame[name] = codec.read(reader)
        else:
            codec.skip(reader)
    *values, tag = reader.unpack(layout.rest)
    frame.update(zip(layout.rest_names, values))
    if tag != 0 or reader.remaining_bytes:
        raise ProtocolError(
            f'frame {frame["number"]} does not end where it should '
            f'(tag {tag}, {reader.remaining_bytes} bytes left)'
        )
    _require_finite((frame['timestamp'], frame.get('software_latency', 0.0)), 'time')
    return Frame(**frame)


def encode_frame(frame: Frame, version: Version) -> bytes:
    """Payload of a FRAMEOFDATA message, without sections that the version does not have.

    Raises ProtocolError if the version is unknown; ValueError, struct.error if a value does not
    fit its field.
    """
    require_supported(version)
    layout = _layout(min(version, NEWEST_VERSION))
    sections = [codec.write(getattr(frame, name)) for name, codec in layout.sections.items()]
    values = [getattr(frame, name) for name in layout.rest_names]
    return b''.join((I32.write(frame.number), *sections, layout.rest.pack(*values, 0)))


class _Layout(NamedTuple):
    """Layout of a frame in one version: sections in order, then numbers, named as in `Frame`."""

    sections: dict[str, Codec]
    rest_names: tuple[str, ...]
    rest: Struct


@cache
def _layout(version: Version) -> _Layout:
    """Layout of a frame in a version, computed once; the version has to be supported."""
    since_3, since_4_1 = version >= (3, 0), version >= (4, 1)
    section = SizedList if since_4_1 else List
    body = _BODY_3 if since_3 else _BODY_2
    labeled = _LABELED_3 if since_3 else _LABELED_2
    analog = Record(_stepped_over, I32, List(List(F32)))
    sections: dict[str, Codec] = {
        'marker_sets': section(Record(_stepped_over, TEXT, List(VEC3))),
        'other_markers': section(VEC3),
        'rigid_bodies': section(body),
        'skeletons': section(Record(_stepped_over, I32, List(body))),
    }
    if since_4_1:
        sections['assets'] = section(Record(_stepped_over, I32, List(body), List(labeled)))
    sections['labeled_markers'] = section(labeled)
    if version >= (2, 9):
        sections['force_plates'] = section(analog)
    if version >= (2, 11):
        sections['devices'] = section(analog)
    formats = {} if since_3 else {'software_latency': 'f'}
    timecode = precise_time = '8x'
    formats['timestamp'] = timecode + ('d' if version >= (2, 7) else 'f')
    if since_3:
        formats |= {'mid_exposure': 'Q', 'data_received': 'Q', 'transmitted': 'Q'}
    formats['params'] = (precise_time if since_4_1 else '') + 'H'
    end_tag = 'i'
    return _Layout(sections, tuple(formats), Struct('<' + ''.join(formats.values()) + end_tag))


def _require_finite(values: Iterable[float], what: str) -> None:
    """Raise ProtocolError, which names `what`, if a value is not finite."""
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f'the {what} is not finite')


def _labeled(rows: list[tuple], *, has_residual: bool) -> list[LabeledMarker]:
    """Labelled markers of rows of numbers, in order.

    Raises ProtocolError if the position of a marker that is not occluded is not finite; the sum of
    all numbers shows whether any is not.
    """
    # The named tuple's own constructor would take as long as decoding the rest of the frame.
    make = tuple.__new__
    if has_residual:
        markers = [
            make(LabeledMarker, (label, (x, y, z), size, params, residual))
            for label, x, y, z, size, params, residual in rows
        ]
    else:
        markers = [
            make(LabeledMarker, (label, (x, y, z), size, params, None))
            for label, x, y, z, size, params in rows
        ]
    if not math.isfinite(sum(chain.from_iterable(rows))):
        for marker in markers:
            if not marker.params & OCCLUDED:
                _require_finite(marker.position, f'position of marker {marker.id}')
    return markers


def _flat_labeled_2(marker: LabeledMarker) -> tuple:
    """Numbers of a labelled marker in NatNet 2: id, position, size, flags."""
    return marker.id, *marker.position, marker.size, marker.params


def _flat_labeled_3(marker: LabeledMarker) -> tuple:
    """Numbers of a labelled marker from NatNet 3 on: those of 2, and the residual (or NaN)."""
    return *_flat_labeled_2(marker), math.nan if marker.residual is None else marker.residual


def _flat_body_3(body: RigidBody) -> tuple:
    """Numbers of a rigid body from NatNet 3 on: id, position, x, y, z, w, error, flags."""
    return body.id, *body.position, *body.orientation_xyzw, body.mean_error, body.params


def _parts_of_body_2(body: RigidBody) -> tuple:
    """Items of a rigid body of NatNet 2: id and pose, columns of markers, error and parameters."""
    columns = tuple(zip(*body.markers)) or ((), (), ())
    head = body.id, *body.position, *body.orientation_xyzw
    return head, columns, (body.mean_error, body.params)


_LABELED_2 = Row('i4fH', partial(_labeled, has_residual=False), _flat_labeled_2)
_LABELED_3 = Row('i4fHf', partial(_labeled, has_residual=True), _flat_labeled_3)
_BODY_2 = Record(
    _stepped_over,
    *(Row('i7f'), Columns(VEC3, I32, F32), Row('fH')),
    flatten=_parts_of_body_2,
)
_BODY_3 = Row('i8fH', flatten=_flat_body_3)


MARKER_SET, RIGID_BODY, SKELETON, FORCE_PLATE, DEVICE, CAMERA, ASSET = range(7)

_IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


class MarkerSetDescription(NamedTuple):
    """Marker set with the names of its markers."""

    name: str
    marker_names: tuple[str, ...]


class RigidBodyDescription(NamedTuple):
    """Description of a rigid body."""

    name: str
    id: int  # Id in the frames; the body's marker number m is the labelled marker ``id << 16 | m``
    parent_id: int = -1  # -1 for none
    # Pose relative to the parent, m and x, y, z, w (the rotation is sent since 4.2)
    offset: Vec3 = (0.0, 0.0, 0.0)
    offset_rotation: Quaternion = _IDENTITY
    marker_positions: tuple[Vec3, ...] = ()  # In the body's own axes, m (since 3.0)
    # Required active label of each marker, 0 for passive ones (since 3.0)
    marker_labels: tuple[int, ...] = ()
    marker_names: tuple[str, ...] = ()  # Since 4.0


class OtherDescription(NamedTuple):
    """Skeleton, force plate, device, camera or asset, of which only kind, name and id are kept."""

    kind: int  # The wire's type number, `SKELETON` to `ASSET`, or one unknown here
    name: str
    id: int | None = None  # None for cameras, which have none, and for unknown kinds


Description = MarkerSetDescription | RigidBodyDescription | OtherDescription


@dataclass(frozen=True)
class ModelDefinition:
    """Description of everything that the server streams, in its order."""

    descriptions: tuple[Description, ...] = ()

    @property
    def rigid_bodies(self) -> tuple[RigidBodyDescription, ...]:
        """Rigid bodies that are no part of a skeleton."""
        return tuple(d for d in self.descriptions if isinstance(d, RigidBodyDescription))

    @property
    def labelled_assets(self) -> dict[str, int]:
        """Ids by name of rigid bodies and (4.1+) trained marker sets; a rigid body wins a name."""
        named = {
            d.name: d.id
            for d in self.descriptions
            if isinstance(d, OtherDescription) and d.kind == ASSET and d.id is not None
        }
        return named | {body.name: body.id for body in self.rigid_bodies}


def decode_model_definition(payload: bytes, version: Version) -> ModelDefinition:
    """Content of the payload of a MODELDEF datagram.

    Bytes after the last description, and from 4.1 on after each, are skipped: newer servers put
    new fields there. Raises ProtocolError if the version is unknown, the bytes end early or a
    count does not fit.
    """
    require_supported(version)
    reader = Reader(payload)
    count = reader.count(8 if version >= (4, 1) else 4)
    return ModelDefinition(tuple([_read(reader, version) for _ in range(count)]))


def encode_model_definition(definition: ModelDefinition, version: Version) -> bytes:
    """Payload of a MODELDEF message.

    Raises ProtocolError if the version is unknown; ValueError if a name has a NUL or over 255
    bytes, or a description is of a kind whose details are not kept.
    """
    require_supported(version)
    descriptions = [_write(description, version) for description in definition.descriptions]
    return I32.write(len(descriptions)) + b''.join(descriptions)


def _read(reader: Reader, version: Version) -> Description:
    """Description at the reader's position.

    Raises ProtocolError for an unknown kind before 4.1.
    """
    kind = I32.read(reader)
    codec = _codecs(min(version, NEWEST_VERSION)).get(kind)
    if version < (4, 1):
        if codec is None:
            # Without a byte size there is no way to find the next description.
            raise ProtocolError(f'a description of the unknown kind {kind}')
        return codec.read(reader)
    with reader.bounded(I32.read(reader)):
        return OtherDescription(kind, '') if codec is None else codec.read(reader)


def _write(description: Description, version: Version) -> bytes:
    """Bytes of a description in one bitstream version; ValueError if only its name was kept."""
    kind = _KINDS.get(type(description))
    if kind is None:
        raise ValueError(f'only the name of {description.name!r} is kept: it cannot be encoded')
    body = _codecs(min(version, NEWEST_VERSION))[kind].write(description)
    size = I32.write(len(body)) if version >= (4, 1) else b''
    return I32.write(kind) + size + body


_KINDS: dict[type, int] = {
    MarkerSetDescription: MARKER_SET,
    RigidBodyDescription: RIGID_BODY,
}


@cache
def _codecs(version: Version) -> dict[int, Codec]:
    """Codec of each kind of description in a version, by the wire's type number."""
    body = _rigid_body(version)
    codecs: dict[int, Codec] = {
        MARKER_SET: Record(MarkerSetDescription, TEXT, List(TEXT)),
        RIGID_BODY: body,
        SKELETON: Record(
            lambda name, skeleton_id, _: OtherDescription(SKELETON, name, skeleton_id),
            *(TEXT, I32, List(body)),
        ),
    }
    if version >= (3, 0):
        plate = Row(f'{2 + 3 + 144 + 12}f2i')
        marker = Record(_stepped_over, TEXT, Row('i4fH'))
        codecs |= {
            FORCE_PLATE: Record(
                lambda plate_id, serial, *_: OtherDescription(FORCE_PLATE, serial, plate_id),
                *(I32, TEXT, plate, List(TEXT)),
            ),
            DEVICE: Record(
                lambda device_id, name, *_: OtherDescription(DEVICE, name, device_id),
                *(I32, TEXT, TEXT, Row('2i'), List(TEXT)),
            ),
            CAMERA: Record(lambda name, _pose: OtherDescription(CAMERA, name), TEXT, Row('7f')),
            ASSET: Record(
                lambda name, type_and_id, *_: OtherDescription(ASSET, name, type_and_id[1]),
                *(TEXT, Row('2i'), List(body), List(marker)),
            ),
        }
    return codecs


def _rigid_body(version: Version) -> Record:
    """Codec of a rigid body's description in a version, which added fields one after another."""
    has_rotation, has_markers = version >= (4, 2), version >= (3, 0)
    columns: list[Codec] = [VEC3, I32]
    if version >= (4, 0):
        columns.append(TEXT)

    def build(name: str, ids_and_offset: tuple, *fields: tuple) -> RigidBodyDescription:
        rotation = fields[0] if has_rotation else _IDENTITY
        markers = fields[-1] if has_markers else ()
        body_id, parent_id, *offset = ids_and_offset
        return RigidBodyDescription(name, body_id, parent_id, tuple(offset), rotation, *markers)

    def flatten(body: RigidBodyDescription) -> list:
        rotation = [body.offset_rotation] if has_rotation else []
        markers = [(body.marker_positions, body.marker_labels, body.marker_names)]
        return [body.name, (body.id, body.parent_id, *body.offset), *rotation, *markers]

    parts: list[Codec] = [TEXT, Row('2i3f')]
    if has_rotation:
        parts.append(QUATERNION)
    if has_markers:
        parts.append(Columns(*columns))
    return Record(build, *parts, flatten=flatten)


DEFAULT_COMMAND_PORT = 1510
DEFAULT_DATA_PORT = 1511
DEFAULT_MULTICAST_GROUP = '239.255.42.99'
MAX_PAYLOAD_BYTES = 65503

_HEADER = Struct('<2H')
_SENDER = Struct('<256s4B4B')
_CONNECTION = Struct('<QHB4B')
_OPTIONS = Struct('<B4B')
_CLOCK = number('Q')
_TWO_CLOCKS = Row('2Q')


class MessageId(IntEnum):
    """Kind of a message: the first two bytes of a datagram."""

    CONNECT = 0
    SERVERINFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    REQUEST_FRAMEOFDATA = 6
    FRAMEOFDATA = 7
    MESSAGESTRING = 8
    DISCONNECT = 9
    KEEPALIVE = 10
    DISCONNECT_BY_TIMEOUT = 11
    ECHOREQUEST = 12
    ECHORESPONSE = 13
    DISCOVERY = 14
    UNRECOGNIZED_REQUEST = 100


@dataclass(frozen=True)
class Connection:
    """Connection settings of a server of NatNet 3.0 or newer."""

    clock_frequency: int  # Ticks per second of the three stamps of a frame
    data_port: int
    is_multicast: bool
    multicast_group: str


@dataclass(frozen=True)
class ServerInfo:
    """Answer to CONNECT."""

    name: str
    app_version: tuple[int, int, int, int]
    natnet_version: Version  # Bitstream version that determines the decoding
    connection: Connection | None = None  # None before NatNet 3.0


@dataclass(frozen=True)
class Response:
    """Answer to a REQUEST; its meaning depends on the request."""

    payload: bytes

    @property
    def code(self) -> int | None:
        """Answer as an integer, 0 for success; None if it is a text."""
        return I32.read(Reader(self.payload)) if len(self.payload) == 4 else None

    @property
    def value(self) -> float | None:
        """Answer as a number, such as the frame rate; None if it is a text."""
        return F32.read(Reader(self.payload)) if len(self.payload) == 4 else None

    @property
    def text(self) -> str:
        """Answer as a text, such as ``Bitstream,4.1``."""
        return _text(self.payload)


@dataclass(frozen=True)
class MessageString:
    """Line of text from the server."""

    text: str


@dataclass(frozen=True)
class EchoResponse:
    """Client's clock as sent, and the server's ticks at its arrival."""

    client_clock: int
    server_clock: int


@dataclass(frozen=True)
class Notice:
    """Message without content: UNRECOGNIZED_REQUEST, or a disconnection by the server."""

    id: MessageId


Message = ServerInfo | Response | ModelDefinition | Frame | MessageString | EchoResponse | Notice


@dataclass(frozen=True)
class ClientRequest:
    """Request of a client."""

    id: int  # A `MessageId`, or an unknown number
    text: str = ''  # Command of a REQUEST
    # Bitstream that a CONNECT requests; None for the server's own
    wanted_version: Version | None = None
    clock: int = 0  # Client's clock in an ECHOREQUEST


def split_datagram(datagram: bytes) -> tuple[int, bytes]:
    """Message id and payload of a datagram; bytes after the payload are ignored.

    Raises ProtocolError if the datagram is shorter than its header states.
    """
    if len(datagram) < _HEADER.size:
        raise ProtocolError(f'a datagram of {len(datagram)} bytes has no header')
    message_id, size = _HEADER.unpack_from(datagram)
    if len(datagram) < _HEADER.size + size:
        raise ProtocolError(
            f'a datagram of {len(datagram)} bytes that should have {_HEADER.size + size}'
        )
    return message_id, datagram[_HEADER.size : _HEADER.size + size]


def join_datagram(message_id: int, payload: bytes = b'') -> bytes:
    """Datagram of a header and a payload.

    ``message_id``: one of `MessageId`, in 16 bits. The header is message_id and the payload's
    length.

    Raises ValueError if the payload is longer than a datagram can be.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f'a payload of {len(payload)} bytes is over {MAX_PAYLOAD_BYTES}')
    return _HEADER.pack(message_id, len(payload)) + payload


def decode_message(datagram: bytes, version: Version | None) -> Message:
    """Message of a server; a frame as by `decode_frame`.

    ``datagram``: as received; ``version``: the server's bitstream version, or None while it is
    unknown, when frames and model definitions cannot be read. Raises ProtocolError if the datagram
    is not a whole, valid message of a server.
    """
    message_id, payload = split_datagram(datagram)
    match message_id:
        case MessageId.FRAMEOFDATA:
            return decode_frame(payload, _known(version))
        case MessageId.SERVERINFO:
            return _decode_server_info(payload)
        case MessageId.MODELDEF:
            return decode_model_definition(payload, _known(version))
        case MessageId.RESPONSE:
            return Response(payload)
        case MessageId.MESSAGESTRING:
            return MessageString(_text(payload))
        case MessageId.ECHORESPONSE:
            return EchoResponse(*_TWO_CLOCKS.read(Reader(payload)))
        case (
            MessageId.UNRECOGNIZED_REQUEST | MessageId.DISCONNECT | MessageId.DISCONNECT_BY_TIMEOUT
        ):
            return Notice(MessageId(message_id))
    raise ProtocolError(f'message {message_id} is none that a server sends')


def encode_message(message: Message, version: Version) -> bytes:
    """Datagram of a server's message, with header.

    Raises ProtocolError if the version of a frame or model definition is unknown; ValueError,
    struct.error if a value does not fit its field.
    """
    if isinstance(message, Frame):
        return join_datagram(MessageId.FRAMEOFDATA, encode_frame(message, version))
    if isinstance(message, ServerInfo):
        return join_datagram(MessageId.SERVERINFO, _encode_server_info(message))
    if isinstance(message, ModelDefinition):
        return join_datagram(MessageId.MODELDEF, encode_model_definition(message, version))
    if isinstance(message, Response):
        return join_datagram(MessageId.RESPONSE, message.payload)
    if isinstance(message, MessageString):
        return join_datagram(MessageId.MESSAGESTRING, message.text.encode() + b'\0')
    if isinstance(message, EchoResponse):
        clocks = _TWO_CLOCKS.write((message.client_clock, message.server_clock))
        return join_datagram(MessageId.ECHORESPONSE, clocks)
    return join_datagram(message.id)


def decode_request(datagram: bytes) -> ClientRequest:
    """Request in a client's datagram.

    The length in its header is ignored, as clients get it wrong.

    Raises ProtocolError if there is no header, or an ECHOREQUEST has no clock.
    """
    if len(datagram) < _HEADER.size:
        raise ProtocolError(f'a datagram of {len(datagram)} bytes has no header')
    (message_id, _size), payload = _HEADER.unpack_from(datagram), datagram[_HEADER.size :]
    if message_id == MessageId.CONNECT:
        return ClientRequest(message_id, wanted_version=_wanted_version(payload))
    if message_id == MessageId.REQUEST:
        return ClientRequest(message_id, text=_text(payload))
    if message_id == MessageId.ECHOREQUEST:
        return ClientRequest(message_id, clock=_CLOCK.read(Reader(payload)))
    return ClientRequest(message_id)


def encode_connect_request(name: str, wanted_version: Version | None = None) -> bytes:
    """CONNECT in its full form, which servers of every version accept.

    ``name``: name of this program; ``wanted_version``: bitstream for this client (unicast, servers
    from 4.0); None for the server's own.
    """
    major, minor = wanted_version or (0, 0)
    sender = _SENDER.pack(name.encode()[:255], 1, 0, 0, 0, *NEWEST_VERSION, 0, 0)
    # Two bytes of padding, as OptiTrack's own client sends them.
    return join_datagram(
        MessageId.CONNECT, sender + _OPTIONS.pack(0, major, minor, 0, 0) + b'\0\0'
    )


def encode_command_request(command: str) -> bytes:
    """REQUEST with a command such as ``FrameRate`` or ``Bitstream,4.1``.

    Raises ValueError if it has a NUL or over 255 bytes.
    """
    return join_datagram(MessageId.REQUEST, TEXT.write(command))


def encode_echo_request(clock: int) -> bytes:
    """ECHOREQUEST with the client's clock, an unsigned 64-bit number; struct.error for another."""
    return join_datagram(MessageId.ECHOREQUEST, _CLOCK.write(clock))


def parse_version(text: str) -> Version:
    """Version in a text such as ``4.1`` (or ``4.1.0.0``).

    Raises ValueError if the text is not two or more whole numbers with dots between.
    """
    parts = text.split('.')
    if len(parts) < 2 or not all(part.isdecimal() and part.isascii() for part in parts):
        raise ValueError(f'{text!r} is no NatNet version such as 4.1')
    return int(parts[0]), int(parts[1])


def format_version(version: Version) -> str:
    """Version as text, such as ``4.1``."""
    return f'{version[0]}.{version[1]}'


def _known(version: Version | None) -> Version:
    """Return the bitstream version; ProtocolError if it is None."""
    if version is None:
        raise ProtocolError('the bitstream version is not known yet')
    return version


def _text(payload: bytes) -> str:
    """UTF-8 text up to the first NUL, or to the end; invalid bytes become U+FFFD."""
    return payload.partition(b'\0')[0].decode('utf-8', 'replace')


def _wanted_version(payload: bytes) -> Version | None:
    """Wanted bitstream in the full form of CONNECT; None in shorter forms, or for 0.0."""
    if len(payload) < _SENDER.size + _OPTIONS.size:
        return None
    _subscribed, major, minor, _build, _revision = _OPTIONS.unpack_from(payload, _SENDER.size)
    return (major, minor) if major else None


def _decode_server_info(payload: bytes) -> ServerInfo:
    """Decode the answer to CONNECT; its connection is None before NatNet 3.0.

    Raises ProtocolError if the payload is too short; further bytes are ignored.
    """
    reader = Reader(payload)
    name, *versions = reader.unpack(_SENDER)
    app_version, natnet_version = tuple(versions[:4]), (versions[4], versions[5])
    connection = None
    if natnet_version >= (3, 0):
        frequency, data_port, multicast, *group = reader.unpack(_CONNECTION)
        connection = Connection(frequency, data_port, bool(multicast), '.'.join(map(str, group)))
    return ServerInfo(_text(name), app_version, natnet_version, connection)  # type: ignore[arg-type]


def _encode_server_info(info: ServerInfo) -> bytes:
    """Encode an answer to CONNECT; ValueError if one of 3.0 or later lacks its connection."""
    name = info.name.encode()[:255]
    payload = _SENDER.pack(name, *info.app_version, *info.natnet_version, 0, 0)
    if info.natnet_version < (3, 0):
        return payload
    if info.connection is None:
        raise ValueError('a server of NatNet 3.0 or newer tells how it streams')
    group = (int(part) for part in info.connection.multicast_group.split('.'))
    return payload + _CONNECTION.pack(
        info.connection.clock_frequency,
        info.connection.data_port,
        info.connection.is_multicast,
        *group,
    )
