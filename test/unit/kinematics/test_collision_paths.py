# SPDX-License-Identifier: Apache-2.0
"""Paths without a collision, and what the motion gate takes of the bodies."""

import numpy as np
import pytest
from collision_scene import EXACT, at, capsules, distances
from worlds.arms import planar_arm
from worlds.random_arm import random_arm_urdf

from remaster_ros.errors import InputError
from remaster_ros.kinematics.bodies import Body, box, cylinder, hull, obstacle, sphere
from remaster_ros.kinematics.collision import HALF_STEP_M, CollisionModel, arm_bodies
from remaster_ros.kinematics.serial_chain import SerialChain

# Paths


def test_a_sweep_finds_what_lies_between_its_ends_and_the_spot_checks_between():
    """A post of 1 cm in the way of a thin arm that swings half a turn: 25 spot checks pass."""
    chain = planar_arm(1)
    arm = Body('rod', 1, cylinder(0.005, 0.8), at(0, 0, 0.4))
    angle = np.pi / 2 * (1 + 1 / 50)
    post = obstacle(
        'post', [0.7 * np.sin(angle), 0, 0.3 + 0.7 * np.cos(angle)], [0.01, 0.01, 0.01]
    )
    model = CollisionModel(chain, [arm, post], floor_z=None, **EXACT)
    ends = np.array([[0.0], [np.pi]])
    assert model.free_mask(np.linspace(*ends, 26)).all()
    assert 'post' in model.path_trouble(ends)
    assert model.path_trouble(np.array([[0.0], [1.4]])) == ''
    # Through a third point on the other side it is free: 3.4 rad the other way round.
    assert model.path_trouble(np.array([[0.0], [-1.5], [-3.1]])) == ''


@pytest.mark.parametrize(
    'seed', [0, *(pytest.param(seed, marks=pytest.mark.qualify) for seed in (1, 2, 3))]
)
def test_sweeps_agree_with_the_finest_sampling(lwr, seed):
    print('seed', seed)
    rng = np.random.default_rng(seed)
    tool = Body('probe', 7, box([0.05, 0.2, 0.25]), lwr.T_fixed[-1] @ at(0, 0, 0.125), 'tool')
    things = [
        tool,
        obstacle('box', [0.5, 0.2, 0.3], [0.3, 0.2, 0.4]),
        obstacle('pole', [-0.4, 0.3, 0.5], [0.05, 0.05, 1.0]),
    ]
    model = capsules(lwr, 0.06, *things)
    q = rng.uniform(lwr.lower, lwr.upper, (50, 7))
    q = q[model.free_mask(q)]
    outcomes = []
    for start, goal in zip(q[::2], q[1::2]):
        end = start + 0.4 * (goal - start)
        steps = int(np.ceil(model.travel(start, end) / 1e-3))
        fine = model.shortfalls(start + np.linspace(0, 1, steps + 1)[:, None] * (end - start))
        trouble = model.path_trouble(np.array([start, end]))
        outcomes.append(trouble == '')
        if trouble == '':
            # Between two checks it may be 5 mm nearer, no more.
            assert all(s.distance > s.kept - HALF_STEP_M for s in fine)
        else:
            assert fine
    assert 0.1 < np.mean(outcomes) < 0.98


def test_a_way_of_joints_that_slide_is_bounded_and_swept():
    """Against dense sampling: no body moves further than `travel`, nothing is missed."""
    seed = 3
    print('seed', seed)
    rng = np.random.default_rng(seed)
    text = random_arm_urdf(rng, 5, slides=(0, 2)).replace('"-3" upper="3"', '"-0.8" upper="0.8"')
    chain = SerialChain.from_urdf(text, tip_link='tool')
    boxes = [obstacle(f'box {i}', rng.normal(0, 0.7, 3), [0.2, 0.3, 0.2]) for i in range(3)]
    model = capsules(chain, 0.03, *boxes)
    q = rng.uniform(chain.lower, chain.upper, (300, 5))
    q = q[model.free_mask(q)]
    outcomes = []
    for start, goal in zip(q[::2], q[1::2]):
        end = start + 0.5 * (goal - start)
        way = start + np.linspace(0, 1, 400)[:, None] * (end - start)
        # A point of the tool against the base, and against the link of the second joint.
        frames, tip = chain.frames(way), chain.forward(way)[:, :3, 3]
        behind = np.einsum('nji,nj->ni', frames[:, 1, :3, :3], tip - frames[:, 1, :3, 3])
        for point in (tip, behind):
            gone = np.sum(np.linalg.norm(np.diff(point, axis=0), axis=1))
            assert gone <= model.travel(start, end) + 1e-9
        trouble = model.path_trouble(np.array([start, end]))
        outcomes.append(trouble == '')
        fine = model.shortfalls(way)
        if trouble == '':
            assert all(s.distance > s.kept - HALF_STEP_M for s in fine)
        else:
            assert fine
    assert 0.1 < np.mean(outcomes) < 0.98


