"""Nodes that compute with another arm are found by the checksums in their records."""

import pytest

from remaster_ros.collection.events import (
    Alive,
    ArmModel,
    EventRecord,
    PlannerState,
    RecorderState,
    decode,
    encode,
)
from remaster_ros.collection.peer_models import SILENT_S, PeerModels

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
