# SPDX-License-Identifier: Apache-2.0
"""Hostile bytes: valid messages of every version of the two wire formats, and damaged ones.

The same seed gives the same bytes.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterable, Sequence

from remaster_ros.sensors.laser_tracker import codes
from remaster_ros.sensors.laser_tracker import packets as emscon
from remaster_ros.sensors.optitrack import natnet, natnet_bytes, natnet_model
from remaster_ros.sensors.optitrack.natnet_frame import (
    TRACKING_VALID,
    Frame,
    LabeledMarker,
    RigidBody,
)
from remaster_ros.sensors.optitrack.natnet_model import (
    MarkerSetDescription,
    ModelDefinition,
    RigidBodyDescription,
)

VERSIONS: tuple[natnet_bytes.Version, ...] = (
    (2, 6), (2, 7), (2, 9), (2, 10), (2, 11), (3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3),
)  # fmt: skip
_INTEGERS = (0, 1, -1, 2, 255, 65535, 70_000, 10**6, 2**31 - 1, -(2**31), 2**30, 4711)
_REALS = (math.nan, math.inf, -math.inf, 0.0, 0.3, 1e-45, 3e38, -3e38)
_LONGEST = 65_507
"""Bytes that one UDP datagram carries."""


def full_frame(
    version: natnet_bytes.Version, number: int = 7, markers: int = 4, stray: bool = True
) -> Frame:
    """Return a frame with something in every section that the version has."""
    residual = 2e-4 if version >= (3, 0) else None
    # No two frames are the same to the last bit: such a marker counts as frozen.
    y = 0.2 + 1e-6 * (number % 1000)
    positions = tuple((0.1 * i, y, 2.0) for i in range(1, markers + 1))
    labeled = tuple(
        LabeledMarker(1 << 16 | i, position, 0.014, 0x0A, residual)
        for i, position in enumerate(positions, start=1)
    )
    inner = tuple((p, i, 0.014) for i, p in enumerate(positions, start=1))
    body = RigidBody(
        1, positions[0], (0.0, 0.0, 0.0, 1.0), 1e-4, TRACKING_VALID,
        inner if version < (3, 0) else (),
    )  # fmt: skip
    analog = ((5, ((1.0, 2.0), (3.0,))),)
    return Frame(
        number=number,
        timestamp=number / 120,
        labeled_markers=(
            *labeled,
            *([LabeledMarker(4711, (1.0,) * 3, 0.01, 0x12, residual)] if stray else []),
        ),
        rigid_bodies=(body,),
        marker_sets=(('tool', positions), ('all', positions)),
        other_markers=((1.0, 1.0, 1.0),),
        skeletons=((2, (body,)),),
        assets=((3, (body,), labeled[:1]),) if version >= (4, 1) else (),
        force_plates=analog if version >= (2, 9) else (),
        devices=analog if version >= (2, 11) else (),
        mid_exposure=10**6 + number * 80_000,
        transmitted=10**6 + number * 80_000 + 5000,
    )


def server_info(version: natnet_bytes.Version) -> natnet.ServerInfo:
    """Return a server's answer to CONNECT."""
    connection = natnet.Connection(10_000_000, 1511, True, '239.255.42.99')
    return natnet.ServerInfo(
        'Motive', (3, 1, 0, 0), version, connection if version >= (3, 0) else None
    )


BODY = RigidBodyDescription(
    'tool', 1, marker_positions=((0.0,) * 3,) * 3, marker_labels=(0, 0, 0),
    marker_names=('a', 'b', 'c'),
)  # fmt: skip
MODEL = ModelDefinition((MarkerSetDescription('tool', ('a', 'b', 'c')), BODY))


