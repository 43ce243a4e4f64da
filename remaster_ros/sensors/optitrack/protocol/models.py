"""MODELDEF, the names behind the ids of a frame: decode and encode, NatNet 2.6 to 4.3."""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct

from remaster_ros.sensors.optitrack.protocol import wire
from remaster_ros.sensors.optitrack.protocol.wire import (
    ProtocolError,
    Quaternion,
    Reader,
    Vec3,
    Version,
    require_supported,
)

MARKER_SET, RIGID_BODY, SKELETON, FORCE_PLATE, DEVICE, CAMERA, ASSET = range(7)

_FORCE_PLATE_BODY = Struct(f'<{2 + 3 + 144 + 12}f2i')
_BODY_HEAD = Struct('<2i3f')
_CAMERA_POSE = Struct('<7f')
_ASSET_MARKER_TAIL = Struct('<i4fH')
_IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class MarkerSetDescription:
    """A marker set and the names of its markers."""

    name: str
    marker_names: tuple[str, ...]


@dataclass(frozen=True)
class RigidBodyDescription:
    """A rigid body.

    Attributes
    ----------
    id
        The id in the frames; its marker number m is the labelled marker ``id << 16 | m``.
    parent_id
        -1 for none.
    offset, offset_rotation
        Pose relative to the parent, m and x, y, z, w (the rotation is sent since 4.2).
    marker_positions
        In the body's own axes, m (since 3.0).
    marker_labels
        Required active label of each marker, 0 for passive ones (since 3.0).
    marker_names
        Since 4.0.
    """

    name: str
    id: int
    parent_id: int = -1
    offset: Vec3 = (0.0, 0.0, 0.0)
    offset_rotation: Quaternion = _IDENTITY
    marker_positions: tuple[Vec3, ...] = ()
    marker_labels: tuple[int, ...] = ()
    marker_names: tuple[str, ...] = ()


@dataclass(frozen=True)
class SkeletonDescription:
    """A skeleton and its bones."""

    name: str
    id: int
    bodies: tuple[RigidBodyDescription, ...]


@dataclass(frozen=True)
class OtherDescription:
    """A force plate, device, camera or asset: only what names it is kept.

    Attributes
    ----------
    kind
        The wire's type number, `FORCE_PLATE` to `ASSET`, or one unknown here.
    id
        None for cameras, which have none, and for unknown kinds.
    """

    kind: int
    name: str
    id: int | None = None


Description = MarkerSetDescription | RigidBodyDescription | SkeletonDescription | OtherDescription


@dataclass(frozen=True)
class ModelDefinition:
    """Everything the server streams, in its order."""

    descriptions: tuple[Description, ...] = ()

    @property
    def rigid_bodies(self) -> tuple[RigidBodyDescription, ...]:
        """The rigid bodies that are no part of a skeleton."""
        return tuple(d for d in self.descriptions if isinstance(d, RigidBodyDescription))

    @property
    def labelled_assets(self) -> dict[str, int]:
        """Ids by name of what labels markers: rigid bodies and (4.1+) trained marker sets."""
        named = {
            d.name: d.id
            for d in self.descriptions
            if isinstance(d, OtherDescription) and d.kind == ASSET and d.id is not None
        }
        return named | {body.name: body.id for body in self.rigid_bodies}


def decode_model_definition(payload: bytes, version: Version) -> ModelDefinition:
    """Decode the payload of a MODELDEF datagram.

    Bytes behind the last description, and from 4.1 on behind each, are skipped: servers newer
    than this decoder put new fields there.

    Raises
    ------
    ProtocolError
        If the version is unknown, the bytes end early or a count does not fit.
    """
    require_supported(version)
    reader = Reader(payload)
    smallest = 8 if version >= (4, 1) else 4
    return ModelDefinition(reader.items(lambda r: _read_description(r, version), smallest))


def encode_model_definition(definition: ModelDefinition, version: Version) -> bytes:
    """Encode the payload of a MODELDEF message.

    Raises
    ------
    ProtocolError
        If the version is unknown.
    ValueError
        If a name is too long, or a description is of a kind whose details are not kept.
    """
    require_supported(version)
    return wire.items(_write_description(d, version) for d in definition.descriptions)


def _read_description(reader: Reader, version: Version) -> Description:
    kind = reader.integer()
    if version < (4, 1):
        return _read_body_of(kind, reader, version)
    size = reader.integer()
    if not 0 <= size <= reader.left:
        raise ProtocolError(f'a description of {size} bytes with {reader.left} bytes left')
    all_bytes, reader.end = reader.end, reader.offset + size
    description = _read_body_of(kind, reader, version)
    reader.offset, reader.end = reader.end, all_bytes
    return description


