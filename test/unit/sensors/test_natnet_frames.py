# SPDX-License-Identifier: Apache-2.0
"""Frames of data: sizes, round trips and damage, for every bitstream version."""

import contextlib
import dataclasses
import math
import struct

import pytest
from hostile.fuzz_messages import VERSIONS, full_frame
from hypothesis import given, settings
from hypothesis import strategies as st

from remaster_ros.sensors.optitrack.natnet_bytes import ProtocolError
from remaster_ros.sensors.optitrack.natnet_frame import (
    MEASURED,
    OCCLUDED,
    TRACKING_VALID,
    Frame,
    LabeledMarker,
    RigidBody,
    decode_frame,
    encode_frame,
)

# Of what takes every byte in turn: the oldest, the first with a residual, the newest.
SOME_VERSIONS = [
    pytest.param(version, marks=() if version in ((2, 6), (3, 0), (4, 3)) else pytest.mark.qualify)
    for version in VERSIONS
]

f32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
i32 = st.integers(-(2**31), 2**31 - 1)
u16 = st.integers(0, 2**16 - 1)
u64 = st.integers(0, 2**64 - 1)
vec3 = st.tuples(f32, f32, f32)
quaternion = st.tuples(f32, f32, f32, f32)
names = st.text(st.characters(exclude_characters='\0', codec='utf-8'), max_size=20)


def few(item):
    return st.lists(item, max_size=3).map(tuple)


def frames(version):
    """Every frame that this version can carry."""
    since3, since41 = version >= (3, 0), version >= (4, 1)
    body_markers = st.just(()) if since3 else few(st.tuples(vec3, i32, f32))
    bodies = few(st.builds(RigidBody, i32, vec3, quaternion, f32, u16, body_markers))
    labeled = few(st.builds(LabeledMarker, i32, vec3, f32, u16, f32 if since3 else st.none()))
    analog = few(st.tuples(i32, few(few(f32))))
    finite = st.floats(allow_nan=False, allow_infinity=False)
    fields = {
        'number': i32,
        'timestamp': finite if version >= (2, 7) else f32,
        'labeled_markers': labeled,
        'rigid_bodies': bodies,
        'marker_sets': few(st.tuples(names, few(vec3))),
        'other_markers': few(vec3),
        'skeletons': few(st.tuples(i32, bodies)),
        'params': u16,
    }
    if since3:
        fields |= dict.fromkeys(('mid_exposure', 'data_received', 'transmitted'), u64)
    else:
        fields['software_latency'] = f32
    if since41:
        fields['assets'] = few(st.tuples(i32, bodies, labeled))
    if version >= (2, 9):
        fields['force_plates'] = analog
    if version >= (2, 11):
        fields['devices'] = analog
    return st.builds(Frame, **fields)


def demo_scene(version):
    """Build one body of three markers, one stray, two marker sets (natnet-wire.md, section 5)."""
    positions = ((0.1, 0.2, 2.0), (0.2, 0.2, 2.0), (0.1, 0.3, 2.1))
    residual = 2e-4 if version >= (3, 0) else None
    return Frame(
        number=7,
        timestamp=1.5,
        marker_sets=(('Tool_1', positions), ('all', positions)),
        other_markers=((1.0, 1.0, 1.0),),
        rigid_bodies=(
            RigidBody(
                1, (0.1, 0.2, 2.0), (0.0, 0.0, 0.0, 1.0), 1e-4, TRACKING_VALID,
                tuple((p, i, 0.01) for i, p in enumerate(positions, 1)),
            ),
        ),
        labeled_markers=(
            *(
                LabeledMarker(1 << 16 | i, p, 0.01, 0x0A, residual)
                for i, p in enumerate(positions, 1)
            ),
            LabeledMarker(4711, (1.0, 1.0, 1.0), 0.01, 0x12, residual),
        ),
    )  # fmt: skip


@pytest.mark.parametrize(
    ('version', 'bytes_with_header'),
    [
        ((2, 6), 343), ((2, 9), 351), ((2, 10), 351), ((2, 11), 355), ((3, 0), 327),
        ((3, 1), 327), ((4, 0), 327), ((4, 1), 371), ((4, 2), 371),
    ],
)  # fmt: skip
def test_size_of_the_demo_scene(version, bytes_with_header):
    assert 4 + len(encode_frame(demo_scene(version), version)) == bytes_with_header


@pytest.mark.parametrize('version', VERSIONS)
@settings(max_examples=10)
@given(data=st.data())
def test_what_is_encoded_is_decoded_but_for_what_is_stepped_over(version, data):
    frame = data.draw(frames(version))
    decoded = decode_frame(encode_frame(frame, version), version)
    left_out = ('rigid_bodies', 'marker_sets', 'other_markers', 'skeletons', 'assets')
    left_out += ('force_plates', 'devices')
    assert decoded == dataclasses.replace(frame, **dict.fromkeys(left_out, ()))


@pytest.mark.parametrize('version', SOME_VERSIONS)
def test_every_truncation_is_refused(version):
    payload = encode_frame(full_frame(version), version)
    for length in range(len(payload)):
        with pytest.raises(ProtocolError):
            decode_frame(payload[:length], version)