def skeleton_definition(version: natnet_bytes.Version) -> bytes:
    """Return the datagram of a skeleton, of which a client keeps the name alone."""
    sized = version >= (4, 1)
    body = natnet_model.encode_model_definition(ModelDefinition((BODY,)), version)
    hand = b'hand\0' + struct.pack('<2i', 2, 1) + body[12 if sized else 8 :]
    size = struct.pack('<i', len(hand)) if sized else b''
    payload = struct.pack('<2i', 1, natnet_model.SKELETON) + size + hand
    return natnet.join_datagram(natnet.MessageId.MODELDEF, payload)


def natnet_seeds(version: natnet_bytes.Version | None = None) -> list[bytes]:
    """Return valid datagrams of every kind and of one version, or of all."""
    seeds = []
    for spoken in [version] if version else VERSIONS:
        messages: list[natnet.Message] = [
            full_frame(spoken),
            full_frame(spoken, 8, markers=1),
            Frame(9, 0.1, params=8),
            server_info(spoken),
            MODEL,
        ]
        seeds += [natnet.encode_message(message, spoken) for message in messages]
        seeds.append(skeleton_definition(spoken))
    other_messages: list[natnet.Message] = [
        natnet.Response(b'Bitstream,4.1\0'),
        natnet.Response(bytes(4)),
        natnet.MessageString('hello'),
        natnet.EchoResponse(1, 2),
        natnet.Notice(natnet.MessageId.UNRECOGNIZED_REQUEST),
        natnet.Notice(natnet.MessageId.DISCONNECT_BY_TIMEOUT),
    ]
    seeds += [natnet.encode_message(message, (4, 3)) for message in other_messages]
    seeds.append(natnet.encode_connect_request('remaster_ros', (4, 1)))
    seeds.append(natnet.encode_command_request('Bitstream,4.1'))
    return seeds


def measurement() -> emscon.Measurement:
    """Return a result as an instrument sends it."""
    three = (1e-5, 2e-5, 3e-5)
    return emscon.Measurement(
        0,
        codes.STATIONARY,
        0,
        (2.0, 0.5, -0.3),
        three,
        4e-5,
        three,
        three,
        4e-5,
        20.0,
        1013.0,
        50,
    )


def emscon_seeds() -> list[bytes]:
    """Return valid packets of every kind, in both directions."""
    values = {'s': b'text', 'd': 1.5, 'i': 1, 'I': 2}
    seeds = [
        emscon.encode(event)
        for event in (
            measurement(),
            emscon.ErrorReport(49, 10004),
            emscon.StatusChange(25),
            emscon.StatusChange(27),
            emscon.UnknownPacket(77, b'12345678'),
        )
    ]
    for command in codes.Command:
        for kind, layout in (('request', command.request), ('reply', command.reply)):
            zeros = layout.unpack(bytes(layout.size))
            filled = tuple(
                values['s']
                if isinstance(v, bytes)
                else values['d' if isinstance(v, float) else 'i']
                for v in zeros
            )
            event: emscon.Event = (
                emscon.Request(command, filled)
                if kind == 'request'
                else emscon.Reply(command, 0, filled)
            )
            seeds.append(emscon.encode(event))
        seeds.append(emscon.encode(emscon.Reply(command, 10004)))
    return seeds


