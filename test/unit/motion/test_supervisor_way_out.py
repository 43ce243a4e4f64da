# SPDX-License-Identifier: Apache-2.0
"""The way out of a margin: offered, confirmed by a person, gone slowly."""

import numpy as np
from supervisor_rig import HOME, LIMITS, STOPPED, Rig, halted

from remaster_ros.motion.actions import CheckPath, Drive, Halted, PathAnswer
from remaster_ros.motion.move_queue import PROBE, WAY_OUT
from remaster_ros.motion.path_check import FreePath
from remaster_ros.simulation import arm_motion as servo

# Ways out


def in_contact(rig, way_out=True):
    """The arm stands in a margin around its place; a way out leads 0.3 rad away."""

    def answer(request):
        if np.max(np.abs(request.start - HOME)) < 0.1:
            corner = np.add(request.start, [0.1, -0.05])
            points = np.array([request.start, corner, np.add(corner, [0.3, -0.01])])
            path = FreePath(points, way_out=True) if way_out else None
            return PathAnswer(None, 'the tool is in the floor', at_start=True, way_out=path)
        return Rig._free(request)

    rig.answer_path = answer


def test_a_way_out_is_offered_confirmed_and_gone_slowly(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    reason = (
        'the arm stands where it must not: the tool is in the floor; /remaster/clear_halt and '
        '/remaster/collect let it leave slowly (at most 0.05 m/s): a by 17.2 deg, b by 2.9 deg'
    )
    halted(rig, reason)
    rig.plan([0.9, 0.2])
    rig.collect()
    drives = rig.said(Drive)
    rig.run(2.0)
    drives = rig.said(Drive)
    assert [d.solution for d in drives] == [PROBE, WAY_OUT]
    fastest = max(np.max(np.abs(p.velocity)) for p in drives[1].admitted.waypoints)
    assert fastest <= 0.1 * LIMITS.velocity[0]
    rig.settles()
    assert [d.solution for d in rig.said(Drive)] == [PROBE, WAY_OUT, 0]
    assert len(rig.said(Halted)) == 1


def test_where_no_way_out_is_found_it_is_said(rig):
    in_contact(rig, way_out=False)
    rig.plan([0.9, 0.2])
    reason = (
        'the arm stands where it must not: the tool is in the floor; no way out is known: move '
        'it by hand, then /remaster/clear_halt'
    )
    halted(rig, reason)
    rig.collect()
    rig.run(1.0)
    assert not rig.said(Drive)
    assert len(rig.said(Halted)) == 2


def test_a_way_out_is_not_gone_twice_or_by_an_arm_that_was_moved(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    assert rig.said(Halted)
    # Somebody moves it by hand, within the margin still.
    rig.arm = servo.Motion(rig.t, rig.arm.at(rig.t)[0] + [0.0, 0.05])
    rig.run(0.3)
    rig.collect()
    rig.run(7.0)
    # The person has confirmed where it is; the probe is made from there, and nothing else.
    assert [d.solution for d in rig.said(Drive)] == [PROBE]
    assert len(rig.said(Halted)) == 2, 'it is asked again, and the person too'
    assert len(rig.said(CheckPath)) >= 2


def test_a_way_out_that_is_not_the_last_word_of_a_halt_is_not_gone(rig):
    """What a person clears is what the halt tells, not what one before it offered."""
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    reason = rig.supervisor.halted
    rig.alive.discard('robot')
    rig.run(5.0)
    rig.alive.add('robot')
    rig.run(1.0)
    assert rig.supervisor.halted == reason
    assert len(rig.said(Halted)) == 1
    assert rig.supervisor.clear_halt() == ''
    rig.do(rig.supervisor.emergency(True, rig.wall))
    rig.do(rig.supervisor.emergency(False, rig.wall))
    rig.collect()
    rig.run(2.0)
    assert not rig.said(Drive)
    assert rig.supervisor.halted == reason


def test_an_emergency_stop_on_a_way_out_halts(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    rig.collect()
    rig.run(3.0)
    assert rig.last(Drive).solution == WAY_OUT
    rig.freeze()
    rig.run(3.0)
    assert rig.last(Halted).reason == STOPPED
    assert [d.solution for d in rig.said(Drive)] == [PROBE, WAY_OUT]


def test_a_way_out_that_the_gate_refuses_halts(rig):
    def answer(request):
        points = np.array([request.start, np.add(request.start, [3.0, 0.0])])
        return PathAnswer(None, 'the floor', at_start=True, way_out=FreePath(points, way_out=True))

    rig.answer_path = answer
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    rig.collect()
    rig.run(2.0)
    assert rig.last(Halted).reason.startswith('a would go to 1')
    assert [d.solution for d in rig.said(Drive)] == [PROBE]
