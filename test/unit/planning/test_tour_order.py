# SPDX-License-Identifier: Apache-2.0
"""The order of a collection: proximity, splits mixed, registration by the widest triangle."""

import numpy as np
import pytest
from worlds.arms import planar_arm

from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.bodies import obstacle
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel, arm_bodies
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.transforms import transform
from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.planning.candidates import (
    CurvedWay,
    Plan,
    PlannedPose,
    PoseRanges,
    candidate_poses,
    plan_poses,
)
from remaster_ros.planning.tour_order import Tour, free_order, nearest_solution
from remaster_ros.planning.tour_planner import registration_tour
from remaster_ros.session.cells.workcell import read_cell

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
    here, remaining_places = CHAIN.forward(np.zeros(7))[:3, 3], [s.T_R_T[:3, 3] for s in stops]
    for stop in stops:
        distances = [np.linalg.norm(p - here) for p in remaining_places]
        assert np.linalg.norm(stop.T_R_T[:3, 3] - here) == pytest.approx(min(distances))
        remaining_places.pop(int(np.argmin(distances)))
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
    assert nearest_solution(solutions, solutions[3] + 0.01, TURNING) == 3
    assert nearest_solution(solutions, solutions[3] + 0.03, TURNING) is None
    # 20 mrad, and 5 mm of a slide.
    slides = JointUnits((True, *(False,) * (solutions.shape[1] - 1)))
    first = np.eye(solutions.shape[1])[0]
    assert nearest_solution(solutions, solutions[3] + 4e-3 * first, slides) == 3
    assert nearest_solution(solutions, solutions[3] + 6e-3 * first, slides) is None


def test_the_pose_is_where_the_plan_has_it():
    T = transform(np.eye(3), np.array([0.3, 0.1, 0.5]))
    plan = Plan((PlannedPose(T, np.zeros((1, 7))),))
    np.testing.assert_array_equal(Tour(CHAIN, {'optimization': plan}).next(np.zeros(7)).T_R_T, T)


# Among obstacles


def walled():
    """The demo arm, a wall to its left, and nothing else."""
    wall = obstacle('wall', [0.0, 0.6, 0.5], [0.05, 0.5, 1.0])
    return CollisionModel(CHAIN, [*arm_bodies(CHAIN, [], 0.075), wall])


def free_plan(model, seed, poses, solutions=4):
    """A plan whose every configuration is free."""
    q = np.random.default_rng(seed).uniform(CHAIN.lower, CHAIN.upper, (400, 7))
    q = q[model.free_mask(q, RESERVE_M)][: poses * solutions].reshape(poses, solutions, 7)
    return Plan(
        tuple(PlannedPose(CHAIN.forward(solution_set[0]), solution_set) for solution_set in q)
    )


@pytest.mark.parametrize('seed', [1, 2])
def test_every_move_of_a_tour_is_free_and_none_is_forgotten(seed):
    print('seed', seed)
    model = walled()
    plan = free_plan(model, seed, 8)
    tour = Tour(CHAIN, {'optimization': plan}, model=model)
    here, seen, around = np.zeros(7), 0, 0
    while (stop := tour.next(here)) is not None:
        assert len(stop.paths) == len(stop.solutions) == len(stop.ids)
        assert sorted([*stop.ids, *stop.unreached]) == [0, 1, 2, 3]
        seen += len(stop.ids) + len(stop.unreached)
        for way, solution in zip(stop.paths, stop.solutions):
            assert way.shape[1] == 7
            around += len(way) > 0
            assert model.path_trouble(np.vstack((here, way, solution))) == ''
            here = solution
    assert seen == sum(tour.configurations.values())
    assert around > 0
    # Without the model some of the same moves go through the wall.
    blind, here, hits = Tour(CHAIN, {'optimization': plan}), np.zeros(7), 0
    while (stop := blind.next(here)) is not None:
        for solution in stop.solutions:
            hits += bool(model.path_trouble(np.array([here, solution])))
            here = solution
    assert hits > 0


def beside_a_post():
    """An arm that goes round in a circle, with a post at half a radian."""
    chain = planar_arm(1, limit=3.0)
    post = obstacle('post', [0.25 * np.sin(0.5), 0, 0.3 + 0.25 * np.cos(0.5)], [0.01, 0.4, 0.01])
    return chain, CollisionModel(chain, [*arm_bodies(chain, [], 0.02), post], floor_z=None)


