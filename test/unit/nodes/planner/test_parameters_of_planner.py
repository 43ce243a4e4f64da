# SPDX-License-Identifier: Apache-2.0
"""What the planner's plan depends on."""

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from remaster_ros.errors import InputError
from remaster_ros.nodes.planner.parameters import Parameters
from remaster_ros.planning import tour_planner
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.session.cells.workcell import read_cell

pytestmark = pytest.mark.ros

CAUSE = FoundCause(
    'encoder_scale', (6,), {'scale_6': 1e-3}, (('encoder_eccentricity', (6,), 'range'),)
)


def test_a_plan_that_separates_other_causes_is_another_plan():
    cell = read_cell('demo')
    plain = Parameters().plan_settings(cell, ())
    # As in plans of before.
    assert 'separate' not in plain
    given = Parameters().plan_settings(cell, (CAUSE,))
    assert {key: value for key, value in given.items() if key != 'separate'} == plain
    assert "'encoder_scale'" in given['separate']


def test_the_parameters_make_what_plans_the_tours(tmp_path, monkeypatch):
    monkeypatch.setattr(tour_planner, 'POOL_CANDIDATES', 30)
    cell = read_cell('demo')
    chain = cell.chain()
    parameters = Parameters(optimization_candidates=20, validation_candidates=0, reference_every=0)
    assert parameters.causes(()) == ()
    planner = parameters.tour_planner(cell, chain, (CAUSE,))
    tour = planner.collection(planner.rough_places)
    plain = parameters.tour_planner(cell, chain, ()).collection(planner.rough_places)
    added = sum(len(pose.solutions) for pose in planner.separating_design.poses)
    assert 0 < added <= 25
    assert tour.configurations['optimization'] == plain.configurations['optimization'] + added
    with pytest.raises(InputError, match=r'none\.json'):
        Parameters(separate=str(tmp_path / 'none.json')).causes(())
