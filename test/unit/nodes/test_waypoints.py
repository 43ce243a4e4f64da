# SPDX-License-Identifier: Apache-2.0
"""Waypoints on their own topic: grouped again by the solution that they lead to."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.errors import InputError
from remaster_ros.nodes.messages import (
    curves_by_solution,
    waypoints_by_solution,
    waypoints_message,
)
from remaster_ros.planning.tour_order import PoseVisit

NAMES = ('a', 'b', 'c')


def stop_with(*lengths):
    rng = np.random.default_rng(1)
    paths = tuple(rng.standard_normal((n, 3)) for n in lengths)
    solutions = rng.standard_normal((len(lengths), 3))
    return PoseVisit(0, 'optimization', np.eye(4), solutions, 0, tuple(range(len(lengths))), paths)


def test_what_was_sent_is_what_is_grouped():
    stop = stop_with(0, 2, 0, 3)
    header = Header(stamp=Time(sec=7, nanosec=8))
    message = waypoints_message(stop, NAMES, header)
    assert message.header == header
    assert [point.time_from_start.sec for point in message.points] == [2, 2, 4, 4, 4]
    found = waypoints_by_solution(message, NAMES)
    assert sorted(found) == [1, 3]
    for index, path in found.items():
        np.testing.assert_array_equal(path, stop.paths[index])
    # In another order of joints.
    turned = waypoints_by_solution(message, ('c', 'a', 'b'))
    np.testing.assert_array_equal(turned[3], stop.paths[3][:, [2, 0, 1]])
    assert waypoints_by_solution(waypoints_message(stop_with(0, 0), NAMES, header), NAMES) == {}


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda m: setattr(m, 'joint_names', ['a', 'b', 'x']), 'c is missing'),
        (lambda m: setattr(m.points[0], 'positions', [1.0, 2.0]), 'for 3 joints'),
        (lambda m: setattr(m.points[0], 'positions', [1.0, 2.0, np.nan]), 'for 3 joints'),
        (lambda m: setattr(m.points[2].time_from_start, 'sec', 1), 'solution 0 after solution 1'),
        (lambda m: setattr(m.points[0].time_from_start, 'sec', 0), 'solution -1'),
    ],
)
def test_what_is_wrong_is_refused(change, message):
    sent: JointTrajectory = waypoints_message(stop_with(0, 2, 1), NAMES, Header())
    change(sent)
    with pytest.raises(InputError, match=message):
        waypoints_by_solution(sent, NAMES)


SHARES = np.array([0.0, 1.0 / 3.0, 0.9])


def curved():
    """Return a visit whose second solution is reached by a curve, and the fourth by lines."""
    none = np.empty(0)
    return dataclasses.replace(stop_with(0, 3, 0, 2), shares=(none, SHARES, none, none))


def test_the_shares_of_a_curve_come_with_its_waypoints():
    message = waypoints_message(curved(), NAMES, Header())
    found = curves_by_solution(message)
    assert list(found) == [1]
    np.testing.assert_allclose(found[1], SHARES, atol=1e-9)
    assert found[1][0] == 0.0
    paths = waypoints_by_solution(message, NAMES)
    np.testing.assert_array_equal(paths[1], curved().paths[1])
    np.testing.assert_array_equal(paths[3], curved().paths[3])
    assert curves_by_solution(waypoints_message(stop_with(2, 1), NAMES, Header())) == {}


@pytest.mark.parametrize(
    'marks', [(0, 5, 9), (2, 5, 9), (1, 5, 5), (1, 9, 5), (1, 5, 999_999_999)]
)
def test_shares_that_do_not_ascend_from_nothing_to_the_end_are_refused(marks):
    message = waypoints_message(curved(), NAMES, Header())
    for point, mark in zip(message.points, marks):
        point.time_from_start.nanosec = mark
    with pytest.raises(InputError, match='the curve to solution 1'):
        curves_by_solution(message)


def test_a_curve_of_one_point_is_refused():
    message = waypoints_message(stop_with(1), NAMES, Header())
    message.points[0].time_from_start.nanosec = 1
    with pytest.raises(InputError, match='two points and more'):
        curves_by_solution(message)
