# SPDX-License-Identifier: Apache-2.0
"""Pairing: only what was captured after settling, while the arm stood, is ever an observation."""

import numpy as np
import pytest
from pairing_feed import SHOT, STREAM, Q, run

from remaster_ros.collection.pairing import PairedReading, Pairing, Rejection
from remaster_ros.types import MarkerReading


def test_the_mean_has_exactly_the_samples_of_the_dwell():
    pairing = run(Pairing(10.0, Q, (STREAM,)))
    reading = pairing.decided['mocap']
    assert isinstance(reading, PairedReading)
    # 10.00 < stamp <= 10.50: nothing from before settling, nothing from after the dwell.
    expected = np.arange(10.01, 10.505, 0.01) * 1e-6
    assert reading.samples == len(expected)
    assert reading.position[0] == pytest.approx(expected.mean(), rel=1e-12)
    assert reading.std[0] == pytest.approx(expected.std(ddof=1), rel=1e-6)
    assert reading.stamp_s == 10.5
    np.testing.assert_allclose(reading.q, Q)


def test_orientations_are_averaged_over_the_readings_that_have_one():
    pairing = Pairing(10.0, Q, (STREAM,))
    for i, stamp in enumerate(np.arange(9.8, 10.8, 0.01)):
        pairing.add_joint_state(stamp, Q)
        # Turned far elsewhere before the arm has settled; to and fro about z after it.
        half = 1.0 if stamp < 10.0 else 0.01 * (-1) ** i
        turn = np.array([0.0, 0.0, np.sin(half), np.cos(half)]) if i % 5 > 1 else None
        position = np.array([stamp, 0.0, 0.0]) * 1e-6
        pairing.add_reading('mocap', MarkerReading(stamp, position, orientation=turn))
    reading = pairing.decided['mocap']
    np.testing.assert_allclose(reading.orientation, [0.0, 0.0, 0.0, 1.0], atol=2e-3)
    assert run(Pairing(10.0, Q, (STREAM,))).decided['mocap'].orientation is None


def test_it_is_not_decided_before_something_later_than_the_dwell_has_come():
    assert not run(Pairing(10.0, Q, (STREAM,)), until=0.5).decided
    assert run(Pairing(10.0, Q, (STREAM,)), until=0.56).complete


def test_the_order_of_arrival_does_not_matter():
    """All readings first, all joint states later: a replay's worst case."""
    mixed, sorted_by_kind = run(Pairing(10.0, Q, (STREAM,))), Pairing(10.0, Q, (STREAM,))
    for t in np.arange(-0.1, 1.0, 0.01):
        stamp = 10.0 + t
        reading = MarkerReading(stamp, np.array([stamp, 0.0, 0.0]) * 1e-6)
        sorted_by_kind.add_reading('mocap', reading)
    for t in np.arange(-0.1, 1.0, 0.02):
        sorted_by_kind.add_joint_state(10.0 + t, Q)
    reading_mixed, reading_sorted = mixed.decided['mocap'], sorted_by_kind.decided['mocap']
    np.testing.assert_array_equal(reading_mixed.position, reading_sorted.position)
    assert (reading_mixed.samples, reading_mixed.stamp_s) == (
        reading_sorted.samples,
        reading_sorted.stamp_s,
    )


def test_a_marker_hidden_for_a_moment_prolongs_the_dwell():
    """Three samples in the dwell, then a gap: the fifth ends it, and no later one counts."""
    pairing = Pairing(10.0, Q, (STREAM,))
    for stamp in (10.1, 10.2, 10.3, 10.9, 11.0, 11.1):
        pairing.add_reading('mocap', MarkerReading(stamp, np.array([stamp, 0, 0]) * 1e-6))
    run(pairing, skip_stream=True, until=1.5)
    reading = pairing.decided['mocap']
    assert (reading.samples, reading.stamp_s) == (5, 11.0)


DWELL = np.arange(10.01, 10.7, 0.01)
EVEN = np.arange(len(DWELL)) % 2
ONE_BIT = np.where(np.arange(len(DWELL)) % 7, 1.0, np.nextafter(1.0, 2.0))


@pytest.mark.parametrize(
    ('stamps', 'x', 'moved', 'reason', 'detail'),
    [
        (DWELL, 1e-6 * DWELL, 1e-3, 'moving', 'a joint moved 1.00e-03 rad'),
        (DWELL, 2e-3 * EVEN, 0.0, 'unsteady', ''),
        # To the last bit the same, reading after reading: no measurement is like that.
        (DWELL, 1.0 + 0.0 * DWELL, 0.0, 'frozen', '50 readings are the same to the last bit'),
        (DWELL, ONE_BIT, 0.0, '', ''),
        ([10.1, 10.2, 10.3, 10.6], [0.0] * 4, 0.0, 'too_few', '4 usable samples'),
        ([], [], 0.0, 'stale', 'no reading'),
    ],
)
def test_what_is_no_reading_of_a_stream(stamps, x, moved, reason, detail):
    pairing = Pairing(10.0, Q, (STREAM,))
    for stamp, value in zip(stamps, x):
        pairing.add_reading('mocap', MarkerReading(stamp, np.array([value, 2.0, 3.0])))
    run(pairing, skip_stream=True, offset=moved)
    # Its time is over.
    pairing.give_up(12.4)
    assert pairing.complete == (reason not in ('too_few', 'stale'))
    pairing.give_up(12.6)
    decided = pairing.decided['mocap']
    assert (decided.reason if isinstance(decided, Rejection) else '') == reason
    assert not reason or detail in decided.detail


