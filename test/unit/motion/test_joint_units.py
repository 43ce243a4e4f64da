# SPDX-License-Identifier: Apache-2.0
"""Joints that slide: the gate in metres against SciPy's cubics, and what else is told in mm."""

import dataclasses

import numpy as np
import pytest
from gate_rig import judge
from scipy.interpolate import CubicHermiteSpline

from remaster_ros.kinematics.serial_chain import LEVER_M
from remaster_ros.motion import motion_gate
from remaster_ros.motion.actions import PathAnswer, SupervisorRules
from remaster_ros.motion.arm_supervisor import ArmSupervisor
from remaster_ros.motion.following import path_tolerance
from remaster_ros.motion.joint_reports import JointReport, JointReports
from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import (
    ForeignGate,
    MotionGate,
    MotionRefusedError,
    StartMovedError,
)
from remaster_ros.motion.move_queue import MoveQueue, probe_path
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleDetector, SettleRules
from remaster_ros.motion.trajectory import Waypoint

UNITS = JointUnits((True, False))
# A rail of 2 m under a joint that turns.
LIMITS = MotionLimits(
    ('rail', 'a'),
    np.array([0.0, -1.0]),
    np.array([2.0, 1.0]),
    np.array([0.5, 1.0]),
    np.array([1.25, 5.0]),
    units=UNITS,
)
AT = np.array([0.5, 0.0])


@pytest.mark.parametrize(
    ('along', 'waypoints', 'why'),
    [
        # A cubic from rest to rest over d in T has a speed of 1.5 d / T ...
        (
            [[2.0, 0.0]],
            [(2.5, [1.5, 0.0], [0.0, 0.0])],
            'rail would have a speed of 600.0 mm/s; 500.0 are allowed',
        ),
        # ... and an acceleration of 6 d / T².
        (
            [[2.0, 0.0]],
            [(0.4, [0.54, 0.0], [0.0, 0.0])],
            'rail would have a acceleration of 1500.0 mm/s2; 1250.0 are allowed',
        ),
        (
            [[0.5, 0.8]],
            [(4.0, [0.5 + 6e-7, 0.8], [0.0, 0.0])],
            'a waypoint lies 0.0006 mm off the path found free',
        ),
        # A corner that is cut by half a micrometre of the slide, which counts as two microradians.
        (
            [[0.6, 0.0], [0.6, 0.4]],
            [(4.0, [0.6 - 6e-7, 0.0], [0.0, 0.0]), (8.0, [0.6, 1e-4], [0.0, 0.0])],
            'the move leaves the path found free by 0.0006 mm between two waypoints',
        ),
    ],
)
def test_what_is_told_of_a_slide(monkeypatch, along, waypoints, why):
    assert judge(monkeypatch, waypoints, (AT, *along), AT, LIMITS) == why


def test_a_target_beyond_the_end_of_a_slide_and_its_margin():
    """Half a degree of margin is 2.2 mm: an angle at 0.25 m."""
    limits = dataclasses.replace(LIMITS, margin=float(np.deg2rad(0.5)))
    gate, kept = MotionGate(limits), 0.25e3 * np.deg2rad(0.5)
    with pytest.raises(MotionRefusedError) as refused:
        gate.admit(FreePath(np.array([AT, [1.999, 0.0]])), AT)
    assert str(refused.value) == (
        f'rail would go to 1999.00 mm; its limits less the margin are [{kept:.2f}, '
        f'{2e3 - kept:.2f}] mm'
    )
    gate.admit(FreePath(np.array([AT, [1.997, 0.0]])), AT)
    assert limits.outside(np.array([1.999, 0.0])) == (
        'rail at 1999.00 mm is outside its limits [0.00, 2000.00] mm less 2.18 mm'
    )
    assert limits.outside(np.array([1.0, 0.995])) == (
        'a at 57.01 deg is outside its limits [-57.30, 57.30] deg less 0.50 deg'
    )
    assert limits.outside(np.array([1.997, 0.9])) == ''
    assert limits.outside(np.array([0.003, -0.9])) == ''
    assert limits.outside(np.array([0.002, 0.0])).startswith('rail at 2.00 mm is outside')


def test_a_start_elsewhere():
    """2 mrad of a joint that turns, half a millimetre of one that slides."""
    gate, free = MotionGate(LIMITS), FreePath(np.array([AT, [1.0, 0.5]]))
    gate.admit(free, AT + [0.499e-3, 1.99e-3])
    with pytest.raises(StartMovedError, match=r'the arm stands 0\.60 mm from the start'):
        gate.admit(free, AT + [-0.6e-3, 0.0])
    # Of two joints the one is named that is further off for its kind.
    with pytest.raises(StartMovedError, match=r'the arm stands 0\.60 mm from the start'):
        gate.admit(free, AT + [0.6e-3, 2.1e-3])
    with pytest.raises(StartMovedError, match=r'the arm stands 0\.0030 rad from the start'):
        gate.admit(free, AT + [0.6e-3, 3e-3])
    with pytest.raises(StartMovedError, match='nan'):
        gate.admit(free, np.array([np.nan, 0.0]))


