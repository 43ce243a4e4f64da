"""FRAMEOFDATA, the message that carries marker positions, NatNet 2.6 to 4.3.

Lengths are metres in the axes chosen in Motive. A position counts only where its item claims to
be measured: see the flags of `LabeledMarker` and `RigidBody`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

from remaster_ros.sensors.optitrack.protocol import layouts, wire
from remaster_ros.sensors.optitrack.protocol.wire import (
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
    reader = Reader(payload)
    number = reader.integer()
    before = {} if markers_only else _read_before(reader, version)
    if markers_only:
        layouts.skip_to_labeled(reader, version)
    labeled_layout = layouts.LABELED_3 if version >= (3, 0) else layouts.LABELED_2
    labeled = _labeled(reader.row_section(version, labeled_layout), version)
    analog: list[tuple[AnalogDevice, ...]] = [(), ()]
    for i, since in enumerate(layouts.ANALOG_SINCE):
        if version < since:
            continue
        if markers_only:
            reader.skip_section(version, layouts.skip_analog, 8)
        else:
            analog[i] = reader.section(version, _read_analog, 8)

    latency = reader.unpack(layouts.LATENCY)[0] if version < (3, 0) else 0.0
    timecode = layouts.TIMECODE_F64 if version >= (2, 7) else layouts.TIMECODE_F32
    timecode_main, timecode_sub, timestamp = reader.unpack(timecode)
    stamps = reader.unpack(layouts.STAMPS) if version >= (3, 0) else (0, 0, 0)
    precision = reader.unpack(layouts.PRECISION) if version >= (4, 1) else (0, 0)
    params, tag = reader.unpack(layouts.END)
    if tag != 0 or reader.left:
        raise ProtocolError(
            f'frame {number} does not end where it should (tag {tag}, {reader.left} bytes left)'
        )
    _require_finite((timestamp, latency), 'time')
    return Frame(
        number=number,
        timestamp=timestamp,
        labeled_markers=labeled,
        force_plates=analog[0],
        devices=analog[1],
        software_latency=latency,
        timecode=timecode_main,
        timecode_sub=timecode_sub,
        mid_exposure=stamps[0],
        data_received=stamps[1],
        transmitted=stamps[2],
        precision_seconds=precision[0],
        precision_fraction=precision[1],
        params=params,
        **before,
    )


def _read_before(reader: Reader, version: Version) -> dict[str, Any]:
    """Read the sections before the labelled markers, as fields of a `Frame`."""
    marker_sets = reader.section(version, _read_marker_set, 5)
    other_markers = reader.row_section(version, wire.VEC3)
    if version >= (3, 0):
        bodies = tuple(_body(row) for row in reader.row_section(version, layouts.BODY_3))
    else:
        bodies = reader.items(_read_body_2, layouts.BODY_2_BYTES)
    skeletons = reader.section(version, lambda r: _read_skeleton(r, version), 8)
    assets = reader.section(version, _read_asset, 12) if version >= (4, 1) else ()
    in_sets = chain.from_iterable([marker_set.positions for marker_set in marker_sets])
    _require_finite(chain.from_iterable(in_sets), 'position of a marker')
    _require_finite(chain.from_iterable(other_markers), 'position of a marker')
    _require_tracked_bodies_finite(bodies)
    return {
        'marker_sets': marker_sets,
        'other_markers': tuple(other_markers),
        'rigid_bodies': bodies,
        'skeletons': skeletons,
        'assets': assets,
    }


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


def _body(row: tuple) -> RigidBody:
    return RigidBody(row[0], row[1:4], row[4:8], row[8], row[9])


def _read_body_2(reader: Reader) -> RigidBody:
    body_id, x, y, z, *orientation = reader.unpack(layouts.BODY_2)
    count = reader.count(layouts.BODY_MARKER_BYTES)
    positions = reader.rows(wire.VEC3, count)
    ids = reader.numbers('i', count)
    sizes = reader.numbers('f', count)
    mean_error, params = reader.unpack(layouts.BODY_2_END)
    markers = tuple(
        [tuple.__new__(BodyMarker, marker) for marker in zip(positions, ids, sizes, strict=True)]
    )
    if params & TRACKING_VALID:
        _require_finite(chain.from_iterable(positions), f'position of a marker of body {body_id}')
    return RigidBody(body_id, (x, y, z), tuple(orientation), mean_error, params, markers)  # type: ignore[arg-type]


def _read_skeleton(reader: Reader, version: Version) -> Skeleton:
    skeleton_id = reader.integer()
    if version >= (3, 0):
        bodies = _read_bodies_3(reader)
    else:
        bodies = reader.items(_read_body_2, layouts.BODY_2_BYTES)
    _require_tracked_bodies_finite(bodies)
    return Skeleton(skeleton_id, bodies)


def _read_bodies_3(reader: Reader) -> tuple[RigidBody, ...]:
    return tuple(
        _body(row) for row in reader.rows(layouts.BODY_3, reader.count(layouts.BODY_3.size))
    )


def _read_asset(reader: Reader) -> Asset:
    asset_id = reader.integer()
    bodies = _read_bodies_3(reader)
    _require_tracked_bodies_finite(bodies)
    rows = reader.rows(layouts.LABELED_3, reader.count(layouts.LABELED_3.size))
    return Asset(asset_id, bodies, _labeled(rows, (4, 1)))


def _read_analog(reader: Reader) -> AnalogDevice:
    return AnalogDevice(reader.integer(), reader.items(_read_channel, 4))


def _read_channel(reader: Reader) -> tuple[float, ...]:
    return reader.numbers('f', reader.count(wire.F32.size))
