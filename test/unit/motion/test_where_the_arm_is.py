# SPDX-License-Identifier: Apache-2.0
"""What is done where it is not sure that the arm is where it is reported; who goes on when."""

import copy

import numpy as np
import pytest
from supervisor_rig import ASKED, HOME, LIMITS, RULES, SPEED, Rig, begun

from remaster_ros.motion.actions import Drive, Halted, Stop
from remaster_ros.motion.following import allowed_lag_s
from remaster_ros.motion.motion_gate import Cubic, MotionGate
from remaster_ros.motion.move_queue import PROBE, probe_path
from remaster_ros.motion.trajectory import Waypoint

SEED = 34


@pytest.mark.parametrize('trial', range(6))
def test_an_emergency_stop_while_it_brakes_halts(trial):
    """Released at once; a sensor is missing for two seconds. It never goes on by itself."""
    rng = np.random.default_rng([SEED, trial])
    print(f'seed {SEED}, trial {trial}')
    rig = begun()
    rig.go([0.9, -1.9], rng.uniform(0.8, 2.0))
    rig.waiting_for = 'mocap'
    rig.do(rig.supervisor.recorder_waits('mocap', rig.wall))
    (stop,) = rig.said(Stop)
    rig.run(rng.uniform(0.02, stop.admitted.waypoints[0].time_s))
    rig.freeze()
    rig.run(2.0)
    rig.waiting_for = ''
    rig.run(5.0)
    assert rig.said(Halted)
    assert len(rig.said(Drive)) == 1


@pytest.mark.parametrize('rate', [1.0, 10.0])
def test_a_stop_that_is_long_on_its_way_is_no_emergency_stop(rate):
    """The arm has come to the end of its move meanwhile, stands there and then goes back."""
    rng = np.random.default_rng([SEED, int(rate)])
    print(f'seed {SEED}')
    begun = Rig(rate=rate)
    # The rate is learned.
    begun.run(1.0 * rate)
    stops = farthest = 0
    for _ in range(12):
        rig = copy.deepcopy(begun)
        # It is reported with its own rig's values.
        rig.alter, rig.obey, rig.answer_path = (lambda t, q: q), (lambda points: points), rig._free
        rig.plan(rng.uniform(-0.9, 0.9, 2))
        duration_s = rig.last(Drive).admitted.waypoints[-1].time_s
        rig.run(duration_s - rng.uniform(0.05, 0.8))
        rig.stop_s = rng.uniform(0.8, 1.0) * allowed_lag_s(RULES, rate) - 0.02
        rig.pause()
        if not rig.said(Stop):
            continue
        (end,) = rig.last(Stop).admitted.waypoints
        rig.run(allowed_lag_s(RULES, rate) + end.time_s + 4.0)
        assert not rig.said(Halted)
        stops += 1
        farthest = max(farthest, np.max(np.abs(rig.last(Drive).admitted.trajectory.end - end.q)))
    assert stops >= 6
    # Where it stood meanwhile is no place for the end of a stop.
    assert farthest > 2 * RULES.settle.arrive_tolerance


@pytest.mark.parametrize('noise', [1e-6, 2e-5])
@pytest.mark.parametrize('sag', [0.0, 8e-4])
def test_an_arm_that_stops_as_ever_goes_on(noise, sag):
    """Also one whose servo gives way under its weight, and reports with noise."""
    rng = np.random.default_rng([SEED, 1])
    rig = Rig(begun=False)
    rig.alter = lambda t, q: q + [sag, -sag] + rng.normal(0.0, noise, 2)
    rig.visit([0.3, 0.3], [0.9, -1.9])
    rig.answer(0)
    for _ in range(2):
        rig.run(5.0, lambda: rig.speed() > 0.2)
        rig.waiting_for = 'mocap'
        rig.run(3.0)
        rig.waiting_for = ''
    rig.settles(2)
    assert not rig.said(Halted)
    assert len(rig.said(Stop)) == 2


@pytest.mark.parametrize(
    ('seconds', 'released', 'goes_on'),
    [(4.0, None, True), (7.0, None, False), (7.0, 'always', True), (7.0, 'lately', False)],
)
@pytest.mark.parametrize('place', ['moving', 'settled'])
def test_who_goes_on_after_an_interruption(seconds, released, goes_on, place):
    """A person, unless the robot reported all the time that nobody has stopped it."""
    rig = begun()
    if released == 'always':
        rig.do(rig.supervisor.emergency(False, rig.wall))
    if place == 'moving':
        rig.go([0.9, -1.9], 1.2)
    else:
        rig.visit([0.3, 0.0], [0.9, -1.9])
    rig.waiting_for = 'mocap'
    rig.run(seconds / 2)
    assert [stop.reason for stop in rig.said(Stop)] == (place == 'moving') * ['waiting for mocap']
    if released == 'lately':
        rig.do(rig.supervisor.emergency(False, rig.wall))
    rig.run(seconds / 2)
    rig.waiting_for = ''
    if place == 'settled':
        rig.answer(0)
    count = len(rig.said(Drive))
    rig.run(4.0)
    assert (len(rig.said(Drive)) > count) == goes_on
    assert not rig.said(Halted)
    if goes_on:
        return
    assert rig.supervisor.blocked(rig.wall) == (
        'the collection was interrupted for more than 5 s (waiting for mocap): '
        '/remaster/collect goes on'
    )
    # As the planner does that is told so, and then a person.
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.run(5.0)
    assert len(rig.said(Drive)) > count


