# SPDX-License-Identifier: Apache-2.0
"""Arms that do what they are told and arms that do not: what is decided, and in which words.

An arm with joints that slide is judged as one whose joints turn, a quarter of a metre a radian:
`LEVER_M` is a power of two, so that all numbers of the two arms are the same but for that factor,
to the last bit, and whatever is decided, and when, has to be the same too. A tolerance that is
kept in the wrong unit anywhere between reports and commands decides otherwise.
"""

import copy
import dataclasses
import re
from fnmatch import fnmatchcase
from functools import cache

import numpy as np
import pytest
from supervisor_rig import ASKED, NOT_TAKEN, STOPPED, Rig, begun, stays_halted

from remaster_ros.motion.actions import CheckPath, Drive, PathAnswer, Settled, Stop
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.trajectory import Waypoint

SCENES = {}
TARGET = ' from its target: an emergency stop, or an arm less precise than arrive_tolerance?'
STOP = ' from where its stop led: an emergency stop?'
BEHIND = (
    'the robot does not follow its path: 0.6* s behind it; is its speed override below 100 %, '
    'or do joint_states come late?'
)
PAUSED, NOTHING = 'planner is paused; ', ': nothing is commanded'


def scene(kinds, halted=''):
    """Note what is decided in a scene, the checks of paths apart, and why it ends in a halt.

    ``halted``: as of `fnmatch`, where * stands for any text.
    """

    def note(play):
        SCENES[play] = kinds, halted
        return play

    return note


@scene('Drive Settled Drive Settled')
def settles(rig):
    rig.visit([0.5, 0.5], [-0.9, 1.0])
    rig.answer(0)
    rig.settles(2)


@scene('Drive Settled Drive Settled')
def lags(rig):
    """Each command comes a quarter of a second later to the robot than it was sent."""
    rig.obey = lambda waypoints: [
        Waypoint(0.25, rig.arm.at(rig.t)[0], np.zeros(2)),
        *(dataclasses.replace(p, time_s=0.25 + p.time_s) for p in waypoints),
    ]
    settles(rig)


@scene('Drive Stop Drive Drive Settled')
def is_stopped_and_goes_on(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(3.0)
    rig.state = 'running'
    rig.visit([0.9, -1.9])


@scene('Drive Halted', STOPPED)
def is_stopped_by_an_emergency(rig):
    rig.go([0.9, -1.9])
    rig.freeze()
    rig.run(3.0)


@scene('Drive Halted', 'the robot stands 0.06* rad' + TARGET)
def is_stopped_by_an_emergency_just_before_its_end(rig):
    """It is behind by less than an arm may lag."""
    target = np.array([0.9, -1.9])
    rig.plan(target)
    rig.run(5.0, lambda: np.max(np.abs(rig.arm.at(rig.t)[0] - target)) < 0.07)
    rig.freeze()
    rig.run(5.0)


@scene('Drive Stop Halted', 'the arm stands 0.2* rad' + STOP)
def is_stopped_by_an_emergency_in_its_stop(rig):
    rig.go([0.9, -1.9], 1.2)
    rig.pause()
    rig.step()
    rig.freeze()
    rig.run(2.0)


@scene('Drive Halted', PAUSED + STOPPED + NOTHING)
def is_stopped_by_an_emergency_just_before_a_pause(rig):
    rig.go([0.9, -1.9], 1.2)
    rig.freeze()
    rig.run(0.1)
    rig.state = 'paused'
    rig.run(3.0)


@scene('Drive Halted', NOT_TAKEN)
def does_not_move(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.5, 0.5])
    rig.run(10.0)


@scene('Drive Halted', STOPPED)
def stands_still_in_its_reports(rig):
    """Its driver sends the same position for ever, with new stamps."""
    rig.go([0.9, -1.9], 1.0)
    here = rig.arm.at(rig.t)[0]
    rig.alter = lambda t, q: here
    rig.run(3.0)


@scene('Drive Halted', 'the robot does not follow its path: * deg beside it')
def leaves_its_path(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, q=np.add(p.q, [0.1 * (i == 0), 0.2 * (i == 0)]))
        for i, p in enumerate(waypoints)
    ]
    rig.plan([0.9, -0.5])
    rig.run(10.0)


@scene('Drive Halted', BEHIND)
def is_slow(rig, times=2, target=(0.9, -1.0)):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, time_s=times * p.time_s, velocity=p.velocity / times)
        for p in waypoints
    ]
    rig.plan(target)
    rig.run(10.0)


@scene('Drive Halted', BEHIND)
def is_slow_on_a_short_way(rig):
    is_slow(rig, 3, (0.2, 0.3))


@scene('Drive Halted', 'the robot stands 0.0025 rad' + TARGET)
def stands_beside(rig, off=(0.0025, 0.0022)):
    begun = rig.t
    rig.alter = lambda t, q: q + np.array(off) * np.clip((t - begun) / 2, 0, 1)
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0)


@scene('Drive Halted', 'the robot stands 0.0180 rad' + TARGET)
def stands_far_beside(rig):
    stands_beside(rig, (0.0, -0.018))


