"""FRAMEOFDATA as a server writes it, NatNet 2.6 to 4.3."""

from __future__ import annotations

import math

from remaster_ros.sensors.optitrack.protocol import layouts, wire
from remaster_ros.sensors.optitrack.protocol.frames import (
    AnalogDevice,
    Asset,
    Frame,
    LabeledMarker,
    MarkerSet,
    RigidBody,
    Skeleton,
)
from remaster_ros.sensors.optitrack.protocol.wire import Version, require_supported


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
        parts.append(layouts.LATENCY.pack(frame.software_latency))
    timecode = layouts.TIMECODE_F64 if version >= (2, 7) else layouts.TIMECODE_F32
    parts.append(timecode.pack(frame.timecode, frame.timecode_sub, frame.timestamp))
    if version >= (3, 0):
        parts.append(
            layouts.STAMPS.pack(frame.mid_exposure, frame.data_received, frame.transmitted)
        )
    if version >= (4, 1):
        parts.append(layouts.PRECISION.pack(frame.precision_seconds, frame.precision_fraction))
    parts.append(layouts.END.pack(frame.params, 0))
    return b''.join(parts)


def _write_marker_set(marker_set: MarkerSet) -> bytes:
    positions = wire.items(wire.VEC3.pack(*p) for p in marker_set.positions)
    return wire.text(marker_set.name) + positions


def _write_body(body: RigidBody, version: Version) -> bytes:
    if version >= (3, 0):
        return layouts.BODY_3.pack(
            body.id, *body.position, *body.orientation_xyzw, body.mean_error, body.params
        )
    return b''.join(
        (
            layouts.BODY_2.pack(body.id, *body.position, *body.orientation_xyzw),
            wire.items(wire.VEC3.pack(*marker.position) for marker in body.markers),
            *(wire.I32.pack(marker.id) for marker in body.markers),
            *(wire.F32.pack(marker.size) for marker in body.markers),
            layouts.BODY_2_END.pack(body.mean_error, body.params),
        )
    )


def _write_skeleton(skeleton: Skeleton, version: Version) -> bytes:
    bodies = wire.items(_write_body(body, version) for body in skeleton.bodies)
    return wire.I32.pack(skeleton.id) + bodies


def _write_asset(asset: Asset, version: Version) -> bytes:
    bodies = wire.items(_write_body(body, version) for body in asset.bodies)
    markers = wire.items(_write_labeled(marker, version) for marker in asset.markers)
    return wire.I32.pack(asset.id) + bodies + markers


def _write_labeled(marker: LabeledMarker, version: Version) -> bytes:
    if version < (3, 0):
        return layouts.LABELED_2.pack(marker.id, *marker.position, marker.size, marker.params)
    residual = math.nan if marker.residual is None else marker.residual
    return layouts.LABELED_3.pack(
        marker.id, *marker.position, marker.size, marker.params, residual
    )


def _write_analog(device: AnalogDevice) -> bytes:
    channels = (
        wire.items(wire.F32.pack(value) for value in channel) for channel in device.channels
    )
    return wire.I32.pack(device.id) + wire.items(channels)
