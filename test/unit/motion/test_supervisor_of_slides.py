"""An arm with joints that slide is judged as one whose joints turn, a quarter of a metre a radian.

`LEVER_M` is a power of two, so that all numbers of the two arms are the same but for that factor,
to the last bit: whatever is decided, and when, has to be the same too. A tolerance that is kept in
the wrong unit anywhere between reports and commands decides otherwise.
"""

import dataclasses
import re
from functools import cache

import numpy as np
import pytest
from supervisor_rig import Rig

from remaster_ros.motion.actions import CheckPath, Drive, Halted, PathAnswer, Settled, Stop
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.path_check import FreePath


def settles(rig):
    rig.plan([0.5, 0.5], [-0.9, 1.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(0)
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)


def is_stopped_and_goes_on(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(3.0)
    rig.state = 'running'
    rig.plan([0.9, -1.9])
    rig.run(20.0, lambda: rig.said(Settled))


def is_stopped_by_an_emergency(rig):
    rig.go([0.9, -1.9])
    rig.freeze()
    rig.run(3.0)


def is_stopped_by_an_emergency_just_before_a_pause(rig):
    rig.go([0.9, -1.9], 1.2)
    rig.freeze()
    rig.run(0.1)
    rig.state = 'paused'
    rig.run(3.0)


def does_not_move(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.5, 0.5])
    rig.run(10.0)


def leaves_its_path(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, q=np.add(p.q, [0.1 * (i == 0), 0.2 * (i == 0)]))
        for i, p in enumerate(waypoints)
    ]
    rig.plan([0.9, -0.5])
    rig.run(10.0)


def is_slow(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, time_s=2 * p.time_s, velocity=p.velocity / 2) for p in waypoints
    ]
    rig.plan([0.9, -1.0])
    rig.run(10.0)


def stands_beside(rig, off=(0.0025, 0.0022)):
    begun = rig.t
    rig.alter = lambda t, q: q + np.array(off) * np.clip((t - begun) / 2, 0, 1)
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0)


def stands_just_near_enough(rig):
    stands_beside(rig, (0.0019, -0.0019))


def is_moved_while_measured(rig):
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    begun = rig.t
    rig.alter = lambda t, q: np.add(q, [min(0.05 * (t - begun), 0.1), -0.06 * (t - begun)])
    rig.run(3.0)


def jumps(rig):
    begun = rig.t
    rig.alter = lambda t, q: np.add(q, [0.0, 0.3 * (t > begun + 1.0)])
    rig.run(5.0)


def is_reported_outside(rig):
    rig.alter = lambda t, q: np.array([1.06, 2.0])
    rig.run(3.0)


def trembles(rig):
    rig.alter = lambda t, q: np.add(q, [1.5e-4 * np.sin(20 * t), 1.5e-4 * np.cos(20 * t)])
    rig.plan([0.5, 0.5])
    rig.run(20.0)


