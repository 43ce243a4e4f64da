# SPDX-License-Identifier: Apache-2.0
"""Moves in pieces: what a controller has ends soon, and no renewal is seen in the motion."""

import copy
import dataclasses

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, RULES, Rig

from remaster_ros.motion.actions import Drive, Failed, Halted, Renew, Stop
from remaster_ros.motion.arm_supervisor import MISSED_IN_A_ROW
from remaster_ros.motion.motion_gate import Cubic, MotionGate, MotionRefusedError
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.pieces import (
    AHEAD_S,
    HORIZON_S,
    LEAST_PAST_S,
    PAST_S,
    RENEWED_S,
    piece_of,
)
from remaster_ros.motion.states import Arm
from remaster_ros.motion.trajectory import RAMP_S, plan_trajectory

FAR = np.array([0.9, -1.5])
IN_PIECES = dataclasses.replace(RULES, horizon_s=HORIZON_S)
WITHOUT_STAMPS = dataclasses.replace(IN_PIECES, keeps_stamps=False)
BOTH = pytest.mark.parametrize('rules', [IN_PIECES, WITHOUT_STAMPS], ids=['stamps', 'none'])
STANDS_RAD_S = 1e-3
SLOW = dataclasses.replace(LIMITS, velocity=LIMITS.velocity / 3.0)
"""The way of the tests takes 5 s."""
AFTER_S = 2.0
"""An arm stands so long after its bridge was killed."""


@pytest.mark.parametrize(
    'points', [[HOME, FAR], [HOME, [0.3, 0.4], [0.31, 0.4], FAR], [HOME, [0.2, 0.3]]]
)
def test_a_piece_is_the_trajectory_up_to_its_stop_and_ends_soon(points):
    trajectory = plan_trajectory(LIMITS, np.array(points))
    for sent_s in np.linspace(0.0, trajectory.duration_s - 0.05, 97):
        piece = piece_of(trajectory, sent_s, HORIZON_S)
        assert piece.end_s <= sent_s + HORIZON_S + 1e-9 or piece.is_last
        assert piece.end_s <= max(sent_s + HORIZON_S, trajectory.duration_s)
        first, *further_waypoints = piece.waypoints
        if sent_s > RAMP_S + PAST_S:
            assert first.time_s == pytest.approx(sent_s - PAST_S)
        elif sent_s > RAMP_S + LEAST_PAST_S:
            assert first.time_s == pytest.approx(RAMP_S)
        assert np.all(piece.waypoints[-1].velocity == 0.0)
        for before, after in zip([first, *further_waypoints], further_waypoints):
            cubic = Cubic.between(before, after)
            for share in np.linspace(0.0, 1.0, 7):
                at_s = before.time_s + share * cubic.duration_s
                if at_s <= piece.cut_s:
                    wanted, speed = trajectory.at(at_s)
                    np.testing.assert_allclose(cubic.at(at_s - before.time_s), wanted, atol=1e-9)
                    np.testing.assert_allclose(
                        cubic.velocity(at_s - before.time_s), speed, atol=1e-8
                    )
        # The one that would follow ends where this one says.
        following = piece_of(trajectory, sent_s + RENEWED_S, HORIZON_S)
        np.testing.assert_allclose(piece.next_end, following.end, atol=1e-9)


def test_each_piece_passes_the_gate():
    gate = MotionGate(LIMITS)
    gate.admit(FreePath(np.array([HOME, FAR])), HOME, HORIZON_S)
    gate.renew(0.4, HORIZON_S)
    # Other limits since: what is faster than they allow is not sent.
    trajectory, limits, path = gate._under_way
    gate._under_way = trajectory, dataclasses.replace(limits, velocity=limits.velocity / 2), path
    with pytest.raises(MotionRefusedError, match='speed'):
        gate.renew(0.8, HORIZON_S)
    assert gate.refused == 1


def slow(rules):
    """Return a rig that is slow."""
    rig = Rig(rules)
    rig.do(rig.supervisor.use_limits(SLOW, rig.wall))
    return rig


def moved(rules, **events):
    """Return the times and places of an arm on a long way, until it has settled."""
    rig = slow(rules)
    rig.plan(FAR)
    begun, trail = rig.t, []
    while not rig.said(Halted) and rig.supervisor.state is not Arm.MEASURES:
        rig.step()
        trail.append((rig.t - begun, *rig.arm.at(rig.t)[0]))
        for at_s, event in events.items():
            if rig.t - begun >= float(at_s.removeprefix('at_')) and event is not None:
                event(rig)
                events[at_s] = None
        assert rig.t < begun + 60.0
    return rig, np.array(trail)


