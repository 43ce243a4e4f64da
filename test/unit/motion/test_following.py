# SPDX-License-Identifier: Apache-2.0
"""Where the arm is by its reports: whether it stands, and on its path, lag, and what is lost."""

import numpy as np
import pytest

from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.following import (
    ASTRAY_S,
    FRESH_S,
    JITTER_S,
    LATENCY_S,
    ON_PATH_RAD,
    STANDING_S,
    STOPPED_ON_ITS_WAY,
    Following,
    Seen,
    allowed_lag_s,
)
from remaster_ros.motion.joint_reports import JointReport
from remaster_ros.motion.settling import SettleRules
from remaster_ros.motion.trajectory import REST_S, Line, Trajectory
from remaster_ros.simulation import arm_motion as servo

RULES = SupervisorRules(settle=SettleRules(settle_s=1.0, still_tolerance=2.0**-12))
AT = np.array([0.25, 0.5])
LINE = Line(np.array([0.25, -0.5]), np.array([1.25, -0.5]), 0.5)
"""2.5 s, of which 1.5 s at half a radian a second."""


def see(stamp, q, wall=None, last=None, late=0.0):
    wall = stamp if wall is None else wall
    report = JointReport(stamp, np.asarray(q, float), stamp, wall)
    return Seen.after(last, report, RULES, late)


BESIDE = 'the robot does not follow its path: 1.7 deg beside it'
NOT_TAKEN = 'the robot does not take commands: see its controller, and its driver'
CORNERS = Trajectory((LINE, Line(LINE.end, np.array([1.25, 0.5]), 0.5)))


class Arm:
    """A trajectory sent at 64 s; reports at 50 Hz of an arm that is where a function tells."""

    def __init__(self, trajectory=None, rate=1.0, rules=RULES):
        self.trajectory = trajectory or Trajectory((LINE,))
        self.following = Following(self.trajectory, 64.0, 512.0, rules)
        self.rate, self.seen, self.said = rate, None, ''

    def run(self, until_s, where, dt=1 / 64):
        """Report up to `until_s`; return the time when it was said to be astray, or None."""
        first = 0.0 if self.seen is None else self.seen.time - 64.0 + dt
        for elapsed in np.arange(first, until_s + dt / 2, dt):
            q = np.asarray(where(elapsed), float)
            self.seen = see(64.0 + elapsed, q, 512.0 + elapsed / self.rate, self.seen)
            self.said = self.following.update(self.seen, self.rate)
            if self.said:
                return float(elapsed)
        return None

    @property
    def lost(self):
        return self.following.lost(self.seen, self.seen.wall)

    @property
    def window(self):
        return self.following.window(self.seen, self.seen.wall, self.rate)

    def lagging(self, lag_s):
        return lambda elapsed: self.trajectory.at(elapsed - lag_s)[0]


# Standstill, and robot time


def test_robot_time_goes_by_the_stamps():
    seen = see(100.0, AT, wall=7.0)
    assert (seen.time, seen.stamp, seen.wall) == (100.0, 100.0, 7.0)
    seen = see(100.5, AT, wall=7.25, last=seen)
    assert seen.time == 100.5
    assert seen.now(7.5, 2.0) == 101.0
    assert seen.now(7.25, 9.0) == 100.5


@pytest.mark.parametrize(('passed', 'stands'), [(0.125, False), (STANDING_S, True)])
def test_how_long_an_arm_must_stand(passed, stands):
    seen = see(8.0 + passed, AT, wall=8.0, last=see(8.0, AT, wall=8.0))
    assert seen.stands(8.0) == stands


@pytest.mark.parametrize(('moved', 'stands'), [(2.0**-12, True), (2.0**-11, False)])
@pytest.mark.parametrize('side', [1.0, -1.0])
def test_what_counts_as_standing(moved, stands, side):
    seen = see(8.0, AT)
    seen = see(8.25, np.add(AT, [0.0, side * moved]), last=seen)
    assert seen.stands(8.25) == stands
    assert seen.stands_since == (8.0 if stands else 8.25)
    np.testing.assert_array_equal(
        seen.stands_at, AT if stands else np.add(AT, [0.0, side * moved])
    )


