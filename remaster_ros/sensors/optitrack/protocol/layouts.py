"""How the parts of a NatNet frame lie in their bytes, and how to step over them unread."""

from __future__ import annotations

from struct import Struct

from remaster_ros.sensors.optitrack.protocol import wire
from remaster_ros.sensors.optitrack.protocol.wire import Reader, Version

LABELED_2 = Struct('<i4fH')
LABELED_3 = Struct('<i4fHf')
BODY_2 = Struct('<i7f')
BODY_3 = Struct('<i8fH')
BODY_2_END = Struct('<fH')
BODY_MARKER_BYTES = 20
BODY_2_BYTES = BODY_2.size + wire.I32.size + BODY_2_END.size
ANALOG_SINCE: tuple[Version, Version] = ((2, 9), (2, 11))
"""Force plates, devices."""
LATENCY = wire.F32
TIMECODE_F32 = Struct('<2If')
TIMECODE_F64 = Struct('<2Id')
STAMPS = Struct('<3Q')
PRECISION = Struct('<2I')
END = Struct('<Hi')


def skip_to_labeled(reader: Reader, version: Version) -> None:
    """Step over the sections before the labelled markers."""
    reader.skip_section(version, _skip_marker_set, 5)
    reader.skip_section(version, lambda r: r.skip(wire.VEC3.size), wire.VEC3.size)
    if version >= (3, 0):
        reader.skip_section(version, lambda r: r.skip(BODY_3.size), BODY_3.size)
    else:
        reader.skip_section(version, _skip_body_2, BODY_2_BYTES)
    reader.skip_section(version, lambda r: _skip_skeleton(r, version), 8)
    if version >= (4, 1):
        # Assets: never item by item, as this version tells their size.
        reader.skip_section(version, Reader.integer, 12)


def _skip_marker_set(reader: Reader) -> None:
    reader.skip_text()
    reader.skip(wire.VEC3.size * reader.count(wire.VEC3.size))


def _skip_body_2(reader: Reader) -> None:
    reader.skip(BODY_2.size)
    reader.skip(BODY_MARKER_BYTES * reader.count(BODY_MARKER_BYTES) + BODY_2_END.size)


def _skip_skeleton(reader: Reader, version: Version) -> None:
    reader.skip(wire.I32.size)
    if version >= (3, 0):
        reader.skip(BODY_3.size * reader.count(BODY_3.size))
        return
    for _ in range(reader.count(BODY_2_BYTES)):
        _skip_body_2(reader)


def skip_analog(reader: Reader) -> None:
    """Step over one force plate or device."""
    reader.skip(wire.I32.size)
    for _ in range(reader.count(wire.I32.size)):
        reader.skip(wire.F32.size * reader.count(wire.F32.size))
