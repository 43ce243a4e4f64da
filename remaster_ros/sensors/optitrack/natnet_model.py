# SPDX-License-Identifier: Apache-2.0
"""MODELDEF, the message that describes marker sets, rigid bodies and other assets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
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
    I32,
    QUATERNION,
    TEXT,
    VEC3,
    Codec,
    Columns,
    List,
    Record,
    Row,
    stepped_over,
)

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
    """Read the description at the reader's position.

    Of an unknown kind: from 4.1 on an `OtherDescription` with the number of the kind and no
    name; before, ProtocolError is raised, as its size is unknown.
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
        marker = Record(stepped_over, TEXT, Row('i4fH'))
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
