# SPDX-License-Identifier: Apache-2.0
"""What becomes of a configuration at the very limits of its times and distances."""

import dataclasses

import numpy as np
import pytest

from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.following import ON_PATH_RAD, STANDING_S, Following, Seen
from remaster_ros.motion.joint_units import TURNING
from remaster_ros.motion.motion_under_way import MOVED_RAD, PROBE_WAIT_S, Braking, Visit
from remaster_ros.motion.settling import SettleDetector, SettleRules
from remaster_ros.motion.trajectory import Line, Trajectory

RULES = SupervisorRules(
    settle=SettleRules(settle_s=1.0, arrive_tolerance=2.0**-8, still_tolerance=2.0**-12),
    stall_s=1.0,
    answer_timeout_s=16.0,
)
LINE = Line(np.array([-1.0, 0.0]), np.zeros(2), 0.5)
"""2.5 s to zero."""
SENT_S = 64.0


def at(q, time_s, stood_s=0.0):
    q = np.asarray(q, float)
    return Seen(q, time_s, time_s, time_s, q, time_s - stood_s, 0.0)


def visit(solution=0, rules=RULES, **changes):
    following = Following(Trajectory((LINE,)), SENT_S, SENT_S, rules)
    following.reacted = True
    detector = SettleDetector(LINE.end, rules.settle)
    made = Visit(solution, following, detector, rules, SENT_S, SENT_S + 8.0)
    return dataclasses.replace(made, **changes)


@pytest.mark.parametrize(('moved', 'outcome'), [(MOVED_RAD, ''), (MOVED_RAD + 1e-12, 'halted')])
def test_how_far_an_arm_may_move_while_it_is_measured(moved, outcome):
    settled = visit(deadline=SENT_S + 100.0)
    for q in ([moved, 0.0], [0.0, -moved]):
        assert settled.judge_settled(at(q, SENT_S), recorder_waits=False)[0] == outcome


@pytest.mark.parametrize(('late', 'outcome'), [(0.0, ''), (2.0**-30, 'failed')])
def test_how_long_the_recorder_may_take(late, outcome):
    settled = visit(deadline=SENT_S + 16.0)
    seen = at(LINE.end + 1e-6, SENT_S + 16.0 + late)
    assert settled.judge_settled(seen, recorder_waits=False)[0] == outcome
    assert settled.judge_settled(seen, recorder_waits=True)[0] == ''
    assert settled.deadline == seen.time + 16.0


@pytest.mark.parametrize(('late', 'outcome'), [(0.0, ''), (2.0**-30, 'failed')])
def test_how_long_an_arm_may_take(late, outcome):
    seen = at([1e-3, 0.0], SENT_S + 8.0 + late)
    assert visit().judge(seen, 1.0)[0] == outcome


@pytest.mark.parametrize(
    ('off', 'stood_s', 'outcome'),
    [
        (2.0**-8, 4.0, ''),
        (2.0**-8 + 2.0**-20, 1.0, 'halted'),
        (2.0**-8 + 2.0**-20, 1.0 - 2.0**-20, ''),
    ],
)
def test_how_long_an_arm_may_stand_beside_its_target(off, stood_s, outcome):
    seen = at([-off, 0.0], SENT_S + 5.0, stood_s)
    assert visit().judge(seen, 1.0)[0] == outcome


@pytest.mark.parametrize(('after_s', 'outcome'), [(1.0, 'halted'), (1.0 - 2.0**-20, '')])
def test_an_arm_that_stood_before_its_move_ended_is_given_time_from_its_end(after_s, outcome):
    seen = at([-0.015, 0.0], SENT_S + 2.5 + after_s, 2.0)
    assert visit().judge(seen, 1.0)[0] == outcome


def test_a_probe_is_over_when_it_must_have_arrived():
    arrived = SENT_S + LINE.duration_s + PROBE_WAIT_S
    probe = visit(solution=-1)
    assert probe.judge(at([1e-3, 0.0], arrived), 1.0) == ('', '')
    assert probe.judge(at([1e-3, 0.0], arrived + 2.0**-20), 1.0) == ('over', '')


def test_an_arm_that_has_stood_for_long_enough_has_settled():
    made = visit()
    outcomes = [made.judge(at([1e-5, 0.0], SENT_S + 2.5 + t, t), 1.0) for t in (0.0, 0.5, 1.0)]
    assert outcomes == [('', ''), ('', ''), ('settled', '')]
    assert made.deadline == SENT_S + 3.5 + 16.0


NEAR, PATIENCE_S = 2.0**-11, 0.5


def braking(begins=0.0, over=0.0, deadline=4.0):
    times = (SENT_S + after_s for after_s in (begins, over, deadline))
    return Braking(np.zeros(2), *times, NEAR, PATIENCE_S, TURNING)


@pytest.mark.parametrize(('off', 'outcome'), [(NEAR, 'over'), (NEAR + 1e-12, 'halted')])
def test_how_far_from_its_stop_an_arm_may_stand(off, outcome):
    """One that stands further off has until the deadline: a servo may creep to its end."""
    for q in ([off, 0.0], [0.0, -off]):
        stop = braking()
        first = stop.judge(at(q, SENT_S, 1.0))
        assert first[0] == ('over' if outcome == 'over' else '')
        said, why = stop.judge(at(q, SENT_S + 4.0 + 2.0**-20, 1.0))
        assert said == outcome
        assert bool(why) == (outcome == 'halted')


@pytest.mark.parametrize(
    ('off', 'time_s', 'stood_s', 'outcome'),
    [
        (1.0, 1.5, 9.0, 'halted'),
        # It may stand until its stop gets to it.
        (1.0, 1.5 - 2.0**-20, 9.0, ''),
        (1.0, 1.75, 0.5, 'halted'),
        (1.0, 1.75, 0.5 - 2.0**-20, ''),
        (ON_PATH_RAD, 1.75, 9.0, ''),
        (0.0, 1.75, 9.0, ''),
    ],
)
def test_how_long_an_arm_may_stand_that_should_brake(off, time_s, stood_s, outcome):
    stop = braking(begins=1.0, over=2.0)
    assert stop.judge(at([-off, 0.0], SENT_S + time_s, stood_s))[0] == outcome


def test_an_arm_that_still_brakes_before_its_stop_is_over_is_waited_for():
    stop = braking(over=2.0)
    assert stop.judge(at([0.5, 0.0], SENT_S + 1.9, 0.1)) == ('', '')


@pytest.mark.parametrize(('late', 'outcome'), [(0.0, ''), (2.0**-30, 'halted')])
def test_how_long_a_stop_may_take(late, outcome):
    stop = braking()
    assert stop.judge(at([1.0, 0.0], SENT_S + 4.0 + late))[0] == outcome


@pytest.mark.parametrize(
    ('after_gap_s', 'off', 'stood_s', 'outcome'),
    [
        # A report alone does not show whether the arm stands: neither that it goes on.
        (0.0, 0.0, 0.0, ''),
        (2.0 * STANDING_S, 1.0, 0.0, ''),
        (2.0 * STANDING_S + 2.0**-20, 1.0, 0.0, 'halted'),
        (STANDING_S, 0.0, STANDING_S, 'over'),
    ],
)
def test_what_the_first_reports_after_a_silence_show(after_gap_s, off, stood_s, outcome):
    seen = at([off, 0.0], SENT_S + 9.0, stood_s)
    seen = dataclasses.replace(seen, resumed=SENT_S + 9.0 - after_gap_s)
    assert braking(over=2.0).judge(seen)[0] == outcome
