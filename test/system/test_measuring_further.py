# SPDX-License-Identifier: Apache-2.0
"""Behind a complete collection: collect measures what separates a cause from its look-alike."""

import json

import pytest
from rigs.collection_rig import Cell
from rigs.ros_rig import call, node_arguments

from remaster_ros.collection.events import TourPlanned
from remaster_ros.planning.separating_design import MOST_ADDED
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.records.journal import read_journal
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.effect_sampling import EffectSpec

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


def sag(size):
    """Return a cause as discovery.json has it, with the base as its look-alike."""
    alike = {
        'name': 'base_compliance', 'joints': [],
        'log_evidence_gain': 9.0, 'separate_by': 'a payload',
    }  # fmt: skip
    return {
        'name': 'joint_compliance', 'joints': [2], 'place': 'joint_angle',
        'driver': 'gravity_torque', 'form': 'linear',
        'parameters': [{'name': 'compliance_2', 'value': size, 'std': 1e-5, 'unit': 'rad/(N m)'}],
        'p_value': 0.003, 'log_evidence_gain': 10.0, 'confusable_with': [alike], 'cause': 'sag',
    }  # fmt: skip


@pytest.mark.qualify
def test_what_separates_is_measured_behind_the_session_and_decides(start, client, tmp_path):
    found = tmp_path / 'discovery'
    cell = Cell(
        start, client, tmp_path, 'mocap', ['mocap'], candidates=5, discovery=found,
        hidden=[EffectSpec('joint_compliance', 2, 3e-3)],
    )  # fmt: skip
    optimizer = node_arguments(session=cell.session, discovery=found, figures=False)
    cell.nodes['optimizer'] = start('remaster_ros.nodes.optimizer', *optimizer)
    session = cell.complete()
    before = (cell.session / 'observations.csv').read_bytes()
    cell.until(lambda: cell.said['pose_planner']['state'] == 'complete', 'the planner')
    refused = call(client, '/remaster/collect')
    assert not refused.success
    assert refused.message.startswith('the collection is complete: /remaster/discover looks for')

    response = call(client, '/remaster/discover', timeout_s=200)
    assert response.success, response.message
    path = found / 'discovery.json'
    content = json.loads(path.read_text())
    other = content['session'].pop('observations_sha256')
    content |= {'verdict': 'undetermined', 'effects': [sag(3e-4)]}
    path.write_text(json.dumps(content))
    refused = call(client, '/remaster/collect')
    assert 'is not of the observations that the session has now' in refused.message
    content['session']['observations_sha256'] = other
    path.write_text(json.dumps(content))
    commanded = int(cell.said['robot_bridge']['commanded'])
    # One that has seen nothing of the session but its files.
    cell.said.pop('recorder')
    cell.kill_and_start('recorder')
    cell.until(lambda: cell.recorder('exit_status') == 'complete', 'the recorder')
    response = call(client, '/remaster/collect')
    assert response.success, response.message

    count, ended = len(set(session.measurements.configuration.tolist())), len(cell.results)
    cell.until(lambda: len(cell.results) > ended, 'the first that separates')
    cell.kill_and_start('pose_planner')
    cell.until(lambda: cell.recorder('exit_status') == '', 'the open session')
    further = cell.complete()
    numbers = further.measurements.configuration.tolist()
    assert len(set(numbers)) == len(numbers) == cell.planned()
    # What was there is there, unchanged.
    assert (cell.session / 'observations.csv').read_bytes().startswith(before)
    assert further.exit_status == 'complete'
    added = len(numbers) - count
    assert 1 < added <= MOST_ADDED
    assert int(cell.said['robot_bridge']['commanded']) >= commanded + added
    # In the order of the choice, with numbers of their own.
    records = read_journal(cell.session / 'plan.jsonl').records
    tour = next(record for record in records if record.get('begin_at'))
    assert tour['begin_at'] == len(set(session.measurements.pose.tolist()))
    rows = further.measurements.select(further.measurements.configuration >= count)
    assert rows.pose.min() >= tour['begin_at']
    poses = tour['plans']['optimization']['poses']
    for q, (_, pose, place) in zip(rows.q, tour['order'], strict=True):
        assert q == pytest.approx(poses[pose]['solutions'][place], abs=1e-3)
    planned = [body.description for body in cell.events if isinstance(body, TourPlanned)]
    assert any('joint compliance of joint 2 and base compliance' in text for text in planned)
    topics = [message.topic for message in BagReader(cell.session / 'bag')]
    assert topics.count('/remaster/settled') >= len(numbers)

    response = call(client, '/remaster/discover', timeout_s=200)
    assert response.success, response.message
    after = json.loads(path.read_text())
    (decision,) = after['decided']
    assert decision['cause'] == {'name': 'joint_compliance', 'joints': [2]}
    assert decision['look_alike'] == {'name': 'base_compliance', 'joints': []}
    assert (
        after['session']['observations_sha256'] == read_session(cell.session).observations_sha256
    )