def never_stands_after_a_stop(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(0.5)
    rig.alter = lambda t, q: np.add(q, [0.01 * np.sin(8 * t), 0.01 * np.sin(8 * t)])
    rig.run(5.0)


def ignores_a_stop(rig):
    rig.go([0.9, -1.9])
    rig.obey = lambda waypoints: ()
    rig.state = 'paused'
    rig.run(5.0)


def is_elsewhere_when_its_halt_is_cleared(rig):
    rig.go([0.9, -1.9])
    rig.freeze()
    rig.run(3.0, lambda: rig.said(Halted))
    rig.run(1.0)
    rig.told = re.sub(r' -?\d.*? (deg|mm)', '', rig.supervisor.clear_halt())
    rig.collect()
    rig.plan([0.5, 0.5])
    rig.run(60.0, lambda: rig.said(Settled))


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
    rig.plan([0.5, 0.5])
    rig.run(30.0, lambda: rig.said(Settled))


def goes_through_corners(rig):
    corners = {0: np.array([[-0.5, 1.0], [0.3, -1.0]])}
    rig.plan([0.9, 1.5], waypoints=corners)
    rig.run(0.7)
    rig.state = 'paused'
    rig.run(3.0)
    rig.state = 'running'
    rig.plan([0.9, 1.5], waypoints=corners)
    rig.run(40.0, lambda: rig.said(Settled))


def is_asked_for_what_is_outside(rig):
    rig.plan([0.5, 2.1], [1.3, 0.5], [0.2, 0.2])
    rig.run(20.0, lambda: rig.said(Settled))


def is_elsewhere_by_a_little(rig):
    rig.alter = lambda t, q: np.add(q, [0.0, 0.003])
    rig.run(1.0)
    rig.plan([0.5, 0.5])
    rig.run(3.0)


def is_stopped_on_a_short_way(rig):
    rig.plan([0.16, 0.26])
    rig.run(0.5)
    rig.freeze()
    rig.run(0.1)
    rig.state = 'paused'
    rig.run(1.0)


def does_not_move_a_short_way(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.13, 0.23])
    rig.run(5.0)


def moves_a_little_and_stops(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(waypoints[0], q=rig.arm.at(rig.t)[0] + 0.005, velocity=np.zeros(2))
    ]
    rig.plan([0.5, 0.6])
    rig.run(5.0)


def is_slow_on_a_short_way(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, time_s=3 * p.time_s, velocity=p.velocity / 3) for p in waypoints
    ]
    rig.plan([0.2, 0.3])
    rig.run(10.0)


def stands_beside_the_end_of_its_stop(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(0.3)
    begun = rig.t
    rig.alter = lambda t, q: q + np.array([0.003, -0.003]) * np.clip(t - begun, 0, 1)
    rig.run(5.0)


CASES = [
    stands_beside_the_end_of_its_stop,
    is_elsewhere_by_a_little,
    is_stopped_on_a_short_way,
    does_not_move_a_short_way,
    moves_a_little_and_stops,
    is_slow_on_a_short_way,
    settles,
    is_stopped_and_goes_on,
    is_stopped_by_an_emergency,
    is_stopped_by_an_emergency_just_before_a_pause,
    does_not_move,
    leaves_its_path,
    is_slow,
    stands_beside,
    stands_just_near_enough,
    is_moved_while_measured,
    jumps,
    is_reported_outside,
    trembles,
    never_stands_after_a_stop,
    ignores_a_stop,
    is_elsewhere_when_its_halt_is_cleared,
    leaves_a_contact,
    goes_through_corners,
    is_asked_for_what_is_outside,
]


def course(rig, case):
    """Return what was decided in a case, and when, in radians and without figures in words."""
    case(rig)
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
def of_turning_joints(case):
    return course(Rig(), case)


def words(text):
    """Return a text without its lengths and angles, and without what they are called."""
    text = re.sub(r'\[[-\d.]+, [-\d.]+\] (deg|mm)', 'so much', text)
    return re.sub(r'[-+]?[\d.]+ (deg|mm|rad)', 'so much', text).replace('positions', 'angles')


@pytest.mark.parametrize('case', CASES, ids=lambda case: case.__name__)
@pytest.mark.parametrize('slides', [(False, True), (True, True)], ids=str)
def test_an_arm_with_a_slide_is_judged_as_one_whose_joints_turn(case, slides):
    turning = of_turning_joints(case)
    assert turning[0]
    assert course(Rig(units=JointUnits(slides)), case) == turning


def test_the_cases_end_in_every_way():
    """What is compared above are moves, stops and halts of many kinds."""
    ends = [of_turning_joints(case) for case in CASES]
    kinds = {action[1] for actions, *_ in ends for action in actions}
    assert {'Drive', 'Stop', 'Settled', 'Halted', 'Failed', 'CheckPath'} <= kinds
    assert len({halted for _, halted, _ in ends}) > 9
