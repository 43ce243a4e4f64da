# SPDX-License-Identifier: Apache-2.0
"""Speeds of points against numerical differences and pinocchio; free paths and their distance."""

from pathlib import Path

import numpy as np
import pytest

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.motion.path_check import PEAK_STEP_RAD, FreePath, PointSpeeds

pin = pytest.importorskip('pinocchio', reason='a judge: pip install .[test]')

URDF = Path(__file__).parents[3] / 'config' / 'robots' / 'iiwa7.urdf'


@pytest.fixture(scope='module', params=['iiwa7', 'slides'])
def arm(request):
    """Return an arm whose joints all turn, and one of which the first and the fourth slide."""
    text = URDF.read_text(encoding='utf-8')
    if request.param == 'slides':
        for name in ('joint_1', 'joint_4'):
            turns = f'<joint name="{name}" type="revolute">'
            assert text.count(turns) == 1
            text = text.replace(turns, turns.replace('revolute', 'prismatic'))
    chain = SerialChain.from_urdf(text)
    assert chain.slides.sum() == (2 if request.param == 'slides' else 0)
    rng = np.random.default_rng(4)
    # The third body has no points at all.
    extents = [rng.uniform(-0.2, 0.2, (n, 3)) for n in (3, 1, 0, 4, 2, 5, 8)]
    return chain, extents, PointSpeeds(chain, extents), pin.buildModelFromXML(text)


def places(chain, extents, q):
    """Return where the points are, each body's in base_link."""
    frames = chain.frames(q)
    return [p @ frames[j, :3, :3].T + frames[j, :3, 3] for j, p in enumerate(extents) if len(p)]


def test_speeds_against_numerical_differences(arm):
    chain, extents, speeds, _ = arm
    rng = np.random.default_rng(5)
    q = rng.uniform(chain.lower, chain.upper, (40, 7))
    velocity = rng.normal(0.0, 1.0, (40, 7))
    fastest = speeds.fastest(q, velocity)
    dt = 1e-6
    for mine, here, v in zip(fastest, q, velocity):
        before = places(chain, extents, here - dt * v)
        after = places(chain, extents, here + dt * v)
        moved = [np.linalg.norm(b - a, axis=1) / (2 * dt) for a, b in zip(before, after)]
        assert mine == pytest.approx(np.max(np.concatenate(moved)), rel=1e-6)


def test_speeds_against_pinocchio(arm):
    """Its frame velocities; each joint's placement is the frame after the joint."""
    chain, extents, speeds, model = arm
    data = model.createData()
    rng = np.random.default_rng(6)
    for _ in range(40):
        q, v = rng.uniform(chain.lower, chain.upper), rng.normal(0.0, 1.0, 7)
        pin.forwardKinematics(model, data, q, v)
        expected = 0.0
        for joint, points in enumerate(extents):
            motion = pin.getVelocity(model, data, joint + 1, pin.ReferenceFrame.LOCAL)
            for point in points:
                speed = np.linalg.norm(motion.linear + np.cross(motion.angular, point))
                expected = max(expected, float(speed))
        assert speeds.fastest(q[None], v[None])[0] == pytest.approx(expected, rel=1e-9)


def test_the_peak_of_a_line_is_that_of_dense_samples(arm):
    chain, _, speeds, _ = arm
    rng = np.random.default_rng(7)
    for _ in range(20):
        start, end = rng.uniform(chain.lower, chain.upper, (2, 7))
        q = start + np.linspace(0, 1, 3001)[:, None] * (end - start)
        dense = np.max(speeds.fastest(q, np.broadcast_to(end - start, q.shape)))
        peak = speeds.peak_m(start, end)
        assert peak <= dense * (1 + 1e-4)
        # What planning leaves of the allowed speed is a hundred times as much.
        assert peak >= dense * (1 - 3e-4)


class Asked(PointSpeeds):
    """Notes which configurations are looked at."""

    def fastest(self, q, velocity):
        self.q = q
        return super().fastest(q, velocity)


