# SPDX-License-Identifier: Apache-2.0
"""Capsules around the links: distances of segments and the line of sight."""

import numpy as np
import pytest
from worlds.arms import planar_arm

from remaster_ros.errors import InputError
from remaster_ros.kinematics.line_of_sight import LinkCapsules, segment_distance


def test_segment_distance_is_the_least_over_both_segments():
    rng = np.random.default_rng(1)
    a, b, c, d = rng.uniform(-1, 1, (4, 60, 3))
    b[:10] = a[:10]  # a point and a segment
    d[5:15] = c[5:15]  # two points, then a segment and a point
    d[20:30] = c[20:30] + 0.7 * (b[20:30] - a[20:30])  # parallel
    c[30:40] = a[30:40] + 0.3 * (b[30:40] - a[30:40])  # touching
    share = np.linspace(0, 1, 201)[:, None, None]
    first, second = a + share * (b - a), c + share * (d - c)
    sampled = np.min(np.linalg.norm(first[:, None] - second[None], axis=-1), axis=(0, 1))
    exact = segment_distance(a, b, c, d)
    assert np.all(exact <= sampled + 1e-12)
    # Half a sample step on each segment is the most that sampling can miss.
    steps = (np.linalg.norm(b - a, axis=1) + np.linalg.norm(d - c, axis=1)) / 400
    assert np.all(exact >= sampled - steps - 1e-12)
    np.testing.assert_allclose(exact[30:40], 0, atol=1e-12)


def test_the_links_hide_from_the_base_to_the_origin_of_the_last_joint(lwr):
    arm = LinkCapsules(lwr, radius=0.05)

    def hides(height):
        marker_T = [0.5, 0.0, height - 1.2285]
        return arm.hides(np.zeros(7), marker_T, [-0.5, 0.0, height])

    assert not hides(-0.051)
    assert all(hides(height) for height in np.arange(-0.049, 1.2285, 0.005))
    assert hides(1.1785 + 0.049)
    assert not hides(1.1785 + 0.051)


def test_batches_agree_with_single_configurations(lwr):
    arm = LinkCapsules(lwr, radius=0.09)
    q = np.random.default_rng(2).uniform(lwr.lower, lwr.upper, (4, 50, 7))
    marker, sensor = [0.1, 0, 0.02], [1.0, 0.2, 0.5]
    together = arm.hides(q, marker, sensor)
    assert together.shape == (4, 50)
    assert 0 < together.sum() < together.size
    single = [arm.hides(row, marker, sensor) for row in q.reshape(-1, 7)]
    np.testing.assert_array_equal(together.ravel(), single)


def test_line_of_sight_is_cut_by_a_link_within_the_radius():
    # A gallows: up 0.6 m, out 0.3 m along X, down 0.3 m; the marker below, the sensor behind.
    arm = LinkCapsules(planar_arm(3), radius=0.05)
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
        LinkCapsules(lwr, radius)
