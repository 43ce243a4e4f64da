# SPDX-License-Identifier: Apache-2.0
"""Configurations: distances by closed forms, clearance, what is left out."""

import numpy as np
import pytest
from collision_scene import EXACT, at, capsules, distances
from worlds.arms import planar_arm

from remaster_ros.kinematics import body_pairs
from remaster_ros.kinematics.bodies import Body, box, capsule, cylinder, hull, obstacle, sphere
from remaster_ros.kinematics.collision import CollisionModel, arm_bodies
from remaster_ros.kinematics.transforms import apply, matrix_from_rpy

# Bodies on a link of a one-joint arm, its joint at z = 0.3: link frame = R shifted up by 0.3.


@pytest.mark.parametrize(
    ('shape', 'above_floor'),
    [
        (sphere(0.05), 0.5 - 0.05),
        (capsule([0, 0, -0.1], [0, 0, 0.1], 0.05), 0.5 - 0.15),
        (cylinder(0.05, 0.2), 0.5 - 0.1),
        (box([0.2, 0.4, 0.1]), 0.5 - 0.05),
        (hull(np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))), None),
    ],
)
@pytest.mark.parametrize('turn', [0.0, 0.4, np.pi / 2])
def test_distance_to_the_floor_is_that_of_the_lowest_point(shape, above_floor, turn):
    chain = planar_arm(1)
    body = Body('part', 1, shape, at(0, 0, 0.2))
    model = CollisionModel(chain, [body], **EXACT)
    q = np.array([turn])
    found = distances(model, q)['the floor', 'part']
    points = apply(chain.frames(q)[0] @ body.T_link_body, shape.points)
    axis = chain.frames(q)[0][2, 2]
    lowest = points[:, 2].min() - shape.ball - shape.disc * np.sqrt(1 - axis**2)
    assert found == pytest.approx(lowest, abs=1e-12)
    if turn == 0.0 and above_floor is not None:
        assert found == pytest.approx(above_floor, abs=1e-12)


@pytest.mark.parametrize(
    ('shape', 'reach'),
    [
        (sphere(0.05), 0.05),
        (capsule([0, 0, -0.1], [0, 0, 0.1], 0.05), 0.05),
        (cylinder(0.05, 0.2), 0.05),
        (box([0.2, 0.4, 0.1]), 0.1),
        (hull([[s * 0.1, y, z] for s in (-1, 1) for y in (-1, 1) for z in (-0.1, 0.1)]), 0.1),
    ],
)
def test_distance_to_an_obstacle_face(shape, reach):
    """The obstacle's face is at x = 0.5; the part is held by a joint that stands still."""
    model = CollisionModel(
        planar_arm(1),
        [Body('part', 1, shape, at(0, 0, 0.2)), obstacle('wall', [0.6, 0, 0.5], [0.2, 3, 3])],
        **EXACT,
    )
    assert distances(model, [0.0])['wall', 'part'] == pytest.approx(0.5 - reach, abs=1e-6)


def test_obstacles_stand_in_yaw():
    """A plate of 2 cm, a metre wide: broadside it is near, edge-on it is far."""
    for yaw, clearance in ((0.0, 0.39), (np.pi / 2, 0.4 - 0.5), (np.pi / 4, None)):
        wall = obstacle(
            'wall', [0.4, 0, 0.5], [0.02, 1, 0.4], matrix_from_rpy(np.array([0, 0, yaw]))
        )
        model = CollisionModel(
            planar_arm(1), [Body('ball', 1, sphere(0.01), at(0, 0, 0.2)), wall], **EXACT
        )
        found = distances(model, [0.0])['wall', 'ball']
        if clearance is None:
            # The line y = -(x - 0.4) ± 0.01 √2, from the origin.
            assert found == pytest.approx(0.4 / np.sqrt(2) - 0.01 - 0.01, abs=1e-6)
        elif clearance > 0:
            assert found == pytest.approx(clearance - 0.01, abs=1e-6)
        else:
            assert found < 0


def test_overlapping_bodies_have_negative_distances():
    model = CollisionModel(
        planar_arm(1),
        [
            Body('part', 1, box([0.2, 0.2, 0.2]), at(0.08, 0, 0.2)),
            obstacle('wall', [0.2, 0, 0.5], [0.1, 1, 1]),
        ],
        **EXACT,
    )
    # The part reaches to x = 0.18, the wall begins at 0.15.
    assert distances(model, [0.0])['wall', 'part'] == pytest.approx(-0.03, abs=1e-6)
    assert 'part reaches 30 mm into wall' in model.trouble([0.0])


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
    model = capsules(planar_arm(4), 0.06, floor_z=None, **EXACT)
    assert (model.reasons(q)[0] == body_pairs.SELF_COLLISION) == hits


