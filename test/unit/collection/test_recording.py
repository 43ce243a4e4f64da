# SPDX-License-Identifier: Apache-2.0
"""Which configuration is read, by which messages, and what becomes of it: stamps are arguments."""

import numpy as np
import pytest

from remaster_ros.collection.events import PoseAnnounced
from remaster_ros.collection.pairing import Rejection, SensorRules
from remaster_ros.collection.recording import BY_HAND, UNSEEN, Recording
from remaster_ros.types import MarkerReading

Q = np.array([0.1, 0.2])
OTHER = np.array([0.4, -0.2])
BAR = SensorRules('mocap', 'sir', False, 0.5, 5, 0.5e-3, 3.0)
TRACKER = SensorRules('tracker', 'smr', True, 0.5, 5, 0.5e-3, 60.0)
POSE = PoseAnnounced(stamp='7.000000000', pose=3, split='optimization', ids=(5, 2), plan='plan a')


class Judge:
    """Takes every reading, or refuses all of one sensor; notes what it was asked."""

    def __init__(self, refused=''):
        self.refused, self.asked = refused, []

    def judge_frame(self, readings, T_R_N, *, anywhere):
        name = readings[0].sensor
        self.asked.append((name, T_R_N, anywhere))
        return [
            Rejection(name, 'swapped', 'far off')
            if self.refused in (name, reading.marker)
            else reading
            for reading in readings
        ]


class Bench:
    """A recording, and an arm that stands at a place while time passes."""

    def __init__(self, *rules, require='all', refused=''):
        self.judge = Judge(refused)
        self.recording = Recording(rules or (BAR,), 5e-4, require, self.judge)
        self.t = 100.0

    def announce(self, pose=POSE, solutions=(Q, OTHER)):
        self.recording.announced = pose
        self.recording.take_solutions(pose.stamp, np.array(solutions))

    def stand(self, q, seconds, sensors=('mocap',), T_R_N=None):
        """Let joints and sensors report every 20 ms; return what has ended."""
        ended = []
        for i in range(round(seconds / 0.02)):
            self.t += 0.02
            for sensor in sensors:
                position = np.array([1.0, 1e-6 * (i % 3), 0.0])
                self.recording.take_reading(sensor, MarkerReading(self.t, position))
            self.recording.take_joints(self.t, q)
            ended.append(self.recording.end(T_R_N or {}))
        return [item for item in ended if item is not None]

    def settle(self, q):
        self.recording.take_joints(self.t, q)
        known = self.recording.take_settled(self.t, q)
        if (settled := self.recording.next()) is not None:
            self.recording.begin(settled)
        return known


def begun(*rules, at=Q, **options):
    """Return a bench whose arm has settled at a solution of the pose."""
    bench = Bench(*rules, **options)
    bench.announce()
    assert bench.settle(at)
    return bench


def test_a_settled_configuration_is_read_and_reported():
    bench = begun(at=OTHER)
    settled_s = bench.t
    (ended,) = bench.stand(OTHER, 1.0, T_R_N={'mocap': np.eye(4)})
    assert (ended.result, ended.why) == ('recorded', '')
    assert (ended.settled.solution, ended.settled.id) == (1, 2)
    assert ended.from_q is None
    (reading,) = ended.accepted
    assert reading.stamp_s == pytest.approx(settled_s + 0.5)
    event = ended.event(registered=True)
    assert (event.stamp, event.solution, event.registered) == (POSE.stamp, 1, True)
    assert event.measuring_s == pytest.approx(0.5)
    assert ended.waited_s.keys() == {'mocap'}
    assert bench.recording.is_idle
    ((sensor, T_R_N, anywhere),) = bench.judge.asked
    assert (sensor, anywhere) == ('mocap', False)
    np.testing.assert_array_equal(T_R_N, np.eye(4))


def test_a_reference_may_lie_anywhere():
    bench = Bench()
    bench.announce(PoseAnnounced(stamp='1', pose=0, split='reference', ids=(0,)), [Q])
    bench.settle(Q)
    bench.stand(Q, 1.0)
    assert bench.judge.asked[0][2]