def test_a_short_line_is_looked_at_its_ends_and_middle_and_a_long_one_often(arm):
    chain, extents, _, _ = arm
    asked = Asked(chain, extents)
    asked.peak_m(np.zeros(7), np.zeros(7))
    assert len(asked.q) == 3
    end = np.array([0.2, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    asked.peak_m(np.zeros(7), end)
    assert len(asked.q) == 3 + 50
    np.testing.assert_array_equal(asked.q[0], 0.0)
    np.testing.assert_array_equal(asked.q[-1], end)
    assert np.max(np.abs(np.diff(asked.q, axis=0))) <= PEAK_STEP_RAD
    # A quarter of a metre of a joint that slides is looked at as often as a radian.
    asked.peak_m(np.zeros(7), 0.5 * np.eye(7)[0])
    assert len(asked.q) == 3 + (100 if chain.slides[0] else 25)


def test_an_arm_that_stands_has_no_fast_point_and_no_bodies_no_speed(arm):
    chain, extents, speeds, _ = arm
    q = np.zeros((2, 7))
    np.testing.assert_array_equal(speeds.fastest(q, np.zeros((2, 7))), 0.0)
    bare = PointSpeeds(chain, [np.empty((0, 3))] * 7)
    np.testing.assert_array_equal(bare.fastest(q, np.ones((2, 7))), 0.0)
    with pytest.raises(ValueError, match='6 bodies for 7 joints'):
        PointSpeeds(chain, extents[:-1])


def test_no_point_is_farther_from_a_joint_than_its_reach(arm):
    """What a probe supposes: a point's speed is at most the sum of reach times joint speed."""
    chain, _, speeds, _ = arm
    rng = np.random.default_rng(8)
    q = rng.uniform(chain.lower, chain.upper, (400, 7))
    for joint in range(7):
        unit = np.broadcast_to(np.eye(7)[joint], q.shape)
        fastest = speeds.fastest(q, unit)
        assert np.max(fastest) <= speeds.reach_m[joint] * (1 + 1e-12)
        if chain.slides[joint]:
            np.testing.assert_allclose(fastest, 1.0)
            assert speeds.reach_m[joint] == 1.0


# Paths


def test_the_peaks_of_a_polyline_are_those_of_its_lines(arm):
    _, _, speeds, _ = arm
    points = np.zeros((3, 7))
    points[1, 0], points[2, 1] = 0.5, 0.3
    expected = (speeds.peak_m(points[0], points[1]), speeds.peak_m(points[1], points[2]))
    assert speeds.peaks_m(points) == expected
    found = FreePath(points)
    assert found.peaks_m == ()
    assert not found.way_out


@pytest.mark.parametrize(
    ('q', 'distance'),
    [
        ([0.5, 0.25], 0.25),
        ([-0.5, 0.0], 0.5),
        ([1.0, 0.5], 0.0),
        ([1.25, 0.75], 0.25),
        ([1.125, 2.5], 0.5),
        ([2.0, -0.5], 1.0),
        ([np.nan, 0.0], np.nan),
    ],
)
def test_the_distance_from_a_polyline(q, distance):
    free = FreePath(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]))
    np.testing.assert_equal(TURNING.largest(free.off(np.array(q), TURNING)), distance)


def test_the_distance_from_a_path_of_no_length():
    free = FreePath(np.array([[1.0, 1.0], [1.0, 1.0]]))
    np.testing.assert_array_equal(free.off(np.array([1.0, 1.5]), TURNING), [0.0, 0.5])
    np.testing.assert_array_equal(free.off(np.array([1.0, 1.0]), TURNING), [0.0, 0.0])


def test_the_nearest_place_of_a_path_is_nearest_for_joints_of_both_kinds():
    """A quarter of a metre of a slide is as far as a radian: the corner is cut evenly."""
    free = FreePath(np.array([[0.0, 0.0], [0.25, 1.0]]))
    units = JointUnits((True, False))
    off = free.off(np.array([0.25, 0.0]), units)
    np.testing.assert_allclose(off, [0.125, -0.5])
    assert units.largest(off) == 0.5
