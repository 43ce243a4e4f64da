# SPDX-License-Identifier: Apache-2.0
"""Which of address, interface, multicast, port, version or rigid body is wrong."""

import dataclasses

import pytest

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack.frame_gate import Dropped
from remaster_ros.sensors.optitrack.marker_follower import (
    StreamStatus,
    diagnose,
    warning,
)
from remaster_ros.sensors.optitrack.natnet import Connection, ServerInfo
from remaster_ros.sensors.optitrack.settings import NatNetSettings

GROUP = '239.255.42.99'
MULTICAST = Connection(10_000_000, 1511, True, GROUP)


def server(version=(3, 1), connection=MULTICAST):
    return ServerInfo('Motive', (3, 1, 0, 0), version, connection)


FINE = StreamStatus(
    server_ip='10.0.0.2', interface='10.0.0.1', server=server(), version=(3, 1),
    port_closed=False, send_error='', silent_s=0.1, starved_s=0.1, frames=100, accepted=90,
    lost=0, restarts=0, dropped={}, last_reason=None, foreign=(), last_malformed='', problem='',
    marker_id=65537, labels=(65537,),
)  # fmt: skip
SETTINGS = NatNetSettings(server='motive', transport='multicast')


def test_nothing_is_wrong_when_readings_come():
    diagnosis = diagnose(FINE, SETTINGS)
    assert (diagnosis.fault, diagnosis.message) == ('none', '')


def test_who_else_sends_is_told_while_readings_come():
    status = dataclasses.replace(FINE, source='10.0.0.2:4', rivals=('10.0.0.2:5',))
    assert diagnose(status, SETTINGS).fault == 'none'
    assert '10.0.0.2:5 and are refused; those of 10.0.0.2:4' in warning(status)
    assert warning(dataclasses.replace(FINE, source='10.0.0.2:4')) == ''


NO_SERVER = {'server': None, 'version': None, 'silent_s': None}
NO_FRAMES = {'silent_s': None}
OTHER_GROUP = dataclasses.replace(MULTICAST, multicast_group='239.1.1.1')
OTHER_PORT = dataclasses.replace(MULTICAST, data_port=1600)
UNICAST = dataclasses.replace(MULTICAST, is_multicast=False)


@pytest.mark.parametrize(
    ('status', 'fault', 'text'),
    [
        (NO_SERVER, 'address', 'no answer from motive:1510'),
        (NO_SERVER | {'port_closed': True}, 'port', 'nothing listens on UDP port 1510'),
        (NO_SERVER | {'send_error': 'No route to host'}, 'interface', 'No route to host'),
        (NO_SERVER | {'foreign': ('10.0.0.9',)}, 'address', 'come from 10.0.0.9, not from 10'),
        ({'server': server((5, 0)), 'version': (5, 0)}, 'version', '2.6 to 4.3 can be read'),
        ({'server': server((2, 5)), 'version': (2, 5)}, 'version', '2.6 to 4.3 can be read'),
        (NO_FRAMES, 'interface', f'no frame comes from {GROUP}:1511 on 10.0.0.1'),
        (NO_FRAMES | {'server': server(connection=UNICAST)}, 'multicast', 'streams unicast'),
        (NO_FRAMES | {'server': server(connection=OTHER_GROUP)}, 'multicast', '239.1.1.1'),
        (NO_FRAMES | {'server': server(connection=OTHER_PORT)}, 'port', 'UDP port 1600'),
        (NO_FRAMES | {'server': server((2, 10), None)}, 'interface', 'no frame comes'),
        (NO_FRAMES | {'last_malformed': 'junk'}, 'version', 'not NatNet 3.1 (junk)'),
        (NO_FRAMES | {'foreign': ('10.0.0.9',)}, 'address', '10.0.0.9'),
        ({'silent_s': 3.2}, 'silence', 'no frame for 3.2 s'),
        ({'silent_s': 3.2, 'rivals': ('10.0.0.2:5',)}, 'address', 'only from 10.0.0.2:5, which'),
        (
            NO_FRAMES | {'contestants': ('10.0.0.2:5', '10.0.0.2:6')},
            'address',
            '10.0.0.2:5 and 10.0.0.2:6 at the same time',
        ),
        ({'problem': "no rigid body 'x'"}, 'rigid_body', "no rigid body 'x'"),
        ({'starved_s': None, 'last_reason': Dropped.NOT_PRESENT}, 'rigid_body', '1:1 is not in'),
        ({'starved_s': 2.0, 'last_reason': Dropped.OCCLUDED}, 'marker', 'hidden'),
        ({'starved_s': 2.0, 'last_reason': Dropped.MODEL_FILLED}, 'marker', 'guesses'),
        ({'starved_s': 2.0, 'last_reason': Dropped.NOT_LIVE}, 'silence', 'Live mode'),
        ({'starved_s': 2.0, 'last_reason': Dropped.JUMP}, 'marker', 'jumps'),
        ({'starved_s': 2.0, 'last_reason': Dropped.DISAGREEMENT}, 'marker', 'two decoders'),
        ({'starved_s': None, 'marker_id': None, 'last_reason': Dropped.NOT_PRESENT}, 'marker',
         'the marker is not in the frames'),
        ({'starved_s': 2.0, 'marker_id': None, 'last_reason': Dropped.AMBIGUOUS}, 'marker',
         'not the only one'),
    ],
)  # fmt: skip
def test_each_fault_is_named_with_its_remedy(status, fault, text):
    diagnosis = diagnose(dataclasses.replace(FINE, **status), SETTINGS)
    assert diagnosis.fault == fault
    assert text in diagnosis.message
    assert '\n' not in diagnosis.message


def test_unicast_clients_are_told_of_a_multicast_server_and_of_silence():
    settings = NatNetSettings(transport='unicast')
    status = dataclasses.replace(FINE, silent_s=None)
    assert diagnose(status, settings).fault == 'multicast'
    status = dataclasses.replace(status, server=server(connection=UNICAST))
    assert 'unicast' in diagnose(status, settings).message


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('transport', 'broadcast'),
        ('multicast_group', '10.0.0.1'),
        ('multicast_group', '239.255.42'),
        ('multicast_group', 'motive'),
        ('command_port', 0),
        ('data_port', 70_000),
        ('silence_s', 0.0),
        ('bitstream', '3.1'),  # multicast has one version for all
    ],
)
def test_settings_that_cannot_work_are_refused(field, value):
    with pytest.raises(InputError, match=field):
        NatNetSettings(**{field: value})


@pytest.mark.parametrize('bitstream', ['5.0', '1.9', 'new', '4'])
def test_a_bitstream_that_cannot_be_read_is_refused(bitstream):
    assert NatNetSettings(transport='unicast', bitstream='4.1').wanted_version == (4, 1)
    with pytest.raises(InputError, match='bitstream'):
        NatNetSettings(transport='unicast', bitstream=bitstream)