def test_an_arm_that_creeps_does_not_stand():
    seen = see(8.0, AT)
    for i in range(1, 50):
        seen = see(8.0 + i * 0.125, np.add(AT, [i * 2.0**-12, 0.0]), last=seen)
        assert not seen.stands(seen.wall)


@pytest.mark.parametrize(('gap', 'stands'), [(0.5, True), (0.625, False)])
def test_a_gap_begins_the_standstill_anew(gap, stands):
    seen = see(8.0 + gap, AT, last=see(8.0, AT))
    assert seen.stands(seen.wall) == stands
    assert seen.time == 8.0 + gap


def test_an_old_report_proves_nothing():
    seen = see(8.5, AT, wall=8.5, last=see(8.25, AT))
    assert seen.is_fresh(8.5 + FRESH_S - 1e-6)
    assert seen.stands(8.5 + FRESH_S - 1e-6)
    assert not seen.is_fresh(8.5 + FRESH_S + 1e-6)
    assert not seen.stands(8.5 + FRESH_S + 1e-6)


def test_the_lag_that_is_allowed():
    assert allowed_lag_s(RULES, 1.0) == pytest.approx(RULES.lag_s + LATENCY_S)
    assert allowed_lag_s(RULES, 0.2) == pytest.approx(RULES.lag_s + LATENCY_S)
    assert allowed_lag_s(RULES, 20.0) == pytest.approx(RULES.lag_s + 20 * LATENCY_S)
    # So that an arm is never on two lines at once.
    assert allowed_lag_s(RULES, 1.0) + JITTER_S < REST_S


# Along a line


@pytest.mark.parametrize('lag', [0.0, 0.1, 0.3, 0.36])
def test_an_arm_that_lags_follows_and_its_lag_is_known(lag):
    arm = Arm()
    for until in np.arange(0.1, 4.0, 0.1):
        assert arm.run(until, arm.lagging(lag)) is None
        assert arm.lost == ''
        low, high = arm.window
        elapsed = arm.seen.time - 64.0
        assert high == pytest.approx(elapsed + JITTER_S)
        # The arm is within the window; on the ramps and in the cruise it is at its beginning.
        at = arm.trajectory.at(elapsed - lag)[0]
        share, _ = LINE.project(at)
        assert LINE.share(low)[0] <= share + 1e-9 <= LINE.share(high)[0] + 2e-9
        ended = arm.following.has_ended(arm.seen, arm.seen.wall, 1.0)
        assert ended == (elapsed - max(LINE.duration_s - LINE.time_s(share), 0) - JITTER_S >= 2.5)
        if 0.7 + lag < elapsed < 2.0:
            assert low == pytest.approx(elapsed - lag - JITTER_S, abs=1e-9)


def test_the_window_grows_with_the_time_and_with_a_late_report():
    """The reference goes on; the arm may have been stopped since the last report."""
    arm = Arm()
    arm.run(1.0, arm.lagging(0.1))
    low, high = arm.window
    later = arm.following.window(arm.seen, arm.seen.wall + 0.125, 1.0)
    assert later == (low, pytest.approx(high + 0.125))
    report = JointReport(arm.seen.stamp, arm.seen.q, 0.0, arm.seen.wall)
    late = Seen.after(None, report, RULES, 0.2)
    assert arm.following.window(late, late.wall, 1.0) == (low, pytest.approx(high + 0.2))


@pytest.mark.parametrize('q', [AT, np.add(AT, 0.1)])
def test_how_late_a_report_came_is_kept(q):
    """In the first one, standing or moved."""
    seen = see(8.0, AT, late=0.125)
    assert seen.late_s == 0.125
    assert see(8.125, q, last=seen, late=0.0625).late_s == 0.0625


def test_before_the_first_report_nothing_is_lost():
    """A stop that comes at once after a move was sent is made from its start."""
    following = Following(Trajectory((LINE,)), 64.0, 512.0, RULES)
    assert following.reacted is False
    seen = see(64.0, LINE.start, 512.0)
    assert following.lost(seen, 512.0) == ''
    assert following.window(seen, 512.0, 1.0) == (-JITTER_S, JITTER_S)