def test_no_joint_alone_within_its_limits_makes_the_arm_hit_itself(lwr):
    model = capsules(lwr, floor_z=None)
    margin = np.deg2rad(1.0)  # as the planner keeps
    for joint in range(7):
        q = np.zeros((50, 7))
        q[:, joint] = np.linspace(lwr.lower[joint] + margin, lwr.upper[joint] - margin, 50)
        assert model.free_mask(q).all()


def test_the_lwr_hits_its_base_when_it_curls_up(lwr):
    curled = [0, np.deg2rad(115), 0, np.deg2rad(-115), 0, np.deg2rad(100), 0]
    assert capsules(lwr).reasons(curled)[0] == body_pairs.SELF_COLLISION


def test_floor(lwr):
    reaching_down = [0, np.deg2rad(110), 0, 0, 0, 0, 0]
    assert capsules(lwr).reasons(reaching_down)[0] == body_pairs.FLOOR
    assert capsules(lwr, floor_z=-1.0).trouble(reaching_down) == ''
    assert capsules(lwr, floor_z=None).trouble(reaching_down) == ''
    # Upright, on its pedestal, which touches the floor.
    assert capsules(lwr).trouble(np.zeros(7)) == ''


def test_tool_and_markers_are_seen_where_the_links_are_free(lwr):
    """The tool and its markers were 22 mm below the floor in configurations called free."""
    tip = lwr.T_fixed[-1]
    rng = np.random.default_rng(5)
    q = rng.uniform(lwr.lower, lwr.upper, (3000, 7))
    bare = capsules(lwr, **EXACT)
    marker = Body('marker sir', 7, sphere(0.02), tip @ at(0.1, 0, 0), 'tool')
    bar = Body('tool bar', 7, box([0.24, 0.04, 0.02]), tip, 'tool')
    full = capsules(lwr, 0.075, marker, bar, **EXACT)
    heights = lwr.positions(q, [0.1, 0, 0])[:, 2]
    was_free = bare.free_mask(q)
    below = was_free & (heights < 0.02)
    assert below.sum() > 5
    assert not full.free_mask(q)[below].any()


def test_a_tool_of_250_mm_is_part_of_the_arm(lwr):
    tool = Body('probe', 7, cylinder(0.02, 0.25), lwr.T_fixed[-1] @ at(0, 0, 0.125), 'tool')
    bare, long = capsules(lwr, **EXACT), capsules(lwr, 0.075, tool, **EXACT)
    q = np.random.default_rng(8).uniform(lwr.lower, lwr.upper, (3000, 7))
    was_free = bare.free_mask(q)
    tips = lwr.positions(q, [0, 0, 0.25])
    below = was_free & (tips[:, 2] < 0.0)
    assert below.sum() > 20
    assert not long.free_mask(q)[below].any()
    # Folded at the elbow it reaches the shoulder, which the arm without it does not.
    folded = q.copy()
    folded[:, 3] = np.deg2rad(-118.0)
    found = long.shortfalls(folded[bare.free_mask(folded)])
    assert ('the link of joint_1', 'probe') in {long._pairs.names(s.pair) for s in found}
    words = long.trouble(q[below][0])
    assert 'probe reaches' in words
    assert 'the floor' in words


# What is kept


def test_clearance_is_the_margin_and_the_unknown_offset_times_the_levers():
    """An arm stretched out level, 0.9 m long: its end is 0.6 and 0.3 m from the axes."""
    chain = planar_arm(2, limit=3.0)
    ball = Body('ball', 2, sphere(0.01), at(0, 0, 0.3))
    table = obstacle('table', [0.6, 0, 0.0], [0.4, 0.4, 0.4])
    delta = np.deg2rad(1.0)
    model = CollisionModel(chain, [ball, table], floor_z=None, margin=0.006, unknown_offset=delta)
    q = np.array([np.pi / 2, 0.0])
    (pair,) = [p for p in range(len(model._pairs.inner)) if model._pairs.names(p)[0] == 'table']
    kept = model._pairs.kept(model._pairs.place(q[None]), np.array([0]), np.array([pair]))[0]
    # The body's own radius belongs to its levers.
    assert kept == pytest.approx(0.006 + delta * np.hypot(0.61, 0.31))
    # At that height it is free; a hair lower it is not. The ball's underside is at 0.29.
    for gap, free in ((kept + 1e-4, True), (kept - 1e-4, False)):
        table = obstacle('table', [0.6, 0, 0.29 - gap - 0.2], [0.4, 0.4, 0.4])
        model = CollisionModel(
            chain, [ball, table], floor_z=None, margin=0.006, unknown_offset=delta
        )
        assert (model.trouble(q) == '') == free


