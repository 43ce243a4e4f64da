"""The order of a collection: proximity, splits mixed, registration by the widest triangle."""

import numpy as np
import pytest

from remaster_ros.core.errors import InsufficientDataError
from remaster_ros.core.planning import Plan, PlannedPose
from remaster_ros.core.tour import Tour, nearest_solution, registration_tour
from remaster_ros.core.transforms import transform
from remaster_ros.storage.cell import read_cell

CHAIN = read_cell('demo').chain()


def plan_of(joints, **dropped):
    """A plan whose poses are where the given joint positions put the tool."""
    poses = [PlannedPose(CHAIN.forward(q), np.array([q, -q])) for q in joints]
    return Plan(tuple(poses), dropped)


def random_joints(seed, count):
    print(f'seed {seed}')
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 7))


def walk(tour, q):
    stops = []
    while (stop := tour.next(q)) is not None:
        stops.append(stop)
        q = stop.solutions[-1]
    return stops


def test_every_solution_once_nearest_first_and_splits_among_each_other():
    plans = {
        'optimization': plan_of(random_joints(1, 6)),
        'validation': plan_of(random_joints(2, 4)),
    }
    tour = Tour(CHAIN, plans)
    stops = walk(tour, np.zeros(7))
    splits = [stop.split for stop in stops]
    assert sorted(splits) == ['optimization'] * 6 + ['validation'] * 4
    assert 'validation' in splits[:6]
    assert [stop.pose for stop in stops] == list(range(10))
    assert tour.configurations == {'optimization': 12, 'validation': 8}
    planned = np.concatenate([p.solutions for plan in plans.values() for p in plan.poses])
    visited = np.concatenate([stop.solutions for stop in stops])
    assert sorted(map(tuple, planned)) == sorted(map(tuple, visited))
    # Each pose is the nearest of those left to where the last one ended.
    here, left = CHAIN.forward(np.zeros(7))[:3, 3], [s.T_R_T[:3, 3] for s in stops]
    for stop in stops:
        distances = [np.linalg.norm(p - here) for p in left]
        assert np.linalg.norm(stop.T_R_T[:3, 3] - here) == pytest.approx(min(distances))
        left.pop(int(np.argmin(distances)))
        here = CHAIN.forward(stop.solutions[-1])[:3, 3]


def test_what_was_dropped_is_said():
    tour = Tour(CHAIN, {'optimization': plan_of(random_joints(3, 2), **{'out of reach': 5})})
    assert '2 optimization poses with 4 configurations' in tour.describe()
    assert '5 out of reach' in tour.describe()


def test_registration_begins_with_the_widest_triangle():
    """By trying every triangle."""
    plan = plan_of(random_joints(4, 8))
    marker = np.array([0.1, 0.0, 0.0])
    tour = registration_tour(CHAIN, plan, [marker])
    stops = walk(tour, np.zeros(7))
    assert len(stops) == 8
    assert all(len(stop.solutions) == 1 for stop in stops)
    assert all(stop.pose < 0 for stop in stops)
    points = np.array([CHAIN.positions(pose.solutions[0], marker) for pose in plan.poses])

    def area(a, b, c):
        return np.linalg.norm(np.cross(b - a, c - a))

    widest = max(
        area(points[i], points[j], points[k]) for i in range(8) for j in range(i) for k in range(j)
    )
    first = [
        points[next(i for i, p in enumerate(plan.poses) if np.array_equal(p.T_R_T, s.T_R_T))]
        for s in stops[:3]
    ]
    assert area(*first) == pytest.approx(widest)


def test_two_poses_are_too_few_to_register():
    with pytest.raises(InsufficientDataError, match=r'only 2 .*rough_position_m'):
        registration_tour(CHAIN, plan_of(random_joints(5, 2)), [np.zeros(3)])


def test_the_arm_stands_at_the_solution_it_is_near_or_at_none():
    solutions = random_joints(6, 5)
    assert nearest_solution(solutions, solutions[3] + 0.01) == 3
    assert nearest_solution(solutions, solutions[3] + 0.03) is None


def test_the_pose_is_where_the_plan_has_it():
    T = transform(np.eye(3), np.array([0.3, 0.1, 0.5]))
    plan = Plan((PlannedPose(T, np.zeros((1, 7))),))
    np.testing.assert_array_equal(Tour(CHAIN, {'optimization': plan}).next(np.zeros(7)).T_R_T, T)
