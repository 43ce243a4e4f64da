# SPDX-License-Identifier: Apache-2.0
"""The way that the bridge finds beside its callbacks: straight, the planner's, around, or none."""

import functools

import numpy as np
import pytest
from worlds.simple_cells import write_cell

from remaster_ros.motion.actions import CheckPath
from remaster_ros.motion.path_check import PointSpeeds
from remaster_ros.motion.path_search import PathSearch, beside_chords_m
from remaster_ros.session.cells.workcell import read_cell

CHAIN = read_cell('demo').chain()
ARM = np.array([0.0, 0.9, 0.0, 1.2, 0.0, 0.3, 0.0])
TOOL = CHAIN.forward(ARM)[:3, 3]
POST = {'center_m': [*TOOL[:2].tolist(), 0.35], 'size_m': [0.06, 0.06, 0.7]}


def turned(q1, q2=0.9):
    q = ARM.copy()
    q[:2] = q1, q2
    return q


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return a function that returns the model, the speeds and the search among obstacles."""

    @functools.cache
    def make(name):
        tool = TOOL.tolist()
        obstacles = {
            'nothing': {},
            'post': {'post': POST},
            # Nearer to the tool than is kept; and all around it.
            'near': {'slab': {'center_m': [*tool[:2], tool[2] + 0.15], 'size_m': [0.2, 0.2, 0.1]}},
            'around': {'block': {'center_m': tool, 'size_m': [0.9, 0.9, 0.9]}},
        }[name]
        path = tmp_path_factory.mktemp('cell') / 'cell.yaml'
        model = read_cell(write_cell(path, obstacles=obstacles)).collision_model(CHAIN)
        speeds = PointSpeeds(CHAIN, model.extent_points)
        return model, speeds, PathSearch(model, speeds)

    return make


def ask(search, start, target, *waypoints):
    ways = np.reshape(np.array(waypoints, float), (-1, len(start)))
    return search.find(CheckPath(7, start, target, ways))


def is_path(path, points, speeds):
    np.testing.assert_array_equal(path.points, points)
    assert path.peaks_m == speeds.peaks_m(path.points)
    assert not path.way_out
    return True


def test_a_free_way_is_taken_as_it_is(scene):
    _, speeds, search = scene('nothing')
    answer = ask(search, turned(-0.8), turned(0.8))
    assert is_path(answer.path, [turned(-0.8), turned(0.8)], speeds)
    assert (answer.why, answer.at_start, answer.way_out) == ('', False, None)


def test_the_planners_waypoints_are_gone_through_in_their_order(scene):
    _, speeds, search = scene('post')
    ways = turned(-0.8, 0.0), turned(0.8, 0.0)
    answer = ask(search, turned(-0.8), turned(0.8), *ways)
    assert is_path(answer.path, [turned(-0.8), *ways, turned(0.8)], speeds)


def test_where_it_is_not_free_another_way_is_found(scene):
    model, speeds, search = scene('post')
    straight = np.array([turned(-0.8), turned(0.8)])
    assert 'post' in model.path_trouble(straight)
    answer = ask(search, *straight)
    assert len(answer.path.points) > 2
    np.testing.assert_array_equal(answer.path.points[[0, -1]], straight)
    assert not model.path_trouble(answer.path.points)
    assert is_path(answer.path, answer.path.points, speeds)
    assert (answer.why, answer.at_start, answer.way_out) == ('', False, None)
    # The same question has the same answer.
    assert is_path(ask(search, *straight).path, answer.path.points, speeds)


def test_the_planners_waypoints_are_tried_one_by_one_too(scene, monkeypatch):
    """All of them together lead through the post; one of them alone does not."""
    model, _, search = scene('post')
    seen = []
    from remaster_ros.motion import path_search

    def free_path(model, start, end, rng, hints=()):
        seen.extend(hints)
        assert isinstance(rng, np.random.Generator)
        return None

    monkeypatch.setattr(path_search, 'free_path', free_path)
    bad, good = turned(0.0), turned(0.8, 0.0)
    answer = ask(search, turned(-0.8), turned(0.8), bad, good)
    np.testing.assert_array_equal(seen, [bad, good])
    assert answer.path is None
    assert answer.why == model.path_trouble(np.array([turned(-0.8), bad, good, turned(0.8)]))


def test_a_target_that_is_not_free_has_no_way(scene):
    _, _, search = scene('post')
    answer = ask(search, turned(-0.8), turned(0.0))
    assert answer.path is None
    assert 'post' in answer.why
    assert (answer.at_start, answer.way_out) == (False, None)


def test_an_arm_that_stands_too_near_is_offered_a_slow_way_out(scene):
    model, speeds, search = scene('near')
    answer = ask(search, ARM, turned(0.8))
    assert answer.path is None
    assert answer.at_start
    assert answer.why == model.trouble(ARM)
    assert 'slab' in answer.why
    way = answer.way_out
    assert way.way_out
    np.testing.assert_array_equal(way.points[0], ARM)
    assert not model.trouble(way.points[-1])
    assert way.peaks_m == speeds.peaks_m(way.points)
    assert all(peak > 0.0 for peak in way.peaks_m)


def test_an_arm_that_is_too_deep_in_is_offered_none(scene):
    _, _, search = scene('around')
    answer = ask(search, ARM, ARM)
    assert (answer.path, answer.at_start, answer.way_out) == (None, True, None)
    assert 'block' in answer.why


def on_curve(search, start, through, target):
    """Ask for the curve that begins at the first of the configurations to go through."""
    shares = np.linspace(0.0, 1.0, len(through) + 1)[:-1]
    return search.find(CheckPath(7, start, target, np.array(through), shares))


THROUGH = [turned(0.0), turned(0.3, 0.8), turned(0.5), turned(0.2, 0.7), turned(-0.2)]


def test_a_free_curve_is_the_path(scene):
    _, speeds, search = scene('nothing')
    # The servo has left it a little off.
    start = turned(0.0) + 1e-3
    path = on_curve(search, start, THROUGH, turned(-0.1, 0.8)).path
    curve = path.curve
    assert curve is not None
    np.testing.assert_array_equal(path.points[[0, -1]], [start, turned(-0.1, 0.8)])
    np.testing.assert_allclose(curve.at(curve.knots[2:-2]), THROUGH[1:], atol=1e-12)
    shares = np.linspace(0.0, 1.0, 2000)
    fastest = speeds.fastest(curve.at(shares), curve.at(shares, 1))
    assert path.peaks_m == pytest.approx((np.max(fastest),), rel=5e-3)


def test_a_curve_through_an_obstacle_or_too_near_to_it_is_not_gone(scene):
    model, _, search = scene('post')
    start, target = turned(-0.9), turned(0.9)
    path = on_curve(search, start, [start, turned(-0.4), turned(0.4)], target).path
    assert path.curve is None
    assert model.path_trouble(path.points) == ''
    np.testing.assert_array_equal(path.points[[0, -1]], [start, target])
    # Between the samples a body may be so far beside the chords, which counts as clearance.
    assert beside_chords_m(model) == model.travel(np.zeros(7), np.full(7, 2e-4)) > 0.0


def test_an_arm_that_stands_elsewhere_goes_straight(scene):
    _, _, search = scene('nothing')
    start = turned(0.1)
    path = on_curve(search, start, THROUGH, turned(-0.1)).path
    assert path.curve is None
    np.testing.assert_array_equal(path.points, [start, turned(-0.1)])