def test_only_what_lifts_counts_for_the_floor():
    """About a vertical axis nothing comes nearer to the floor; straight above a joint nothing."""
    upright = CollisionModel(
        planar_arm(1, axis='0 0 1', limit=3.0), [Body('ball', 1, sphere(0.01), at(0.8, 0, 0))]
    )
    level = CollisionModel(
        planar_arm(1, limit=3.0), [Body('ball', 1, sphere(0.01), at(0, 0, 0.8))]
    )
    for model, q, lever in ((upright, 0.3, 0.0), (level, np.pi / 2, 0.81), (level, 0.0, 0.01)):
        kept = model._pairs.kept(
            model._pairs.place(np.array([[q]])), np.array([0]), np.array([0])
        )[0]
        assert kept == pytest.approx(model.margin + np.deg2rad(1.0) * lever, abs=1e-12)


def test_a_known_arm_keeps_less(lwr):
    q = np.random.default_rng(3).uniform(lwr.lower, lwr.upper, (1000, 7))
    free = [capsules(lwr, unknown_offset=np.deg2rad(d)).free_mask(q).sum() for d in (0, 0.1, 1, 3)]
    assert free[0] > free[1] > free[2] > free[3]


@pytest.mark.parametrize('seed', range(5))
def test_an_arm_that_is_off_by_the_unknown_offset_still_hits_nothing(lwr, seed):
    """Free configurations, each joint off by a normal draw of a third of the unknown offset."""
    print('seed', seed)
    rng = np.random.default_rng(seed)
    model = capsules(lwr, 0.075, obstacle('box', [0.5, 0.3, 0.3], [0.3, 0.2, 0.4]))
    q = rng.uniform(lwr.lower, lwr.upper, (800, 7))
    q = q[model.free_mask(q)]
    # What is too near is looked for without any clearance: contact.
    contact = capsules(lwr, 0.075, obstacle('box', [0.5, 0.3, 0.3], [0.3, 0.2, 0.4]), **EXACT)
    off = q + np.deg2rad(1.0) * rng.standard_normal(q.shape) / 3
    assert all(short.distance > 0 for short in contact.shortfalls(off))


# What is left out


def test_neighbours_and_what_always_overlaps_are_left_out_and_named(lwr):
    model = capsules(lwr)
    assert any('joint_5' in line and 'joint_7' in line for line in model.left_out)
    names = {model._pairs.names(p) for p in range(len(model._pairs.inner))}
    assert ('the link of joint_3', 'the link of joint_5') in names
    assert ('the base', 'the link of joint_7') in names
    assert not any(a == 'the floor' and b == 'the base' for a, b in names)
    assert ('the link of joint_3', 'the link of joint_4') not in names


def test_what_is_always_near_is_kept_from_touching_only():
    """A collar 3 mm above the base: nearer than is kept wherever it turns, and no contact."""
    chain = planar_arm(2, axis='0 0 1', limit=3.0)
    bodies = [
        Body('base', 0, cylinder(0.05, 0.1), at(0, 0, 0.05)),
        Body('collar', 2, cylinder(0.05, 0.1), at(0, 0, -0.6 + 0.153)),
    ]
    model = CollisionModel(chain, bodies, floor_z=None)
    assert model.left_out == ('base and collar: checked for contact',)
    q = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    assert model.free_mask(q, body_pairs.RESERVE_M).all()
    assert model.path_trouble(q, body_pairs.RESERVE_M) == ''


def test_a_tool_is_checked_against_the_link_before_its_own():
    """A hook that bends back over the last joint hits the link before it."""
    chain = planar_arm(2, limit=3.0)
    hook = Body('hook', 2, sphere(0.02), at(0.1, 0, 0.0), 'tool')
    model = CollisionModel(chain, [*arm_bodies(chain, [], 0.05), hook], floor_z=None, **EXACT)
    assert model.trouble([0.0, 0.0]) == ''
    assert 'hook' in model.trouble([0.0, np.pi / 2])


def test_a_pair_that_can_hit_and_be_free_is_never_left_out():
    """An obstacle that is in the way of most configurations stays checked."""
    chain = planar_arm(1, limit=3.0)
    ring = [
        obstacle('wall', [0.0, 0, 0.6], [0.55, 0.2, 0.4]),
        obstacle('low', [0, 0, 0], [2, 2, 0.2]),
    ]
    model = CollisionModel(chain, [*arm_bodies(chain, [], 0.05), *ring], floor_z=None)
    shares = model.free_mask(np.linspace(-3, 3, 200)[:, None]).mean()
    assert 0 < shares < 0.6
    assert model.left_out == ()
