"""Decoding a NatNet frame: this package beside PyPI ``natnet``, on the same bytes in one process.

Both decode a frame of 50 labelled markers to Python objects with every number in them; first it is
made sure that the two read the same positions. Ours checks every count, finiteness and the end
tag as well. The two take turns, and each one's fastest turn counts: what else the machine does
can only make a turn slower. "Markers only" is what our client does: it steps over the rest.

Run: python benchmarks/bench_decode.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from natnet.data_frame import DataFrame
from natnet.packet_buffer import PacketBuffer
from natnet.version import Version as TheirVersion

from remaster_ros.sensors.optitrack.protocol.frames import (
    HAS_MODEL,
    MEASURED,
    TRACKING_VALID,
    BodyMarker,
    Frame,
    LabeledMarker,
    MarkerSet,
    RigidBody,
)
from remaster_ros.sensors.optitrack.protocol.natnet import (
    Version,
    decode_message,
    encode_message,
    format_version,
)

VERSIONS: tuple[Version, ...] = ((2, 10), (3, 1), (4, 1))
BODIES, MARKERS_EACH = 10, 5
TURNS, REPEATS = 15, 200


def scene(version: Version, marker_sets: bool = True) -> Frame:
    """Return a frame of 10 rigid bodies with 5 markers each, with or without their marker sets."""
    rng = np.random.default_rng(0)
    residual = 1e-4 if version >= (3, 0) else None
    labeled, bodies, sets = [], [], []
    for body in range(1, BODIES + 1):
        positions = [tuple(row) for row in rng.normal(size=(MARKERS_EACH, 3)).tolist()]
        members = list(enumerate(positions, start=1))
        labeled += [
            LabeledMarker(body << 16 | member, position, 0.014, MEASURED | HAS_MODEL, residual)
            for member, position in members
        ]
        inner = tuple(BodyMarker(position, member, 0.014) for member, position in members)
        pose = positions[0], (0.0, 0.0, 0.0, 1.0)
        bodies.append(
            RigidBody(body, *pose, 1e-4, TRACKING_VALID, inner if version < (3, 0) else ())
        )
        sets.append(MarkerSet(f'body_{body}', tuple(positions)))
    sets.append(MarkerSet('all', tuple(marker.position for marker in labeled)))
    return Frame(
        number=1,
        timestamp=1.5,
        labeled_markers=tuple(labeled),
        rigid_bodies=tuple(bodies),
        marker_sets=tuple(sets) if marker_sets else (),
    )


def seconds_each(decode: Callable[[], object]) -> float:
    """Return the time of one call, mean over a turn, s."""
    begin = time.perf_counter()
    for _ in range(REPEATS):
        decode()
    return (time.perf_counter() - begin) / REPEATS


def compare(version: Version, marker_sets: bool) -> tuple[int, float, float, float]:
    """Return the datagram's size, and the times of the client's decoding, ours and theirs, s."""
    datagram = encode_message(scene(version, marker_sets), version)
    their_version = TheirVersion(*version)

    def ours() -> Frame:
        return decode_message(datagram, version)  # type: ignore[return-value]

    def client() -> Frame:
        return decode_message(datagram, version, markers_only=True)  # type: ignore[return-value]

    def theirs() -> DataFrame:
        return DataFrame.read_from_buffer(PacketBuffer(datagram[4:]), their_version)

    read = [marker.position for marker in ours().labeled_markers]
    if read != [marker.pos for marker in theirs().labeled_markers]:
        raise SystemExit(f'the decoders disagree about NatNet {format_version(version)}')
    turns = [[seconds_each(decode) for decode in (client, ours, theirs)] for _ in range(TURNS)]
    markers_only, full, their = map(min, zip(*turns))
    return len(datagram), markers_only, full, their


def main() -> None:
    """Print one line a version and scene."""
    print('NatNet  marker sets   bytes  markers only, µs  ours, µs  natnet, µs  natnet / ours')
    for version in VERSIONS:
        for marker_sets in (True, False):
            size, *seconds = compare(version, marker_sets)
            client, ours, theirs = (1e6 * each for each in seconds)
            print(
                f'{format_version(version):7} {"yes" if marker_sets else "no":12} {size:6} '
                f'{client:17.1f} {ours:9.1f} {theirs:11.1f} {theirs / ours:14.2f}',
                flush=True,
            )


if __name__ == '__main__':
    main()
