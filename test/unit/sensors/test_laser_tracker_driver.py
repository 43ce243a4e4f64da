# SPDX-License-Identifier: Apache-2.0
"""A laser tracker's driver on the fake's wire: one of several reflectors, never another one."""

import numpy as np
import pytest
from worlds.tracker_world import MARKER, OTHER_BESIDE, ReflectorWorld

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.driver import SensorClock
from remaster_ros.sensors.laser_tracker.driver import LaserTrackerDriver, Parameters
from remaster_ros.simulation.laser_tracker import FakeLaserTracker
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour

QUICK = TrackerBehaviour(warm_up_s=0.1, initialise_s=0.1, search_failure_share=0.0)
NEAR_M = 0.2e-3


@pytest.fixture
def scene():
    """Return world and driver of a tracker with two reflectors, 143 mm apart."""
    world = ReflectorWorld()
    with FakeLaserTracker(
        world, 'tracker', np.random.default_rng(3), behaviour=QUICK, further={'b': 2}
    ) as fake:
        host, port = fake.address
        parameters = Parameters(host=host, port=port, attempts=2, further_markers={'b': 2})
        driver = LaserTrackerDriver(parameters, SensorClock(world.now, world.sleep, True))
        driver.open()
        yield world, driver
        driver.close()


def off(reading, place):
    return np.linalg.norm(reading.position - place)


def test_each_is_measured_where_it_is_and_no_search_is_made_twice(scene):
    _, driver = scene
    searches = []
    for marker, place in (('', MARKER), ('b', MARKER + OTHER_BESIDE)) * 2:
        # As well as the place is known: some millimetres.
        driver.turn_to(marker, place + 4e-3)
        driver.turn_to(marker, place + 4e-3)
        assert off(driver.measure(place + 4e-3), place) < NEAR_M
        searches.append(driver.tracker.counts['searches'])
    assert searches == [1, 2, 3, 4]


def test_one_that_is_hidden_is_not_replaced_by_the_other(scene):
    world, driver = scene
    driver.turn_to('', MARKER)
    driver.measure(MARKER)
    world.faulty = {'hidden': 2}
    searches = [driver.tracker.counts['searches']]
    for _ in range(2):
        with pytest.raises(DeviceError):
            driver.turn_to('b', MARKER + OTHER_BESIDE)
        searches.append(driver.tracker.counts['searches'])
    # Two attempts, and no more than one at the next standstill.
    assert np.diff(searches).tolist() == [2, 1]
    # Nor is the other one taken for it afterwards, and it is found again where it is.
    driver.turn_to('', MARKER)
    assert off(driver.measure(MARKER), MARKER) < NEAR_M
    world.faulty = {}
    driver.turn_to('b', MARKER + OTHER_BESIDE)
    assert off(driver.measure(MARKER + OTHER_BESIDE), MARKER + OTHER_BESIDE) < NEAR_M


def test_after_the_arm_has_moved_the_beam_is_still_on_the_same_one(scene):
    world, driver = scene
    driver.turn_to('b', MARKER + OTHER_BESIDE)
    moved = np.array([0.0, 0.02, 0.01])
    world.path = lambda t: MARKER + moved
    driver.prepare(MARKER + moved)
    driver.turn_to('b', MARKER + moved + OTHER_BESIDE)
    place = MARKER + moved + OTHER_BESIDE
    assert off(driver.measure(place), place) < NEAR_M
    assert driver.tracker.counts['searches'] == 1
