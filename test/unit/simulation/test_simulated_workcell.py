# SPDX-License-Identifier: Apache-2.0
"""The parts of a simulated workcell: robot, sensors, placement, order of the visits."""

from pathlib import Path

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.planning.candidates import order_solutions
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation import simulated_tour, simulated_workcell
from remaster_ros.simulation.truth import SimulatedSensor, place_sensor

ROOT = Path(__file__).parents[3]
MIDDLE = np.array([0.0, 0.0, 0.6])


@pytest.fixture
def cell():
    return read_cell('demo')


def place_all(cell, seed):
    rng = np.random.default_rng(seed)
    return {
        name: SimulatedSensor(
            sensor.marker,
            place_sensor(sensor.rough_position_m, MIDDLE, simulated_workcell.PLACEMENT_STD_M, rng),
        )
        for name, sensor in cell.sensors.items()
    }


def test_a_shipped_robot_goes_by_its_name_and_keeps_the_held_joint(cell):
    chain = simulated_workcell.choose_robot(cell, 'iiwa14', None, None)
    assert chain.name == 'iiwa14'
    assert 'iiwa14' in cell.urdf_text
    assert list(cell.held(chain)) == [2]


def test_any_urdf_goes_by_its_path_with_the_links_asked_for(cell):
    path = ROOT / 'config/robots/iiwa7.urdf'
    chain = simulated_workcell.choose_robot(cell, str(path), 'base_link', 'link_6')
    assert len(chain) == 6
    assert chain.tip_link == 'link_6'
    # Six joints leave none to hold.
    assert cell.held(chain) is None


def test_an_unknown_robot_is_refused_with_the_names_there_are(cell):
    with pytest.raises(InputError, match='one of iiwa14, iiwa7, lwr4plus'):
        simulated_workcell.choose_robot(cell, 'nix', None, None)


def test_a_urdf_that_is_none_is_named(cell, tmp_path):
    path = tmp_path / 'robot.urdf'
    path.write_text('<robot name="x">')
    with pytest.raises(InputError, match=r'robot\.urdf: '):
        simulated_workcell.choose_robot(cell, str(path), None, None)


def test_the_tool_faces_a_sensor_that_is_there(cell):
    simulated_workcell.choose_sensors(cell, ('mocap',))
    assert list(cell.sensors) == ['mocap']
    assert cell.aim_at == 'mocap'
    with pytest.raises(InputError, match=r"no sensor 'sonar' in the cell \(mocap\)"):
        simulated_workcell.choose_sensors(cell, ('sonar',))


def test_sensors_stand_near_their_rough_place_and_look_at_the_workspace(cell):
    """Five std of the placement; another seed gives another place."""
    for name, sensor in place_all(cell, 3).items():
        T, rough = sensor.T_R_N, np.array(cell.sensors[name].rough_position_m)
        assert np.all(np.abs(T[:3, 3] - rough) < 5 * simulated_workcell.PLACEMENT_STD_M)
        to_middle = MIDDLE - T[:3, 3]
        np.testing.assert_allclose(T[:3, 2], to_middle / np.linalg.norm(to_middle), atol=1e-12)
    assert not np.allclose(
        place_all(cell, 3)['mocap'].T_R_N, place_all(cell, 4)['mocap'].T_R_N, atol=1e-3
    )


@pytest.fixture
def planned(cell):
    chain = cell.chain()
    counts = {'optimization': 12, 'validation': 6}
    sensors = place_all(cell, 5)
    places = {name: sensor.T_R_N for name, sensor in sensors.items()}
    tour = simulated_tour.plan_tour(chain, cell, places, counts, np.random.default_rng(5))
    return chain, sensors, tour


def test_every_planned_solution_is_visited_nearest_first(planned):
    chain, _, tour = planned
    visits = simulated_tour.visit(tour, chain)
    q = np.zeros(len(chain))
    for split, poses in visits.items():
        assert len(poses) == tour.poses[split] > 0
        assert sum(map(len, poses)) == tour.configurations[split]
        for solutions in poses:
            order = order_solutions(solutions, q, chain.velocity_limits)
            np.testing.assert_array_equal(order, np.arange(len(solutions)))
            tools = chain.forward(solutions)
            np.testing.assert_allclose(tools, np.broadcast_to(tools[0], tools.shape), atol=1e-7)
            q = solutions[-1]


def test_the_tool_faces_the_sensor_it_aims_at(planned):
    chain, sensors, tour = planned
    for poses in simulated_tour.visit(tour, chain).values():
        for solutions in poses:
            T = chain.forward(solutions[0])
            line = sensors['tracker'].T_R_N[:3, 3] - T[:3, 3]
            np.testing.assert_allclose(T[:3, 2], line / np.linalg.norm(line), atol=1e-6)


def test_ranges_out_of_reach_are_refused(cell):
    cell.poses.radius_m = (4.0, 5.0)
    with pytest.raises(InputError, match=r'dropped poses: 5 out of reach: no pose is left'):
        simulated_tour.plan_tour(
            cell.chain(),
            cell,
            {name: sensor.T_R_N for name, sensor in place_all(cell, 1).items()},
            {'optimization': 5, 'validation': 0},
            np.random.default_rng(1),
        )
