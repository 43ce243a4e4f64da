# SPDX-License-Identifier: Apache-2.0
"""A whole collection before it begins: designs and orders of a cell, every way of them free."""

from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import groupby

import numpy as np
import pytest

from remaster_ros.collection.plan_confirmation import fingerprint
from remaster_ros.kinematics.free_paths import is_straight_free
from remaster_ros.planning import planned_design, pose_design
from remaster_ros.planning.candidates import order_solutions, plan_poses
from remaster_ros.planning.collection_plan import look_ahead, plan_collection, session_time_s
from remaster_ros.planning.planned_design import ENOUGH_RAD, NOT_NEEDED, DesignSettings
from remaster_ros.planning.pose_design import HELD_OUT_POSES, HELD_OUT_SOLUTIONS, Floors
from remaster_ros.planning.pose_settings import PoseSettings
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.reports.plan_json import missed_goal, plan_text, plan_to_dict
from remaster_ros.session.cells.workcell import read_cell


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(planned_design, 'POOL_CANDIDATES', 60)
    monkeypatch.setattr(pose_design, 'EFFORT', 300)


def planner_of(poses, counts=(24, 24), every=0, registration=0):
    cell = read_cell('demo')
    cell.poses = poses
    scene = cell.planning_scene(cell.chain())
    counts = {'optimization': counts[0], 'validation': counts[1]}
    if registration:
        counts['registration'] = registration
    planner = TourPlanner(scene, counts, 0, every, cell.design_settings())
    return planner, np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])


def planned(poses, counts=(24, 24), every=0, registration=0):
    planner, start = planner_of(poses, counts, every, registration)
    return planner.scene, plan_collection(planner, planner.rough_places, start)


@cache
def latin():
    """Return the plan of all poses of the hypercube, which nothing writes into."""
    return planned(PoseSettings(design=LATIN))


def of(plan, split):
    return [visit for visit in plan.visits if visit.split == split]


LATIN = 'latin_hypercube'


def test_a_cell_has_by_default_designed_poses_each_in_all_its_free_solutions_nearest_first():
    _, full_plan = latin()
    scene, plan = planned(PoseSettings())
    assert plan.design_result.reached
    assert plan.joint_rms <= max(full_plan.joint_rms, ENOUGH_RAD)
    assert plan.robot_time_s < full_plan.robot_time_s
    fitted, held_out = of(plan, 'optimization'), of(plan, 'validation')
    assert len({visit.pose for visit in fitted}) >= Floors().poses
    assert len({visit.pose for visit in held_out}) == min(
        HELD_OUT_POSES, full_plan.tour.poses['validation']
    )
    ways = scene.inverse_kinematics
    limits = scene.model.chain.velocity_limits
    for stop in stops(plan):
        # All that the arm can take and every sensor sees, in one go.
        T = plan.tour.plans[stop[0].split].poses[stop[0].pose].T_R_T
        free = plan_poses(ways, scene.model, T[None], scene.sights, scene.limit_margin_rad)
        (pose,) = free.poses
        visited = np.array([visit.q for visit in stop])
        assert len(visited) == len(pose.solutions)
        # Nearest to where the arm stands when the pose is published; a nearer one comes later only
        # where no free straight way led to it.
        nearest = order_solutions(visited, stop[0].points[0], limits).tolist()
        for number, visit in enumerate(stop):
            nearer = [i for i in nearest[: nearest.index(number)] if i > number]
            assert not any(
                is_straight_free(scene.model, visit.points[0], visited[i]) for i in nearer
            )
    assert len(stops(plan)) == len({(v.split, v.pose) for v in (*fitted, *held_out)})
    assert min(len(stop) for stop in stops(plan) if stop[0].split == 'optimization') >= 2


def stops(plan):
    """Return the visits of each pose that is no reference, next to each other."""
    measured = [visit for visit in plan.visits if visit.split in ('optimization', 'validation')]
    return [list(stop) for _, stop in groupby(measured, lambda visit: (visit.split, visit.pose))]