def test_a_single_shot_waits_for_the_joint_state_that_vouches_for_it():
    pairing = Pairing(10.0, Q, (SHOT,))
    pairing.add_joint_state(10.5, Q)
    pairing.add_reading('tracker', MarkerReading(9.0, np.ones(3)))  # before settling: ignored
    pairing.add_reading('tracker', MarkerReading(11.0, np.full(3, 2.0)))
    assert not pairing.complete
    pairing.add_joint_state(11.02, Q)
    reading = pairing.decided['tracker']
    np.testing.assert_array_equal(reading.position, [2.0, 2.0, 2.0])
    assert (reading.samples, reading.std, reading.stamp_s) == (1, None, 11.0)


def test_of_two_shots_the_first_counts():
    """The instrument measured when it was asked; the second may be of an arm on its way."""
    pairing = Pairing(10.0, Q, (SHOT,))
    pairing.add_reading('tracker', MarkerReading(11.0, np.full(3, 2.0)))
    pairing.add_reading('tracker', MarkerReading(11.5, np.full(3, 3.0)))
    pairing.add_joint_state(11.6, Q)
    reading = pairing.decided['tracker']
    np.testing.assert_array_equal(reading.position, [2.0, 2.0, 2.0])
    assert (reading.samples, reading.stamp_s) == (1, 11.0)


def test_the_joints_of_a_reading_are_the_mean_of_its_dwell():
    pairing = Pairing(10.0, Q, (STREAM,))
    for i in range(40):
        stamp = 10.0 + 0.02 * (i + 1)
        pairing.add_reading('mocap', MarkerReading(stamp, np.full(3, 1e-6 * i)))
        pairing.add_joint_state(stamp, Q + 1e-6 * i)
    reading = pairing.decided['mocap']
    # The 25 reports from settling to the end of the dwell, half a second later.
    np.testing.assert_allclose(reading.q, Q + 1e-6 * np.arange(25).mean(), atol=1e-12)


def test_two_sensors_are_decided_on_apart():
    pairing = run(Pairing(10.0, Q, (STREAM, SHOT)))
    assert set(pairing.decided) == {'mocap'}
    pairing.fail('tracker', 'beam broken')
    assert pairing.complete
    assert pairing.decided['tracker'] == Rejection('tracker', 'device', 'beam broken')


def test_a_device_error_does_not_undo_an_accepted_reading():
    pairing = run(Pairing(10.0, Q, (STREAM,)))
    pairing.fail('mocap', 'too late')
    assert isinstance(pairing.decided['mocap'], PairedReading)


# What a fault looks like


def test_a_clock_that_is_set_back_rejects_what_is_open():
    pairing = run(Pairing(10.0, Q, (STREAM, SHOT)))
    assert set(pairing.decided) == {'mocap'}
    pairing.add_joint_state(9.0, Q)
    assert isinstance(pairing.decided['mocap'], PairedReading), 'it was decided before'
    assert pairing.decided['tracker'].reason == 'clock'
    assert pairing.decided['tracker'].detail == 'the clock of joint_states went back by 2.0 s'
    assert pairing.complete


def test_reports_a_little_out_of_order_do_no_harm():
    pairing = run(Pairing(10.0, Q, (STREAM,)), until=0.3)
    pairing.add_joint_state(10.25, Q + 1.0)
    assert not pairing.decided
    assert isinstance(run(pairing, start=10.3, until=0.5).decided['mocap'], PairedReading)


@pytest.mark.parametrize(('gap', 'reason'), [(4.5, None), (5.5, 'unseen'), (3600.0, 'unseen')])
def test_nobody_vouches_for_an_arm_that_was_not_seen(gap, reason):
    """Joint states pause, or their clock jumps ahead, between settling and reading."""
    pairing = Pairing(10.0, Q, (SHOT,))
    pairing.add_joint_state(10.1, Q)
    pairing.add_reading('tracker', MarkerReading(10.1 + gap - 0.01, np.ones(3)))
    pairing.add_joint_state(10.1 + gap, Q)
    decided = pairing.decided['tracker']
    assert getattr(decided, 'reason', None) == reason


# Two sensors, each at its own pace


