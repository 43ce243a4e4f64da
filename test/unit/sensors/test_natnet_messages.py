# SPDX-License-Identifier: Apache-2.0
"""Everything but frames: server info, requests, model definitions; whole, cut and damaged."""

import contextlib
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from remaster_ros.sensors.optitrack import natnet, natnet_model
from remaster_ros.sensors.optitrack.natnet import MessageId
from remaster_ros.sensors.optitrack.natnet_bytes import ProtocolError
from remaster_ros.sensors.optitrack.natnet_frame import Frame
from remaster_ros.sensors.optitrack.natnet_model import (
    MarkerSetDescription,
    ModelDefinition,
    OtherDescription,
    RigidBodyDescription,
)

VERSIONS = [(2, 6), (2, 10), (2, 11), (3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3)]
CONNECTION = natnet.Connection(10_000_000, 1511, True, '239.255.42.99')


def server_info(version):
    connection = CONNECTION if version >= (3, 0) else None
    return natnet.ServerInfo('Motive', (3, 1, 0, 0), version, connection)


def tool(version):
    """Build a body as complete as the version can carry it."""
    known = {}
    if version >= (3, 0):
        known |= {'marker_positions': ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)), 'marker_labels': (0, 7)}
    if version >= (4, 0):
        known['marker_names'] = ('sir', 'Marker 2')
    if version >= (4, 2):
        known['offset_rotation'] = (0.0, 1.0, 0.0, 0.0)
    return RigidBodyDescription('tool', 1, -1, (0.25, 0.5, 1.0), **known)


def model(version):
    return ModelDefinition((MarkerSetDescription('all', ('tool_1', 'tool_2')), tool(version)))


def messages(version):
    return [
        server_info(version),
        model(version),
        Frame(1, 2.5, software_latency=0.0),
        natnet.Response(struct.pack('<i', 0)),
        natnet.Response(b'Bitstream,4.1\0'),
        natnet.MessageString('hello'),
        natnet.EchoResponse(2**64 - 1, 5),
        natnet.Notice(MessageId.UNRECOGNIZED_REQUEST),
        natnet.Notice(MessageId.DISCONNECT_BY_TIMEOUT),
    ]


@pytest.mark.parametrize('version', VERSIONS)
def test_messages_arrive_whole_and_with_trailing_junk(version):
    for message in messages(version):
        datagram = natnet.encode_message(message, version)
        assert natnet.decode_message(datagram, version) == message
        assert natnet.decode_message(datagram + b'junk', version) == message


@pytest.mark.parametrize('version', VERSIONS)
def test_every_truncation_is_refused(version):
    for message in messages(version):
        datagram = natnet.encode_message(message, version)
        for length in range(len(datagram)):
            with pytest.raises(ProtocolError):
                natnet.decode_message(datagram[:length], version)


@pytest.mark.parametrize('version', VERSIONS)
def test_a_payload_cut_with_a_header_that_agrees_is_refused(version):
    for message in (server_info(version), model(version)):
        message_id, payload = natnet.split_datagram(natnet.encode_message(message, version))
        for length in range(len(payload)):
            with pytest.raises(ProtocolError):
                natnet.decode_message(natnet.join_datagram(message_id, payload[:length]), version)


@settings(max_examples=500)
@given(
    datagram=st.one_of(
        st.binary(max_size=300),
        st.builds(
            lambda i, p: struct.pack('<HH', i, len(p)) + p,
            st.integers(0, 15) | st.just(100),
            st.binary(max_size=300),
        ),
    ),
    version=st.sampled_from(VERSIONS) | st.none(),
)
def test_random_bytes_raise_nothing_but_protocol_errors(datagram, version):
    for decode in (lambda: natnet.decode_message(datagram, version),
                   lambda: natnet.decode_request(datagram)):  # fmt: skip
        with contextlib.suppress(ProtocolError):
            decode()


@settings(max_examples=200)
@given(
    version=st.sampled_from(VERSIONS),
    which=st.integers(0, 8),
    flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 7)), max_size=8),
)
def test_flipped_bits_raise_nothing_but_protocol_errors(version, which, flips):
    datagram = bytearray(natnet.encode_message(messages(version)[which], version))
    for where, bit in flips:
        datagram[where % len(datagram)] ^= 1 << bit
    with contextlib.suppress(ProtocolError):
        natnet.decode_message(bytes(datagram), version)


@pytest.mark.parametrize(('version', 'size'), [((2, 10), 268), ((3, 1), 283), ((4, 1), 283)])
def test_size_of_server_info(version, size):
    assert len(natnet.encode_message(server_info(version), version)) == size


def test_nothing_versioned_is_decoded_before_the_version_is_known():
    for message in (Frame(1, 0.0), model((4, 1))):
        with pytest.raises(ProtocolError, match='not known yet'):
            natnet.decode_message(natnet.encode_message(message, (4, 1)), None)


@pytest.mark.parametrize(
    ('datagram', 'wanted'),
    [
        (struct.pack('<HH', 0, 0), None),
        (struct.pack('<HH', 0, 4), None),  # natnetclient: a length without the bytes
        (struct.pack('<HH', 0, 5) + b'Ping\0', None),
        (natnet.encode_connect_request('me'), None),
        (natnet.encode_connect_request('me', (4, 1)), (4, 1)),
        (struct.pack('<HH', 0, 269) + bytes(264) + bytes([0, 3, 1, 0, 0]), (3, 1)),
    ],
)
def test_every_form_of_connect_is_understood(datagram, wanted):
    request = natnet.decode_request(datagram)
    assert request == natnet.ClientRequest(MessageId.CONNECT, wanted_version=wanted)