def test_on_a_fast_clock_an_arm_may_be_on_the_line_before():
    """It may lag by more than it rests; a second ago it was on the first line."""
    arm = Arm(Trajectory((*CORNERS.lines, Line(CORNERS.end, np.zeros(2), 0.5))), rate=10.0)
    for until in np.arange(0.1, CORNERS.duration_s + 3.0, 0.1):
        assert arm.run(until, arm.lagging(0.9)) is None, arm.said
        if until > 1.5:
            assert arm.lost == '', until


def test_exactly_at_the_tolerances():
    """Numbers that binary fractions have: on the edge it still follows."""
    assert see(8.0, AT, wall=0.0).is_fresh(FRESH_S)
    rules = SupervisorRules(
        settle=SettleRules(arrive_tolerance=2.0**-8), reaction_s=0.25, lag_s=0.25
    )
    following = Following(Trajectory((LINE,)), 64.0, 512.0, rules)
    at_edge = see(64.25, np.add(LINE.start, [0.0, 2.0**-8]), 512.25)
    assert following.update(at_edge, 1.0) == ''
    assert following.lost(at_edge, 512.25) == ''
    assert not following.reacted
    just_left = see(64.25, np.add(LINE.start, [0.0, 2.0**-7]), 512.25)
    following.update(just_left, 1.0)
    assert following.reacted


def test_at_a_fast_clock_a_move_has_ended_later_and_the_window_is_wider():
    """By how much commands may differ on their way is wall time."""
    for rate in (1.0, 10.0):
        arm = Arm(rate=rate)
        arm.run(1.0, arm.lagging(0.1))
        assert arm.window[1] == pytest.approx(1.0 + rate * JITTER_S)
        arm.run(2.5 + JITTER_S * rate - 1 / 32, arm.lagging(0.0))
        assert not arm.following.has_ended(arm.seen, arm.seen.wall, rate)
        arm.run(2.5 + JITTER_S * rate + 1 / 64, arm.lagging(0.0))
        assert arm.following.has_ended(arm.seen, arm.seen.wall, rate)


@pytest.mark.parametrize(('lag', 'follows'), [(0.44, True), (0.47, False)])
def test_how_far_behind_an_arm_still_follows(lag, follows):
    arm = Arm()
    astray = arm.run(2.4, arm.lagging(lag))
    assert (astray is None) == follows
    if not follows:
        assert 'behind it; is its speed override below 100 %' in arm.said
        assert arm.said.startswith('the robot does not follow its path: 0.4')
        assert arm.lost == arm.said


def test_an_arm_that_runs_ahead_does_not_follow():
    """0.2 s are jitter and a busy machine; more is no arm that obeys."""
    arm = Arm()
    assert arm.run(2.2, arm.lagging(-0.19)) is None
    # A stop is right from where its reference is as well.
    low, high = arm.window
    elapsed = arm.seen.time - 64.0
    assert (low, high) == pytest.approx((elapsed - JITTER_S, elapsed + JITTER_S))
    arm = Arm()
    astray = arm.run(2.2, arm.lagging(-0.22))
    assert astray is not None
    assert '0.22 s ahead of it' in arm.said


@pytest.mark.parametrize(('ahead', 'follows'), [(0.6, True), (1.15, False)])
def test_a_clock_that_runs_ten_times_as_fast_stands_still_meanwhile(ahead, follows):
    """A tenth of a second of a busy machine is a second of such a clock, ahead and behind."""
    arm = Arm(Trajectory((Line(AT, np.add(AT, 4.0), 0.1),)), rate=10.0)
    assert (arm.run(9.0, arm.lagging(-ahead)) is None) == follows


def late(t):
    return LINE.start + LINE.share(t - 0.1)[0] * LINE.way


def stray_way(off_rad, when=lambda t: t > 0.0):
    """Return the way of an arm that lags by 0.1 s and is off its line at some times."""
    return lambda t: late(t) + [0.0, off_rad * when(t)]


