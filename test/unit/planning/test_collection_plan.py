"""A whole collection before it begins: designs and orders of a cell, every way of them free."""

import numpy as np
import pytest

from remaster_ros.kinematics.free_paths import is_straight_free
from remaster_ros.kinematics.transforms import transform
from remaster_ros.planning import planned_design, pose_design
from remaster_ros.planning.collection_plan import look_ahead, plan_collection
from remaster_ros.planning.planned_design import NOT_NEEDED
from remaster_ros.planning.pose_design import HELD_OUT_POSES, HELD_OUT_SOLUTIONS, Floors
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.cell_poses import CellPoses
from remaster_ros.session.workcell import read_cell


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(planned_design, 'POOL_CANDIDATES', 60)
    monkeypatch.setattr(pose_design, 'EFFORT', 300)


def planned(poses, counts=(24, 24), every=0):
    cell = read_cell('demo')
    cell.poses = poses
    chain = cell.chain()
    scene = cell.planning_scene(chain)
    counts = {'optimization': counts[0], 'validation': counts[1]}
    planner = TourPlanner(scene, counts, 0, every, cell.design_settings())
    places = {name: transform(np.eye(3), origin) for name, origin in scene.rough_R.items()}
    start = np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])
    return scene, plan_collection(planner, places, start)


def of(plan, split):
    return [visit for visit in plan.visits if visit.split == split]


def test_an_optimal_design_reaches_what_all_poses_reach_in_less_time_on_free_ways():
    _, whole = planned(CellPoses())
    scene, plan = planned(CellPoses(design='optimal', order='fastest'))
    assert plan.joint_rms <= whole.joint_rms
    assert plan.robot_time_s < 0.7 * whole.robot_time_s
    fitted, held_out = of(plan, 'optimization'), of(plan, 'validation')
    poses = [visit.pose for visit in fitted]
    assert Floors().hold(np.array(poses))
    assert len(fitted) < len(of(whole, 'optimization'))
    assert len({visit.pose for visit in held_out}) == min(
        HELD_OUT_POSES, whole.tour.poses['validation']
    )
    assert max(np.bincount([visit.pose for visit in held_out])) <= HELD_OUT_SOLUTIONS
    for visit in plan.visits:
        for start, end in zip(visit.points, visit.points[1:]):
            assert is_straight_free(scene.model, start, end)
    for before, after in zip(plan.visits, plan.visits[1:]):
        np.testing.assert_array_equal(before.q, after.points[0])


def test_every_candidate_is_accounted_for():
    _, plan = planned(CellPoses(design='optimal'))
    candidates = 24 + 60 + 24
    assert sum(plan.tour.poses.values()) + sum(plan.tour.dropped.values()) == candidates
    assert plan.tour.dropped[NOT_NEEDED] > 0


def test_the_fastest_order_of_the_same_poses_takes_less_time():
    _, nearest = planned(CellPoses())
    _, fastest = planned(CellPoses(order='fastest'))
    assert fastest.tour.configurations == nearest.tour.configurations
    assert len(fastest.visits) + fastest.unreached == len(nearest.visits) + nearest.unreached
    assert fastest.robot_time_s < 0.9 * nearest.robot_time_s
    assert fastest.joint_rms == pytest.approx(nearest.joint_rms)


def test_a_stated_goal_is_reached_or_said_not_to_be():
    _, easy = planned(CellPoses(design='optimal', joint_std_deg=0.01))
    assert easy.designed.reached
    assert np.degrees(easy.joint_rms) <= 0.01
    _, hard = planned(CellPoses(design='optimal', joint_std_deg=1e-4), counts=(8, 0))
    assert not hard.designed.reached


def test_references_are_visited_between():
    _, plan = planned(CellPoses(design='optimal', joint_std_deg=0.01), every=25)
    assert plan.tour.references >= 4
    assert len(of(plan, 'reference')) >= 3 * plan.tour.references


def test_looking_ahead_leaves_a_tour_as_it_is_and_begins_with_what_is_left_of_it():
    cell = read_cell('demo')
    scene = cell.planning_scene(cell.chain())
    counts = {'optimization': 6, 'validation': 3}
    planner = TourPlanner(scene, counts, 0, 5, cell.design_settings())
    start = np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])
    tour = planner.collection(planner.rough_places)
    whole = look_ahead(planner, planner.rough_places, [tour], start)
    assert tour.visited == 0
    visited = []
    stop = tour.next(start)
    while len(visited) < 6:
        visited.append(stop)
        stop = tour.next(stop.solutions[-1])
    # The last one is under way, with its first solution measured.
    here, rest = stop.solutions[0], stop.only(stop.ids[1:])
    done = sum(len(one.ids) for one in visited) + 1
    left = look_ahead(planner, planner.rough_places, [tour], here, rest)
    assert len(left.visits) == len(whole.visits) - done
    for one, other in zip(left.visits[len(rest.ids) :], whole.visits[done + len(rest.ids) :]):
        assert (one.split, one.pose) == (other.split, other.pose)
    assert tour.visited == 7
    # What the fit will state depends on all of it.
    assert left.joint_std == whole.joint_std
