"""Paths without a collision, and what the motion gate takes of the bodies."""

import numpy as np
import pytest
from arms import planar_arm
from collision_scene import EXACT, at, capsules, distances

from remaster_ros.errors import InputError
from remaster_ros.kinematics.bodies import Body, box, cylinder, hull, obstacle, sphere
from remaster_ros.kinematics.collision import HALF_STEP_M, CollisionModel

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
    q = rng.uniform(lwr.lower, lwr.upper, (80, 7))
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
