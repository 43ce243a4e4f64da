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

from remaster_ros.sensors.optitrack.protocol.codec import (
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
)
from remaster_ros.sensors.optitrack.protocol.wire import (
    NEWEST_VERSION,
    ProtocolError,
    Quaternion,
    Reader,
    Vec3,
    Version,
    require_supported,
)

OCCLUDED = 1 << 0
MEASURED = 1 << 1
"""Solved from the cameras' rays (the point cloud)."""
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
    """One entry of the labelled list, which holds every marker, the strays too.

    Attributes
    ----------
    id
        ``asset id << 16 | member`` (member from 1) for a marker of an asset; arbitrary otherwise.
    position
        m, (3,). Not measured where `params` has `OCCLUDED` or `MODEL_FILLED`.
    size
        Diameter, m.
    params
        The flags above; NatNet 2 has the first three only.
    residual
        Metres per ray; None before NatNet 3.
    """

    id: int
    position: Vec3
    size: float
    params: int
    residual: float | None = None


class BodyMarker(NamedTuple):
    """A marker inside a rigid body; only NatNet 2 sends these."""

    position: Vec3
    id: int
    size: float


class RigidBody(NamedTuple):
    """Pose of a body or bone; stale or zero unless `params` has `TRACKING_VALID`."""

    id: int
    position: Vec3
    orientation_xyzw: Quaternion
    mean_error: float
    params: int
    markers: tuple[BodyMarker, ...] = ()


class MarkerSet(NamedTuple):
    """A named list of positions, m; the one called ``all`` repeats the others. No flags."""

    name: str
    positions: tuple[Vec3, ...]


class Skeleton(NamedTuple):
    """Bones of one skeleton."""

    id: int
    bodies: tuple[RigidBody, ...]


class Asset(NamedTuple):
    """A trained marker set (4.1+): bones and markers."""

    id: int
    bodies: tuple[RigidBody, ...]
    markers: tuple[LabeledMarker, ...]


class AnalogDevice(NamedTuple):
    """Samples of a force plate or another analog device, one tuple a channel."""

    id: int
    channels: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Frame:
    """One frame of data.

    Attributes
    ----------
    number
        Frame number; starts again with the stream, loops in Edit mode.
    timestamp
        Seconds since Motive, or the recording, started.
    other_markers
        Unlabelled positions, m (deprecated by OptiTrack; also in `labeled_markers`).
    mid_exposure, data_received, transmitted
        Server clock ticks (3.0+); `mid_exposure` is 0 where the cameras have no such clock.
    precision_seconds, precision_fraction
        PTP time (4.1+), else 0.
    software_latency
        Seconds, before 3.0 only.
    params
        `RECORDING`, `MODEL_LIST_CHANGED`, `NOT_LIVE`, `BITSTREAM_CHANGED`.
    """

    number: int
    timestamp: float
    labeled_markers: tuple[LabeledMarker, ...] = ()
    rigid_bodies: tuple[RigidBody, ...] = ()
    marker_sets: tuple[MarkerSet, ...] = ()
    other_markers: tuple[Vec3, ...] = ()
    skeletons: tuple[Skeleton, ...] = ()
    assets: tuple[Asset, ...] = ()
    force_plates: tuple[AnalogDevice, ...] = ()
    devices: tuple[AnalogDevice, ...] = ()
    software_latency: float = 0.0
    timecode: int = 0
    timecode_sub: int = 0
    mid_exposure: int = 0
    data_received: int = 0
    transmitted: int = 0
    precision_seconds: int = 0
    precision_fraction: int = 0
    params: int = 0


def decode_frame(payload: bytes, version: Version, *, markers_only: bool = False) -> Frame:
    """Decode the payload of a FRAMEOFDATA datagram, to its end tag.

    Parameters
    ----------
    payload
        The bytes behind the 4-byte header.
    version
        The server's bitstream version.
    markers_only
        Step over everything but the labelled markers and the times: every count is checked, but
        what is stepped over is left out and its numbers are not looked at. Half the work.

    Raises
    ------
    ProtocolError
        If the version is unknown, the bytes end early or late, a count does not fit, or a number
        that must be finite is not. Positions of occluded markers and untracked bodies claim
        nothing and may be anything.
    """
    require_supported(version)
    layout = _layout(min(version, NEWEST_VERSION))
    reader = Reader(payload)
    frame = {'number': I32.read(reader)}
    for name, codec in layout.sections.items():
        if markers_only and name != 'labeled_markers':
            codec.skip(reader)
        else:
            frame[name] = codec.read(reader)
    *rest, tag = reader.unpack(layout.rest)
    frame.update(zip(layout.rest_names, rest))
    if tag != 0 or reader.left:
        raise ProtocolError(
            f'frame {frame["number"]} does not end where it should '
            f'(tag {tag}, {reader.left} bytes left)'
        )
    _require_finite((frame['timestamp'], frame.get('software_latency', 0.0)), 'time')
    return Frame(**frame)


