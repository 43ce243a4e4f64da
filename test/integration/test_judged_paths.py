"""Moves as the planner plans them, judged by what shares nothing with its checks.

The kinematics are pinocchio's, the distances FCL's on triangles; sampled at 1 mm, bodies grown by
half of that. Two cells, in make qualify all twelve.
"""

import numpy as np
import pytest

pytest.importorskip('fcl', reason='needs the judge: pip install python-fcl')
pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from path_cells import SPECS, make_cell
from path_judges import collides
from planned_moves import tours

SOON = 'LWR 4+, low, 250 mm tool, boxes'
CELLS = [
    pytest.param(spec, id=spec.name, marks=() if spec.name == SOON else pytest.mark.qualify)
    for spec in SPECS
]


@pytest.fixture(scope='module', params=CELLS)
def judged(request, tmp_path_factory):
    return make_cell(request.param, tmp_path_factory.mktemp('cell'))


def test_no_move_hits_anything(judged):
    cell, judge = judged
    moves, _, _, *_ = tours(cell, range(1), candidates=60 if 'probe' in cell.tool else 45)
    assert len(moves) >= (50 if 'probe' in cell.tool else 150)
    assert [i for i, path in enumerate(moves) if collides(judge, path)[0]] == []


def test_the_judge_finds_what_is_there(judged):
    """Else the test above could not fail: straight through the floor, and back."""
    cell, judge = judged
    chain = cell.chain()
    down = np.zeros(len(chain))
    down[1] = np.deg2rad(119.0)
    assert judge.distance(np.zeros(len(chain))) > 0.01
    assert collides(judge, np.array([np.zeros(len(chain)), down]))[0]
    assert not collides(judge, np.array([np.zeros(len(chain)), 0.3 * down]))[0]