def _read_body_of(kind: int, reader: Reader, version: Version) -> Description:
    if kind == MARKER_SET:
        return MarkerSetDescription(reader.text(), reader.items(Reader.text, 1))
    if kind == RIGID_BODY:
        return _read_rigid_body(reader, version)
    if kind == SKELETON:
        name, skeleton_id = reader.text(), reader.integer()
        bodies = reader.items(lambda r: _read_rigid_body(r, version), _BODY_HEAD.size + 1)
        return SkeletonDescription(name, skeleton_id, bodies)
    if version >= (3, 0) and kind in (FORCE_PLATE, DEVICE, CAMERA, ASSET):
        return _read_other(kind, reader, version)
    if version >= (4, 1):
        return OtherDescription(kind, '')
    # Without a byte size there is no way to find the next description.
    raise ProtocolError(f'a description of the unknown kind {kind}')


def _read_rigid_body(reader: Reader, version: Version) -> RigidBodyDescription:
    name = reader.text()
    body_id, parent_id, *offset = reader.unpack(_BODY_HEAD)
    rotation = reader.unpack(wire.QUATERNION) if version >= (4, 2) else _IDENTITY
    positions: tuple = ()
    labels: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    if version >= (3, 0):
        count = reader.count(wire.VEC3.size + wire.I32.size)
        positions = tuple(reader.rows(wire.VEC3, count))
        labels = reader.numbers('i', count)
        if version >= (4, 0):
            names = tuple(reader.text() for _ in range(count))
    return RigidBodyDescription(
        name, body_id, parent_id, tuple(offset), rotation, positions, labels, names
    )


def _read_other(kind: int, reader: Reader, version: Version) -> OtherDescription:
    """Walk over a description of which only name and id are kept."""
    if kind == FORCE_PLATE:
        plate_id, serial = reader.integer(), reader.text()
        reader.unpack(_FORCE_PLATE_BODY)
        reader.items(Reader.text, 1)
        return OtherDescription(kind, serial, plate_id)
    if kind == DEVICE:
        device_id, name, _serial = reader.integer(), reader.text(), reader.text()
        reader.unpack(wire.TWO_I32)
        reader.items(Reader.text, 1)
        return OtherDescription(kind, name, device_id)
    if kind == CAMERA:
        name = reader.text()
        reader.unpack(_CAMERA_POSE)
        return OtherDescription(kind, name)
    name = reader.text()
    _asset_type, asset_id = reader.unpack(wire.TWO_I32)
    reader.items(lambda r: _read_rigid_body(r, version), _BODY_HEAD.size + 1)
    reader.items(lambda r: (r.text(), r.unpack(_ASSET_MARKER_TAIL)), _ASSET_MARKER_TAIL.size + 1)
    return OtherDescription(kind, name, asset_id)


def _write_description(description: Description, version: Version) -> bytes:
    if isinstance(description, MarkerSetDescription):
        kind = MARKER_SET
        names = wire.items(wire.text(name) for name in description.marker_names)
        body = wire.text(description.name) + names
    elif isinstance(description, RigidBodyDescription):
        kind = RIGID_BODY
        body = _write_rigid_body(description, version)
    elif isinstance(description, SkeletonDescription):
        kind = SKELETON
        bodies = wire.items(_write_rigid_body(b, version) for b in description.bodies)
        body = wire.text(description.name) + wire.I32.pack(description.id) + bodies
    else:
        raise ValueError(f'only the name of {description.name!r} is kept: it cannot be encoded')
    size = wire.I32.pack(len(body)) if version >= (4, 1) else b''
    return wire.I32.pack(kind) + size + body


def _write_rigid_body(body: RigidBodyDescription, version: Version) -> bytes:
    parts = [wire.text(body.name), _BODY_HEAD.pack(body.id, body.parent_id, *body.offset)]
    if version >= (4, 2):
        parts.append(wire.QUATERNION.pack(*body.offset_rotation))
    if version >= (3, 0):
        parts.append(wire.items(wire.VEC3.pack(*p) for p in body.marker_positions))
        parts += (wire.I32.pack(label) for label in body.marker_labels)
    if version >= (4, 0):
        parts += (wire.text(name) for name in body.marker_names)
    return b''.join(parts)
