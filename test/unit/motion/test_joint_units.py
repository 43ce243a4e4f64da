"""Joints that slide: the gate in metres against SciPy's cubics, and what else is told in mm."""

import dataclasses

import numpy as np
import pytest
from gate_rig import judge
from hypothesis import given, settings
from hypothesis import strategies as st
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
from remaster_ros.motion.trajectory import Trajectory, Waypoint

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


@pytest.fixture
def judged(monkeypatch):
    """Return what the gate makes of given waypoints, planned by whomever."""

    def of(*waypoints, along=((0.5, 0.0), (2.0, 0.0)), start=AT, limits=LIMITS, speeds=None):
        return judge(monkeypatch, waypoints, along, start, limits, speeds)

    return of


def test_a_slide_that_is_too_fast(judged):
    """A cubic from rest to rest over d in T has 1.5 d / T."""
    assert judged((3.1, [1.5, 0.0], [0.0, 0.0])) == ''
    assert judged((2.5, [1.5, 0.0], [0.0, 0.0])) == (
        'rail would have a speed of 600.0 mm/s; 500.0 are allowed'
    )
    # As many m/s as a joint that turns has rad/s are too many.
    turning = judged((2.5, [0.5, 1.0], [0.0, 0.0]), along=((0.5, 0.0), (0.5, 1.0)))
    assert turning == ''


def test_a_slide_that_accelerates_too_hard(judged):
    """6 d / T²."""
    assert judged((0.4, [0.54, 0.0], [0.0, 0.0])) == (
        'rail would have a acceleration of 1500.0 mm/s2; 1250.0 are allowed'
    )
    assert judged((0.44, [0.54, 0.0], [0.0, 0.0])) == ''


def test_a_slide_beyond_its_end_between_two_waypoints(judged):
    waypoints = ((6.0, [1.99, 0.0], [0.3, 0.0]), (7.0, [1.995, 0.0], [-0.3, 0.0]),
                 (15.0, [1.0, 0.0], [0.0, 0.0]))  # fmt: skip
    curve = CubicHermiteSpline([6.0, 7.0], [1.99, 1.995], [0.3, -0.3])
    top = np.max(curve(np.linspace(6.0, 7.0, 10001)))
    assert top > 2.0
    assert judged(*waypoints) == (
        f'rail would go to {1e3 * top:.2f} mm; its limits less the margin are [0.00, 2000.00] mm'
    )


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


def test_a_waypoint_beside_the_path(judged):
    along = ((0.5, 0.0), (0.5, 0.8))
    beside = judged((4.0, [0.5 + 6e-7, 0.8], [0.0, 0.0]), along=along)
    assert beside == 'a waypoint lies 0.0006 mm off the path found free'
    assert judged((4.0, [0.5 + 2e-7, 0.8], [0.0, 0.0]), along=along) == ''
    # A corner that is cut.
    corner = ((0.5, 0.0), (0.6, 0.0), (0.6, 0.4))
    cut = judged((4.0, [0.6, 0.4], [0.0, 0.0]), along=corner)
    assert cut.startswith('the move leaves the path found free by ')
    # By half a micrometre of the slide, which counts as two microradians.
    late = ((4.0, [0.6 - 6e-7, 0.0], [0.0, 0.0]), (8.0, [0.6, 1e-4], [0.0, 0.0]))
    assert judged(*late, along=corner) == (
        'the move leaves the path found free by 0.0006 mm between two waypoints'
    )


class Fastest:
    """Speeds of a point that the rail moves, and what it was asked for."""

    def __init__(self):
        self.asked = []

    def fastest(self, q, velocity):
        self.asked.append((q, velocity))
        return np.abs(velocity[:, 0])


def test_the_speed_of_the_fastest_point_of_what_slides(judged):
    limits, speeds = dataclasses.replace(LIMITS, tool_speed=0.25), Fastest()
    assert judged((4.0, [1.5, 0.0], [0.0, 0.0]), limits=limits, speeds=speeds) == (
        'the fastest point of arm and tool would move at 0.375 m/s; 0.25 m/s are allowed'
    )
    assert judged((6.01, [1.5, 0.0], [0.0, 0.0]), limits=limits, speeds=speeds) == ''
    # A metre of a slide is looked at as often as four radians.
    assert len(speeds.asked[-1][0]) in (5 + 79, 5 + 80)


