# SPDX-License-Identifier: Apache-2.0
"""The emScon packets: whole, byte by byte, with trailing junk, damaged; no network."""

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from remaster_ros.sensors.laser_tracker.codes import Command, Status, describe_status
from remaster_ros.sensors.laser_tracker.packets import (
    MAX_PACKET_SIZE,
    NEED_DATA,
    ConnectionClosed,
    ErrorReport,
    Event,
    Measurement,
    PacketReader,
    ProtocolError,
    Reply,
    Request,
    StatusChange,
    UnknownPacket,
    encode,
)

RESULT = Measurement(
    0, 0, 0, values=(1.0, 2.0, 3.0), std=(1e-6, 2e-6, 3e-6), std_total=4e-6,
    pointing_error=(0.1, 0.2, 0.3), a_priori_std=(5e-6, 6e-6, 7e-6), a_priori_std_total=8e-6,
    temperature=20.5, pressure=1013.0, humidity=42.0,
)  # fmt: skip

# Written out by hand from the layout, so that encode and decode cannot share a mistake.
KNOWN: list[tuple[str, Event, bytes]] = [
    ('server', Request(Command.INITIALIZE), struct.pack('<iII', 12, 0, 7)),
    (
        'server',
        Request(Command.GO_POSITION, (1.0, 2.0, 3.0, 1)),
        struct.pack('<iII3di', 40, 0, 55, 1.0, 2.0, 3.0, 1),
    ),
    ('client', Reply(Command.FIND_REFLECTOR), struct.pack('<iIII', 16, 0, 63, 0)),
    (
        'client',
        Reply(Command.GET_TRACKER_STATUS, 0, (2,)),
        struct.pack('<iIIII', 20, 0, 2, 0, 2),
    ),
    ('client', ErrorReport(49, 10013), struct.pack('<iIII', 16, 1, 49, 10013)),
    ('client', StatusChange(25), struct.pack('<iII', 12, 8, 25)),
    (
        'client',
        RESULT,
        struct.pack(
            '<iIIIi17d',
            *(156, 2, 0, 0, 0),
            *(1.0, 2.0, 3.0, 1e-6, 2e-6, 3e-6, 4e-6),
            *(0.1, 0.2, 0.3, 5e-6, 6e-6, 7e-6, 8e-6, 20.5, 1013.0, 42.0),
        ),
    ),
    ('client', UnknownPacket(7, b'abcd'), struct.pack('<iI', 12, 7) + b'abcd'),
]
each_known = pytest.mark.parametrize(('side', 'event', 'packet'), KNOWN)


def drain(reader: PacketReader) -> list[Event]:
    events = []
    while (event := reader.next_event()) is not NEED_DATA:
        events.append(event)
    return events


@each_known
def test_packet_has_the_bytes_of_the_layout(side, event, packet):
    assert encode(event) == packet


@each_known
def test_byte_by_byte(side, event, packet):
    reader = PacketReader(side)
    for i in range(len(packet) - 1):
        reader.receive_data(packet[i : i + 1])
        assert reader.next_event() is NEED_DATA
    reader.receive_data(packet[-1:])
    assert drain(reader) == [event]


@each_known
def test_trailing_bytes_stay_for_the_next_packet(side, event, packet):
    reader = PacketReader(side)
    reader.receive_data(packet)
    assert drain(reader) == [event]
    assert reader.trailing_data == b''
    reader.receive_data(packet + packet[:5])
    assert drain(reader) == [event]
    assert reader.trailing_data == packet[:5]
    reader.receive_data(packet[5:])
    assert drain(reader) == [event]


@each_known
def test_close_in_mid_packet_is_an_error_for_good(side, event, packet):
    for cut in range(1, len(packet)):
        reader = PacketReader(side)
        reader.receive_data(packet[:cut])
        reader.receive_data(b'')
        for _ in range(2):
            with pytest.raises(ProtocolError, match=f'after {cut} of at least'):
                reader.next_event()
        assert reader.broken


def test_close_between_packets_is_an_event():
    reader = PacketReader('client')
    reader.receive_data(encode(StatusChange(27)))
    reader.receive_data(b'')
    assert reader.next_event() == StatusChange(27)
    assert reader.next_event() == ConnectionClosed()


@pytest.mark.parametrize('size', [-(2**31), -1, 0, 11, MAX_PACKET_SIZE + 1, 2**31 - 1])
def test_impossible_size_breaks_the_stream_at_once(size):
    reader = PacketReader('client')
    reader.receive_data(struct.pack('<iI', size, 8))
    for _ in range(2):
        with pytest.raises(ProtocolError, match=f'packet size {size} '):
            reader.next_event()
    assert reader.broken


@pytest.mark.parametrize(
    ('side', 'packet'),
    [
        ('client', struct.pack('<iIIII', 20, 1, 49, 10013, 0)),  # error report, too long
        ('client', struct.pack('<iIII', 16, 8, 25, 0)),  # status change, too long
        ('client', struct.pack('<iI', 148, 2) + bytes(140)),  # result, too short
        ('client', struct.pack('<iII', 12, 0, 7)),  # reply without a status
        ('client', struct.pack('<iIII', 16, 0, 2, 0)),  # reply without its value
        ('client', struct.pack('<iIIII', 20, 0, 7, 0, 0)),  # reply with a value too many
        ('server', struct.pack('<iIII', 16, 0, 63, 3)),  # half of a distance
    ],
)
def test_wrong_body_is_dropped_and_the_stream_goes_on(side, packet):
    reader = PacketReader(side)
    after = Request(Command.INITIALIZE) if side == 'server' else StatusChange(27)
    reader.receive_data(packet + encode(after))
    with pytest.raises(ProtocolError):
        reader.next_event()
    assert not reader.broken
    assert drain(reader) == [after]