@scene('Drive Settled')
def stands_just_near_enough(rig):
    stands_beside(rig, (0.0019, -0.0019))


@scene('Drive Settled Halted', 'the arm was moved by 1.[12] deg, and not by a command')
def is_moved_while_measured(rig):
    rig.visit([0.3, 0.0])
    begun = rig.t
    rig.alter = lambda t, q: np.add(q, [min(0.05 * (t - begun), 0.1), -0.06 * (t - begun)])
    rig.run(3.0)


@scene('Drive Settled')
def is_touched_while_measured(rig):
    rig.visit([0.3, 0.0])
    rig.alter = lambda t, q: np.add(q, [0.015, 0.0])
    rig.run(5.0)


@scene('Halted', ASKED + 'b at 28.65 deg, +17.19 deg from there; compare *')
def jumps(rig):
    begun = rig.t
    rig.alter = lambda t, q: np.add(q, [0.0, 0.3 * (t > begun + 1.0)])
    rig.run(5.0)


@scene('Halted', 'joint 1 is reported at 60.7 deg, outside its limits')
def is_reported_outside(rig):
    rig.alter = lambda t, q: np.array([1.06, 2.0])
    rig.run(3.0)


@scene('Drive Failed')
def trembles(rig):
    rig.alter = lambda t, q: np.add(q, [1.5e-4 * np.sin(20 * t), 1.5e-4 * np.cos(20 * t)])
    rig.plan([0.5, 0.5])
    rig.run(20.0)


@scene('Drive Stop Halted', 'the arm goes on after a stop')
def never_stands_after_a_stop(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(0.5)
    rig.alter = lambda t, q: np.add(q, [0.01 * np.sin(8 * t), 0.01 * np.sin(8 * t)])
    rig.run(5.0)


@scene('Drive Stop Halted', 'the arm goes on after a stop')
def ignores_a_stop(rig):
    rig.go([0.9, -1.9])
    rig.obey = lambda waypoints: ()
    rig.state = 'paused'
    rig.run(5.0)


@scene('Drive Halted Drive Drive Drive Settled')
def is_elsewhere_when_its_halt_is_cleared(rig):
    rig.go([0.9, -1.9])
    rig.freeze()
    rig.halts(3.0)
    rig.run(1.0)
    rig.told = re.sub(r' -?\d.*? (deg|mm)', '', rig.supervisor.clear_halt())
    rig.collect()
    rig.visit([0.5, 0.5])


@scene('Halted Drive Drive Drive Drive Settled')
def leaves_a_contact(rig):
    out = FreePath(np.array([[0.1, 0.2], [0.13, 0.16]]), way_out=True)
    rig.answer_path = lambda request: PathAnswer(None, 'the floor', at_start=True, way_out=out)
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.plan([0.5, 0.5])
    rig.run(5.0)
    rig.answer_path = rig._free
    rig.collect()
    rig.visit([0.5, 0.5])


@scene('Drive Stop Drive Drive Settled')
def goes_through_corners(rig):
    corners = {0: np.array([[-0.5, 1.0], [0.3, -1.0]])}
    rig.plan([0.9, 1.5], waypoints=corners)
    rig.run(0.7)
    rig.state = 'paused'
    rig.run(3.0)
    rig.state = 'running'
    rig.visit([0.9, 1.5], waypoints=corners)


@scene('Failed Failed Drive Settled')
def is_asked_for_what_is_outside(rig):
    rig.visit([0.5, 2.1], [1.3, 0.5], [0.2, 0.2])


@scene('Halted', ASKED + 'b at 11.63 deg, +0.17 deg from there; compare *')
def is_elsewhere_by_a_little(rig):
    rig.alter = lambda t, q: np.add(q, [0.0, 0.003])
    rig.run(1.0)
    rig.plan([0.5, 0.5])
    rig.run(3.0)


@scene('Drive Halted', PAUSED + STOPPED + NOTHING)
def is_stopped_on_a_short_way(rig):
    rig.plan([0.16, 0.26])
    rig.run(0.5)
    rig.freeze()
    rig.run(0.1)
    rig.state = 'paused'
    rig.run(1.0)


@scene('Drive Halted', NOT_TAKEN)
def does_not_move_a_short_way(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.13, 0.23])
    rig.run(5.0)


@scene('Drive Halted', STOPPED)
def moves_a_little_and_stops(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(waypoints[0], q=rig.arm.at(rig.t)[0] + 0.005, velocity=np.zeros(2))
    ]
    rig.plan([0.5, 0.6])
    rig.run(5.0)


