# SPDX-License-Identifier: Apache-2.0
"""Waypoints on their own topic: grouped again by the solution that they lead to."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.errors import InputError
from remaster_ros.nodes.messages import waypoints_by_solution, waypoints_message
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