class Mutator:
    """Spoils valid messages: flips, cuts, counts, numbers that are none, splices, floods.

    Parameters
    ----------
    seeds
        Valid messages.
    rng
        Source of all randomness; inputs repeat with its seed.
    size_at
        Where the u16 (NatNet) or i32 (emScon) size of the message stands, as
        ``(struct format, offset, bytes it does not count)``: most spoilt messages get a size that
        fits, so that they come through to what lies behind it.
    """

    def __init__(
        self, seeds: Sequence[bytes], rng: random.Random, size_at: tuple[str, int, int]
    ) -> None:
        self._seeds, self._rng = seeds, rng
        self._format, self._offset, self._uncounted = size_at
        self._largest = 2 ** (8 * struct.calcsize(self._format)) // 2 - 1
        self._ways = (
            self._flip, self._flip, self._flip, self._integer, self._integer,
            self._real, self._real, self._cut, self._remove, self._insert, self._repeat,
            self._splice, self._noise,
        )  # fmt: skip

    def __call__(self) -> bytes:
        """Return the next spoilt message (now and then a valid one)."""
        rng = self._rng
        data = bytearray(rng.choice(self._seeds))
        chance = rng.random()
        if chance < 0.02:
            return bytes(data)
        if chance < 0.021:
            data *= rng.randrange(2, 2 + _LONGEST // max(len(data), 1))
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            data = rng.choice(self._ways)(data)
        del data[_LONGEST:]
        if rng.random() < 0.8:
            self._fit_size(data)
        return bytes(data)

    def _fit_size(self, data: bytearray) -> None:
        end = self._offset + struct.calcsize(self._format)
        if len(data) >= end:
            size = min(len(data) - self._uncounted, self._largest)
            if size >= 0:
                struct.pack_into(self._format, data, self._offset, size)

    def _at(self, data: bytearray, room: int = 0) -> int:
        return self._rng.randrange(max(len(data) - room, 0) + 1)

    def _flip(self, data: bytearray) -> bytearray:
        for _ in range(self._rng.choice((1, 1, 2, 8))):
            if data:
                data[self._rng.randrange(len(data))] ^= 1 << self._rng.randrange(8)
        return data

    def _integer(self, data: bytearray) -> bytearray:
        at = self._at(data, 4)
        if at + 4 <= len(data):
            struct.pack_into('<i', data, at, self._rng.choice(_INTEGERS))
        return data

    def _real(self, data: bytearray) -> bytearray:
        kind = self._rng.choice('ffd')
        size = struct.calcsize(kind)
        at = self._at(data, size)
        if at + size <= len(data):
            struct.pack_into(f'<{kind}', data, at, self._rng.choice(_REALS))
        return data

    def _cut(self, data: bytearray) -> bytearray:
        del data[self._at(data) :]
        return data

    def _remove(self, data: bytearray) -> bytearray:
        at = self._at(data)
        del data[at : at + self._rng.choice((1, 2, 4, 12, 26, 38))]
        return data

    def _insert(self, data: bytearray) -> bytearray:
        at = self._at(data)
        data[at:at] = self._rng.randbytes(self._rng.choice((1, 2, 4, 12, 26, 38)))
        return data

    def _repeat(self, data: bytearray) -> bytearray:
        at, to = sorted((self._at(data), self._at(data)))
        data[to:to] = data[at : min(to, at + 300)]
        return data

    def _splice(self, data: bytearray) -> bytearray:
        other = self._rng.choice(self._seeds)
        return data[: self._at(data)] + other[self._rng.randrange(len(other) + 1) :]

    def _noise(self, data: bytearray) -> bytearray:
        at = self._at(data)
        size = min(len(data) - at, self._rng.choice((4, 16, 64)))
        data[at : at + size] = self._rng.randbytes(size)
        return data


def natnet_mutator(
    rng: random.Random, version: natnet_bytes.Version, more: Iterable[bytes] = ()
) -> Mutator:
    """Return a source of spoilt datagrams, every second one of `version`.

    `more` joins the valid ones.
    """
    seeds = natnet_seeds()
    version_seeds = natnet_seeds(version)
    return Mutator(
        [*seeds, *version_seeds * (len(seeds) // len(version_seeds)), *more], rng, ('<H', 2, 4)
    )


def emscon_mutator(rng: random.Random, more: Iterable[bytes] = ()) -> Mutator:
    """Return a source of spoilt packets; `more` joins the valid ones."""
    seeds = emscon_seeds()
    # Every third is a result, which is what reaches a reading.
    results = [emscon.encode(measurement())] * (len(seeds) // 2)
    return Mutator([*seeds, *results, *more], rng, ('<i', 0, 0))
