# SPDX-License-Identifier: Apache-2.0
"""Parameters of the bridge: their ranges, and what the supervisor keeps of them."""

import dataclasses

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.settling import SettleRules
from remaster_ros.nodes.robot_bridge import Parameters

pytestmark = pytest.mark.ros

RANGES = {
    'resume_alone_s': (5.0, 0.0, 60.0, 's'),
    'simulated_clock_rate': (0.0, 0.0, 100.0, ''),
    'cell': ('', None, None, ''),
    'speed_share': (0.3, 0.01, 1.0, ''),
    'cartesian_speed_limit_m_s': (0.25, 1e-3, 10.0, 'm/s'),
    'limit_margin_deg': (0.5, 0.0, 45.0, 'deg'),
    'compensation': ('', None, None, ''),
    'settle_s': (3.0, 0.1, 60.0, 's'),
    'arrive_tolerance': (2e-3, 1e-6, 0.1, 'rad'),
    'still_tolerance': (2e-4, 1e-7, 0.01, 'rad'),
    'arrive_timeout_s': (10.0, 1.0, 600.0, 's'),
    'answer_timeout_s': (180.0, 1.0, 3600.0, 's'),
    'heartbeat_s': (3.0, 0.5, 60.0, 's'),
    'stall_s': (1.0, 0.2, 60.0, 's'),
    'reaction_s': (2.0, 0.1, 60.0, 's'),
    'lag_s': (0.35, 0.05, 2.0, 's'),
    'command_interface': ('topic', None, None, ''),
    'emergency_stop_topic': ('', None, None, ''),
    'horizon_s': (1.6, 1.4, 1.6, 's'),
    'trajectory_stamps': ('auto', None, None, ''),
}
"""What an arm is left to: whoever changes one of them has to change it here as well."""


def test_defaults_ranges_and_units():
    found = {
        field.name: (field.default, *(field.metadata[key] for key in ('low', 'high', 'unit')))
        for field in dataclasses.fields(Parameters)
    }
    assert found == RANGES
    live = [f.name for f in dataclasses.fields(Parameters) if f.metadata['live']]
    assert live == ['speed_share', 'cartesian_speed_limit_m_s']


@pytest.mark.parametrize('field', dataclasses.fields(Parameters), ids=lambda field: field.name)
def test_every_parameter_says_what_it_is(field):
    """What ros2 param describe shows."""
    assert len(field.metadata['description'].split()) > 3


def test_every_rule_comes_from_its_own_parameter():
    parameters = Parameters(
        settle_s=1.5,
        arrive_tolerance=0.01,
        still_tolerance=0.001,
        arrive_timeout_s=11.0,
        answer_timeout_s=12.0,
        heartbeat_s=13.0,
        stall_s=14.0,
        reaction_s=15.0,
        lag_s=1.25,
        # Without it nothing goes on by itself.
        emergency_stop_topic='robot/stops',
        horizon_s=1.5,
    )
    units = JointUnits((False, True))
    assert parameters.rules(units) == SupervisorRules(
        SettleRules(1.5, 0.01, 0.001, units=units),
        11.0,
        12.0,
        13.0,
        14.0,
        15.0,
        1.25,
        horizon_s=1.5,
    )


def test_parameters_do_not_change_by_themselves():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Parameters().speed_share = 1.0