@pytest.mark.parametrize(
    ('where', 'until_s', 'astray_s', 'said'),
    [
        # A bump, and two of them, which are not added.
        (stray_way(0.03, lambda t: 1.0 < t < 1.25), 2.4, None, ''),
        (stray_way(0.03, lambda t: 1.0 < t < 1.2 or 1.3 < t < 1.55), 2.4, None, ''),
        (stray_way(0.03, lambda t: t > 1.0), 2.4, 1.0 + ASTRAY_S, BESIDE),
        (stray_way(0.95 * ON_PATH_RAD), 2.4, None, ''),
        (stray_way(1.05 * ON_PATH_RAD), 2.4, ASTRAY_S, BESIDE.replace('1.7', '1.2')),
        # An arm that stays 15 mrad short has a lag of seconds, and is near all the same.
        (lambda t: np.minimum(late(t), [1.235, 0.0]), 6.0, None, ''),
        (lambda t: late(min(t, 1.0)), 4.0, 1.35 + ASTRAY_S, STOPPED_ON_ITS_WAY),
        (lambda t: LINE.start, 4.0, RULES.reaction_s + ASTRAY_S, NOT_TAKEN),
    ],
)
def test_when_an_arm_is_astray(where, until_s, astray_s, said):
    arm = Arm()
    astray = arm.run(until_s, where)
    assert arm.said == arm.lost == said
    assert astray is None if astray_s is None else astray_s < astray < astray_s + 0.05


def test_an_arm_is_lost_before_it_is_astray():
    arm = Arm()
    assert arm.run(1.1, stray_way(0.03, lambda t: t > 1.0)) is None
    assert arm.lost == BESIDE
    arm = Arm()
    assert arm.run(0.44, lambda t: LINE.start) is None
    assert arm.lost == ''
    low, high = arm.window
    assert low <= 0.0
    assert high == pytest.approx(arm.following.elapsed_s(arm.seen.time) + JITTER_S)
    assert arm.run(0.49, lambda t: LINE.start) is None
    assert arm.lost == 'the arm is not seen to move yet'


def test_the_reaction_is_wall_time():
    """With a clock ten times as fast half a second of the robot is no time to react."""
    arm = Arm(rate=10.0)
    assert arm.run(4.9, lambda t: LINE.start) is None
    assert arm.lost == 'the arm is not seen to move yet'
    assert arm.run(12.0, lambda t: LINE.start) is not None
    assert 'does not take commands' in arm.said


def test_an_arm_that_has_moved_once_has_taken_the_command():
    """Back at its start it has not followed; it is not said to have taken no command."""
    arm = Arm()
    arm.run(0.4, lambda t: np.add(LINE.start, [0.003, 0.0]))
    assert arm.run(3.0, lambda t: LINE.start) is not None
    assert arm.said == STOPPED_ON_ITS_WAY


def test_a_move_too_short_to_be_seen_is_not_missed():
    line = Line(np.zeros(2), np.array([ON_PATH_RAD / 2, 0.0]), 2.0)
    arm = Arm(Trajectory((line,)))
    assert arm.run(3.0, lambda t: line.start) is None
    assert arm.lost == ''


def test_an_old_report_tells_nothing():
    arm = Arm()
    arm.run(1.0, arm.lagging(0.1))
    following, wall = arm.following, arm.seen.wall
    assert following.lost(arm.seen, wall + FRESH_S - 0.01) == ''
    assert following.lost(arm.seen, wall + 0.5) == 'the last report of the joints is 0.5 s old'


# Several lines


@pytest.mark.parametrize('lag', [0.0, 0.1, 0.3, 0.36])
def test_around_a_corner_an_arm_that_lags_follows(lag):
    arm = Arm(CORNERS)
    for until in np.arange(0.1, CORNERS.duration_s + 1.0, 0.1):
        assert arm.run(until, arm.lagging(lag)) is None, arm.said
        assert arm.lost == ''


def test_near_its_place_on_a_later_line_a_long_lag_is_no_reason():
    """0.03 rad in 2.5 s: a servo's error is most of a second there."""
    short = Line(LINE.end, np.add(LINE.end, [0.0, 0.03]), 0.5)
    arm = Arm(Trajectory((LINE, short)))
    begun = arm.trajectory.starts_s[1]
    assert arm.run(begun + 0.9, lambda t: arm.trajectory.at(min(t, begun))[0]) is None
    assert arm.lost == ''