def test_what_leads_a_joint_that_slides_is_a_body():
    """A rail along all of the way where the base has no shape; else a rod that slides along."""
    text = random_arm_urdf(np.random.default_rng(4), 4, slides=(0, 2))
    chain = SerialChain.from_urdf(text, tip_link='tool')
    bodies = {body.name: body for body in arm_bodies(chain, [], 0.05)}
    rail, rod = bodies['the rail'], bodies['the rod of joint_3']
    assert (rail.link, rod.link) == (0, 3)
    for q in np.random.default_rng(5).uniform(-3, 3, (20, 4)):
        frames = chain.frames(q)
        a, b, radius = rail.capsule
        assert radius == pytest.approx(0.05)
        # The carriage is on the rail.
        along = (frames[0, :3, 3] - a) @ (b - a) / ((b - a) @ (b - a))
        assert 0.0 <= along <= 1.0
        np.testing.assert_allclose(frames[0, :3, 3], a + along * (b - a), atol=1e-9)
        # The rod reaches from where the link would be at zero to where it is.
        ends = [frames[2, :3, :3] @ end + frames[2, :3, 3] for end in rod.capsule[:2]]
        zero = chain.frames(q * (1, 1, 0, 1))[2, :3, 3]
        way = ends[1] - ends[0]
        for place in (zero, frames[2, :3, 3]):
            share = (place - ends[0]) @ way / (way @ way)
            assert -1e-9 <= share <= 1 + 1e-9
            np.testing.assert_allclose(place, ends[0] + share * way, atol=1e-9)


def test_joint_limits_are_part_of_a_path(lwr):
    q = np.zeros((2, 7))
    q[1, 3] = lwr.upper[3] + 0.01
    assert 'joint_4 at 120.57 deg, its limits are -120.00 to 120.00 deg' in capsules(
        lwr
    ).path_trouble(q)
    q[1, 3] = np.nan
    assert 'not finite' in capsules(lwr).path_trouble(q)
    with pytest.raises(ValueError, match='a path of shape'):
        capsules(lwr).path_trouble(np.zeros((2, 6)))


def test_words_name_both_bodies_and_the_distance(lwr):
    q = np.deg2rad([0, 110.0, 0, 0, 0, 0, 0])
    words = capsules(lwr).trouble(q)
    assert 'the link of joint_7' in words
    assert 'into the floor' in words
    lowest = -min(d for (other, _), d in distances(capsules(lwr), q).items() if 'floor' in other)
    above = capsules(lwr, floor_z=-lowest - 0.012).trouble(q)
    assert above.startswith('the link of joint_7 12 mm from the floor, ')
    assert above.endswith(' mm is kept')


# What the motion gate takes


def test_extent_points_enclose_what_moves(lwr):
    tool = Body(
        'probe', 7, cylinder(0.03, 0.25), lwr.T_fixed[-1] @ at(0, 0, 0.125, (0.3, 0.2, 0)), 'tool'
    )
    model = capsules(lwr, 0.075, tool)
    assert len(model.extent_points) == 7
    assert all(points.shape[1] == 3 and len(points) <= 60 for points in model.extent_points)
    rng = np.random.default_rng(0)
    for link, points in enumerate(model.extent_points, start=1):
        for body in model.bodies:
            if body.link != link:
                continue
            for direction in rng.standard_normal((200, 3)):
                direction /= np.linalg.norm(direction)
                local = direction @ body.T_link_body[:3, :3]
                support = (body.shape.points @ local).max() + direction @ body.T_link_body[:3, 3]
                support += body.shape.ball + body.shape.disc * np.hypot(local[0], local[1])
                assert (points @ direction).max() >= support - 1e-9


@pytest.mark.parametrize('kind', ['box', 'hull'])
def test_the_bounding_capsule_contains_its_body(kind):
    rng = np.random.default_rng(7)
    for _ in range(50):
        size = rng.uniform(0.02, 0.6, 3)
        shape = box(size) if kind == 'box' else hull(rng.standard_normal((40, 3)) * size)
        a, b, radius = shape.capsule
        along = np.clip(
            np.sum((shape.points - a) * (b - a), axis=1) / max((b - a) @ (b - a), 1e-15), 0, 1
        )
        off = np.linalg.norm(shape.points - a - along[:, None] * (b - a), axis=1)
        assert off.max() <= radius + 1e-12


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda c: capsules(c, margin=0.004), 'at least 0.005 m'),
        (lambda c: capsules(c, margin=np.nan), 'at least 0.005 m'),
        (lambda c: capsules(c, unknown_offset=-0.1), 'unknown offset'),
        (lambda c: capsules(c, -0.1), '1 positive m'),
        (lambda c: CollisionModel(c, [Body('x', 8, sphere(1.0))]), 'x is fastened to no link'),
        (lambda c: box([0.1, 0.0, 0.1]), '3 positive m'),
        (lambda c: hull(np.zeros((10, 3))), 'all lie in one plane'),
        (lambda c: hull([[0, 0, np.inf]] * 4), 'not finite'),
    ],
)
def test_wrong_bodies_are_refused(lwr, make, message):
    with pytest.raises(InputError, match=message):
        make(lwr)