def test_a_solution_behind_a_free_one_waits_and_one_that_is_shut_in_is_unreached():
    """On a circle with two posts: the nearer solution lies behind the post, the other is free."""
    chain, model = beside_a_post()
    solutions = np.array([[1.0], [-1.5]])
    rng = np.random.default_rng(0)
    order, paths = free_order(model, np.array([0.0]), solutions, np.ones(1), rng)
    assert order == [1]
    assert [len(path) for path in paths] == [0]
    assert free_order(None, np.array([0.0]), solutions, np.ones(1), rng)[0] == [0, 1]
    plan = Plan((PlannedPose(chain.forward(solutions[0]), solutions),))
    stop = Tour(chain, {'optimization': plan}, model=model).next(np.array([0.0]))
    assert (stop.ids, stop.unreached) == ((1,), (0,))
    # Where one is enough, the free one is it, and nothing is lost.
    tour = Tour(chain, {'optimization': plan}, one_solution=True, model=model)
    stop = tour.next(np.array([0.0]))
    assert (stop.ids, stop.unreached) == ((1,), ())
    shut = Tour(
        chain,
        {'optimization': Plan((PlannedPose(chain.forward([1.0]), solutions[:1]),))},
        one_solution=True,
        model=model,
    )
    stop = shut.next(np.array([0.0]))
    assert (stop.ids, stop.unreached) == ((), (0,))


def test_what_is_left_of_a_stop_is_reached_from_elsewhere():
    model = walled()
    tour = Tour(CHAIN, {'optimization': free_plan(model, 3, 2)}, model=model)
    stop = tour.next(np.zeros(7))
    open_stop = tour.with_route(stop, stop.ids[1:])
    assert len(open_stop.paths) == len(open_stop.ids)
    elsewhere = np.deg2rad([-150.0, 20, 0, 60, 0, 30, 0])
    again = tour.reroute(open_stop, elsewhere)
    assert sorted([*again.ids, *again.unreached]) == sorted(open_stop.ids)
    assert again.pose == stop.pose
    here = elsewhere
    for way, solution, number in zip(again.paths, again.solutions, again.ids):
        assert model.path_trouble(np.vstack((here, way, solution))) == ''
        np.testing.assert_array_equal(
            solution, tour.plans['optimization'].poses[stop.index].solutions[number]
        )
        here = solution


def test_proposing_changes_nothing():
    tour = Tour(CHAIN, {'optimization': plan_of(random_joints(1, 3))})
    first, second = tour.propose(np.zeros(7)), tour.propose(np.zeros(7))
    assert (first.index, first.pose, tour.visited) == (second.index, second.pose, 0)
    taken = tour.accept(first)
    assert (taken.index, taken.pose, tour.visited) == (first.index, 0, 1)
    assert tour.propose(np.zeros(7)).pose == 1


@pytest.mark.parametrize('held_values', [(0.0,), (-1.0, 0.0, 1.0)])
def test_low_poses_are_not_reached_through_the_floor(held_values):
    """Straight moves between nearest solutions sweep far: some went through the floor."""
    chain = CHAIN
    model = CollisionModel(chain, arm_bodies(chain, [], 0.075))
    low = PoseRanges(height_m=(0.1, 0.6))
    candidates = candidate_poses(150, low, [1.9, 0.0, 1.1], np.random.default_rng(4))
    inverse = InverseKinematics(chain, {2: held_values})
    plan = plan_poses(inverse, model, candidates, limit_margin_rad=0.02)

    def troubles(tour):
        here, found = np.zeros(7), []
        while (stop := tour.next(here)) is not None:
            for way, solution in zip(stop.paths, stop.solutions):
                found.append(model.path_trouble(np.vstack((here, way, solution))))
                here = solution
        return found

    blind = troubles(Tour(chain, {'optimization': plan}))
    assert sum('floor' in trouble for trouble in blind) > 0
    seeing = troubles(Tour(chain, {'optimization': plan}, model=model))
    assert len(seeing) > 0.9 * len(blind)
    assert set(seeing) == {''}


def references_of(joints):
    """A plan of single configurations."""
    return Plan(tuple(PlannedPose(CHAIN.forward(q), np.array([q])) for q in joints))


def test_references_twice_at_first_then_every_so_many_and_at_the_end():
    goals = random_joints(21, 4)
    plans = {
        'optimization': plan_of(random_joints(22, 9)),
        'validation': plan_of(random_joints(23, 8)),
        'reference': references_of(goals),
    }
    tour = Tour(CHAIN, plans, reference_every=7)
    assert sum(tour.configurations.values()) == 34
    stops = walk(tour, np.zeros(7))
    splits = ''.join('r' if stop.split == 'reference' else '.' for stop in stops)
    # Two solutions each: three poses, of six configurations, lie between.
    assert splits == 'rrrrrrrr' + '...rrrr' * 5 + '..rrrr'
    assert [stop.pose for stop in stops] == list(range(len(stops)))
    assert tour.poses_begun == 17
    visited = [stop.solutions[0] for stop in stops if stop.split == 'reference']
    np.testing.assert_array_equal(visited, np.tile(goals, (8, 1)))
    assert '4 reference configurations, measured again every 7' in tour.describe()