def test_in_a_rest_the_window_reaches_back_to_an_arm_that_lags():
    arm = Arm(CORNERS)
    assert arm.run(2.75, arm.lagging(0.36)) is None
    low, high = arm.window
    assert low == pytest.approx(2.75 - 0.36 - JITTER_S)
    assert high == pytest.approx(2.75 + JITTER_S)
    assert not arm.following.has_ended(arm.seen, arm.seen.wall, 1.0)


def test_an_arm_that_cuts_the_corner_is_astray():
    arm = Arm(CORNERS)
    straight = Line(LINE.start, CORNERS.end, 1.0 / CORNERS.duration_s)
    assert arm.run(
        CORNERS.duration_s, lambda t: straight.start + straight.share(t)[0] * straight.way
    )


def test_an_arm_that_stays_at_the_corner_is_astray():
    """Just after the rest it may be there; when the second line is well under way it may not."""
    arm = Arm(CORNERS)
    begun = CORNERS.starts_s[1]

    def stays(t):
        return CORNERS.at(min(t, begun) - 0.1)[0]

    assert arm.run(begun + 0.4, stays) is None
    assert arm.lost == ''
    assert arm.run(begun + 2.0, stays) is not None
    assert arm.said == STOPPED_ON_ITS_WAY


# An arm that is being stopped


def braked(trajectory, lag, at_s, brake_s=0.15):
    """An arm whose own brakes close at a time, as an emergency stop does."""

    def where(t):
        since = min(max(t - at_s, 0.0), brake_s)
        time = min(t, at_s) + since - since**2 / (2 * brake_s)
        return trajectory.at(time - lag)[0]

    return where


@pytest.mark.parametrize(
    ('at_s', 'lag'),
    [(0.3, 0.0), *((at, lag) for at in (0.8, 1.2, 1.6) for lag in (0.0, 0.1, 0.3))],
)
def test_an_arm_that_is_being_stopped_is_lost_long_before_its_lag_tells(lag, at_s):
    arm = Arm()
    where = braked(arm.trajectory, lag, at_s)
    arm.run(at_s, where)
    assert arm.lost == ''
    assert arm.run(at_s + 0.22, where) is None
    assert arm.lost == STOPPED_ON_ITS_WAY
    assert arm.seen.time - arm.seen.stands_since < STANDING_S


def test_on_a_later_line_it_is_lost_where_its_lag_is_known():
    arm = Arm(CORNERS)
    begun = CORNERS.starts_s[1]
    where = braked(CORNERS, 0.1, begun + 0.8)
    assert arm.run(begun + 1.02, where) is None
    assert arm.lost == STOPPED_ON_ITS_WAY


def test_an_arm_that_runs_up_later_than_a_moment_ago_is_not_called_slow():
    """Where it speeds up, a lag that grows looks like a loss of speed."""
    arm = Arm()

    def where(t):
        return arm.trajectory.at(t - 0.55 * np.clip(t - 0.3, 0.0, 0.1))[0]

    for until in np.arange(0.1, 1.0, 1 / 64):
        assert arm.run(until, where) is None
        assert arm.lost == '', until


def test_an_arm_that_was_not_seen_for_a_while_is_not_called_slow():
    """Over a longer time its lag may have changed."""
    arm = Arm()
    where = braked(arm.trajectory, 0.0, 1.0)
    arm.run(1.0, where)
    arm.seen = see(64.0 + 1.375, where(1.375), 512.0 + 1.375, arm.seen)
    arm.following.update(arm.seen, 1.0)
    assert arm.lost == ''


@pytest.mark.parametrize('trajectory', [Trajectory((LINE,)), CORNERS])
def test_a_servo_that_lags_and_overshoots_is_never_called_slow(trajectory):
    arm, joints = Arm(trajectory), servo.Motion(0.0, trajectory.start)
    joints.follow(
        0.0, [servo.ServoPoint(p.time_s, p.q, p.velocity) for p in trajectory.waypoints()]
    )
    for until in np.arange(0.05, trajectory.duration_s + 1.0, 0.05):
        assert arm.run(until, lambda t: joints.at(t)[0]) is None
        assert arm.lost == '', until