@pytest.mark.parametrize('version', VERSIONS)
def test_bytes_after_the_end_tag_are_refused(version):
    payload = encode_frame(full_frame(version), version)
    with pytest.raises(ProtocolError, match='does not end'):
        decode_frame(payload + b'\0', version)


@settings(max_examples=200)
@given(payload=st.binary(max_size=400), version=st.sampled_from(VERSIONS))
def test_random_bytes_give_a_protocol_error_or_a_frame(payload, version):
    with contextlib.suppress(ProtocolError):
        decode_frame(payload, version)


@settings(max_examples=200)
@given(
    version=st.sampled_from(VERSIONS),
    flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 7)), max_size=8),
)
def test_flipped_bits_give_a_protocol_error_or_a_frame(version, flips):
    payload = bytearray(encode_frame(full_frame(version), version))
    for where, bit in flips:
        payload[where % len(payload)] ^= 1 << bit
    try:
        frame = decode_frame(bytes(payload), version)
    except ProtocolError:
        return
    for marker in frame.labeled_markers:
        assert marker.params & OCCLUDED or all(map(math.isfinite, marker.position))


@pytest.mark.parametrize('version', SOME_VERSIONS)
@pytest.mark.parametrize('count', [-1, 2**31 - 1, 70_000])
def test_absurd_counts_are_refused_at_every_place(version, count):
    """Overwrite every aligned-or-not i32 with a count that the bytes cannot hold."""
    payload = encode_frame(full_frame(version), version)
    for where in range(4, len(payload) - 3):
        damaged = payload[:where] + struct.pack('<i', count) + payload[where + 4 :]
        with contextlib.suppress(ProtocolError):
            decode_frame(damaged, version)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize('version', VERSIONS)
def test_a_measured_position_must_be_finite(version, bad):
    residual = 0.0 if version >= (3, 0) else None
    measured = LabeledMarker(1, (0.0, bad, 0.0), 0.01, MEASURED, residual)
    guessed = measured._replace(params=OCCLUDED)
    with pytest.raises(ProtocolError, match='not finite'):
        decode_frame(encode_frame(Frame(1, 0.0, (measured,)), version), version)
    decoded = decode_frame(encode_frame(Frame(1, 0.0, (guessed,)), version), version)
    assert decoded.labeled_markers[0].params == OCCLUDED
    with pytest.raises(ProtocolError, match='not finite'):
        decode_frame(encode_frame(Frame(1, bad), version), version)


@pytest.mark.parametrize('version', [(1, 9), (2, 5), (5, 0), (0, 0)])
def test_an_unknown_version_is_refused(version):
    with pytest.raises(ProtocolError, match='unknown'):
        decode_frame(b'', version)
    with pytest.raises(ProtocolError, match='unknown'):
        encode_frame(Frame(1, 0.0), version)


def test_a_newer_4_x_is_read_as_the_last_known_one():
    payload = encode_frame(demo_scene((4, 3)), (4, 3))
    assert decode_frame(payload, (4, 5)) == decode_frame(payload, (4, 3))


def test_bytes_that_a_newer_server_adds_to_a_section_are_skipped():
    frame = Frame(3, 0.0, marker_sets=(('all', ((1.0, 2.0, 3.0),)),))
    payload = encode_frame(frame, (4, 1))
    size = struct.unpack_from('<i', payload, 8)[0]
    longer = payload[:8] + struct.pack('<i', size + 3) + payload[12 : 12 + size] + b'xyz'
    assert decode_frame(longer + payload[12 + size :], (4, 1)) == decode_frame(payload, (4, 1))


def test_labelled_markers_of_another_size_are_refused():
    """A size that does not fit the count means that this layout is not the known one."""
    payload = bytearray(encode_frame(Frame(3, 0.0, (LabeledMarker(1, (0.0,) * 3, 0.0, 2, 0.0),)),
                                     (4, 1)))  # fmt: skip
    where = payload.index(struct.pack('<2i', 1, 26))
    payload[where + 4 : where + 8] = struct.pack('<i', 28)
    with pytest.raises(ProtocolError, match='claims 28 bytes'):
        decode_frame(bytes(payload), (4, 1))


def test_labelled_marker_bytes_by_hand():
    """The layout of natnet-wire.md, section 5, written out; not by our encoder."""
    payload = (
        struct.pack('<i', 99)  # frame number
        + struct.pack('<i', 0) * 4  # marker sets, other markers, bodies, skeletons
        + struct.pack('<i', 1)
        + struct.pack('<i3ffhf', 2 << 16 | 3, 0.5, -0.25, 2.0, 0.016, 0x0A, 0.125)
        + struct.pack('<i', 0) * 2  # force plates, devices
        + struct.pack('<IId', 1, 2, 12.5)
        + struct.pack('<QQQ', 10, 20, 30)
        + struct.pack('<hi', 0b100, 0)
    )
    frame = decode_frame(payload, (3, 1))
    assert frame.number == 99
    assert frame.timestamp == 12.5
    assert (frame.mid_exposure, frame.data_received, frame.transmitted) == (10, 20, 30)
    assert frame.params == 0b100
    (marker,) = frame.labeled_markers
    assert (marker.id >> 16, marker.id & 0xFFFF) == (2, 3)
    assert marker.position == (0.5, -0.25, 2.0)
    assert (marker.params, marker.residual) == (0x0A, 0.125)