def test_no_renewal_is_seen_in_the_path_that_is_followed():
    _, full_path = moved(RULES)
    rig, pieces = moved(IN_PIECES)
    assert len(rig.said(Renew)) > 5
    assert len(rig.said(Drive)) == 1
    assert not rig.said(Stop, Halted, Failed)
    # It begins a moment later: the same function of time from the end of its first ramp on.
    shift = round(AHEAD_S / 0.02)
    full_path, pieces = full_path[60:, 1:], pieces[60 + shift :, 1:]
    count = min(len(full_path), len(pieces))
    assert count > 200
    assert np.max(np.abs(full_path[:count] - pieces[:count])) <= 1e-4
    # No controller ever has more than the horizon.
    for t, _, _, points in rig.commands:
        begins_s = rig.said(Drive)[0].begins_s
        assert points[-1].time_s + begins_s - t <= HORIZON_S + AHEAD_S + 0.02


def test_without_stamps_the_arm_goes_along_its_line_in_steps_from_rest_to_rest():
    """A controller begins each trajectory where the arm is, so that each begins at rest."""
    rig, trail = moved(WITHOUT_STAMPS)
    assert len(rig.said(Renew)) == 4
    assert len(rig.said(Drive)) == 1
    assert not rig.said(Stop, Halted, Failed)
    # Beside the line; at its end a servo overshoots.
    way = (FAR - HOME) / np.linalg.norm(FAR - HOME)
    gone = trail[:, 1:] - HOME
    assert np.max(np.abs(gone - np.outer(gone @ way, way))) <= 1e-4
    np.testing.assert_allclose(trail[-1, 1:], FAR, atol=1e-3)
    for cubic in rig.cubics():
        assert np.all(cubic.largest_speed() <= SLOW.velocity)
        assert np.all(cubic.largest_acceleration() <= LIMITS.acceleration)
    # It never goes back, and not by jumps.
    along = (trail[:, 1:] - HOME) @ (FAR - HOME)
    assert np.min(np.diff(along)) > -1e-3
    for _, _, _, points in rig.commands:
        assert points[-1].time_s <= HORIZON_S + 0.02


@BOTH
def test_a_bridge_that_is_killed_leaves_two_seconds_of_motion(rules):
    """At twenty moments of a move."""
    rig = slow(rules)
    rig.plan(FAR)
    rig.run(0.1)
    (drive,) = rig.said(Drive)
    path, longest_s = FreePath(np.array([HOME, FAR])), 0.0
    for _ in range(20):
        killed = copy.deepcopy(rig)
        killed.alive.discard('bridge')
        killed.run(10.0, lambda killed=killed: killed.speed() < STANDS_RAD_S)
        longest_s = max(longest_s, killed.t - rig.t)
        stands = killed.arm.at(killed.t)[0]
        np.testing.assert_allclose(killed.arm.at(killed.t + 10.0)[0], stands, atol=1e-3)
        # On its line, between the places where a bridge after this one expects it.
        assert np.max(np.abs(path.off(stands, LIMITS.units))) < 1e-3
        rig.run(drive.admitted.trajectory.duration_s / 20.0)
    print(f'{longest_s:.2f} s')
    assert 0.5 < longest_s <= AFTER_S


@BOTH
def test_a_renewal_that_comes_too_late_is_none_and_the_arm_goes_on_from_where_it_stands(rules):
    """The process stands still; the arm has begun the stop of its piece meanwhile."""

    def gone(rig):
        rig.alive.discard('bridge')

    def back(rig):
        rig.alive.add('bridge')

    rig, trail = moved(rules, at_1=gone, at_4=back)
    assert not rig.said(Halted, Failed)
    assert len(rig.said(Drive)) == 2, 'it was not sent on from where it stood'
    # Nothing jumps: no speed is higher than that of the move.
    speeds = np.abs(np.diff(trail[:, 1:], axis=0)) / np.diff(trail[:, 0])[:, None]
    assert np.max(speeds / SLOW.velocity) < 1.1
    np.testing.assert_allclose(trail[-1, 1:], FAR, atol=1e-3)


