# SPDX-License-Identifier: Apache-2.0
"""The configurations of a check: chosen, written, read again, and refused where they are none."""

import numpy as np
import pytest
from worlds.sliding_cells import rail, sliding_cell

from remaster_ros.compensation.check_visits import CHECK_POSES, chosen_visits, read_visits
from remaster_ros.errors import InputError
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()


@pytest.fixture(scope='module')
def planner():
    scene = CELL.planning_scene(CHAIN)
    return TourPlanner(scene, {}, 0, travel=TravelTime.of(scene.model))


@pytest.fixture(scope='module')
def visits(planner):
    poses = planner.verification().plans['validation'].poses
    q = np.array([pose.solutions[0] for pose in poses[::2]])
    return chosen_visits(CELL, CHAIN, q, planner.travel, np.random.default_rng(1))


def test_what_was_written_is_visited_in_its_order_and_expected_alike(planner, visits, tmp_path):
    path = tmp_path / 'check.csv'
    path.write_text(visits.table())
    again = read_visits(path, CELL, CHAIN)
    np.testing.assert_allclose(again.q, visits.q, atol=1e-7)
    # The lever of a joint is its RMS over what there was to choose from.
    np.testing.assert_allclose(again.detectable_m, visits.detectable_m, rtol=0.3)
    assert np.isnan(again.detectable_m[0])
    assert again.expected()[0] == 'joint_1: none: looks like a sensor that was moved'
    assert again.noise_m == visits.noise_m > 0.0
    # From each the nearest in time of those that are left.
    between = planner.travel.between(visits.q)
    assert all(between[i, i + 1] == between[i, i + 1 :].min() for i in range(CHECK_POSES - 1))
    seconds = visits.seconds(planner.travel)
    ways = sum(between[i, i + 1] for i in range(CHECK_POSES - 1))
    assert abs(seconds - ways - 8 * 3.5) < 1e-9
    assert visits.too_long(seconds) == ''
    assert 'more than the 90 s' in visits.too_long(91.0)

    tour, q, seen = planner.check(again.q), np.array(again.q[0]), []
    assert tour.inspection == 'check'
    while (stop := tour.next(q)) is not None:
        q = stop.solutions[-1]
        seen.append(q)
        assert (stop.split, stop.correction) == ('validation', '')
    np.testing.assert_array_equal(seen, again.q)


def test_a_slide_of_a_check_is_written_and_read_in_mm(tmp_path):
    options = {'held_joint': 'rail', 'held_values_deg': [], 'held_values_m': [-0.3, 0.3]}
    cell = read_cell(sliding_cell(tmp_path, rail(), **options))
    chain = cell.chain()
    scene = cell.planning_scene(chain)
    poses = scene.plan(60, scene.rough_R, np.random.default_rng(2)).poses
    q = np.array([pose.solutions[0] for pose in poses])
    visits = chosen_visits(cell, chain, q, None, np.random.default_rng(1))
    path = tmp_path / 'check.csv'
    path.write_text(visits.table())
    assert visits.table().startswith('rail [mm],joint_1 [deg],')
    again = read_visits(path, cell, chain)
    np.testing.assert_allclose(again.q, visits.q, atol=1e-8)
    assert set(np.abs(again.q[:, 0]).round(9)) == {0.3}
    planner = TourPlanner(scene, {}, 0, travel=TravelTime.of(scene.model))
    assert planner.check(again.q).inspection == 'check'


def test_an_arm_that_cannot_stand_at_a_configuration_is_sent_to_none(planner):
    bad = np.zeros((8, len(CHAIN)))
    bad[:, 1] = CHAIN.upper[1]
    with pytest.raises(InputError, match=r'configuration 1 of the check: .*choose others'):
        planner.check(bad)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda text: text.replace('joint_2', 'elbow', 1), 'line 1: is not joint_1'),
        (lambda text: text[: text.rindex('\n', 0, -1) + 1], 'has 7 configurations, and a check'),
        (lambda text: text[:-1] + ',1.0\n', 'line 9: does not have 7 numbers'),
        (lambda text: text.replace(text.splitlines()[3], ','.join('0' * 6 + 'x')), 'line 4: does'),
        (lambda text: text.replace(text.splitlines()[2], ','.join(['nan'] * 7)), 'line 3: does'),
        (lambda text: text.replace(text.splitlines()[2], ','.join(['inf'] * 7)), 'line 3: does'),
        (lambda text: text.replace(text.splitlines()[5], '0'), 'line 6: does not have 7'),
        (lambda text: '\n' + text.replace(text.splitlines()[5], '0'), 'line 7: does not have 7'),
        (lambda text: text.replace(text.splitlines()[2], ','.join(['400'] * 7)), 'line 3: is out'),
        (lambda text: '', 'line 1: is not joint_1'),
    ],
)
def test_a_table_that_is_none_is_refused_in_a_line(visits, tmp_path, change, words):
    path = tmp_path / 'check.csv'
    path.write_text(change(visits.table()))
    with pytest.raises(InputError, match=words) as found:
        read_visits(path, CELL, CHAIN)
    assert '\n' not in str(found.value)


def test_without_a_table_the_command_that_makes_it_is_named(tmp_path):
    with pytest.raises(InputError, match='remaster plan CELL --check'):
        read_visits(tmp_path / 'check.csv', CELL, CHAIN)