def test_where_the_arm_comes_from_is_known_until_it_is_stopped():
    bench = begun()
    bench.stand(Q, 1.0)
    bench.settle(OTHER)
    (ended,) = bench.stand(OTHER, 1.0)
    np.testing.assert_array_equal(ended.from_q, Q)
    bench.settle(Q)
    # A stop while it reads: the arm still came from there.
    bench.recording.take_stop()
    (ended,) = bench.stand(Q, 1.0)
    np.testing.assert_array_equal(ended.from_q, OTHER)
    bench.settle(OTHER)
    (ended,) = bench.stand(OTHER, 1.0)
    assert ended.from_q is None


def test_messages_that_came_before_the_settling_belong_to_it():
    """Topics overtake each other: the dwell is over when /remaster/settled comes."""
    bench = Bench()
    bench.announce()
    settled_s = bench.t
    bench.stand(Q, 1.0)
    bench.recording.take_settled(settled_s, Q)
    bench.recording.begin(bench.recording.next())
    assert bench.recording.end({}).result == 'recorded'


def test_settled_before_the_pose_is_announced():
    bench = Bench()
    assert not bench.settle(Q)
    assert bench.recording.next() is None
    bench.stand(Q, 0.1)
    bench.recording.look_again()
    assert bench.recording.next() is None, 'the pose has not come'
    bench.announce()
    bench.recording.look_again()
    assert bench.recording.next().id == 5
    bench.recording.look_again()
    assert bench.recording.next() is None, 'once'


def test_an_arm_that_has_left_is_not_taken_up():
    bench = Bench()
    assert not bench.settle(Q)
    bench.stand(Q + 0.01, 0.1)
    bench.stand(Q, 0.1)
    bench.announce()
    bench.recording.look_again()
    assert bench.recording.next() is None


def test_the_event_and_the_solutions_belong_together():
    bench = Bench()
    bench.recording.announced = POSE
    assert bench.recording.pose is None
    bench.recording.take_solutions('8.0', np.array([Q, OTHER]))
    assert bench.recording.pose is None
    assert not bench.settle(Q)
    bench.announce()
    assert bench.recording.pose == POSE
    assert not bench.settle(Q + 0.05), 'at no solution'
    bench.recording.take_solutions(POSE.stamp, np.empty((0, 2)))
    assert bench.recording.pose is None, 'a stop takes the pose back'


def test_one_after_the_other():
    bench = begun()
    assert bench.recording.take_settled(bench.t + 0.6, OTHER)
    assert bench.recording.next() is None, 'a reading is under way'
    assert not bench.recording.is_idle
    (ended,) = bench.stand(Q, 0.56)
    assert ended.settled.id == 5
    assert not bench.recording.is_idle
    assert bench.recording.next().id == 2


@pytest.mark.parametrize(
    ('require', 'sensors', 'refused', 'result', 'reasons'),
    [
        ('all', ('mocap', 'tracker'), '', 'recorded', []),
        ('all', ('mocap', 'tracker'), 'tracker', 'partial', ['swapped']),
        ('tracker', ('mocap', 'tracker'), 'tracker', 'rejected', ['not_waited', 'swapped']),
        ('any', ('tracker',), '', 'recorded', ['not_waited']),
        ('mocap', ('mocap',), '', 'recorded', ['not_waited']),
    ],
)
def test_what_is_recorded_in_part_or_not_at_all(require, sensors, refused, result, reasons):
    bench = begun(BAR, TRACKER, require=require, refused=refused)
    (ended,) = bench.stand(Q, 1.0, sensors)
    assert ended.result == result
    assert sorted(item.reason for item in ended.rejected) == reasons
    assert all(f'{item.sensor}: {item.reason}: ' in ended.why for item in ended.rejected)


def test_a_sensor_that_is_silent_is_given_up():
    bench = begun()
    bench.stand(Q, 4.0, sensors=())
    bench.recording.give_up((), {})
    ended = bench.recording.end({})
    assert (ended.result, [item.reason for item in ended.rejected]) == ('rejected', ['stale'])
    assert ended.last_s == bench.t


