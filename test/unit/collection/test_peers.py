# SPDX-License-Identifier: Apache-2.0
"""The other nodes of a cell: what the preflight knows of them, and whether they mean one arm."""

import pytest

from remaster_ros.collection.events import (
    Alive,
    ArmModel,
    BridgeState,
    EventRecord,
    PlannerState,
    RecorderState,
    SensorReport,
    decode,
    encode,
)
from remaster_ros.collection.peers import SILENT_S, PeerModels, Peers, RequiredSensors
from remaster_ros.errors import InputError
from remaster_ros.motion.preflight import preflight

NAMES = 'mocap', 'tracker'
OWN = ArmModel(urdf='a' * 64, cell='b' * 64, urdf_file='/c/lwr.urdf', cell_file='/c/cell.yaml')
IIWA = ArmModel(urdf='c' * 64, cell='d' * 64, urdf_file='/d/iiwa.urdf', cell_file='/d/other.yaml')
RUNNING = PlannerState(state='running', run='r')


def record(node, body, model):
    return decode(encode(EventRecord(node=node, body=body, model=model)))


def test_another_arm_is_named_by_both_files():
    models = PeerModels('/robot_bridge', OWN)
    models.take(record('/pose_planner', RUNNING, IIWA), 1.0)
    assert models.trouble(1.5) == (
        'robot_bridge has the URDF /c/lwr.urdf (checksum aaaaaaaa) and pose_planner has '
        '/d/iiwa.urdf (cccccccc); robot_bridge has the cell file /c/cell.yaml (checksum bbbbbbbb) '
        'and pose_planner has /d/other.yaml (dddddddd): start both with the same cell file'
    )
    # Started again with the right one.
    models.take(record('/pose_planner', RUNNING, OWN), 2.0)
    assert models.trouble(2.0) == ''


@pytest.mark.parametrize(('body', 'sender'), [(RecorderState(waiting_for=''), 'recorder'),
                                              (Alive(), 'laser')])  # fmt: skip
def test_every_node_counts_until_it_is_ended(body, sender):
    models = PeerModels('/cell1/robot_bridge', OWN)
    models.take(record(f'/cell1/{sender}', body, IIWA), 1.0)
    models.take(record('/cell1/pose_planner', RUNNING, OWN), 1.0)
    assert f'and {sender} has /d/iiwa.urdf' in models.trouble(1.0 + SILENT_S)
    assert models.trouble(1.1 + SILENT_S) == ''


def test_a_planner_must_name_its_arm_and_the_others_need_not():
    models = PeerModels('/robot_bridge', OWN)
    models.take(record('/robot_bridge', Alive(), IIWA), 1.0)
    models.take(record('/optimizer', Alive(), None), 1.0)
    assert models.trouble(1.0) == ''
    models.take(record('/pose_planner', RUNNING, None), 1.0)
    assert models.trouble(1.0).startswith('the records of /pose_planner do not tell which arm')


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


def take(peers, body, now=10.0):
    peers.take(EventRecord(node='/node', body=body), now)


def facts(require='all', read_age_s=0.5):
    found = Peers(NAMES)
    take(found, BridgeState(halted='', joints_age_s=0.1))
    ages = dict.fromkeys(NAMES, read_age_s)
    take(found, RecorderState(waiting_for='', require=require, read_age_s=ages))
    for name in NAMES:
        take(found, SensorReport(sensor=name, ready=True))
    return found


def findings(found, now=10.5, seen_before=False):
    return preflight(found.facts(now, seen_before=seen_before))


def test_nothing_is_in_the_way_where_all_are_there():
    assert findings(facts()) == ()


def test_nothing_is_known_of_nodes_that_have_not_come():
    found = Peers(NAMES)
    take(found, Alive())
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
    take(found, SensorReport(sensor='mocap', ready=False, trouble='no frames'))
    lines = findings(found)
    assert len(lines) == count
    assert all(line == 'mocap: no frames' for line in lines)


def test_what_is_wrong_with_the_joints_is_passed_on():
    found = facts()
    take(found, BridgeState(halted='', joints_age_s=0.0, joints_trouble='not finite'))
    assert findings(found) == ('not finite',)
    take(found, BridgeState(halted=''))
    assert findings(found) == ('no joint_states: is the robot running?',)


def test_a_recorder_of_another_cell_is_refused():
    """It waits for a sensor that is not here: without this nothing would be looked at."""
    with pytest.raises(InputError, match="'bar'; it must be"):
        findings(facts('bar'))