def encode_frame(frame: Frame, version: Version) -> bytes:
    """Encode the payload of a FRAMEOFDATA message; what the version does not have is left out.

    Raises
    ------
    ProtocolError
        If the version is unknown.
    ValueError, struct.error
        If a value does not fit its field.
    """
    require_supported(version)
    layout = _layout(min(version, NEWEST_VERSION))
    sections = [codec.write(getattr(frame, name)) for name, codec in layout.sections.items()]
    rest = [getattr(frame, name) for name in layout.rest_names]
    return b''.join((I32.write(frame.number), *sections, layout.rest.pack(*rest, 0)))


class _Layout(NamedTuple):
    """A frame of one version: its sections in order, then numbers; all named as in `Frame`."""

    sections: dict[str, Codec]
    rest_names: tuple[str, ...]
    rest: Struct


@cache
def _layout(version: Version) -> _Layout:
    """Describe the frame of a version."""
    since_3, since_4_1 = version >= (3, 0), version >= (4, 1)
    section = SizedList if since_4_1 else List
    body = _BODY_3 if since_3 else _BODY_2
    labeled = _LABELED_3 if since_3 else _LABELED_2
    analog = Record(AnalogDevice, I32, List(List(F32)))
    sections: dict[str, Codec] = {
        'marker_sets': section(Record(MarkerSet, TEXT, List(_POSITION))),
        'other_markers': section(_POSITION),
        'rigid_bodies': section(body),
        'skeletons': section(Record(Skeleton, I32, List(body))),
    }
    if since_4_1:
        sections['assets'] = section(Record(Asset, I32, List(body), List(labeled)))
    sections['labeled_markers'] = section(labeled)
    if version >= (2, 9):
        sections['force_plates'] = section(analog)
    if version >= (2, 11):
        sections['devices'] = section(analog)
    rest = {} if since_3 else {'software_latency': 'f'}
    rest |= {'timecode': 'I', 'timecode_sub': 'I', 'timestamp': 'd' if version >= (2, 7) else 'f'}
    if since_3:
        rest |= {'mid_exposure': 'Q', 'data_received': 'Q', 'transmitted': 'Q'}
    if since_4_1:
        rest |= {'precision_seconds': 'I', 'precision_fraction': 'I'}
    rest['params'] = 'H'
    end_tag = 'i'
    return _Layout(sections, tuple(rest), Struct('<' + ''.join(rest.values()) + end_tag))


def _require_finite(values: Iterable[float], what: str) -> None:
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f'the {what} is not finite')


def _positions(rows: list[tuple]) -> list[tuple]:
    _require_finite(chain.from_iterable(rows), 'position of a marker')
    return rows


def _labeled(rows: list[tuple], *, has_residual: bool) -> list[LabeledMarker]:
    """Build the labelled markers; the sum of all numbers shows whether one is not finite."""
    # The named tuple's own constructor would take as long as all the rest of a frame.
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
    return marker.id, *marker.position, marker.size, marker.params


def _flat_labeled_3(marker: LabeledMarker) -> tuple:
    return *_flat_labeled_2(marker), math.nan if marker.residual is None else marker.residual


def _bodies_3(rows: list[tuple]) -> list[RigidBody]:
    bodies = [RigidBody(row[0], row[1:4], row[4:8], row[8], row[9]) for row in rows]
    for body in bodies:
        _require_finite_if_tracked(body)
    return bodies


def _flat_body_3(body: RigidBody) -> tuple:
    return body.id, *body.position, *body.orientation_xyzw, body.mean_error, body.params


def _body_2(head: tuple, columns: tuple[tuple, ...], end: tuple) -> RigidBody:
    markers = tuple(map(BodyMarker, *columns))
    mean_error, params = end
    body = RigidBody(head[0], head[1:4], head[4:8], mean_error, params, markers)
    _require_finite_if_tracked(body)
    return body


def _parts_of_body_2(body: RigidBody) -> tuple:
    columns = tuple(zip(*body.markers)) or ((), (), ())
    head = body.id, *body.position, *body.orientation_xyzw
    return head, columns, (body.mean_error, body.params)


def _require_finite_if_tracked(body: RigidBody) -> None:
    if not body.params & TRACKING_VALID:
        return
    _require_finite(body.position + body.orientation_xyzw, f'pose of rigid body {body.id}')
    inside = chain.from_iterable([marker.position for marker in body.markers])
    _require_finite(inside, f'position of a marker of body {body.id}')


_POSITION = Row('3f', _positions)
_LABELED_2 = Row('i4fH', partial(_labeled, has_residual=False), _flat_labeled_2)
_LABELED_3 = Row('i4fHf', partial(_labeled, has_residual=True), _flat_labeled_3)
_BODY_2 = Record(_body_2, Row('i7f'), Columns(VEC3, I32, F32), Row('fH'), flatten=_parts_of_body_2)
_BODY_3 = Row('i8fH', _bodies_3, _flat_body_3)
