# SPDX-License-Identifier: Apache-2.0
"""Time of a node's watchdogs: the wall clock's beside an arm, and never faster than that.

And what a simulation that waits for its nodes hears of them.
"""

import os
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from builtin_interfaces.msg import Time

from remaster_ros.errors import InputError
from remaster_ros.nodes import simulated_clock
from remaster_ros.nodes.simulated_clock import LEADS, SILENT_WALL_S, ReportsTaken, SteadyTime

pytestmark = pytest.mark.ros

RATE = 10.0


class Node:
    """Whose clock is set by hand."""

    def __init__(self, simulated=True):
        self.simulated, self.now = simulated, 0.0
        self.hear = None

    def create_subscription(self, kind, topic, callback, qos, raw):
        assert (topic, raw) == ('/clock', True)
        self.hear = callback

    def get_name(self):
        return 'robot_bridge'

    def get_parameter(self, name):
        assert name == 'use_sim_time'
        return SimpleNamespace(value=self.simulated)

    def now_s(self):
        return self.now


@pytest.fixture
def wall(monkeypatch):
    wall = SimpleNamespace(now=500.0)
    monkeypatch.setattr(simulated_clock, 'time', SimpleNamespace(monotonic=lambda: wall.now))
    return wall


def passes(steady, node, wall, seconds, rate, step=0.01, published=True):
    """Return how much watchdog time passes while the clock runs at this rate."""
    before = steady()
    for _ in range(round(seconds / step)):
        wall.now += step
        node.now += rate * step
        if published:
            node.hear(b'')
        steady()
    return steady() - before


def test_without_a_rate_it_is_the_wall_clock_whatever_the_node_s_clock_does(wall):
    node = Node()
    steady = SteadyTime(node, 0.0)
    for wall.now, node.now in ((501.0, 100.0), (501.5, 100.0), (502.25, 5.0), (599.0, 9000.0)):
        assert steady() == wall.now


def test_a_rate_beside_a_real_arm_is_refused(wall):
    with pytest.raises(InputError, match='simulated_clock_rate is 10, but use_sim_time'):
        SteadyTime(Node(simulated=False), RATE)


def test_it_follows_a_clock_that_waits_and_is_never_faster_than_the_wall(wall):
    node = Node()
    steady = SteadyTime(node, RATE)
    node.now = 1000.0
    assert passes(steady, node, wall, 1.0, RATE) == pytest.approx(1.0, abs=0.02)
    assert passes(steady, node, wall, 1.0, 0.25 * RATE) == pytest.approx(0.25, abs=0.02)
    # However long it waits.
    assert passes(steady, node, wall, 20 * SILENT_WALL_S, 0.0) == pytest.approx(0.0, abs=0.02)
    assert passes(steady, node, wall, 1.0, 5 * RATE) <= 1.0 + 1e-9
    node.now += 3600.0
    assert passes(steady, node, wall, 0.5, RATE) <= 0.5 + 1e-9


def test_silence_is_noticed_where_the_simulation_has_ended(wall):
    """Killed, not waiting: watchdogs go on with the wall clock, and with the next simulation."""
    node = Node()
    steady = SteadyTime(node, RATE)
    node.now = 1000.0
    passes(steady, node, wall, 1.0, RATE)
    ended = passes(steady, node, wall, SILENT_WALL_S + 4.0, 0.0, published=False)
    assert ended == pytest.approx(4.0, abs=0.05)
    node.now = 0.5
    assert passes(steady, node, wall, 1.0, RATE) == pytest.approx(1.0, abs=0.05)


def test_a_node_that_was_itself_kept_busy_has_not_heard_a_clock_fall_silent(wall):
    """It loads a library for seconds: the messages of meanwhile are still to be taken."""
    node = Node()
    steady = SteadyTime(node, RATE)
    node.now = 1000.0
    passes(steady, node, wall, 1.0, RATE)
    before = steady()
    for _ in range(3):
        wall.now += 2.0 * SILENT_WALL_S
        assert steady() - before == pytest.approx(0.0, abs=0.02)
        assert passes(steady, node, wall, 0.2, 0.0) == pytest.approx(0.0, abs=0.02)


def test_reports_are_confirmed_ten_times_a_second_one_that_comes_again_too(wall):
    node, confirmed = Node(), []
    node.create_publisher = lambda *_: SimpleNamespace(publish=confirmed.append)
    reports = ReportsTaken(node, RATE)
    for hundredths in range(100):
        reports.take(Time(sec=7, nanosec=hundredths * 10_000_000))
    assert 10 <= len(confirmed) <= 11
    confirmed.clear()
    for _ in range(100):
        wall.now += 0.01
        reports.take(Time(sec=7, nanosec=990_000_000))
    assert 9 <= len(confirmed) <= 11
    assert {message.stamp.nanosec for message in confirmed} == {990_000_000}


def test_who_leads_the_arm_confirms_each_report_and_says_that_it_leads(wall):
    node, confirmed = Node(), []
    node.create_publisher = lambda *_: SimpleNamespace(publish=confirmed.append)
    reports = ReportsTaken(node, RATE, leads=True)
    for hundredths in range(50):
        for _ in range(2):
            reports.take(Time(sec=7, nanosec=hundredths * 10_000_000))
    assert [message.stamp.nanosec for message in confirmed] == [
        hundredths * 10_000_000 for hundredths in range(50)
    ]
    assert {message.frame_id for message in confirmed} == {f'{os.getpid()} {LEADS}'}