@pytest.mark.parametrize('side', ['client', 'server'])
def test_unknown_command_is_an_event_not_an_error(side):
    reader = PacketReader(side)
    reader.receive_data(struct.pack('<iIII', 16, 0, 9999, 0))
    (event,) = drain(reader)
    assert event == UnknownPacket(0, struct.pack('<II', 9999, 0))


def test_failed_reply_comes_with_or_without_its_values():
    failed = Reply(Command.GET_UNITS, Status.SERVER_BUSY)
    assert len(encode(failed)) == 36
    reader = PacketReader('client')
    reader.receive_data(encode(failed) + struct.pack('<iIII', 16, 0, 6, 1))
    assert drain(reader) == [failed, failed]


@pytest.mark.parametrize(
    'event',
    [
        Request(Command.FIND_REFLECTOR),
        Request(Command.FIND_REFLECTOR, ('far',)),
        Request(Command.SET_REFLECTOR, (2**40,)),
        Reply(Command.GET_UNITS, 0, (1, 2)),
        ErrorReport(-1, 0),
        ConnectionClosed(),
    ],
)
def test_encode_refuses_what_has_no_packet(event):
    with pytest.raises(ValueError, match='packet'):
        encode(event)


# Round trips

uint32 = st.integers(0, 2**32 - 1)
double = st.floats(allow_nan=False)
three = st.tuples(double, double, double)


def values_of(layout: struct.Struct) -> st.SearchStrategy:
    """Strategy for the values of a struct layout."""
    kinds = {'I': uint32, 'i': st.integers(-(2**31), 2**31 - 1), 'd': double}
    sample = layout.unpack(bytes(layout.size))
    codes = []
    # '2iId64s' -> one entry per value
    digits = ''
    for letter in layout.format.lstrip('<'):
        if letter.isdigit():
            digits += letter
            continue
        count = int(digits or 1)
        codes += (
            [st.binary(min_size=count, max_size=count)]
            if letter == 's'
            else ([kinds[letter]] * count)
        )
        digits = ''
    assert len(codes) == len(sample)
    return st.tuples(*codes)


@st.composite
def requests(draw):
    command = draw(st.sampled_from(Command))
    return Request(command, draw(values_of(command.request)))


@st.composite
def replies(draw):
    command = draw(st.sampled_from(Command))
    status = draw(st.just(0) | uint32)
    return Reply(command, status, () if status else draw(values_of(command.reply)))


results = st.builds(
    Measurement, status=uint32, mode=uint32, is_try=st.integers(0, 1), values=three, std=three,
    std_total=double, pointing_error=three, a_priori_std=three, a_priori_std_total=double,
    temperature=double, pressure=double, humidity=double,
)  # fmt: skip
from_instrument = (
    replies()
    | results
    | st.builds(ErrorReport, uint32, uint32)
    | st.builds(StatusChange, uint32)
    | st.builds(UnknownPacket, st.integers(100, 2**32 - 1), st.binary(min_size=4, max_size=99))
)


def feed(reader: PacketReader, stream: bytes, cuts: list[int]) -> list[Event]:
    """Feed a stream in pieces cut at the given places."""
    events = []
    places = sorted({c % (len(stream) + 1) for c in cuts} | {0, len(stream)})
    for a, b in itertools.pairwise(places):
        reader.receive_data(stream[a:b])
        events += drain(reader)
    return events


@given(st.lists(requests(), min_size=1, max_size=5), st.lists(st.integers(0, 10_000)))
def test_requests_survive_any_cutting_of_the_stream(sent, cuts):
    assert feed(PacketReader('server'), b''.join(map(encode, sent)), cuts) == sent


@given(st.lists(from_instrument, min_size=1, max_size=5), st.lists(st.integers(0, 10_000)))
def test_what_an_instrument_sends_survives_any_cutting_of_the_stream(sent, cuts):
    assert feed(PacketReader('client'), b''.join(map(encode, sent)), cuts) == sent


@given(
    st.sampled_from(['client', 'server']),
    st.lists(from_instrument | requests(), max_size=3),
    st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=5),
    st.binary(max_size=40),
)
def test_damage_raises_one_exception_and_memory_stays_bounded(side, sent, flips, junk):
    stream = bytearray(b''.join(map(encode, sent)) + junk)
    for place, value in flips:
        if stream:
            stream[place % len(stream)] = value
    reader = PacketReader(side)
    for i in range(0, len(stream), 100):
        reader.receive_data(bytes(stream[i : i + 100]))
        while True:
            try:
                if reader.next_event() is NEED_DATA:
                    break
            except ProtocolError:
                if reader.broken:
                    return
        assert len(reader.trailing_data) < MAX_PACKET_SIZE


@given(st.integers(0, 2**32 - 1))
def test_every_status_is_described_in_one_line(status):
    text = describe_status(status)
    assert str(status) in text
    assert '\n' not in text


@pytest.mark.parametrize('status', list(Status)[1:])
def test_every_status_we_know_has_words_and_a_remedy(status):
    assert '; ' in describe_status(status)