@pytest.mark.parametrize(
    ('require', 'complete'), [('all', False), ('any', True), ('mocap', True), ('tracker', False)]
)
def test_the_arm_waits_for_what_is_required(require, complete):
    pairing = run(Pairing(10.0, Q, (STREAM, SHOT), require=require))
    assert isinstance(pairing.decided['mocap'], PairedReading)
    assert pairing.complete == complete
    assert pairing.is_required('tracker') == (require != 'mocap')
    pairing.finish()
    assert pairing.complete
    if complete:
        assert pairing.decided['tracker'].reason == 'not_waited'
        assert pairing.decided['tracker'].detail == f'the arm waits for {require}'
    assert isinstance(pairing.decided['mocap'], PairedReading)


@pytest.mark.parametrize(
    ('require', 'complete'), [('all', False), ('any', False), ('mocap', True)]
)
def test_a_rejection_is_no_reading(require, complete):
    """With `any` the next sensor is waited for; a required one has had its chance."""
    pairing = Pairing(10.0, Q, (STREAM, SHOT), require=require)
    pairing.fail('mocap', 'gone')
    assert pairing.complete == complete
    pairing.fail('tracker', 'gone too')
    assert pairing.complete


def test_the_time_that_a_required_sensor_is_absent_is_not_counted():
    """Thirty seconds without it, then a reading: accepted; the arm stood all the while."""
    pairing = Pairing(10.0, Q, (STREAM,))
    for stamp in np.arange(10.0, 40.0, 0.1):
        pairing.add_joint_state(stamp, Q)
        pairing.give_up(stamp, {'mocap'})
    assert not pairing.decided
    for stamp in np.arange(40.0, 40.3, 0.02):
        pairing.add_joint_state(stamp, Q)
        pairing.add_reading('mocap', MarkerReading(stamp, np.array([stamp, 0, 0]) * 1e-6))
        pairing.give_up(stamp)
    assert isinstance(pairing.decided['mocap'], PairedReading)
    assert pairing.waited_s()['mocap'] == pytest.approx(30.1, abs=0.11)


def test_back_again_and_silent_it_has_its_time_out_as_ever():
    pairing = Pairing(10.0, Q, (STREAM,))
    for stamp in np.arange(10.0, 40.0, 0.1):
        pairing.give_up(stamp, {'mocap'} if stamp < 30 else set())
    assert pairing.decided['mocap'].reason == 'stale'
    pairing = Pairing(10.0, Q, (STREAM,))
    pairing.give_up(30.0, {'mocap'})
    pairing.give_up(32.4)
    assert not pairing.decided
    pairing.give_up(32.6)
    assert pairing.decided['mocap'].reason == 'stale'


def test_a_silence_that_is_longer_than_the_time_out_decides_nothing():
    """The clock runs fast: the time-out (2.5 s) passes before the heartbeat (here 18 s)."""
    pairing = Pairing(10.0, Q, (STREAM,))
    for stamp in np.arange(10.0, 60.0, 0.1):
        pairing.give_up(stamp, {'mocap'} if stamp > 28 else set(), {'mocap': 7})
    assert not pairing.decided
    pairing.give_up(60.1, set(), {'mocap': 8})
    assert not pairing.decided, 'heard again, it has its time from now on'
    pairing.give_up(62.2, set(), {'mocap': 9})
    assert not pairing.decided
    pairing.give_up(62.7, set(), {'mocap': 9})
    assert not pairing.decided, 'its time is over, but who knows whether it is still there?'
    pairing.give_up(62.8, set(), {'mocap': 10})
    assert pairing.decided['mocap'].reason == 'stale'


def test_a_silence_that_ends_with_a_new_start_of_its_node_is_excused():
    """It died and is back before the heartbeat (here 18 s) was over; the time-out is 2.5 s."""
    pairing = Pairing(10.0, Q, (STREAM,))
    for stamp in np.arange(10.0, 25.0, 0.1):
        pairing.give_up(stamp, set(), {'mocap': 7})
    pairing.give_up(25.0, {'mocap'}, {'mocap': 8})
    pairing.give_up(27.4, set(), {'mocap': 9})
    assert not pairing.decided, 'its time begins when it is back'
    pairing.give_up(27.7, set(), {'mocap': 10})
    assert pairing.decided['mocap'].reason == 'stale'


def test_an_absent_sensor_that_is_not_required_is_left_out_at_once():
    pairing = Pairing(10.0, Q, (STREAM, SHOT), require='mocap')
    pairing.give_up(10.1, {'tracker', 'another'})
    assert pairing.decided['tracker'].reason == 'absent'
    assert set(pairing.decided) == {'tracker'}


def test_who_was_waited_for():
    """The bar takes its dwell; the tracker the rest; the sum is what the arm stood."""
    pairing = run(Pairing(10.0, Q, (STREAM, SHOT)), until=4.0)
    pairing.add_reading('tracker', MarkerReading(13.9, np.ones(3)))
    pairing.add_joint_state(14.0, Q)
    waited = pairing.waited_s()
    assert waited['mocap'] == pytest.approx(0.5, abs=0.05)
    assert sum(waited.values()) == pytest.approx(4.0, abs=0.05)
