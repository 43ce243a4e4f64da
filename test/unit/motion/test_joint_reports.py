# SPDX-License-Identifier: Apache-2.0
"""Reports that are believed and that are not: values, speeds, stamps, lateness, three clocks."""

import numpy as np
import pytest

from remaster_ros.motion.joint_reports import (
    DRIFT,
    LEARN,
    LEARN_WALL_S,
    LIMIT_TOLERANCE_RAD,
    ClockRate,
    JointReport,
    JointReports,
)

LOWER, UPPER = np.array([-1.0, -np.inf]), np.array([1.0, np.inf])
VELOCITY = np.array([2.0, np.inf])
AT = np.array([0.25, 0.5])
BELIEVED = '', ''


class Stream:
    """Reports at 50 Hz, believed ones; each test alters one."""

    def __init__(self, offset_s=0.0, rate=1.0, count=70):
        self.reports = JointReports(LOWER, UPPER, VELOCITY)
        self.stamp, self.wall, self.rate, self.offset = 100.0, 5000.0, rate, offset_s
        for _ in range(count):
            assert self.next(), self.reports.trouble

    def next(self, dt=0.02, q=AT, late=0.0, stamp_dt=None):
        """Report `dt` of robot time later, `late` s late; its stamp may tell another time."""
        self.stamp += dt if stamp_dt is None else stamp_dt
        self.clock = getattr(self, 'clock', self.stamp + self.offset) + dt
        self.wall += dt / self.rate
        q = np.asarray(q, float)
        return self.reports.believes(
            JointReport(self.stamp, q, self.clock + late, self.wall + late / self.rate)
        )

    def doubt(self):
        return self.reports.kind, self.reports.trouble


def test_nothing_is_refused_of_what_is_right():
    fresh = JointReports(LOWER, UPPER, VELOCITY)
    assert (fresh.kind, fresh.trouble, fresh.late_s) == ('', '', 0.0)
    assert fresh.believes(JointReport(0.0, AT, 0.0, 0.0))
    assert (fresh.kind, fresh.trouble) == ('', '')
    stream = Stream()
    assert not stream.reports.refused
    assert stream.doubt() == ('', '')
    assert stream.reports.late_s == pytest.approx(0.0, abs=1e-6)


def test_what_is_outside_the_limits():
    reports = JointReports(LOWER, UPPER, VELOCITY)
    for q in (1.0 + LIMIT_TOLERANCE_RAD, -1.0 - LIMIT_TOLERANCE_RAD):
        reports.forget()
        assert reports.believes(JointReport(0.0, np.array([q, 1e3]), 0.0, 0.0))
    for q, words in ((1.06, '60.7'), (-1.06, '-60.7')):
        assert not reports.believes(JointReport(1.0, np.array([q, 0.5]), 1.0, 1.0))
        assert reports.kind == 'outside_limits'
        assert reports.trouble == f'joint 1 is reported at {words} deg, outside its limits'
    assert reports.refused == {'outside_limits': 2}


def test_the_joint_that_is_farthest_outside_is_named():
    reports = JointReports(np.array([-1.0, -1.0]), np.array([1.0, 1.0]), VELOCITY)
    reports.believes(JointReport(0.0, np.array([1.1, -2.0]), 0.0, 0.0))
    assert reports.trouble.startswith('joint 2 is reported at -114.6 deg')


def jump(joint, rad):
    return {'dt': 0.1, 'q': AT + rad * np.eye(2)[joint]}


NOT_FINITE = 'not_finite', 'joint_states are not finite'
AHEAD = 'joint_states are stamped'
STAMP = 'stamp', 'the stamps of joint_states do not advance'
# 1.5 times its limit, 4 rad/s where there is none, and 20 ms of doubt about the stamps.
REACH_RAD = 3.0 * 0.12, 6.0 * 0.12
FAST = [
    ('too_fast', f'joint {i} is reported {deg} deg away after 0.100 s')
    for i, deg in ((1, 20.6), (2, 41.3))
]


