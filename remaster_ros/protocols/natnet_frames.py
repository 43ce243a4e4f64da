"""FRAMEOFDATA, the message that carries marker positions: decode and encode, NatNet 2.6 to 4.3.

Lengths are metres in the axes chosen in Motive. A position counts only where its item claims to
be measured: see the flags of `LabeledMarker` and `RigidBody`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from struct import Struct
from typing import NamedTuple

from remaster_ros.protocols import natnet_wire as wire
from remaster_ros.protocols.natnet_wire import (
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

_LABELED_2 = Struct('<i4fH')
_LABELED_3 = Struct('<i4fHf')
_BODY_2 = Struct('<i7f')
_BODY_3 = Struct('<i8fH')
_BODY_2_END = Struct('<fH')
_BODY_MARKER_BYTES = 20
_LATENCY = wire.F32
_TIMECODE_F32 = Struct('<2If')
_TIMECODE_F64 = Struct('<2Id')
_STAMPS = Struct('<3Q')
_PRECISION = Struct('<2I')
_END = Struct('<Hi')


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
        The flags above; NatNet 2 knows the first three only.
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


def decode_frame(payload: bytes, version: Version) -> Frame:
    """Decode the payload of a FRAMEOFDATA datagram, to its end tag.

    Parameters
    ----------
    payload
        The bytes behind the 4-byte header.
    version
        The server's bitstream version.

    Raises
    ------
    ProtocolError
        If the version is unknown, the bytes end early or late, a count does not fit, or a number
        that must be finite is not. Positions of occluded markers and untracked bodies claim
        nothing and may be anything.
    """
    require_supported(version)
    reader = Reader(payload)
    number = reader.integer()
    marker_sets = reader.section(version, _read_marker_set, 5)
    other_markers = reader.row_section(version, wire.VEC3)
    if version >= (3, 0):
        bodies = tuple(_body(row) for row in reader.row_section(version, _BODY_3))
    else:
        bodies = reader.items(_read_body_2, _BODY_2.size + 10)
    skeletons = reader.section(version, lambda r: _read_skeleton(r, version), 8)
    assets = reader.section(version, _read_asset, 12) if version >= (4, 1) else ()
    labeled_layout = _LABELED_3 if version >= (3, 0) else _LABELED_2
    labeled = _labeled(reader.row_section(version, labeled_layout), version)
    force_plates = reader.section(version, _read_analog, 8) if version >= (2, 9) else ()
    devices = reader.section(version, _read_analog, 8) if version >= (2, 11) else ()

    latency = reader.unpack(_LATENCY)[0] if version < (3, 0) else 0.0
    timecode = _TIMECODE_F64 if version >= (2, 7) else _TIMECODE_F32
    timecode_main, timecode_sub, timestamp = reader.unpack(timecode)
    stamps = reader.unpack(_STAMPS) if version >= (3, 0) else (0, 0, 0)
    precision = reader.unpack(_PRECISION) if version >= (4, 1) else (0, 0)
    params, tag = reader.unpack(_END)
    if tag != 0 or reader.left:
        raise ProtocolError(
            f'frame {number} does not end where it should (tag {tag}, {reader.left} bytes left)'
        )
    _require_finite((timestamp, latency), 'time')
    _require_finite(chain.from_iterable(other_markers), 'position of a marker')
    in_sets = chain.from_iterable([marker_set.positions for marker_set in marker_sets])
    _require_finite(chain.from_iterable(in_sets), 'position of a marker')
    _require_tracked_bodies_finite(bodies)
    return Frame(
        number=number,
        timestamp=timestamp,
        labeled_markers=labeled,
        rigid_bodies=bodies,
        marker_sets=marker_sets,
        other_markers=tuple(other_markers),
        skeletons=skeletons,
        assets=assets,
        force_plates=force_plates,
        devices=devices,
        software_latency=latency,
        timecode=timecode_main,
        timecode_sub=timecode_sub,
        mid_exposure=stamps[0],
        data_received=stamps[1],
        transmitted=stamps[2],
        precision_seconds=precision[0],
        precision_fraction=precision[1],
        params=params,
    )


def encode_frame(frame: Frame, version: Version) -> bytes:
    """Encode the payload of a FRAMEOFDATA message; what the version does not know is left out.

    Raises
    ------
    ProtocolError
        If the version is unknown.
    ValueError, struct.error
        If a value does not fit its field.
    """
    require_supported(version)
    parts = [
        wire.I32.pack(frame.number),
        wire.section(version, map(_write_marker_set, frame.marker_sets)),
        wire.section(version, (wire.VEC3.pack(*p) for p in frame.other_markers)),
        wire.section(version, (_write_body(b, version) for b in frame.rigid_bodies)),
        wire.section(version, (_write_skeleton(s, version) for s in frame.skeletons)),
    ]
    if version >= (4, 1):
        parts.append(wire.section(version, (_write_asset(a, version) for a in frame.assets)))
    labeled = (_write_labeled(m, version) for m in frame.labeled_markers)
    parts.append(wire.section(version, labeled))
    if version >= (2, 9):
        parts.append(wire.section(version, map(_write_analog, frame.force_plates)))
    if version >= (2, 11):
        parts.append(wire.section(version, map(_write_analog, frame.devices)))
    if version < (3, 0):
        parts.append(_LATENCY.pack(frame.software_latency))
    timecode = _TIMECODE_F64 if version >= (2, 7) else _TIMECODE_F32
    parts.append(timecode.pack(frame.timecode, frame.timecode_sub, frame.timestamp))
    if version >= (3, 0):
        parts.append(_STAMPS.pack(frame.mid_exposure, frame.data_received, frame.transmitted))
    if version >= (4, 1):
        parts.append(_PRECISION.pack(frame.precision_seconds, frame.precision_fraction))
    parts.append(_END.pack(frame.params, 0))
    return b''.join(parts)


def _labeled(rows: list[tuple], version: Version) -> tuple[LabeledMarker, ...]:
    """Build the labelled markers; one sum tells whether any number needs a closer look."""
    # Past the named tuple's own constructor, which takes as long as all the rest of a frame.
    make = tuple.__new__
    if version >= (3, 0):
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
    return tuple(markers)


def _require_finite(values: Iterable[float], what: str) -> None:
    # A sum of f32 values cannot overflow a double; an infinity or NaN among them always shows.
    if not math.isfinite(sum(values)):
        raise ProtocolError(f'the {what} is not finite')


def _require_tracked_bodies_finite(bodies: Iterable[RigidBody]) -> None:
    for body in bodies:
        if body.params & TRACKING_VALID:
            _require_finite(body.position + body.orientation_xyzw, f'pose of rigid body {body.id}')


def _read_marker_set(reader: Reader) -> MarkerSet:
    name = reader.text()
    return MarkerSet(name, tuple(reader.rows(wire.VEC3, reader.count(wire.VEC3.size))))  # type: ignore[arg-type]


def _write_marker_set(marker_set: MarkerSet) -> bytes:
    positions = wire.items(wire.VEC3.pack(*p) for p in marker_set.positions)
    return wire.text(marker_set.name) + positions


def _body(row: tuple) -> RigidBody:
    return RigidBody(row[0], row[1:4], row[4:8], row[8], row[9])


def _read_body_2(reader: Reader) -> RigidBody:
    body_id, x, y, z, *orientation = reader.unpack(_BODY_2)
    count = reader.count(_BODY_MARKER_BYTES)
    positions = reader.rows(wire.VEC3, count)
    ids = reader.numbers('i', count)
    sizes = reader.numbers('f', count)
    mean_error, params = reader.unpack(_BODY_2_END)
    markers = tuple(
        [tuple.__new__(BodyMarker, marker) for marker in zip(positions, ids, sizes, strict=True)]
    )
    if params & TRACKING_VALID:
        _require_finite(chain.from_iterable(positions), f'position of a marker of body {body_id}')
    return RigidBody(body_id, (x, y, z), tuple(orientation), mean_error, params, markers)  # type: ignore[arg-type]


def _write_body(body: RigidBody, version: Version) -> bytes:
    if version >= (3, 0):
        return _BODY_3.pack(
            body.id, *body.position, *body.orientation_xyzw, body.mean_error, body.params
        )
    return b''.join(
        (
            _BODY_2.pack(body.id, *body.position, *body.orientation_xyzw),
            wire.items(wire.VEC3.pack(*marker.position) for marker in body.markers),
            *(wire.I32.pack(marker.id) for marker in body.markers),
            *(wire.F32.pack(marker.size) for marker in body.markers),
            _BODY_2_END.pack(body.mean_error, body.params),
        )
    )


def _read_skeleton(reader: Reader, version: Version) -> Skeleton:
    skeleton_id = reader.integer()
    if version >= (3, 0):
        bodies = _read_bodies_3(reader)
    else:
        bodies = reader.items(_read_body_2, _BODY_2.size + 10)
    _require_tracked_bodies_finite(bodies)
    return Skeleton(skeleton_id, bodies)


def _read_bodies_3(reader: Reader) -> tuple[RigidBody, ...]:
    return tuple(_body(row) for row in reader.rows(_BODY_3, reader.count(_BODY_3.size)))


def _write_skeleton(skeleton: Skeleton, version: Version) -> bytes:
    bodies = wire.items(_write_body(body, version) for body in skeleton.bodies)
    return wire.I32.pack(skeleton.id) + bodies


def _read_asset(reader: Reader) -> Asset:
    asset_id = reader.integer()
    bodies = _read_bodies_3(reader)
    _require_tracked_bodies_finite(bodies)
    rows = reader.rows(_LABELED_3, reader.count(_LABELED_3.size))
    return Asset(asset_id, bodies, _labeled(rows, (4, 1)))


def _write_asset(asset: Asset, version: Version) -> bytes:
    bodies = wire.items(_write_body(body, version) for body in asset.bodies)
    markers = wire.items(_write_labeled(marker, version) for marker in asset.markers)
    return wire.I32.pack(asset.id) + bodies + markers


def _write_labeled(marker: LabeledMarker, version: Version) -> bytes:
    if version < (3, 0):
        return _LABELED_2.pack(marker.id, *marker.position, marker.size, marker.params)
    residual = math.nan if marker.residual is None else marker.residual
    return _LABELED_3.pack(marker.id, *marker.position, marker.size, marker.params, residual)


def _read_analog(reader: Reader) -> AnalogDevice:
    return AnalogDevice(reader.integer(), reader.items(_read_channel, 4))


def _read_channel(reader: Reader) -> tuple[float, ...]:
    return reader.numbers('f', reader.count(wire.F32.size))


def _write_analog(device: AnalogDevice) -> bytes:
    channels = (
        wire.items(wire.F32.pack(value) for value in channel) for channel in device.channels
    )
    return wire.I32.pack(device.id) + wire.items(channels)