def test_chosen_solutions_reach_what_all_poses_reach_in_the_fewest_minutes_on_free_ways():
    _, full_plan = latin()
    stated = np.degrees(full_plan.joint_rms)
    assert stated < np.degrees(ENOUGH_RAD)
    poses = PoseSettings(solutions='chosen', order='fastest', joint_std_deg=stated)
    scene, plan = planned(poses)
    assert plan.joint_rms <= full_plan.joint_rms
    assert plan.robot_time_s < 0.7 * full_plan.robot_time_s
    fitted, held_out = of(plan, 'optimization'), of(plan, 'validation')
    poses = [visit.pose for visit in fitted]
    assert Floors().hold(np.array(poses))
    assert len(fitted) < len(of(full_plan, 'optimization'))
    assert len({visit.pose for visit in held_out}) == min(
        HELD_OUT_POSES, full_plan.tour.poses['validation']
    )
    assert max(np.bincount([visit.pose for visit in held_out])) <= HELD_OUT_SOLUTIONS
    for visit in plan.visits:
        for start, end in zip(visit.points, visit.points[1:]):
            assert is_straight_free(scene.model, start, end)
    for before, after in zip(plan.visits, plan.visits[1:]):
        np.testing.assert_array_equal(before.q, after.points[0])


def test_the_robot_time_is_that_of_the_whole_session():
    _, plan = planned(PoseSettings(), every=25, registration=12)
    by_split = Counter()
    for visit in plan.visits:
        by_split[visit.split] += visit.trajectory.duration_s + plan.measuring_s
    assert by_split.keys() == {'registration', 'optimization', 'validation', 'reference'}
    assert len(of(plan, 'registration')) == 3
    assert sum(by_split.values()) == pytest.approx(plan.robot_time_s)
    assert plan_to_dict(plan)['robot_time_s'] == pytest.approx(plan.robot_time_s, abs=0.1)
    assert 'robot time of the whole session' in plan_text(plan, DesignSettings(optimal=True))


def test_more_poses_are_drawn_where_too_few_can_be_taken_for_the_registration():
    planner, _ = planner_of(PoseSettings(), registration=1)
    tour = planner.registration()
    assert sum(tour.poses.values()) >= 3
    again, _ = planner_of(PoseSettings(), registration=1)
    for pose, other in zip(
        tour.plans['registration'].poses,
        again.registration().plans['registration'].poses,
        strict=True,
    ):
        np.testing.assert_array_equal(pose.T_R_T, other.T_R_T)


@pytest.mark.qualify
def test_the_time_without_looking_for_ways_is_that_of_the_plan():
    planner, start = planner_of(PoseSettings(), every=25, registration=12)
    plan = plan_collection(planner, planner.rough_places, start)
    tour = plan.tour.fork()
    # However far it is: what a planner that goes on states is the whole session too.
    for _ in range(3):
        start = tour.next(start).solutions[-1]
    assert session_time_s(planner, tour, start) == pytest.approx(plan.robot_time_s, rel=0.1)


def test_every_candidate_is_accounted_for():
    _, plan = planned(PoseSettings(design='optimal'))
    candidates = 24 + 60 + 24
    assert sum(plan.tour.poses.values()) + sum(plan.tour.dropped.values()) == candidates
    assert plan.tour.dropped[NOT_NEEDED] > 0


@pytest.mark.qualify
def test_the_fastest_order_of_the_same_configurations_takes_less_time():
    _, nearest = latin()
    _, fastest = planned(PoseSettings(design=LATIN, solutions='chosen', order='fastest'))
    assert fastest.tour.configurations == nearest.tour.configurations
    assert len(fastest.visits) + fastest.unreached == len(nearest.visits) + nearest.unreached
    assert fastest.robot_time_s < 0.9 * nearest.robot_time_s
    assert fastest.joint_rms == pytest.approx(nearest.joint_rms)


def test_the_fastest_order_of_whole_poses_visits_each_once():
    _, plan = planned(PoseSettings(design=LATIN, order='fastest'))
    found = [(stop[0].split, stop[0].pose) for stop in stops(plan)]
    assert len(found) == len(set(found)) == sum(plan.poses.values())


def test_a_stated_goal_is_reached_or_said_not_to_be():
    _, easy = planned(PoseSettings(design='optimal', joint_std_deg=0.01))
    assert easy.design_result.reached
    assert easy.goal_reached
    assert np.degrees(easy.joint_rms) <= 0.01
    _, hard = planned(PoseSettings(design='optimal', joint_std_deg=1e-4), counts=(8, 0))
    assert not hard.design_result.reached
    assert not hard.goal_reached


