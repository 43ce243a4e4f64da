"""Which sensors the arm waits for."""

import pytest

from remaster_ros.collection.required_sensors import RequiredSensors
from remaster_ros.errors import InputError

NAMES = 'mocap', 'tracker'


@pytest.mark.parametrize(
    ('require', 'absent', 'missing'),
    [
        ('all', {}, ''),
        ('all', {'mocap': 'off'}, 'mocap: off'),
        ('all', {'mocap': 'off', 'tracker': 'gone'}, 'mocap: off; tracker: gone'),
        ('any', {'mocap': 'off'}, ''),
        ('any', {'mocap': 'off', 'tracker': 'gone'}, 'mocap: off; tracker: gone'),
        ('tracker', {'mocap': 'off'}, ''),
        ('tracker', {'tracker': 'gone'}, 'tracker: gone'),
        ('all', {'stranger': 'off'}, ''),
    ],
)
def test_what_the_arm_waits_for(require, absent, missing):
    assert RequiredSensors(NAMES, require).missing(absent) == missing


@pytest.mark.parametrize(
    ('require', 'found', 'enough'),
    [
        ('all', {'mocap'}, False),
        ('all', {'mocap', 'tracker'}, True),
        ('any', {'tracker'}, True),
        ('any', set(), False),
        ('mocap', {'tracker'}, False),
        ('mocap', {'mocap'}, True),
    ],
)
def test_whether_enough_of_them_are_registered(require, found, enough):
    assert RequiredSensors(NAMES, require).are_among(found) == enough


def test_a_sensor_that_the_cell_has_not_is_refused():
    with pytest.raises(InputError, match="'bar'; it must be all, any or one of mocap, tracker"):
        RequiredSensors(NAMES, 'bar')
