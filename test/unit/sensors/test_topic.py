# SPDX-License-Identifier: Apache-2.0
"""Topics of other packages' nodes: what is read of a message, and what the stream shows."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.driver import SensorClock
from remaster_ros.sensors.topic import driver as module
from remaster_ros.sensors.topic.driver import (
    MARKERS,
    POINT,
    POSE,
    READERS,
    Parameters,
    TopicDriver,
)
from remaster_ros.session.cells.workcell import MESSAGE_TYPES

PLACE = (0.5, -0.25, 2.0)
OURS = ('/vrpn', POINT)


def header(stamp_s=10.0, frame='world'):
    stamp = SimpleNamespace(sec=int(stamp_s), nanosec=round(1e9 * (stamp_s % 1)))
    return SimpleNamespace(stamp=stamp, frame_id=frame)


def xyz(values):
    return SimpleNamespace(x=values[0], y=values[1], z=values[2])


def point(values=PLACE, stamp_s=10.0, frame='world'):
    return SimpleNamespace(header=header(stamp_s, frame), point=xyz(values))


def pose(xyzw):
    turn = SimpleNamespace(**dict(zip('xyzw', xyzw, strict=True)))
    return SimpleNamespace(
        header=header(), pose=SimpleNamespace(position=xyz(PLACE), orientation=turn)
    )


def markers(**places):
    """Fields as in Marker.msg and Markers.msg of mocap4r2_msgs."""
    found = [
        SimpleNamespace(id_type=2, marker_index=index, marker_name=name, translation=xyz(place))
        for index, (name, place) in enumerate(places.items())
    ]
    return SimpleNamespace(header=header(), frame_number=7, markers=found)


def test_a_cell_file_may_name_what_can_be_read():
    assert tuple(READERS) == MESSAGE_TYPES


def test_each_message_gives_stamp_frame_and_place():
    found = READERS[POINT](point(stamp_s=3.5), 'sir')
    assert (found.stamp_s, found.frame, tuple(found.position)) == (3.5, 'world', PLACE)
    found = READERS[POSE](pose((0.0, 0.6, 0.0, 0.8)), 'sir')
    assert (tuple(found.position), tuple(found.orientation)) == (PLACE, (0.0, 0.6, 0.0, 0.8))
    # Of drivers that do not measure it.
    for xyzw in ((0, 0, 0, 0), (np.nan,) * 4, (0, 0, 0, 2)):
        assert READERS[POSE](pose(xyzw), 'sir').orientation is None
    several = markers(other=(1, 1, 1), sir=PLACE)
    assert tuple(READERS[MARKERS](several, 'sir').position) == PLACE
    assert tuple(READERS[MARKERS](several, '1').position) == PLACE
    assert READERS[MARKERS](several, 'smr').position is None


@pytest.mark.parametrize('values', [(np.nan, 0, 0), (1, np.inf, 0), (0, 0, 0)])
def test_a_place_that_was_not_measured_is_none(values):
    assert READERS[POINT](point(values), 'sir').position is None


@pytest.fixture
def rig(monkeypatch):
    """Return a function that makes a driver at 10 s, and moves its clocks."""
    clock = SimpleNamespace(now=10.0, wall=100.0)
    monkeypatch.setattr(module, 'time', SimpleNamespace(monotonic=lambda: clock.wall))
    monkeypatch.setattr(module, 'WAIT_S', 0.0)

    def make(publishers=(OURS,), **parameters):
        made = TopicDriver(Parameters(**parameters), SensorClock(lambda: clock.now))
        made.follow('/tool', POINT, 'sir', lambda: publishers)
        rng = np.random.default_rng(1)

        def stream(count, period_s=0.01, noise_m=1e-4, late_s=0.02, **fields):
            for _ in range(count):
                clock.now += period_s
                clock.wall += period_s
                place = np.array(PLACE) + noise_m * rng.standard_normal(3)
                made.take(point(place, clock.now - late_s, **fields))

        def read():
            found = []
            while (reading := made.read()) is not None:
                found.append(reading)
            return found

        return SimpleNamespace(driver=made, clock=clock, stream=stream, read=read)

    return make


def test_rate_age_and_stillness_are_those_of_the_stream(rig):
    r = rig()
    r.driver.open()
    r.stream(300)
    state = r.driver.state()
    assert (state.ready, state.trouble, state.level) == (True, '', 'ok')
    assert state.values['rate_hz'] == '100.0'
    assert state.values['age_s'] == '0.020'
    assert 0.08 < float(state.values['std_mm']) < 0.13
    readings = r.read()
    assert len(readings) == 300
    # The time of capture, not that of arrival.
    assert readings[-1].stamp_s == pytest.approx(r.clock.now - 0.02, abs=1e-6)


def test_a_slow_stream_is_reported_and_read(rig):
    r = rig()
    r.stream(8, period_s=0.4)
    state = r.driver.state()
    assert (state.ready, state.level) == (True, 'warn')
    assert 'comes at 2.5 Hz, fewer than min_rate_hz (5)' in state.trouble
    assert len(r.read()) == 8


def test_a_stream_of_less_than_a_message_per_second_has_a_rate(rig):
    r = rig()
    r.stream(4, period_s=1.4)
    state = r.driver.state()
    assert (state.level, state.values['rate_hz']) == ('warn', '0.7')
    assert 'fewer than min_rate_hz (5)' in state.trouble


def test_a_marker_that_was_hidden_does_not_make_a_stream_slow(rig):
    r = rig()
    r.stream(20)
    r.clock.now += 2.5
    r.stream(20)
    assert (r.driver.state().level, r.driver.state().values['rate_hz']) == ('ok', '100.0')


@pytest.mark.parametrize('always_sends', [False, True])
def test_silence_is_a_hidden_marker_or_a_fault(rig, always_sends):
    r = rig(always_sends=always_sends)
    r.stream(20)
    r.clock.wall += 1.5
    state = r.driver.state()
    assert (state.ready, state.values['fault']) == (
        (False, 'none') if always_sends else (True, 'marker')
    )
    assert ('look at its driver' in state.trouble) == always_sends
    # A hidden marker is none where messages come.
    r.driver.take(point((np.nan,) * 3, r.clock.now))
    state = r.driver.state()
    assert (state.ready, state.trouble) == (True, 'the marker is not in view (/tool)')


def test_a_simulated_clock_may_lag_behind_the_messages(rig):
    rig()
    for simulated in (True, False):
        driver = TopicDriver(Parameters(), SensorClock(lambda: 10.0, simulated=simulated))
        driver.follow('/tool', POINT, 'sir', lambda: (OURS,))
        driver.take(point(stamp_s=10.5))
        assert (driver.read() is not None) == simulated


def test_what_was_measured_once_is_read_once(rig):
    r = rig()
    r.stream(5)
    message = point(stamp_s=r.clock.now - 0.02)
    for _ in range(3):
        r.driver.take(message)
    assert len(r.read()) == 5
    assert r.driver.state().values['dropped_repeated'] == 3


def test_an_occluded_marker_is_hidden_and_no_reading(rig):
    r = rig()
    r.stream(20)
    r.driver.take(point((np.nan,) * 3, stamp_s=r.clock.now))
    state = r.driver.state()
    assert (state.ready, state.values['fault']) == (True, 'marker')
    assert 'not in view' in state.trouble
    assert len(r.read()) == 20
    r.stream(1)
    assert r.driver.state().values['fault'] == 'none'


def test_silence_is_a_hidden_marker_or_an_ended_node(rig):
    publishers = [OURS]
    r = rig(publishers)
    assert 'nothing on /tool yet: is the marker in view?' in r.driver.state().trouble
    r.stream(20)
    r.clock.wall += 3.0
    state = r.driver.state()
    assert (state.ready, state.values['fault']) == (True, 'marker')
    assert 'nothing on /tool for 3.0 s' in state.trouble
    publishers.clear()
    state = r.driver.state()
    assert (state.ready, state.values['fault']) == (False, 'none')
    assert 'no node publishes /tool' in state.trouble


def test_a_topic_of_another_type_or_of_no_one_is_not_opened(rig):
    with pytest.raises(DeviceError, match='no node publishes /tool; is its driver running'):
        rig(()).driver.open()
    with pytest.raises(DeviceError, match=r'/vrpn publishes /tool as .*PoseStamped, message_type'):
        rig((('/vrpn', POSE),)).driver.open()


@pytest.mark.parametrize(('late_s', 'way'), [(5.0, '5.00 s behind'), (-2.0, '2.00 s ahead of')])
def test_stamps_of_another_clock_are_refused_unless_arrival_counts(rig, late_s, way):
    r = rig()
    r.stream(20, late_s=late_s)
    state = r.driver.state()
    assert not state.ready
    assert f'stamps of /tool are {way} the clock of this host; synchronise' in state.trouble
    assert not r.read()
    r = rig(stamps='arrival')
    r.stream(20, late_s=late_s)
    assert r.driver.state().ready
    assert r.read()[-1].stamp_s == r.clock.now


def test_without_stamps_arrival_counts(rig):
    r = rig()
    r.driver.take(point(stamp_s=0.0))
    assert [reading.stamp_s for reading in r.read()] == [10.0]


def test_a_camera_on_the_tool_needs_orientations(rig):
    r = rig(((OURS[0], POSE),))
    r.driver.follow('/tool', POSE, 'lens', lambda: (), on_tool=True)
    r.driver.take(pose((0.0, 0.0, 0.0, 0.0)))
    state = r.driver.state()
    assert not state.ready
    assert state.values['dropped_no_orientation'] == 1
    assert 'the poses on /tool have no orientation' in state.trouble
    assert not r.read()
    r.driver.take(pose((0.0, 0.6, 0.0, 0.8)))
    assert r.driver.state().ready
    assert len(r.read()) == 1


def test_another_frame_is_refused(rig):
    r = rig()
    r.stream(20)
    r.stream(5, frame='camera')
    state = r.driver.state()
    assert not state.ready
    assert "was in frame 'world' and is in 'camera' now" in state.trouble
    assert len(r.read()) == 20
    r.stream(1)
    assert r.driver.state().ready


def test_a_value_that_is_held_over_is_no_measurement(rig):
    r = rig()
    r.stream(module.FROZEN, noise_m=0.0)
    state = r.driver.state()
    assert not state.ready
    assert 'repeats one position to the last bit' in state.trouble


def test_reading_waits_a_moment_only():
    made = TopicDriver(Parameters(), SensorClock(time.time))
    assert made.read() is None
