# SPDX-License-Identifier: Apache-2.0
"""Several markers of a sensor: of one frame, and measured one after another."""

from dataclasses import replace

import numpy as np
import pytest
from pairing_feed import STREAM, Q, run

from remaster_ros.collection.pairing import PairedReading, Pairing, SensorRules
from remaster_ros.types import MarkerReading

THREE = replace(STREAM, further=('b', 'c'))


def frames(
    pairing, seen, *, until=1.0, start=10.0, joints_until=None, order=1, topics=('', 'b', 'c')
):
    """Feed joint states at 50 Hz and frames at 100 Hz; `seen` tells which markers it shows."""
    stamps = start + np.arange(-0.1, until, 0.01)
    for name in topics[::order]:
        for stamp in stamps:
            if any(seen(other or 'sir', stamp - start) for other in ('', 'b', 'c')):
                position = np.array([stamp, 'bc'.find(name), 0.0]) * 1e-6
                if not seen(name or 'sir', stamp - start):
                    position = np.full(3, np.nan)
                pairing.add_reading('mocap', MarkerReading(stamp, position, marker=name))
    for t in np.arange(-0.1, joints_until or until, 0.02):
        pairing.add_joint_state(start + t, Q)
    return pairing


def taken(pairing):
    """Return the samples of each marker of the bar."""
    first = pairing.decided['mocap']
    readings = [first, *pairing.further.get('mocap', [])]
    assert all(isinstance(reading, PairedReading) for reading in readings), readings
    assert len({(reading.stamp_s, reading.q.tobytes()) for reading in readings}) == 1
    return {reading.marker: reading.samples for reading in readings}


@pytest.mark.parametrize('order', [1, -1])
def test_the_markers_of_a_frame_are_taken_together(order):
    pairing = frames(Pairing(10.0, Q, (THREE,)), lambda name, t: True, order=order)
    assert taken(pairing) == {'sir': 50, 'b': 50, 'c': 50}
    assert not pairing.left_out


def test_nothing_is_decided_while_a_marker_may_still_come():
    """Its messages are late, as in a fast replay, and the joint states far ahead of all."""
    rules = replace(THREE, timeout_s=20.0)
    late = frames(
        Pairing(10.0, Q, (rules,)), lambda name, t: True, joints_until=5.0, topics=('', 'b')
    )
    late.give_up(15.0)
    assert not late.decided
    late = frames(late, lambda name, t: True, topics=('c',))
    assert taken(late) == {'sir': 50, 'b': 50, 'c': 50}


def test_what_was_seen_counts_when_the_time_is_over():
    """Nothing at all comes on one topic: it is waited for as long as for any sensor."""
    pairing = frames(
        Pairing(10.0, Q, (THREE,)), lambda name, t: True, joints_until=3.0, topics=('', 'b')
    )
    assert not pairing.decided
    pairing.give_up(13.0)
    assert taken(pairing) == {'sir': 50, 'b': 50}


@pytest.mark.parametrize('hidden', ['sir', 'b'])
def test_a_hidden_marker_is_left_out_and_the_others_count(hidden):
    """Also the one that the sensor follows; the arm waits no longer than for all."""
    pairing = Pairing(10.0, Q, (THREE,))
    frames(pairing, lambda name, t: name != hidden, until=0.56)
    assert set(taken(pairing)) == {'sir', 'b', 'c'} - {hidden}
    assert [(item.reason, item.detail) for item in pairing.left_out] == [
        ('hidden', f'{hidden} was not seen')
    ]


def test_a_marker_that_was_seen_too_seldom_is_left_out():
    rules = Pairing(10.0, Q, (THREE,))
    pairing = frames(rules, lambda name, t: name != 'c' or t < 0.025 or t > 0.485)
    assert taken(pairing) == {'sir': 50, 'b': 50}


def test_where_all_are_hidden_the_first_that_comes_back_ends_the_dwell():
    pairing = frames(
        Pairing(10.0, Q, (THREE,)),
        lambda name, t: t > (0.995 if name == 'b' else 1.295),
        until=2.0,
    )
    assert taken(pairing) == {'b': 5}
    assert pairing.decided['mocap'].stamp_s == pytest.approx(11.04)


def test_a_marker_that_moves_by_itself_is_left_out():
    pairing = Pairing(10.0, Q, (THREE,))
    for stamp in 10.0 + np.arange(0.0, 1.0, 0.01):
        for name in ('', 'b', 'c'):
            swing = 2e-3 * np.sin(40.0 * stamp) if name == '' else 1e-6 * stamp
            place = np.array([swing, 0.0, 0.0])
            pairing.add_reading('mocap', MarkerReading(stamp, place, marker=name))
    run(pairing, skip_stream=True)
    assert set(taken(pairing)) == {'b', 'c'}
    assert [item.reason for item in pairing.left_out] == ['unsteady']


def test_markers_that_never_come_are_a_sensor_without_reading():
    pairing = frames(Pairing(10.0, Q, (THREE,)), lambda name, t: False, until=3.0)
    pairing.give_up(13.0)
    assert pairing.decided['mocap'].reason == 'stale'


def test_several_reflectors_are_one_shot_each_with_a_time_of_its_own():
    rules = SensorRules('tracker', 'smr', single_shot=True, timeout_s=10.0, further=('b', 'c'))
    pairing = Pairing(10.0, Q, (rules,))

    def at(stamp, marker, x=1.0):
        pairing.add_reading('tracker', MarkerReading(stamp, np.full(3, x), marker=marker))
        pairing.add_joint_state(stamp + 0.1, Q)

    at(11.0, 'b')
    # Measured again, as after a kill of its node: the first one counts.
    at(12.0, 'b', 2.0)
    at(13.0, 'smr')
    assert not pairing.complete
    # One that was not found.
    at(13.0, 'c', np.nan)
    readings = [pairing.decided['tracker'], *pairing.further['tracker']]
    assert [(r.marker, r.stamp_s, r.position[0]) for r in readings] == [
        ('smr', 13.0, 1.0),
        ('b', 11.0, 1.0),
    ]
    assert [(r.reason, r.detail) for r in pairing.left_out] == [('hidden', 'c was not seen')]


def test_reflectors_that_never_come_cost_the_others_nothing():
    rules = SensorRules('tracker', 'smr', single_shot=True, timeout_s=10.0, further=('b',))
    pairing = Pairing(10.0, Q, (rules,))
    pairing.add_reading('tracker', MarkerReading(11.0, np.ones(3), marker='smr'))
    for t in np.arange(10.0, 21.0, 0.5):
        pairing.add_joint_state(t, Q)
        pairing.give_up(t)
    assert pairing.decided['tracker'].marker == 'smr'
    assert pairing.left_out[0].reason == 'hidden'
