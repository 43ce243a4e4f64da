# SPDX-License-Identifier: Apache-2.0
"""CESAPI, an independent client of Leica trackers, as judge of the packets and of the fake."""

from __future__ import annotations

import re

import numpy as np
import pytest
from worlds.tracker_world import MARKER, ReflectorWorld, across_and_along

from remaster_ros.sensors.laser_tracker.codes import Command, Status
from remaster_ros.sensors.laser_tracker.packets import (
    ErrorReport,
    Measurement,
    PacketReader,
    Reply,
    Request,
    StatusChange,
    encode,
)
from remaster_ros.simulation.laser_tracker import FakeLaserTracker
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour

packet = pytest.importorskip('CESAPI.packet', reason='the judge, PyPI CESAPI, is not installed')
from CESAPI.command import CommandSync  # noqa: E402
from CESAPI.connection import Connection  # noqa: E402

COMMAND_PACKETS = sorted(name[:-2] for name in vars(packet) if re.fullmatch(r'[A-Z]\w+CT', name))
COMMAND_PACKETS.remove('BasicCommand')


@pytest.mark.parametrize('name', COMMAND_PACKETS)
def test_every_command_it_packs_is_one_we_read(name):
    theirs = vars(packet)[name + 'CT']()
    data = theirs.pack()
    reader = PacketReader('server')
    reader.receive_data(data)
    event = reader.next_event()
    assert isinstance(event, Request)
    assert event.command == theirs.packetInfo.command
    assert encode(event) == data


@pytest.mark.parametrize('name', COMMAND_PACKETS)
def test_every_reply_we_pack_is_one_it_reads(name):
    """Numbers differ from field to field, so that a swap would show."""
    theirs = vars(packet)[name + 'RT']()
    command = Command(theirs.packetInfo.command)
    zeros = command.reply.unpack(bytes(command.reply.size))
    values = tuple(
        bytes([i]) * len(v) if isinstance(v, bytes) else type(v)(i)
        for i, v in enumerate(zeros, start=1)
    )
    data = encode(Reply(command, 0, values))
    read = packet.PacketFactory().packet(data)
    assert type(read) is type(theirs)
    assert read.packetInfo.packetHeader.lPacketSize == len(data)
    assert read.packetInfo.packetHeader.lPacketSize == theirs.packetInfo.packetHeader.lPacketSize
    # The values it unpacked are those it packs again.
    assert read.pack() == data


def test_the_packets_that_are_no_replies():
    result = Measurement(
        0, 0, 0, (1, 2, 3), (4, 5, 6), 7, (8, 9, 10), (11, 12, 13), *range(14, 18)
    )
    read = packet.PacketFactory().packet(encode(result))
    fields = 'dVal1 dVal2 dVal3 dStd1 dStd2 dStd3 dStdTotal dPointingError1 dPointingError2'
    fields += ' dPointingError3 dAprioriStd1 dAprioriStd2 dAprioriStd3 dAprioriStdTotal'
    fields += ' dTemperature dPressure dHumidity'
    assert [getattr(read, field) for field in fields.split()] == list(range(1, 18))

    read = packet.PacketFactory().packet(encode(StatusChange(25)))
    assert read.systemStatusChange == packet.ES_SSC_MeasStatus_NotReady
    read = packet.PacketFactory().packet(encode(ErrorReport(49, 10013)))
    assert (read.command, read.status) == (
        packet.ES_C_StartMeasurement,
        packet.ES_RS_SensorNotStable,
    )


def test_the_numbers_of_statuses_are_its_numbers():
    theirs = {
        re.sub('[^a-z0-9]', '', key.removeprefix('ES_RS_').lower()): value
        for key, value in vars(packet).items()
        if key.startswith('ES_RS_')
    }
    short = {'systemnotready': 'systemnotreadyformeasurement'}
    for status in Status:
        name = status.name.replace('_', '').lower()
        assert theirs[short.get(name, name)] == status


@pytest.fixture
def judge():
    """Yield the world, the fake and the third-party client connected to it."""
    world = ReflectorWorld()
    behaviour = TrackerBehaviour(warm_up_s=0.0, search_failure_share=0.0)
    with FakeLaserTracker(
        world, 'tracker', np.random.default_rng(11), behaviour=behaviour
    ) as fake:
        connection = Connection()
        connection.connect(*fake.address)
        try:
            yield world, fake, CommandSync(connection)
        finally:
            # Its reading thread may sit in recv until its time-out of 1 s.
            connection.disconnect()


def test_it_initialises_finds_the_reflector_and_measures(judge):
    """Errors within 6 standard deviations: fails less than once in 10^7 runs."""
    _world, fake, command = judge
    command.Initialize()
    status = command.GetSystemStatus()
    assert status.trackerProcessorStatus == packet.ES_TPS_Initialized
    assert command.GetTrackerStatus().trackerStatus == packet.ES_TS_NotReady

    units = packet.SystemUnitsDataT()
    units.lenUnitType = packet.ES_LU_Millimeter
    command.SetUnits(units)
    assert command.GetUnits().unitsSettings.lenUnitType == packet.ES_LU_Millimeter
    command.SetCoordinateSystemType(packet.ES_CS_RHR)
    command.SetMeasurementMode(packet.ES_MM_Stationary)
    mode = packet.StationaryModeDataT()
    mode.lMeasTime, mode.bUseADM = 500, 1
    command.SetStationaryModeParams(mode)
    reflector = command.GetReflectors().iInternalReflectorId
    command.SetReflector(reflector)
    assert command.GetReflector().iInternalReflectorId == reflector
    air = packet.EnvironmentDataT()
    air.dTemperature, air.dPressure, air.dHumidity = 21.5, 1001.0, 44.0
    command.SetEnvironmentParams(air)

    command.FindReflector(float(np.linalg.norm(MARKER)) * 1e3)
    assert fake.locked
    result = command.StartMeasurement()
    measured = np.array([result.dVal1, result.dVal2, result.dVal3]) * 1e-3
    across, along = across_and_along(measured - MARKER, MARKER)
    assert across < 6 * 14e-6 * np.sqrt(2)
    assert abs(along) < 6 * 6e-6
    assert (result.dTemperature, result.dPressure, result.dHumidity) == (21.5, 1001.0, 44.0)
    assert 0 < result.dStdTotal < 0.05


def test_it_sees_the_beam_break_and_the_reflector_found_again(judge):
    world, fake, command = judge
    command.Initialize()
    command.GoPosition(1, *(MARKER * 1e3))
    fake.break_beam()
    with pytest.raises(Exception, match='failed with status 10004'):
        command.StartMeasurement()
    world.path = lambda t: MARKER + np.array([0.0, 0.2, 0.0])
    command.GoPosition(1, *(world.path(0) * 1e3))
    result = command.StartMeasurement()
    np.testing.assert_allclose(
        [result.dVal1, result.dVal2, result.dVal3], world.path(0) * 1e3, atol=0.1
    )


def test_the_fake_refuses_an_unknown_command_in_a_readable_packet(judge):
    _, _, command = judge
    with pytest.raises(Exception, match='failed with status 2'):
        command.GetAT4xxInfo()
    assert command.GetTrackerStatus().trackerStatus == packet.ES_TS_NotReady
