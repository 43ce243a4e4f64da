# SPDX-License-Identifier: Apache-2.0
"""A demo of few candidates has enough poses to fit, whatever its seed."""

import numpy as np
import pytest

from remaster_ros.demo.demo import TO_FIT, enough_candidates
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.cells.workcell import read_cell


@pytest.mark.parametrize('asked', [1, 5])
def test_a_demo_of_few_candidates_takes_as_many_as_leave_enough_poses(asked):
    cell = read_cell('demo')
    scene = cell.planning_scene(cell.chain())
    taken = []
    for seed in range(20):
        taken.append(enough_candidates(cell, seed, asked))
        assert TourPlanner(scene, {'optimization': taken[-1]}, seed).usable_to_fit >= TO_FIT
    assert max(taken) > asked
    assert np.median(taken) < asked + 6


def test_a_demo_that_has_enough_takes_what_was_asked():
    assert enough_candidates(read_cell('demo'), 10, 5) == 5
    assert enough_candidates(read_cell('quick'), 0, 30) == 30


def test_a_cell_that_never_has_enough_is_left_to_its_planner(monkeypatch):
    monkeypatch.setattr('remaster_ros.demo.demo.MOST_CANDIDATES', 6)
    cell = read_cell('demo')
    for sensor in cell.sensors.values():
        sensor.rough_position_m = (0.0, 0.0, -3.0)
    assert enough_candidates(cell, 0, 5) == 5
