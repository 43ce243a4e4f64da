# SPDX-License-Identifier: Apache-2.0
"""Moves as the planner plans them, judged by what shares nothing with its checks.

The kinematics are pinocchio's, the distances FCL's on triangles; sampled at 1 mm, bodies grown by
half of that. Two cells, in make qualify all twelve.
"""

import numpy as np
import pytest

pytest.importorskip('fcl', reason='needs the judge: pip install python-fcl')
pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from judges.paths import collides
from worlds.path_cells import SPECS, make_cell

from remaster_ros.planning.tour_planner import TourPlanner

# The judge takes minutes of processor time for a cell, which is shared with other tests.
pytestmark = pytest.mark.timeout(3600)
SOON = 'LWR 4+, low, 250 mm tool, boxes'
CELLS = [
    pytest.param(spec, id=spec.name, marks=() if spec.name == SOON else pytest.mark.qualify)
    for spec in SPECS
]


@pytest.fixture(scope='module', params=CELLS)
def judged(request, tmp_path_factory):
    return make_cell(request.param, tmp_path_factory.mktemp('cell'))


def moves_of_a_tour(cell, candidates):
    """Return every move (n, k) of a tour as the planner node plans it."""
    chain = cell.chain()
    counts = {'registration': 3, 'optimization': candidates, 'validation': candidates}
    T_R_N = {}
    for name, sensor in cell.sensors.items():
        T_R_N[name] = np.eye(4)
        T_R_N[name][:3, 3] = sensor.rough_position_m
    planner = TourPlanner(cell.planning_scene(chain), counts, 0)
    tour = planner.collection(T_R_N)
    here = np.clip(np.zeros(len(chain)), chain.lower, chain.upper)
    if planner.model.trouble(here):
        here = next(iter(tour.plans['optimization'].poses)).solutions[0]
    moves = []
    while (stop := tour.next(here)) is not None:
        for way, solution in zip(stop.paths, stop.solutions):
            moves.append(np.vstack((here, way, solution)))
            here = solution
    return moves


def test_no_move_hits_anything(judged):
    cell, judge = judged
    few, enough = (60, 50) if 'probe' in cell.tool else (45, 120)
    moves = moves_of_a_tour(cell, few)
    if len(moves) < enough:
        # Low poses beside boxes are mostly out of reach.
        moves = moves_of_a_tour(cell, 160)
    assert len(moves) >= enough
    assert [i for i, path in enumerate(moves) if collides(judge, path)[0]] == []


# Where joint 2 has the arm upright, degrees, and what it then has around it at least, m. At zero
# the 6R lies level and in the floor; its shoulder passes its base at 1 mm.
UPRIGHT = {'six': (-90.0, 0.9e-3)}


def test_the_judge_finds_what_is_there(judged):
    """Else the test above could not fail: from upright straight through the floor, and back."""
    cell, judge = judged
    chain = cell.chain()
    joint_2_deg, room_m = UPRIGHT.get(chain.name, (0.0, 0.01))
    upright, down = np.zeros((2, len(chain)))
    upright[1] = np.deg2rad(joint_2_deg)
    down[1] = np.deg2rad(119.0)
    assert judge.distance(upright) > room_m
    assert collides(judge, np.array([upright, upright + down]))[0]
    assert not collides(judge, np.array([upright, upright + 0.3 * down]))[0]
