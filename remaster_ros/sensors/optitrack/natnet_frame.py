# SPDX-License-Identifier: Apache-2.0
"""FRAMEOFDATA, the message that carries marker positions, NatNet 2.6 to 4.3.

Lengths are metres in the axes chosen in Motive. A position counts only where its item claims to
be measured: see the flags of `LabeledMarker` and `RigidBody`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain
from struct import Struct
from typing import NamedTuple

from remaster_ros.sensors.optitrack.natnet_bytes import (
    NEWEST_VERSION,
    ProtocolError,
    Quaternion,
    Reader,
    Vec3,
    Version,
    require_supported,
)
from remaster_ros.sensors.optitrack.natnet_codecs import (
    F32,
    I32,
    TEXT,
    VEC3,
    Codec,
    Columns,
    List,
    Record,
    Row,
    SizedList,
    stepped_over,
)

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
    """Pose of a rigid body or bone; stale or zero unless `params` has `TRACKING_VALID`."""

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
    analog = Record(stepped_over, I32, List(List(F32)))
    sections: dict[str, Codec] = {
        'marker_sets': section(Record(stepped_over, TEXT, List(VEC3))),
        'other_markers': section(VEC3),
        'rigid_bodies': section(body),
        'skeletons': section(Record(stepped_over, I32, List(body))),
    }
    if since_4_1:
        sections['assets'] = section(Record(stepped_over, I32, List(body), List(labeled)))
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

    ``has_residual``: whether a row ends with the marker's residual; else the residual is None.

    Raises ProtocolError if the position of a marker that is not occluded is not finite.
    Positions are looked at singly only if the sum of all numbers is not finite.
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
    """Numbers of a rigid body from NatNet 3 on.

    Id, position, orientation as a quaternion (x, y, z, w), mean error, flags.
    """
    return body.id, *body.position, *body.orientation_xyzw, body.mean_error, body.params


def _parts_of_body_2(body: RigidBody) -> tuple:
    """Items of a rigid body of NatNet 2: id and pose, columns of markers, error and parameters."""
    columns = tuple(zip(*body.markers)) or ((), (), ())
    head = body.id, *body.position, *body.orientation_xyzw
    return head, columns, (body.mean_error, body.params)


_LABELED_2 = Row('i4fH', partial(_labeled, has_residual=False), _flat_labeled_2)
_LABELED_3 = Row('i4fHf', partial(_labeled, has_residual=True), _flat_labeled_3)
_BODY_2 = Record(
    stepped_over,
    *(Row('i7f'), Columns(VEC3, I32, F32), Row('fH')),
    flatten=_parts_of_body_2,
)
_BODY_3 = Row('i8fH', flatten=_flat_body_3)
