# SPDX-License-Identifier: Apache-2.0
"""Joint limits, speeds, accelerations: of a chain, shifted by offsets, and in words."""

from types import SimpleNamespace

import numpy as np
import pytest
from supervisor_rig import LIMITS

from remaster_ros.motion.limits import ACCELERATION, MotionLimits


class Arm(SimpleNamespace):
    """What `MotionLimits.of` asks a chain for."""

    def __len__(self):
        return len(self.joint_names)


CHAIN = Arm(
    joint_names=('a', 'b', 'c'),
    lower=np.array([-1.0, -2.0, -np.inf]),
    upper=np.array([1.0, 2.0, np.inf]),
    velocity_limits=np.array([2.0, 4.0, np.inf]),
    per_radian=np.ones(3),
    slides=np.zeros(3, bool),
)


def test_the_limits_of_a_chain_and_a_share_of_its_speed():
    limits = MotionLimits.of(CHAIN, 0.3)
    assert limits.names == ('a', 'b', 'c')
    np.testing.assert_array_equal(limits.lower, CHAIN.lower)
    np.testing.assert_array_equal(limits.upper, CHAIN.upper)
    # A joint without a limit in the model gets 1 rad/s, and of that the share.
    np.testing.assert_allclose(limits.velocity, [0.6, 1.2, 0.3])
    np.testing.assert_array_equal(limits.acceleration, [5.0, 5.0, 5.0])
    assert ACCELERATION == 5.0
    assert limits.tool_speed == np.inf
    assert limits.margin == 0.0


def test_what_is_unknown_of_a_joint_that_slides_is_a_quarter_of_a_metre_for_a_radian():
    slides = np.array([True, False, True])
    per_radian = np.where(slides, 0.25, 1.0)
    rail = Arm(**{**vars(CHAIN), 'per_radian': per_radian, 'slides': slides})
    limits = MotionLimits.of(rail, 0.5, margin=0.02)
    assert limits.units.slides == (True, False, True)
    np.testing.assert_allclose(limits.margins, [0.005, 0.02, 0.005])
    # What the model states is in m/s and stays.
    np.testing.assert_allclose(limits.velocity, [1.0, 2.0, 0.125])
    np.testing.assert_allclose(limits.acceleration, [1.25, 5.0, 1.25])


def test_what_a_cell_sets_is_taken_as_it_is():
    limits = MotionLimits.of(
        CHAIN, 1.0, acceleration=np.array([1.0, 2.0, 3.0]), tool_speed=0.25, margin=0.02
    )
    np.testing.assert_array_equal(limits.acceleration, [1.0, 2.0, 3.0])
    assert limits.tool_speed == 0.25
    assert limits.margin == 0.02
    np.testing.assert_array_equal(
        MotionLimits.of(CHAIN, 1.0, acceleration=2.5).acceleration, [2.5, 2.5, 2.5]
    )


def test_offsets_in_use_shift_the_limits_and_never_widen_them():
    """True angle = reported + offset; the controller watches the reported one."""
    offsets = np.array([0.1, -0.2, 0.3])
    limits = MotionLimits.of(CHAIN, 1.0, offsets)
    np.testing.assert_allclose(limits.upper[:2], [1.0 - 0.1, 2.0])
    np.testing.assert_allclose(limits.lower[:2], [-1.0, -2.0 + 0.2])
    assert limits.lower[2] == -np.inf
    assert limits.upper[2] == np.inf
    rng = np.random.default_rng(1)
    for q in rng.uniform(-2.5, 2.5, (500, 3)):
        true_inside = np.all((q + offsets >= CHAIN.lower) & (q + offsets <= CHAIN.upper))
        reported_inside = np.all((q >= CHAIN.lower) & (q <= CHAIN.upper))
        assert (limits.outside(q) == '') == (true_inside and reported_inside)


def test_inside_is_inside_and_the_edge_too():
    assert LIMITS.outside(np.array([1.0, -2.0])) == ''
    assert LIMITS.outside(np.array([-1.0, 2.0])) == ''


@pytest.mark.parametrize(
    ('q', 'text'),
    [
        ([0.0, 2.01], 'b at 115.16 deg is outside its limits [-114.59, 114.59] deg'),
        ([-1.01, 0.0], 'a at -57.87 deg is outside its limits [-57.30, 57.30] deg'),
        ([np.nan, 0.0], 'a at nan deg is outside its limits [-57.30, 57.30] deg'),
        ([np.inf, 0.0], 'a at inf deg is outside its limits [-57.30, 57.30] deg'),
    ],
)
def test_outside_names_the_joint_and_its_limits(q, text):
    assert LIMITS.outside(np.array(q)) == text


def test_the_margin_is_kept_on_both_sides_and_said():
    limits = MotionLimits(
        LIMITS.names, LIMITS.lower, LIMITS.upper, LIMITS.velocity, LIMITS.acceleration, margin=0.25
    )
    assert limits.outside(np.array([0.75, -1.75])) == ''
    assert limits.outside(np.array([-0.75, 1.75])) == ''
    assert limits.outside(np.array([0.76, 0.0])) == (
        'a at 43.54 deg is outside its limits [-57.30, 57.30] deg less 14.32 deg'
    )
    assert limits.outside(np.array([0.0, -1.76])).startswith('b at -100.84 deg is outside')