def test_a_planner_of_another_kind_begins_where_the_slide_is():
    gate = ForeignGate(LIMITS)
    points = [Waypoint(0.0, AT, np.zeros(2)), Waypoint(4.0, AT + [0.5, 0.5], np.zeros(2))]
    gate.admit(points, AT + [0.4e-3, 0.0], np.zeros(2))
    with pytest.raises(StartMovedError, match=r'it begins 0\.60 mm from where rail is'):
        gate.admit(points, AT + [0.6e-3, 0.0], np.zeros(2))
    gate.admit(points, AT, np.array([4e-3, 0.0]))
    with pytest.raises(StartMovedError, match='it begins at once while the arm moves'):
        gate.admit(points, AT, np.array([6e-3, 0.0]))


def test_the_probe_of_a_slide_is_harmless_from_anywhere_on_its_way():
    """A quarter of a micrometre, as late as the whole way takes within every limit."""
    path = probe_path(AT, LIMITS)
    np.testing.assert_allclose(np.abs(path.points[1] - AT), [0.25e-6, 1e-6])
    gate = MotionGate(LIMITS)
    (end,) = gate.admit_probe(path, AT, np.array([True, False])).waypoints
    for q in np.linspace(0.0, 2.0, 9):
        curve = CubicHermiteSpline([0.0, end.time_s], [[q, 0.0], end.q], [[0.0, 0.0], [0.0, 0.0]])
        t = np.linspace(0.0, end.time_s, 201)
        assert np.all(np.abs(curve(t, 1)) <= LIMITS.velocity * (1 + 1e-6))
        assert np.all(np.abs(curve(t, 2)) <= LIMITS.acceleration * (1 + 1e-6))
    # 1.5 m at 1.5 times the mean speed.
    assert end.time_s == pytest.approx(1.5 * 1.5 / 0.5)
    (soon,) = MotionGate(LIMITS).admit_probe(path, AT, np.zeros(2, bool)).waypoints
    assert soon.time_s == motion_gate.PROBE_S


def test_reports_of_a_slide():
    reports = JointReports(LIMITS.lower, LIMITS.upper, np.array([np.inf, 3.0]), UNITS)
    assert reports.believes(JointReport(0.0, np.array([2.012, 1.04]), 0.0, 0.0))
    assert not reports.believes(JointReport(1.0, np.array([2.013, 0.0]), 1.0, 1.0))
    assert reports.trouble == 'joint 1 is reported at 2013.0 mm, outside its limits'
    # 17.5 mm beyond what is tolerated are more than 50 mrad.
    assert not reports.believes(JointReport(1.0, np.array([2.03, 1.1]), 1.0, 1.0))
    assert reports.trouble == 'joint 1 is reported at 2030.0 mm, outside its limits'
    # 1 m/s where the model has no limit, and half as much again.
    assert reports.believes(JointReport(1.0, np.array([0.6, 1.04]), 1.0, 1.0))
    assert not reports.believes(JointReport(1.1, np.array([0.4, 1.04]), 1.1, 1.1))
    assert reports.trouble == 'joint 1 is reported 200.0 mm away after 0.100 s'
    # Of two that are too fast the one is named that is so by more for its kind.
    assert not reports.believes(JointReport(1.1, np.array([0.3, 0.3]), 1.1, 1.1))
    assert reports.trouble == 'joint 1 is reported 300.0 mm away after 0.100 s'
    assert reports.believes(JointReport(1.1, np.array([0.43, 1.04]), 1.1, 1.1))


def test_where_a_slide_has_settled():
    rules = SettleRules(settle_s=0.5, units=UNITS)
    for off, state in ((0.4e-3, 'settled'), (0.6e-3, 'elsewhere')):
        detector = SettleDetector(AT, rules)
        states = [detector.update(0.1 * i, AT + [off, 0.0]) for i in range(8)]
        assert states[-1] == state
    # It trembles by 40 micrometres, and by 60.
    for spread, state in ((4e-5, 'settled'), (6e-5, 'settling')):
        detector = SettleDetector(AT, rules)
        states = [detector.update(0.1 * i, AT + [spread * (i % 2), 0.0]) for i in range(8)]
        assert states[-1] == state
    assert detector.farthest == pytest.approx(6e-5 / LEVER_M)


def test_what_a_controller_by_action_keeps():
    rules = SupervisorRules(settle=SettleRules(units=UNITS), lag_s=0.35)
    found = path_tolerance(np.array([0.2, 0.8]), rules)
    np.testing.assert_allclose(found, [0.005 + 0.45 * 0.2, 0.02 + 0.45 * 0.8])


def test_a_way_out_is_told_in_the_units_of_its_joints():
    out = FreePath(np.array([AT, AT + [0.012, 0.1]]), way_out=True)
    text = MoveQueue().offer(PathAnswer(None, 'the floor', at_start=True, way_out=out), LIMITS)
    assert text.endswith('rail by 12.0 mm, a by 5.7 deg')


def test_rules_of_another_arm_are_refused():
    reports = JointReports(LIMITS.lower, LIMITS.upper, LIMITS.velocity, UNITS)
    of_slides = SupervisorRules(settle=SettleRules(units=UNITS))
    ArmSupervisor(MotionGate(LIMITS), reports, of_slides)
    turning = JointReports(LIMITS.lower, LIMITS.upper, LIMITS.velocity)
    for wrong in ((reports, SupervisorRules()), (turning, of_slides)):
        with pytest.raises(ValueError, match='not of the same joints'):
            ArmSupervisor(MotionGate(LIMITS), *wrong)
    gate = MotionGate(dataclasses.replace(LIMITS, units=TURNING))
    with pytest.raises(ValueError, match='not of the same joints'):
        ArmSupervisor(gate, reports, of_slides)