def test_a_reference_is_reached_from_the_one_before_it():
    """So that backlash is the same each time, wherever the arm comes from."""
    goals = random_joints(24, 3)
    plans = {'optimization': plan_of(random_joints(25, 3)), 'reference': references_of(goals)}
    tour = Tour(CHAIN, plans, reference_every=2)
    q, before = np.full(7, 0.5), {}
    while (stop := tour.next(q)) is not None:
        if stop.split == 'reference':
            came_from = stop.paths[0][-1] if len(stop.paths[0]) else q
            assert np.array_equal(came_from, goals[stop.index - 1])
            before.setdefault(stop.index, []).append(came_from)
        q = stop.solutions[-1]
    assert {index: len(ways) for index, ways in before.items()} == {0: 5, 1: 5, 2: 5}


def test_a_round_can_be_asked_for():
    plans = {
        'optimization': plan_of(random_joints(26, 3)),
        'reference': references_of(random_joints(27, 2)),
    }
    tour = Tour(CHAIN, plans, reference_every=100)
    q = np.zeros(7)
    for _ in range(5):
        stop = tour.next(q)
    assert stop.split == 'optimization'
    tour.request_reference_round()
    assert [tour.next(q).split for _ in range(3)] == ['reference', 'reference', 'optimization']


def scattered(plans, seed):
    """Return all visits of some plans in a random order."""
    visits = [
        (split, index, number)
        for split, plan in plans.items()
        for index, pose in enumerate(plan.poses)
        for number in range(len(pose.solutions))
    ]
    return [visits[i] for i in np.random.default_rng(seed).permutation(len(visits))]


def test_a_given_order_is_kept_and_a_pose_keeps_its_number():
    plans = {
        'optimization': plan_of(random_joints(28, 4)),
        'validation': plan_of(random_joints(29, 3)),
    }
    order = scattered(plans, 30)
    tour = Tour(CHAIN, plans, order=order)
    stops = walk(tour, np.zeros(7))
    visited = [(stop.split, stop.index, number) for stop in stops for number in stop.ids]
    # Two solutions of a pose that are next to each other are one stop, nearest first.
    assert sorted(visited) == sorted(order)
    assert [visit[:2] for visit in visited] == [visit[:2] for visit in order]
    numbers = {}
    for stop in stops:
        numbers.setdefault((stop.split, stop.index), set()).add(stop.pose)
    assert all(len(number) == 1 for number in numbers.values())
    assert len(set.union(*numbers.values())) == 7
    assert tour.poses_begun == 7


def test_references_come_between_the_visits_of_a_given_order():
    plans = {'optimization': plan_of(random_joints(31, 4))}
    order = scattered(plans, 32)
    plans['reference'] = references_of(random_joints(33, 2))
    stops = walk(Tour(CHAIN, plans, reference_every=4, order=order), np.zeros(7))
    splits = ''.join('r' if stop.split == 'reference' else '.' * len(stop.ids) for stop in stops)
    assert splits == 'rrrr....rr....rr'


def test_what_cannot_be_reached_in_a_given_order_is_not_tried_again():
    chain, model = beside_a_post()
    pose = PlannedPose(chain.forward([0.0]), np.array([[0.0], [1.0], [-0.3]]))
    order = [('optimization', 0, number) for number in range(3)]
    tour = Tour(chain, {'optimization': Plan((pose,))}, model=model, order=order)
    stop = tour.next(np.array([-0.1]))
    assert (sorted(stop.ids), list(stop.unreached)) == ([0, 2], [1])
    assert tour.next(np.array([-0.3])) is None


def test_a_pose_with_a_curve_is_reached_by_it_from_where_it_begins():
    q = random_joints(1, 5)
    way = CurvedWay(q[:3], np.array([0.0, 0.3, 0.6]))
    poses = [PlannedPose(CHAIN.forward(q[3]), q[3][None], way=way)]
    tour = Tour(CHAIN, {'optimization': Plan(tuple(poses))})
    visit = tour.next(q[0] + 1e-3)
    np.testing.assert_array_equal(visit.paths[0], q[:3])
    np.testing.assert_array_equal(visit.shares[0], way.shares)
    # The rest of it, from elsewhere: any free path will do.
    again = tour.reroute(visit, q[4])
    assert (len(again.paths[0]), len(again.shares[0])) == (0, 0)
    assert len(tour.with_route(visit, visit.ids).shares[0]) == 0