@pytest.mark.parametrize('topic', [False, True])
def test_a_bridge_that_was_away_for_long_waits_for_a_person(topic):
    """Also where the robot says now that it is released: nobody listened meanwhile."""
    for gone_s, goes_on in ((3.0, True), (20.0, False)):
        rig = Rig(begun=False)
        rig.supervisor.interrupted(rig.wall - gone_s)
        if topic:
            rig.do(rig.supervisor.emergency(False, rig.wall))
            rig.do(rig.supervisor.observe('safety_link', '', rig.wall))
        rig.plan([0.3, 0.0])
        rig.run(4.0)
        assert bool(rig.said(Drive)) == goes_on


def test_frozen_reports_and_a_person_who_clears_the_halt():
    """It is asked for a comparison first; whoever does not compare sends the arm off slowly."""
    rig = begun()
    rig.go([0.9, -1.9], 1.0)
    q = rig.arm.at(rig.t)[0]
    rig.alter = lambda t, _: q
    rig.halts(5.0)
    # It has completed its move, unseen.
    rig.run(5.0)
    np.testing.assert_allclose(rig.arm.at(rig.t)[0], [0.9, -1.9], atol=1e-3)
    asked = rig.supervisor.clear_halt()
    assert asked.startswith(ASKED)
    assert rig.supervisor.halted
    rig.collect()
    probe = rig.said(Drive)[-1]
    assert probe.solution == PROBE
    (end,) = probe.admitted.waypoints
    assert end.time_s > 3.0
    cubic = list(rig.cubics())[-1]
    assert np.max(np.abs(cubic.coefficients[0] - q)) > 0.5
    assert np.all(cubic.largest_speed() <= SPEED * 1.001)


def test_reports_that_move_on_after_the_question_are_not_what_was_confirmed():
    rig = begun()
    rig.go([0.9, -1.9], 1.0)
    rig.freeze()
    rig.halts(5.0)
    rig.run(0.5)
    first = rig.supervisor.clear_halt()
    rig.alter = lambda t, q: np.add(q, [0.02, 0.0])
    rig.run(0.5)
    second = rig.supervisor.clear_halt()
    assert first.startswith(ASKED)
    assert second.startswith(ASKED)
    assert first != second
    assert rig.supervisor.clear_halt() == ''


def test_the_probe_is_slow_from_wherever_the_arm_may_be():
    """From any true place within the limits: no joint beyond its speed and acceleration."""
    rng = np.random.default_rng(SEED)
    print(f'seed {SEED}')
    for _ in range(200):
        gate = MotionGate(LIMITS)
        reported, true = rng.uniform(LIMITS.lower, LIMITS.upper, (2, 2))
        path = probe_path(reported, LIMITS)
        admitted = gate.admit_probe(path, reported, np.array([True, True]))
        (end,) = admitted.waypoints
        cubic = Cubic.between(Waypoint(0.0, true, np.zeros(2)), end)
        assert np.all(cubic.largest_speed() <= LIMITS.velocity * (1 + 1e-9))
        assert np.all(cubic.largest_acceleration() <= LIMITS.acceleration * (1 + 1e-9))
        assert admitted.trajectory.duration_s == pytest.approx(end.time_s)
        sure = gate.admit_probe(path, reported, np.array([False, False]))
        assert sure.waypoints[0].time_s == 1.0


@pytest.mark.parametrize(
    ('end', 'frozen', 'slow'), [(HOME, False, False), (HOME, True, True), (None, False, True)]
)
def test_when_the_probe_takes_its_time(end, frozen, slow):
    """Where the last command is unknown, or a joint reads the same to the last bit."""
    rig = Rig(begun=False, end=end)
    if frozen:
        rig.alter = lambda t, q: np.array([HOME[0], q[1]])
    rig.run(2.0)
    rig.plan([0.5, 0.5])
    rig.run(3.0, lambda: rig.said(Drive))
    (probe,) = rig.said(Drive)
    assert probe.solution == PROBE
    assert (probe.admitted.waypoints[0].time_s > 1.0) == slow


@pytest.mark.parametrize('pause_s', [0.5, 4.0])
def test_a_slow_probe_that_was_interrupted_is_slow_again(pause_s):
    """It has not led the arm to its end: where the arm is, is as open as before."""
    rig = Rig(begun=False, end=None)
    rig.plan([0.5, 0.5])
    rig.run(3.0, lambda: rig.said(Drive))
    rig.run(1.0)
    assert rig.supervisor.end is None
    rig.state = 'paused'
    rig.run(pause_s)
    rig.state = 'running'
    rig.run(3.0, lambda: len(rig.said(Drive)) == 2)
    for probe in rig.said(Drive):
        assert probe.solution == PROBE
        assert probe.admitted.waypoints[0].time_s > 3.0
    rig.settles()
    assert rig.supervisor.end is not None
