"""What the preflight knows, from the states of the nodes."""

import pytest

from remaster_ros.collection.events import Alive, BridgeState, RecorderState, SensorReport
from remaster_ros.collection.preflight_facts import PreflightFacts
from remaster_ros.errors import InputError
from remaster_ros.motion.preflight import preflight

NAMES = 'mocap', 'tracker'


def facts(require='all', read_age_s=0.5):
    found = PreflightFacts(NAMES)
    found.take(BridgeState(halted='', joints_age_s=0.1), 10.0)
    ages = dict.fromkeys(NAMES, read_age_s)
    found.take(RecorderState(waiting_for='', require=require, read_age_s=ages), 10.0)
    for name in NAMES:
        found.take(SensorReport(sensor=name, ready=True), 10.0)
    return found


def findings(found, now=10.5, seen_before=False):
    return preflight(found.facts(now, seen_before=seen_before))


def test_nothing_is_in_the_way_where_all_are_there():
    assert findings(facts()) == ()


def test_nothing_is_known_of_nodes_that_have_not_come():
    found = PreflightFacts(NAMES)
    found.take(Alive(), 10.0)
    lines = findings(found)
    assert len(lines) == 5
    assert lines[0] == 'no joint_states: is the robot running?'
    assert all('no sign of' in line for line in lines[1:])


def test_what_came_long_ago_counts_no_more():
    assert len(findings(facts(), now=14.0)) == 4


def test_the_age_of_a_reading_goes_on_with_the_recorders_state():
    assert findings(facts(read_age_s=2.4)) == ()
    lines = findings(facts(read_age_s=2.6))
    assert [line.split(':')[0] for line in lines] == list(NAMES)
    assert 'no reading of its marker' in lines[0]
    assert findings(facts(read_age_s=None), seen_before=True) == ()
    assert len(findings(facts(read_age_s=None))) == 2


@pytest.mark.parametrize(
    ('require', 'count'), [('all', 1), ('any', 0), ('mocap', 1), ('tracker', 0)]
)
def test_a_sensor_that_is_not_ready_counts_where_the_arm_waits_for_it(require, count):
    found = facts(require)
    found.take(SensorReport(sensor='mocap', ready=False, trouble='no frames'), 10.0)
    lines = findings(found)
    assert len(lines) == count
    assert all(line == 'mocap: no frames' for line in lines)


def test_what_is_wrong_with_the_joints_is_passed_on():
    found = facts()
    found.take(BridgeState(halted='', joints_age_s=0.0, joints_trouble='not finite'), 10.0)
    assert findings(found) == ('not finite',)
    found.take(BridgeState(halted=''), 10.0)
    assert findings(found) == ('no joint_states: is the robot running?',)


def test_a_recorder_of_another_cell_is_refused():
    """It waits for a sensor that is not here: without this nothing would be looked at."""
    with pytest.raises(InputError, match="'bar'; it must be"):
        findings(facts('bar'))