@pytest.mark.parametrize(
    ('report', 'doubt'),
    [
        *(({'q': [0.25, bad]}, NOT_FINITE) for bad in (np.nan, np.inf, -np.inf)),
        *((jump(i, side * 0.999 * REACH_RAD[i]), BELIEVED) for i in (0, 1) for side in (1, -1)),
        *((jump(i, side * 1.001 * REACH_RAD[i]), FAST[i]) for i in (0, 1) for side in (1, -1)),
        *(({'stamp_dt': step}, STAMP) for step in (0.0, -0.02, -3600.0)),
        # A quarter of a second more than usual: 0.15 s, and 0.1 s for a busy machine.
        ({'late': 0.245}, BELIEVED),
        ({'late': 0.255}, ('late', 'joint_states come 0.25 s late')),
        ({'stamp_dt': 0.02 + 0.245}, BELIEVED),
        ({'stamp_dt': 0.02 + 0.3}, ('early', f'{AHEAD} 0.30 s ahead of their time')),
        ({'stamp_dt': 3600.0}, ('early', f'{AHEAD} 3599.98 s ahead of their time')),
    ],
)
def test_what_is_believed_of_a_report(report, doubt):
    stream = Stream()
    assert stream.next(**report) == (doubt == BELIEVED)
    assert stream.doubt() == doubt
    assert stream.reports.refused == ({} if doubt == BELIEVED else {doubt[0]: 1})
    # One that is refused counts for nothing: the next is judged by the one before.
    if doubt != BELIEVED:
        stream.stamp = stream.clock
        assert stream.next()
        assert stream.doubt() == BELIEVED


def test_how_late_a_report_came_that_is_believed_is_told():
    stream = Stream()
    stream.next(late=0.125)
    assert stream.reports.late_s == pytest.approx(0.125, abs=1e-3)
    stream.next(late=-0.1)
    assert stream.reports.late_s == 0.0


def test_a_joint_is_judged_by_the_last_report_that_was_believed():
    """A whole turn off for good: never believed; for one message: the next is believed."""
    stream = Stream()
    turned = np.add(AT, [0.0, 2 * np.pi])
    for _ in range(40):
        assert not stream.next(q=turned)
    assert stream.reports.kind == 'too_fast'
    assert stream.next()
    assert not stream.next(q=turned)
    assert stream.next()


@pytest.mark.parametrize('offset', [-1e9, -3600.0, 0.5, 1e9])
def test_a_constant_difference_of_the_clocks_does_not_matter(offset):
    stream = Stream(offset)
    for _ in range(500):
        assert stream.next(), stream.doubt()
    assert not stream.next(late=0.3)
    assert stream.reports.kind == 'late'


def learn(delays, dt):
    reports = JointReports(LOWER, UPPER, VELOCITY)
    for i, delay in enumerate(delays):
        assert reports.believes(JointReport(i * dt, AT, i * dt + delay, 4.0 + i * dt))
    return reports, len(delays) * dt


def test_what_is_usual_is_the_shortest_of_a_second():
    """Those that waited while this process was starting took longer."""
    reports, t = learn([2.0, 2.5, 1.0, 1.25, 1.5], 0.25)
    assert LEARN == 5
    assert LEARN_WALL_S == 1.0
    assert reports.believes(JointReport(t, AT, t + 1.125, t + 4.0))
    assert reports.late_s == 0.125
    assert not reports.believes(JointReport(t + 0.1, AT, t + 1.9, t + 4.1))
    assert reports.kind == 'late'


@pytest.mark.parametrize(('count', 'dt'), [(4, 0.5), (5, 0.2), (40, 0.02)])
def test_until_that_is_learned_nothing_is_late(count, dt):
    """Of fewer than five reports, or in less than a second, nothing is learned."""
    reports, t = learn([0.0] * count, dt)
    assert reports.believes(JointReport(t, AT, t + 9.0, t + 4.0))
    assert (reports.kind, reports.trouble) == ('', '')
    assert reports.late_s == 0.0


def test_a_drift_of_the_clocks_is_followed_and_a_jump_is_not():
    stream = Stream()
    # A hundred seconds, ten milliseconds apart at the end: a ten-thousandth.
    for _ in range(5000):
        assert stream.next(stamp_dt=0.02 * 1.0001)
    assert stream.next()
    for _ in range(100):
        assert stream.next(late=0.2)
    # Two seconds moved what is usual by 0.4 ms and no more.
    assert stream.reports.late_s == pytest.approx(0.2 - 100 * 0.02 * DRIFT, abs=2e-3)