@pytest.mark.parametrize('few', [6, 11])
def test_a_goal_is_reached_by_what_free_ways_lead_to_alone(few, monkeypatch):
    """A design does not look at all ways: what a tour finds none to is not measured."""
    next_stop = Tour.next

    def lost(self, q):
        stop = next_stop(self, q)
        if stop is None or stop.split != 'optimization' or stop.index < few:
            return stop
        nothing = {'solutions': np.empty((0, len(q))), 'ids': (), 'paths': (), 'shares': ()}
        return replace(stop, **nothing, unreached=stop.ids)

    monkeypatch.setattr(Tour, 'next', lost)
    _, plan = planned(PoseSettings(design='optimal', joint_std_deg=0.01))
    assert plan.design_result.reached
    assert plan.unreached
    assert not plan.goal_reached
    assert not plan_to_dict(plan)['goal']['reached']
    assert missed_goal(plan).startswith('not reached: ')


def test_references_are_visited_between():
    _, plan = planned(PoseSettings(design='optimal', joint_std_deg=0.01), every=25)
    assert plan.tour.references >= 4
    assert len(of(plan, 'reference')) >= 3 * plan.tour.references


def test_looking_ahead_leaves_a_tour_as_it_is_and_begins_with_what_is_left_of_it():
    cell = read_cell('demo')
    scene = cell.planning_scene(cell.chain())
    counts = {'optimization': 6, 'validation': 3}
    planner = TourPlanner(scene, counts, 0, 5, cell.design_settings())
    start = np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])
    tour = planner.collection(planner.rough_places)
    full_forecast = look_ahead(planner, planner.rough_places, [tour], start)
    assert tour.visited == 0
    visited = []
    stop = tour.next(start)
    while len(visited) < 6:
        visited.append(stop)
        stop = tour.next(stop.solutions[-1])
    # The last one is under way, with its first solution measured.
    here, open_stop = stop.solutions[0], tour.with_route(stop, stop.ids[1:])
    done = sum(len(visit.ids) for visit in visited) + 1
    forecast = look_ahead(planner, planner.rough_places, [tour], here, open_stop)
    assert len(forecast.visits) == len(full_forecast.visits) - done
    for visit, other in zip(
        forecast.visits[len(open_stop.ids) :], full_forecast.visits[done + len(open_stop.ids) :]
    ):
        assert (visit.split, visit.pose) == (other.split, other.pose)
    assert tour.visited == 7
    # What the fit will state depends on all of it.
    assert forecast.joint_std == full_forecast.joint_std


def test_a_verification_has_ten_poses_off_and_on_in_random_order_that_no_collection_has():
    planner, _ = planner_of(PoseSettings(design=LATIN))
    tour = planner.verification()
    assert tour.inspection == 'verify'
    visits, q = [], np.zeros(len(planner.model.chain))
    while (stop := tour.next(q)) is not None:
        visits.append(stop)
        q = stop.solutions[-1]
    assert len(visits) == 20
    assert {visit.split for visit in visits} == {'validation'}
    pairs = list(zip(visits[::2], visits[1::2]))
    first = [twin.correction for twin, _ in pairs]
    assert {'on', 'off'} == set(first)
    for twin, other in pairs:
        assert {twin.correction, other.correction} == {'on', 'off'}
        np.testing.assert_array_equal(twin.solutions, other.solutions)
        # The arm stands there already, as far as it is planned.
        assert [len(way) for way in other.paths] == [0]
    wanted = np.concatenate([twin.solutions for twin, _ in pairs])
    assert len(np.unique(wanted, axis=0)) == 10
    collected = planner.collection(planner.rough_places)
    assert collected.inspection == ''
    used = [q for plan in collected.plans.values() for pose in plan.poses for q in pose.solutions]
    distances = np.max(np.abs(wanted[:, None] - np.array(used)), axis=2)
    assert distances.min() > 0.02
    # Of a seed the same, of another one others.
    again = planner.verification()
    assert fingerprint(again) == fingerprint(planner.verification()) != fingerprint(collected)
    other = TourPlanner(planner.scene, {}, 1, 0, planner.design).verification()
    orders = [[p.correction for p in t.plans['validation'].poses] for t in (again, other)]
    assert orders[0] != orders[1]


def test_a_design_stays_in_one_part_of_what_is_free(monkeypatch):
    """Two halves without a way between: each configuration has neighbours of its own half."""
    sides = []

    def way_in_a_half(model, q, goal, limits, seed):
        sides.append(q[3] > 0)
        return goal[None] if (q[3] > 0) == (goal[3] > 0) else None

    monkeypatch.setattr(planned_design, 'free_waypoints', way_in_a_half)
    planner, _ = planner_of(PoseSettings())
    planner.collection(planner.rough_places)
    poses = planner.design_result.plans['optimization'].poses
    assert {True, False} == set(sides)
    assert len({q[3] > 0 for pose in poses for q in pose.solutions}) == 1
    assert planner.design_result.reached