@scene('Drive Stop Halted', 'the arm stands 0.0030 rad' + STOP)
def stands_beside_the_end_of_its_stop(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(0.3)
    begun = rig.t
    rig.alter = lambda t, q: q + np.array([0.003, -0.003]) * np.clip(t - begun, 0, 1)
    rig.run(5.0)


@scene('Drive Drive Drive Settled')
def is_paused_while_it_settles(rig):
    """Its move is over: there is nothing to be stopped, and it is commanded again afterwards."""
    rig.plan([0.3, 0.0])
    rig.run(10.0, lambda: rig.commands and rig.t > rig.commands[0][0] + 2.0)
    rig.run(5.0, lambda: rig.speed() < 1e-5)
    rig.pause()
    rig.run(1.5)
    assert len(rig.commands) == 1
    rig.state = 'running'
    rig.settles()


@scene('Drive Settled Drive Drive Settled')
def is_paused_while_it_is_measured(rig):
    """The reading goes on; no command follows it before the collection does."""
    rig.visit([0.3, 0.0], [0.4, 0.0])
    rig.pause()
    rig.run(2.0)
    rig.answer(0)
    rig.run(2.0)
    assert len(rig.commands) == 1
    rig.state = 'running'
    rig.run(5.0)


@scene('Drive Stop Halted Halted', 'two publishers')
def is_stopped_by_an_emergency_while_it_is_being_halted(rig):
    """It does not come to where its stop leads either: that does not hide why it was halted."""
    rig.go([0.9, -1.9], 1.2)
    rig.do(rig.supervisor.observe('rivals', 'two publishers', rig.wall))
    rig.run(0.1)
    rig.freeze()
    rig.run(4.0)


@scene('Drive Stop Halted', 'another')
def refuses_the_stop_of_a_halt(rig):
    """It is not judged by that stop: the halt keeps the first reason."""
    rig.obey = lambda waypoints: waypoints if len(waypoints) > 1 else ()
    rig.go([0.9, -1.9], 1.2)
    rig.do(rig.supervisor.observe('rivals', 'another', rig.wall))
    rig.do(rig.supervisor.given_up('the controller refuses a command'))
    rig.freeze()
    rig.run(5.0)


@scene('Drive Halted', 'the controller has given up')
def is_given_up_by_its_controller(rig):
    """It may be anywhere: nothing is commanded."""
    rig.go([0.9, -1.9])
    rig.do(rig.supervisor.given_up('the controller has given up'))
    rig.run(5.0)


@scene('Halted', 'the robot reports an emergency stop')
def is_not_seen_while_it_is_halted(rig):
    rig.do(rig.supervisor.emergency(True, rig.wall))
    rig.do(rig.supervisor.emergency(False, rig.wall))
    rig.alive.discard('robot')
    rig.run(10.0)
    rig.alive.add('robot')
    rig.run(2.0)


@scene('Drive Halted', STOPPED)
def is_stopped_by_an_emergency_in_a_pause_of_this_process(rig):
    rig.go([0.9, -1.9], 0.5)
    rig.alive.discard('bridge')
    rig.run(0.5)
    rig.freeze()
    rig.run(1.5)
    rig.alive.add('bridge')
    rig.run(10.0)


@scene('Drive Stop Halted', ASKED + 'a at * deg, +5.73 deg from there; compare *')
def is_elsewhere_after_a_stop(rig):
    """The next move begins only where the stop led."""
    rig.go([0.3, 0.2])
    rig.pause()
    rig.run(3.0)
    rig.alter = lambda t, q: np.add(q, [0.1, 0.0])
    rig.supervisor.reports.forget()
    rig.run(1.5)
    rig.state = 'running'
    rig.run(2.0)


def course(rig, play):
    """Return what was decided in a scene, and when, in radians and without figures in words."""
    play(rig)
    found = []
    for t, action in rig.actions:
        values = [t, type(action).__name__]
        if isinstance(action, Drive | Stop):
            for point in action.admitted.waypoints:
                values += [point.time_s, *(point.q / rig.unit), *(point.velocity / rig.unit)]
        if isinstance(action, Settled):
            values += [*(action.q / rig.unit), action.motion_s, action.settle_s]
        if isinstance(action, CheckPath):
            values += [*(action.start / rig.unit), *(action.target / rig.unit)]
        values.append(words(getattr(action, 'reason', '')))
        found.append(values)
    return found, words(rig.supervisor.halted), words(getattr(rig, 'told', ''))


@cache
def of_turning_joints(play):
    rig = begun()
    return course(rig, play), rig


def words(text):
    """Return a text without its lengths and angles, and without what they are called."""
    text = re.sub(r'\[[-\d.]+, [-\d.]+\] (deg|mm)', 'so much', text)
    return re.sub(r'[-+]?[\d.]+ (deg|mm|rad)', 'so much', text).replace('positions', 'angles')


@pytest.mark.parametrize('play', SCENES, ids=lambda play: play.__name__)
def test_what_becomes_of_an_arm(play):
    (actions, *_), rig = of_turning_joints(play)
    kinds, halted = SCENES[play]
    assert ' '.join(kind for _, kind, *_ in actions if kind != 'CheckPath') == kinds
    assert fnmatchcase(rig.supervisor.halted, halted)
    if halted:
        stays_halted(copy.deepcopy(rig), rig.supervisor.halted, kinds.count('Halted'))


@pytest.mark.parametrize('play', SCENES, ids=lambda play: play.__name__)
def test_an_arm_with_a_slide_is_judged_as_one_whose_joints_turn(play):
    assert course(Rig(units=JointUnits((False, True))), play) == of_turning_joints(play)[0]