def test_an_early_report_does_not_make_the_next_ones_late():
    stream = Stream()
    assert stream.next(late=-0.2)
    assert stream.next(late=0.2), stream.doubt()
    assert stream.reports.late_s == pytest.approx(0.2, abs=2e-3)


def test_what_was_learned_from_late_reports_excuses_none_later():
    """A bridge that was started while the network held them up by 0.2 s; then it does no more."""
    stream = Stream()
    for _ in range(10):
        assert stream.next(late=-0.2)
    # After a fifth of a second hardly anything has been learned ...
    assert stream.next(late=0.22)
    for _ in range(200):
        assert stream.next(late=-0.2)
    # ... and after four seconds all of it: 0.25 s later than the others is too late.
    assert stream.next(late=0.04)
    assert stream.reports.late_s == pytest.approx(0.24, abs=2e-3)
    assert not stream.next(late=0.06)
    assert stream.reports.kind == 'late'


def test_a_long_silence_does_not_excuse_a_late_report():
    """What is usual moves by 2 ms at most after a silence of any length."""
    stream = Stream()
    assert stream.next(600.0, late=0.2)
    assert stream.reports.late_s == pytest.approx(0.2, abs=1e-6)
    # The drift of a fast clock is faster; of a slow one it is not slower.
    fast = Stream(rate=10.0, count=700)
    for _ in range(50):
        assert fast.next(1.0, late=0.5)
    assert fast.reports.late_s == pytest.approx(0.5 - 49 * 0.1 * DRIFT * 10.0, abs=2e-3)
    assert stream.next(late=0.2)
    assert stream.reports.late_s == pytest.approx(0.2 - DRIFT, abs=1e-6)


@pytest.mark.parametrize('rate', [10.0, 20.0])
def test_a_fast_clock_makes_a_busy_machine_later(rate):
    """Half a second of wall time is `rate` times as long on it; the drift is, too."""
    stream = Stream(rate=rate, count=70 * int(rate))
    assert stream.reports.clock.rate == pytest.approx(rate, rel=1e-6)
    limit = 0.15 + 0.5 * rate
    assert stream.next(late=limit - 0.02)
    assert not stream.next(late=limit + 0.06)
    slow = Stream(rate=0.5, count=200)
    assert slow.reports.clock.rate == pytest.approx(0.5)
    assert slow.next(late=0.24)
    assert not slow.next(late=0.26)


def test_after_it_was_told_to_forget_everything_is_new():
    stream = Stream()
    stream.next(q=[0.25, np.nan])
    stream.reports.forget()
    assert stream.next(q=np.add(AT, [0.5, 3.0]))
    stream.reports.forget()
    assert stream.next(stamp_dt=-50.0)
    assert stream.next(late=9.0)
    assert stream.reports.refused == {'not_finite': 1}


# The rate of the node's clock


def test_the_rate_of_a_clock():
    clock = ClockRate()
    assert clock.rate == 1.0
    clock.update(0.0, 100.0)
    clock.update(2.5, 100.25)
    # A quarter of a second is too short to tell.
    assert clock.rate == 1.0
    clock.update(4.0, 100.4)
    assert clock.rate == pytest.approx(10.0)


def test_the_rate_is_that_of_the_last_two_seconds():
    clock, t = ClockRate(), 0.0
    for i in range(400):
        t += 0.1 if i < 200 else 0.01
        clock.update(t, i * 0.01)
    assert clock.rate == pytest.approx(1.0, rel=0.05)
    clock.update(t + 0.5, 4.49)
    assert clock.rate == pytest.approx(1.0, rel=0.05)


def test_a_clock_that_is_set_back_begins_anew():
    clock = ClockRate()
    clock.update(50.0, 0.0)
    clock.update(60.0, 1.0)
    assert clock.rate == 10.0
    clock.update(0.0, 1.1)
    assert clock.rate == 10.0
    clock.update(2.0, 1.5)
    assert clock.rate == pytest.approx(5.0)


def test_a_clock_that_stands_still():
    clock = ClockRate()
    for i in range(100):
        clock.update(7.0, i * 0.02)
    assert clock.rate == 0.0


def test_many_reports_a_second_take_no_memory():
    clock = ClockRate()
    for i in range(10000):
        clock.update(i * 1e-3, i * 1e-3)
    assert len(clock._seen) <= 41
    assert clock.rate == pytest.approx(1.0)
