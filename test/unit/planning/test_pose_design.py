# SPDX-License-Identifier: Apache-2.0
"""The choice of configurations: what is wanted is reached, in less time, with the floors kept."""

from functools import cache

import numpy as np
import pytest

from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.expected_sensors import ExpectedSensor
from remaster_ros.planning.pose_design import Floors, Goal, choose
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()
SCENE = CELL.planning_scene(CHAIN)
TRAVEL = TravelTime.of(SCENE.model)
BODY = {'a': np.array([0.1, 0, 0]), 'b': np.array([-0.1, 0, 0]), 'c': np.array([0, 0.1, 0.06])}
SENSOR = ExpectedSensor('bar', np.array([1.9, 0, 1.3]), BODY)
LHS = SCENE.plan(20, SCENE.rough_R, np.random.default_rng(1)).poses
POOL = (*LHS, *SCENE.plan(60, SCENE.rough_R, np.random.default_rng(2)).poses)
INFORMATION = DesignInformation.of(CHAIN, POOL, [SENSOR], 0.5e-3)
COUNT = sum(len(pose.solutions) for pose in LHS)
REFERENCE = range(COUNT)
JOINTS, TOOL = INFORMATION.joint_rms(REFERENCE), INFORMATION.tool_rms(REFERENCE)


@cache
def chosen(goal, seed=0, whole_poses=False, **kwargs):
    rng = np.random.default_rng(seed)
    given = {'exchanges': 20, 'whole_poses': whole_poses, **kwargs}
    return choose(INFORMATION, TRAVEL, goal, rng, **given)


@pytest.mark.parametrize('share', [0.0, 0.5])
def test_whole_poses_reach_what_is_wanted_each_with_all_its_solutions(share):
    design = chosen(Goal(JOINTS, TOOL, share), whole_poses=True)
    assert design.reached
    assert INFORMATION.joint_rms(design.chosen) <= JOINTS
    assert len(design.chosen) < COUNT
    pose = INFORMATION.pose
    poses = np.unique(pose[list(design.chosen)])
    assert sorted(design.chosen) == np.flatnonzero(np.isin(pose, poses)).tolist()
    assert Floors().hold(pose[list(design.chosen)])


def test_information_of_whole_poses_is_that_of_their_configurations():
    poses, members = INFORMATION.whole_poses()
    assert sorted(np.concatenate(members)) == list(range(len(INFORMATION)))
    indices = [0, 3, 7]
    configurations = np.concatenate([members[i] for i in indices])
    np.testing.assert_allclose(
        poses.total(indices), INFORMATION.total(configurations), rtol=1e-9, atol=1e-12
    )


def test_beyond_the_goal_the_floors_are_filled_with_the_cheapest_poses():
    """With a goal that three poses reach, the others are those with few solutions."""
    design = chosen(Goal(1.2 * JOINTS, TOOL), whole_poses=True, floors=Floors(12, 12))
    pose, count = np.unique(INFORMATION.pose[list(design.chosen)], return_counts=True)
    assert len(pose) >= 12
    assert count.min() >= 2
    every = np.bincount(INFORMATION.pose)
    assert np.mean(count) < np.mean(every[every > 1])


def test_the_same_precision_takes_fewer_configurations_with_the_floors_kept():
    design = chosen(Goal(JOINTS, TOOL))
    assert design.reached
    assert INFORMATION.joint_rms(design.chosen) <= JOINTS
    assert len(design.chosen) < 0.8 * COUNT
    assert len(set(design.chosen)) == len(design.chosen)
    assert Floors().hold(INFORMATION.pose[list(design.chosen)])


@pytest.mark.qualify
def test_the_same_seed_chooses_the_same():
    goal = Goal(JOINTS, TOOL)
    assert chosen(goal, 3) == chosen.__wrapped__(goal, 3)


def test_what_counts_for_the_tool_is_not_what_counts_for_the_joints():
    for_joints = chosen(Goal(JOINTS, TOOL)).chosen
    for_tool = chosen(Goal(JOINTS, TOOL, 1.0)).chosen
    both = chosen(Goal(JOINTS, TOOL, 0.5)).chosen
    assert INFORMATION.tool_rms(for_tool) <= TOOL
    assert INFORMATION.joint_rms(for_tool) > JOINTS
    assert len(for_tool) < len(for_joints)
    assert INFORMATION.joint_rms(both) <= JOINTS
    assert INFORMATION.tool_rms(both) <= TOOL


def test_floors_cost_configurations_that_the_offsets_do_not_need():
    goal = Goal(4 * JOINTS, TOOL)
    bare = chosen(goal, floors=Floors(0, 0))
    floored = chosen(goal)
    pose = INFORMATION.pose[list(floored.chosen)]
    assert len(np.unique(INFORMATION.pose[list(bare.chosen)])) < Floors().poses
    assert len(np.unique(pose)) == Floors().poses
    assert np.sum(np.bincount(pose) > 1) == Floors().repeated
    assert len(floored.chosen) == Floors().poses + Floors().repeated > len(bare.chosen)


def test_a_goal_out_of_reach_is_said_to_be():
    design = chosen(Goal(JOINTS / 100, TOOL), most=30)
    assert not design.reached
    assert len(design.chosen) == 30


@pytest.mark.parametrize('whole_poses', [False, True])
@pytest.mark.parametrize('count', [1, 3])
def test_few_candidates_are_all_there_is(count, whole_poses):
    few = INFORMATION.only(np.arange(count))
    goal, rng = Goal(JOINTS, TOOL), np.random.default_rng(0)
    design = choose(few, TRAVEL, goal, rng, whole_poses=whole_poses)
    assert not design.reached
    assert sorted(design.chosen) == list(range(count))


@pytest.mark.parametrize(
    ('share', 'words'),
    [
        (0.0, '1e-07 deg for the offsets'),
        (0.5, '1e-07 deg for the offsets and 0.15 mm for the tool'),
        (1.0, '0.15 mm for the tool'),
    ],
)
def test_a_goal_names_what_counts(share, words):
    assert Goal(np.radians(1e-7), 0.15e-3, share).describe() == words
