"""Capsules around the links: distances, self-collision, the floor and the line of sight."""

from pathlib import Path

import numpy as np
import pytest

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.collision import ArmCapsules, segment_distance
from remaster_ros.core.errors import InputError

ROBOTS = Path(__file__).parents[3] / 'config' / 'robots'


@pytest.fixture(scope='module')
def lwr():
    text = (ROBOTS / 'lwr4plus.urdf').read_text(encoding='utf-8')
    return SerialChain.from_urdf(text)


def planar_arm(links):
    """Return an arm of 0.3 m links in the X-Z plane: positive angles turn from Z towards X."""
    parts = ['<link name="link_0"/>']
    for i in range(1, links + 1):
        parts.append(
            f'<link name="link_{i}"/><joint name="joint_{i}" type="continuous">'
            f'<parent link="link_{i - 1}"/><child link="link_{i}"/>'
            '<origin xyz="0 0 0.3"/><axis xyz="0 1 0"/></joint>'
        )
    parts.append(
        f'<link name="tool"/><joint name="tool_joint" type="fixed"><parent link="link_{links}"/>'
        '<child link="tool"/><origin xyz="0 0 0.3"/></joint>'
    )
    return SerialChain.from_urdf('<robot name="planar">' + ''.join(parts) + '</robot>')


def test_segment_distance_is_the_least_over_both_segments():
    rng = np.random.default_rng(1)
    a, b, c, d = rng.uniform(-1, 1, (4, 60, 3))
    b[:10] = a[:10]  # a point and a segment
    d[5:15] = c[5:15]  # two points, then a segment and a point
    d[20:30] = c[20:30] + 0.7 * (b[20:30] - a[20:30])  # parallel
    c[30:40] = a[30:40] + 0.3 * (b[30:40] - a[30:40])  # touching
    share = np.linspace(0, 1, 401)[:, None, None]
    first, second = a + share * (b - a), c + share * (d - c)
    sampled = np.min(np.linalg.norm(first[:, None] - second[None], axis=-1), axis=(0, 1))
    exact = segment_distance(a, b, c, d)
    assert np.all(exact <= sampled + 1e-12)
    # Half a sample step on each segment is the most that sampling can miss.
    steps = (np.linalg.norm(b - a, axis=1) + np.linalg.norm(d - c, axis=1)) / 800
    assert np.all(exact >= sampled - steps - 1e-12)
    np.testing.assert_allclose(exact[30:40], 0, atol=1e-12)


def test_points_run_from_the_base_over_the_joints_to_the_tool(lwr):
    heights = ArmCapsules(lwr).points(np.zeros(7))[:, 2]
    np.testing.assert_allclose(
        heights, [0, 0.102, 0.3105, 0.502, 0.7105, 0.902, 1.1005, 1.1785, 1.2285]
    )


@pytest.mark.parametrize(
    ('q', 'hits'),
    [
        ([0, 0, 0, 0], False),
        # Folded into a square: the last link crosses the base.
        ([np.pi / 2, np.pi / 2, np.pi / 2, np.pi / 2], True),
        # Folded back alongside, 0.3 m away, and 0.1 m away.
        ([np.pi / 2, np.pi / 2, 0, 0], False),
        ([2.0, 1.9, -0.3, 0], True),
    ],
)
def test_folded_arm_hits_itself(q, hits):
    arm = ArmCapsules(planar_arm(4), radius=0.06, floor_z=None)
    assert arm.self_collision(q) == hits


def test_self_collision_depends_on_the_radius_and_leaves_out_neighbours():
    chain = planar_arm(4)
    q = [np.pi / 2, np.pi / 2, 0, 0]  # the third link 0.3 m beside the base
    assert not ArmCapsules(chain, radius=0.149).self_collision(q)
    assert ArmCapsules(chain, radius=0.1499).self_collision([np.pi / 2, np.pi / 2 + 0.01, 0, 0])
    # The second link alongside the first: neighbours, whose joint's limits are there for that.
    folded = [np.pi - 0.1, -np.pi / 2, 0, 0]
    assert not ArmCapsules(chain, radius=0.01).self_collision(folded)
    # The third link starts 0.03 m beside the first.
    assert ArmCapsules(chain, radius=0.02).self_collision(folded)


def test_no_joint_alone_within_its_limits_makes_the_arm_hit_itself(lwr):
    arm = ArmCapsules(lwr)
    for joint in range(7):
        q = np.zeros((50, 7))
        q[:, joint] = np.linspace(lwr.lower[joint], lwr.upper[joint], 50)
        assert not arm.self_collision(q).any()


def test_the_lwr_hits_its_base_when_it_curls_up(lwr):
    curled = [0, np.deg2rad(115), 0, np.deg2rad(-115), 0, np.deg2rad(100), 0]
    points = ArmCapsules(lwr).points(curled)
    tool_to_base = segment_distance(points[-2], points[-1], points[0], points[1])
    assert ArmCapsules(lwr).self_collision(curled) == (tool_to_base < 0.15)
    assert ArmCapsules(lwr).self_collision(curled)


def test_batches_agree_with_single_configurations(lwr):
    arm = ArmCapsules(lwr, radius=0.09)
    q = np.random.default_rng(2).uniform(lwr.lower, lwr.upper, (4, 50, 7))
    marker, sensor = [0.1, 0, 0.02], [1.0, 0.2, 0.5]
    checks = (
        arm.self_collision,
        arm.hits_floor,
        lambda rows: arm.hides(rows, marker, sensor),
    )
    for check in checks:
        together = check(q)
        assert together.shape == (4, 50)
        assert 0 < together.sum() < together.size
        single = [check(row) for row in q.reshape(-1, 7)]
        np.testing.assert_array_equal(together.ravel(), single)


def test_floor(lwr):
    reaching_down = [0, np.deg2rad(110), 0, 0, 0, 0, 0]
    assert ArmCapsules(lwr).hits_floor(reaching_down)
    assert not ArmCapsules(lwr, floor_z=-1.0).hits_floor(reaching_down)
    assert not ArmCapsules(lwr, floor_z=None).hits_floor(reaching_down)
    assert not ArmCapsules(lwr).hits_floor(np.zeros(7))


def test_line_of_sight_is_cut_by_a_link_within_the_radius():
    # A gallows: up 0.6 m, out 0.3 m along X, down 0.3 m; the marker below, the sensor behind.
    arm = ArmCapsules(planar_arm(3), radius=0.05, floor_z=None)
    q = [0, np.pi / 2, np.pi / 2]
    marker_T, marker_height = [0, 0, 0.05], 0.25
    assert arm.chain.positions(q, marker_T) == pytest.approx([0.3, 0, marker_height])
    assert arm.hides(q, marker_T, [-2, 0, marker_height])
    assert not arm.hides(q, marker_T, [2, 0, marker_height])
    # The line passes the column, at X = 0, an eighth of the way to a sensor 2.1 m behind.
    assert arm.hides(q, marker_T, [-1.8, 7 * 0.04, marker_height])
    assert not arm.hides(q, marker_T, [-1.8, 7 * 0.06, marker_height])


@pytest.mark.parametrize('radius', [0.0, -0.1, np.nan, np.inf])
def test_wrong_radius_is_refused(lwr, radius):
    with pytest.raises(InputError, match='link radius'):
        ArmCapsules(lwr, radius)