def test_a_required_sensor_that_is_absent_is_waited_for():
    bench = begun()
    for _ in range(8):
        bench.stand(Q, 1.0, sensors=())
        bench.recording.give_up(('mocap',), {})
    assert bench.recording.end({}) is None


def test_a_clock_that_was_set_back_leaves_nothing_of_before():
    bench = Bench()
    bench.announce()
    bench.stand(Q, 2.0)
    bench.t -= 50.0
    bench.settle(Q)
    (ended,) = bench.stand(Q, 1.0)
    assert ended.result == 'recorded'
    assert ended.accepted[0].stamp_s < 60.0


def test_the_temperature_is_the_last_one_before_the_arm_settled():
    bench = Bench()
    bench.announce()
    for stamp_s, temperature_c in ((bench.t - 9.0, 21.0), (bench.t - 700.0, 10.0)):
        bench.recording.take_temperature(stamp_s, temperature_c)
    bench.settle(Q)
    bench.recording.take_temperature(bench.t + 0.1, 30.0)
    (ended,) = bench.stand(Q, 1.0)
    assert ended.temperature_c == 21.0
    bench.t += 900.0
    bench.settle(Q)
    (ended,) = bench.stand(Q, 1.0)
    assert ended.temperature_c is None


def test_a_point_by_hand_is_read_where_the_arm_stands():
    bench = Bench()
    bench.stand(Q, 0.1)
    bench.recording.begin_by_hand(bench.recording.now_s, bench.recording.q)
    (ended,) = bench.stand(Q, 1.0)
    assert ended.settled.pose is BY_HAND
    np.testing.assert_array_equal(ended.settled.q, Q)


def test_what_was_recorded_before_is_not_read_again():
    bench = Bench()
    bench.announce()
    bench.recording.take_settled(bench.t, OTHER)
    event = bench.recording.next().recorded_before('partial', registered=False)
    assert (event.stamp, event.solution, event.result) == (POSE.stamp, 1, 'partial')
    assert event.reason == 'recorded before'
    assert event.measuring_s is None


def test_markers_of_a_frame_end_together_and_one_that_is_none_costs_no_other():
    """One good marker makes the configuration recorded; without any the sensor is refused."""
    rules = SensorRules('mocap', 'sir', min_samples=5, further=('b', 'c'))
    for refused, count, result in (
        ('', 3, 'recorded'),
        ('b', 2, 'recorded'),
        ('mocap', 0, 'rejected'),
    ):
        bench = begun(rules, refused=refused)
        ended = []
        for i in range(40):
            bench.t += 0.02
            for name in ('', 'b', 'c'):
                place = np.array([1.0, 1e-6 * (i % 3), 0.0])
                bench.recording.take_reading('mocap', MarkerReading(bench.t, place, marker=name))
            bench.recording.take_joints(bench.t, Q)
            ended.append(bench.recording.end({}))
        (end,) = [item for item in ended if item is not None]
        assert (len(end.accepted), end.result) == (count, result)
        assert [item.reason for item in end.left_out] == ['swapped'] * (refused == 'b')
        assert len(end.rejected) == (refused == 'mocap')


def test_a_marker_that_is_not_seen_for_long_is_named_until_it_is_back():
    rules = SensorRules('mocap', 'sir', False, 0.5, 5, 0.5e-3, 3.0, ('b', 'c'))
    bench = Bench(rules, refused='c')
    for number in range(UNSEEN + 1):
        if number == UNSEEN:
            assert 'c of mocap was not seen at the last 5 configurations' in bench.recording.unseen
            assert 'sir' not in bench.recording.unseen
            bench.judge.refused = ''
        else:
            assert not bench.recording.unseen
        bench.announce()
        bench.settle(Q if number % 2 else OTHER)
        ended = []
        while not ended:
            bench.t += 0.02
            for marker in ('sir', 'b', 'c'):
                position = np.array([1.0, 1e-6 * (bench.t % 0.1), 0.0])
                reading = MarkerReading(bench.t, position, marker=marker)
                bench.recording.take_reading('mocap', reading)
            bench.recording.take_joints(bench.t, Q if number % 2 else OTHER)
            ended = [item for item in [bench.recording.end({})] if item is not None]
    assert not bench.recording.unseen
