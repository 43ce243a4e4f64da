# SPDX-License-Identifier: Apache-2.0
"""A short run of the fuzzer; FUZZ=1000000 takes as many inputs of each kind."""

from __future__ import annotations

import os
import random
import time

import pytest
from hostile import fuzz_messages, fuzzing

SEED = random.SystemRandom().randrange(10**6)
INPUTS = int(os.environ.get('FUZZ', '5000'))


@pytest.fixture
def rng():
    print(f'seed {SEED}')
    return random.Random(SEED)


@pytest.mark.parametrize('version', [(2, 6), (2, 11), (3, 1), (4, 3)])
def test_no_datagram_harms_the_optitrack_client(rng, version):
    client = fuzzing.NatNetClientTarget(rng, version)
    with fuzzing.silent_natnet_client():
        fuzzing.run(
            fuzz_messages.natnet_mutator(rng, version),
            [fuzzing.decode_as_any_version(rng), client],
            INPUTS,
        )
    assert client.samples > 50, 'hardly anything came through: the fuzzer tests next to nothing'
    assert client.strangers > 5


def test_no_packet_harms_the_laser_tracker_client(rng):
    client = fuzzing.TrackerClientTarget(rng)
    fuzzing.run(
        fuzz_messages.emscon_mutator(rng), [fuzzing.read_from_both_sides(rng), client], INPUTS
    )
    assert client.readings > 20
    assert client.errors > 20


def test_every_valid_message_is_taken():
    """The seeds of the fuzzer are what they claim to be."""
    for version in fuzz_messages.VERSIONS:
        for datagram in fuzz_messages.natnet_seeds(version)[:5]:
            fuzz_messages.natnet.decode_message(datagram, version)
    for packet in fuzz_messages.emscon_seeds():
        taken = 0
        for side in ('client', 'server'):
            reader = fuzz_messages.emscon.PacketReader(side)
            reader.receive_data(packet)
            try:
                taken += reader.next_event() is not fuzz_messages.emscon.NEED_DATA
            except fuzz_messages.emscon.ProtocolError:
                continue
        assert taken, packet


def test_the_fuzzer_itself_finds_a_crash_and_a_hang(rng, monkeypatch):
    def crash(data):
        if len(data) % 7 == 0:
            raise KeyError('found')

    make = fuzz_messages.natnet_mutator(rng, (3, 1))
    with pytest.raises(fuzzing.FuzzError, match=r"KeyError: 'found'; input [0-9a-f]*$"):
        fuzzing.run(make, [crash], 1000)

    def hang(data):
        until = time.thread_time() + 0.02
        while time.thread_time() < until:
            pass

    monkeypatch.setattr(fuzzing, 'TIME_LIMIT_S', 0.01)
    with pytest.raises(fuzzing.FuzzError, match='processor time'):
        fuzzing.run(make, [hang], 1)
