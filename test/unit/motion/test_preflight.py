# SPDX-License-Identifier: Apache-2.0
"""Preflight: every single thing that is missing is named, and nothing else is in the way."""

from dataclasses import replace
from math import inf, nan

import pytest

from remaster_ros.motion.preflight import Facts, SensorFacts, preflight

MOCAP = SensorFacts('mocap', 0.2, True, '', 0.1)
TRACKER = SensorFacts('tracker', 0.4, True, '', 1.0)
GOOD = Facts(0.1, '', 0.3, 0.3, (MOCAP, TRACKER))


def test_when_all_is_well_nothing_is_in_the_way():
    assert preflight(GOOD) == ()
    assert preflight(replace(GOOD, sensors=())) == ()


@pytest.mark.parametrize('age_s', [3.001, inf, nan])
@pytest.mark.parametrize(
    ('change', 'finding'),
    [
        ('joints_age_s', 'no joint_states: is the robot running?'),
        ('bridge_age_s', 'no sign of robot_bridge: is it running in this ROS domain?'),
        ('recorder_age_s', 'no sign of recorder: is it running in this ROS domain?'),
    ],
)
def test_a_topic_or_node_without_a_fresh_message(change, finding, age_s):
    assert preflight(replace(GOOD, **{change: 3.0})) == ()
    assert preflight(replace(GOOD, **{change: age_s})) == (finding,)


def test_joint_states_of_another_robot_say_so_once():
    facts = replace(GOOD, joints_message='joint_states lacks joint_1', joints_age_s=inf)
    assert preflight(facts) == ('joint_states lacks joint_1',)


@pytest.mark.parametrize(
    ('change', 'finding'),
    [
        ({'node_age_s': 3.1}, 'mocap: no sign of its node: is it running in this ROS domain?'),
        ({'node_age_s': nan}, 'mocap: no sign of its node: is it running in this ROS domain?'),
        ({'ready': False, 'message': 'set data_port'}, 'mocap: set data_port'),
        ({'ready': False}, 'mocap: not ready'),
        (
            {'read_age_s': inf},
            'mocap: the recorder has no reading of its marker: '
            'turn the tool until the sensor sees its marker',
        ),
        (
            {'read_age_s': 3.1, 'message': 'marker 1:1 is hidden from the cameras'},
            'mocap: the recorder has no reading of its marker: '
            'marker 1:1 is hidden from the cameras',
        ),
    ],
)
def test_a_sensor_that_cannot_measure_says_why(change, finding):
    facts = replace(GOOD, sensors=(replace(MOCAP, **change), TRACKER))
    assert preflight(facts) == (finding,)
    # Where one of two is enough, the other one may measure.
    assert preflight(replace(facts, any_sensor=True)) == ()
    single_facts = replace(facts, any_sensor=True, sensors=(replace(MOCAP, **change),))
    assert preflight(single_facts) == (finding,)


def test_exactly_three_seconds_are_fresh():
    old = replace(MOCAP, node_age_s=3.0, read_age_s=3.0)
    assert preflight(replace(GOOD, sensors=(old,))) == ()


def test_everything_at_once_is_all_named():
    gone = [replace(sensor, node_age_s=inf) for sensor in (MOCAP, TRACKER)]
    assert len(preflight(Facts(inf, '', inf, inf, gone))) == 5
    assert len(preflight(Facts(inf, '', inf, inf, gone, any_sensor=True))) == 5