def test_requests_are_understood_whatever_their_header_says():
    assert natnet.decode_request(natnet.encode_command_request('FrameRate')).text == 'FrameRate'
    assert natnet.decode_request(struct.pack('<HH', 2, 0) + b'Bitstream,4.1').text == (
        'Bitstream,4.1'
    )
    assert natnet.decode_request(natnet.encode_echo_request(2**63)).clock == 2**63
    for message_id in (MessageId.REQUEST_MODELDEF, MessageId.KEEPALIVE, MessageId.DISCONNECT):
        plain = natnet.ClientRequest(message_id)
        assert natnet.decode_request(natnet.join_datagram(message_id)) == plain
        assert natnet.decode_request(struct.pack('<HH', message_id, 0) + b'\0') == plain


def test_answers_read_as_number_or_text():
    assert natnet.Response(struct.pack('<f', 120.0)).value == 120.0
    assert natnet.Response(struct.pack('<i', -3)).code == -3
    named = natnet.Response(b'Bitstream,4.1\0')
    assert (named.text, named.code, named.value) == ('Bitstream,4.1', None, None)


def text(value):
    return value.encode() + b'\0'


def other_descriptions(version):
    """Descriptions of the kinds whose details are skipped, by the tables of natnet-wire.md."""
    body = text('bone') + struct.pack('<2i3f', 1, -1, 0, 0, 0)
    if version >= (4, 2):
        body += bytes(16)
    if version >= (3, 0):
        body += struct.pack('<i3fi', 1, 0, 0, 0, 0)
    if version >= (4, 0):
        body += text('Marker 1')
    channels = struct.pack('<i', 2) + text('Fx') + text('Fy')
    kinds = [(2, text('person') + struct.pack('<2i', 4, 2) + 2 * body)]
    if version < (3, 0):
        return kinds
    kinds += [
        (3, struct.pack('<i', 8) + text('SN8') + struct.pack('<2f', 0.4, 0.6)
            + bytes(12 + 4 * 144 + 4 * 12) + struct.pack('<2i', 0, 0) + channels),
        (4, struct.pack('<i', 9) + text('DAQ') + text('SN9') + bytes(8) + channels),
        (5, text('Camera 1') + struct.pack('<7f', 0, 0, 0, 0, 0, 0, 1)),
    ]  # fmt: skip
    if version >= (4, 1):
        marker = text('knee') + struct.pack('<i3ffh', 1, 0, 0, 0, 0.01, 0)
        kinds.append((6, text('leg') + struct.pack('<3i', 0, 12, 1) + body
                      + struct.pack('<i', 1) + marker))  # fmt: skip
    return kinds


@pytest.mark.parametrize('version', VERSIONS)
def test_descriptions_of_other_kinds_are_walked_over(version):
    kinds = other_descriptions(version)
    payload = struct.pack('<i', len(kinds) + 1)
    for kind, body in kinds:
        size = struct.pack('<i', len(body)) if version >= (4, 1) else b''
        payload += struct.pack('<i', kind) + size + body
    only_tool = natnet_model.encode_model_definition(ModelDefinition((tool(version),)), version)
    payload += only_tool[4:]
    definition = natnet_model.decode_model_definition(payload, version)
    expected = [
        *((2, 'person', 4), (3, 'SN8', 8), (4, 'DAQ', 9), (5, 'Camera 1', None)),
        (6, 'leg', 12),
    ]
    assert definition.descriptions[:-1] == tuple(
        OtherDescription(*e) for e in expected[: len(kinds)]
    )
    assert definition.rigid_bodies == (tool(version),)
    assets = {'tool': 1} | ({'leg': 12} if version >= (4, 1) else {})
    assert definition.labelled_assets == assets


def test_a_description_of_an_unknown_kind_is_skipped_where_its_size_is_known():
    unknown = struct.pack('<2i', 77, 3) + b'abc'
    only_tool = natnet_model.encode_model_definition(ModelDefinition((tool((4, 1)),)), (4, 1))
    payload = struct.pack('<i', 2) + unknown + only_tool[4:]
    definition = natnet_model.decode_model_definition(payload, (4, 1))
    assert definition.descriptions == (OtherDescription(77, ''), tool((4, 1)))
    with pytest.raises(ProtocolError, match='unknown kind 77'):
        natnet_model.decode_model_definition(struct.pack('<2i', 1, 77), (3, 1))


def test_what_cannot_be_encoded_is_refused_by_the_sender():
    with pytest.raises(ValueError, match='255 bytes'):
        natnet.encode_command_request('x' * 256)
    with pytest.raises(ValueError, match='65503'):
        natnet.join_datagram(7, bytes(65504))
    with pytest.raises(ValueError, match='cannot be encoded'):
        natnet_model.encode_model_definition(ModelDefinition((OtherDescription(5, 'c'),)), (4, 1))
    with pytest.raises(ValueError, match='how it streams'):
        natnet.encode_message(natnet.ServerInfo('x', (1, 0, 0, 0), (3, 1)), (3, 1))


@pytest.mark.parametrize('bad', ['4', '', 'x.y', '4.-1', '٤.١', '4.1.x'])
def test_versions_as_text(bad):
    assert natnet.parse_version('4.1') == (4, 1)
    assert natnet.parse_version('2.10.0.0') == (2, 10)
    assert natnet.format_version((2, 10)) == '2.10'
    with pytest.raises(ValueError):
        natnet.parse_version(bad)