@BOTH
def test_a_stop_is_on_the_line_from_wherever_the_piece_is(rules):
    for at_s in np.linspace(0.3, 5.0, 12):
        rig = slow(rules)
        rig.plan(FAR)
        rig.run(at_s)
        if rig.supervisor.state is not Arm.MOVES:
            continue
        rig.pause()
        rig.run(4.0)
        assert not rig.said(Halted)
        assert rig.speed() < STANDS_RAD_S
        off = FreePath(np.array([HOME, FAR])).off(rig.arm.at(rig.t)[0], LIMITS.units)
        assert np.max(np.abs(off)) < 2e-3


@BOTH
def test_an_arm_that_was_stopped_by_others_is_led_on_no_further(rules):
    rig = slow(rules)
    rig.plan(FAR)
    rig.run(1.2)
    rig.freeze()
    sent = len(rig.said(Renew))
    rig.obey = lambda points: ()
    rig.halts()
    assert len(rig.said(Renew)) <= sent + 1


@BOTH
def test_a_way_of_several_lines_is_gone_to_its_end(rules):
    """Between two lines the arm rests: there the next piece begins."""
    for speed in (1.0, 3.0):
        rig = Rig(rules)
        limits = dataclasses.replace(LIMITS, velocity=LIMITS.velocity / speed)
        rig.do(rig.supervisor.use_limits(limits, rig.wall))
        rig.visit(HOME + 0.3, waypoints={0: np.array([HOME + [0.1, 0.0], HOME + [0.1, 0.2]])})
        assert len(rig.said(Drive)) == 1, 'it was begun anew'
        assert not rig.said(Stop, Halted, Failed)
        assert len(rig.said(Renew)) >= 2


@BOTH
@pytest.mark.parametrize('released', [True, False])
def test_after_a_piece_that_came_too_late_goes_on_who_may(rules, released):
    """As after any interruption: alone only where the robot says that nobody has stopped it."""
    rig = slow(dataclasses.replace(rules, resume_alone_s=0.0))
    if released:
        rig.do(rig.supervisor.emergency(False, rig.wall))
    rig.plan(FAR)
    rig.run(1.0)
    rig.alive.discard('bridge')
    rig.run(3.0)
    rig.alive.add('bridge')
    rig.run(5.0)
    assert rig.supervisor.missed == 1
    assert bool(rig.supervisor.asks_for_collect) is not released
    assert len(rig.said(Drive)) == 1 + released
    assert not rig.said(Halted)


@BOTH
def test_a_host_that_is_too_slow_ends_in_a_halt_and_not_in_stops_without_end(rules):
    rig = slow(rules)
    rig.plan(FAR)
    for _ in range(40):
        rig.run(0.3)
        rig.alive.discard('bridge')
        rig.run(1.3)
        rig.alive.add('bridge')
        if rig.said(Halted):
            break
    assert rig.supervisor.missed == MISSED_IN_A_ROW
    assert f'too late {MISSED_IN_A_ROW} times in a row' in rig.supervisor.halted
    assert rig.speed() < STANDS_RAD_S
    # After a person has gone on it counts anew.
    assert not rig.supervisor.clear_halt()
    rig.do(rig.supervisor.planner_is('paused', rig.wall))
    rig.told_state = 'paused'
    rig.plan(FAR)
    rig.run(20.0, lambda: rig.supervisor.state is Arm.MEASURES)
    assert rig.supervisor.state is Arm.MEASURES


@pytest.mark.parametrize('late_s', [0.1, 0.2, 0.3])
@BOTH
def test_a_bridge_that_is_held_up_for_some_hundred_milliseconds_does_not_stop_the_arm(
    rules, late_s
):
    for begin_s in np.linspace(0.6, 2.2, 9):
        rig = slow(rules)
        rig.plan(FAR)
        rig.run(float(begin_s))
        rig.alive.discard('bridge')
        rig.run(late_s)
        rig.alive.add('bridge')
        rig.run(20.0, lambda rig=rig: rig.supervisor.state is Arm.MEASURES)
        assert rig.supervisor.state is Arm.MEASURES
        assert len(rig.said(Drive)) == 1, f'it was stopped, held up after {begin_s:.2f} s'


@BOTH
def test_a_driver_that_falls_silent_halts_the_arm_that_stops_by_its_piece(rules):
    """No piece follows, so that a person is asked for; the silence is told all the same."""
    rig = slow(dataclasses.replace(rules, resume_alone_s=0.0))
    rig.plan(FAR)
    rig.run(1.0)
    rig.alive.discard('robot')
    rig.freeze()
    assert 'no sign of robot' in rig.halts()