def test_a_planner_of_another_kind_begins_where_the_slide_is():
    gate = ForeignGate(LIMITS)
    points = [Waypoint(0.0, AT, np.zeros(2)), Waypoint(4.0, AT + [0.5, 0.5], np.zeros(2))]
    gate.admit(points, AT + [0.4e-3, 0.0], np.zeros(2))
    with pytest.raises(StartMovedError, match=r'it begins 0\.60 mm from where rail is'):
        gate.admit(points, AT + [0.6e-3, 0.0], np.zeros(2))
    gate.admit(points, AT, np.array([4e-3, 0.0]))
    with pytest.raises(StartMovedError, match='it begins at once while the arm moves'):
        gate.admit(points, AT, np.array([6e-3, 0.0]))


place = st.tuples(st.floats(0.05, 1.95), st.floats(-0.95, 0.95)).map(np.array)


@settings(max_examples=150)
@given(start=place, end=place, moment=st.floats(0.0, 1.0), lag_s=st.floats(0.0, 0.45))
def test_a_stop_stays_on_the_line_and_within_the_accelerations(start, end, moment, lag_s):
    """From wherever the arm is on its line: SciPy's cubic in m and rad, sampled."""
    gate = MotionGate(LIMITS)
    admitted = gate.admit(FreePath(np.array([start, end])), start)
    trajectory = admitted.trajectory
    now_s = moment * trajectory.duration_s
    low_s = max(now_s - lag_s, 0.0)
    (stop,) = gate.stop(low_s, now_s).waypoints
    way = end - start
    for time_s in np.linspace(low_s, now_s, 5):
        q, velocity = trajectory.at(min(time_s, trajectory.duration_s))
        curve = CubicHermiteSpline([0.0, stop.time_s], [q, stop.q], [velocity, np.zeros(2)])
        t = np.linspace(0.0, stop.time_s, 101)
        # On the line, and not beyond its end.
        length = way @ way
        shares = (curve(t) - start) @ way / length if length else np.zeros(len(t))
        assert np.abs(curve(t) - start - np.outer(shares, way)).max() < 1e-9
        assert shares.max() <= 1.0 + 1e-9
        assert np.all(np.abs(curve(t, 1)) <= LIMITS.velocity * (1 + 1e-9))
        early = now_s + 0.5 < trajectory.duration_s - 0.5
        if early:
            assert np.all(np.abs(curve(t, 2)) <= LIMITS.acceleration * (1 + 1e-9))


def test_the_way_of_a_stop_of_a_slide():
    """At 0.35 m/s on a long line: half of speed times 0.4 s, 70 mm at less than the limit."""
    gate = MotionGate(LIMITS)
    admitted = gate.admit(FreePath(np.array([[0.1, 0.0], [1.9, 0.0]])), np.array([0.1, 0.0]))
    middle = admitted.trajectory.duration_s / 2
    q, velocity = admitted.trajectory.at(middle)
    # 0.42 of 1.25 m/s² for half a second, less the headroom.
    assert velocity[0] == pytest.approx(0.97 * 0.42 * 1.25 * 0.5)
    (stop,) = gate.stop(middle, middle).waypoints
    assert stop.q[0] - q[0] == pytest.approx(0.5 * 0.4 * velocity[0])


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
    told = MoveQueue().offer(PathAnswer(None, 'the floor', at_start=True, way_out=out), LIMITS)
    assert told.endswith('rail by 12.0 mm, a by 5.7 deg')


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


def test_a_trajectory_has_the_speeds_of_each_kind():
    """A rail and a joint that turns arrive together; none passes its own limit."""
    admitted = MotionGate(LIMITS).admit(FreePath(np.array([AT, [1.5, 0.9]])), AT)
    assert isinstance(admitted.trajectory, Trajectory)
    largest = np.max([np.abs(p.velocity) for p in admitted.waypoints], axis=0)
    allowed = np.minimum(LIMITS.velocity, 0.42 * 0.5 * LIMITS.acceleration)
    assert np.max(largest / allowed) == pytest.approx(0.97)
