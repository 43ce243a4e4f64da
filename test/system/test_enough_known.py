# SPDX-License-Identifier: Apache-2.0
"""A collection ends once enough is known: the optimizer's looks and the planner's end, by DDS."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rigs.collection_rig import Cell
from rigs.ros_rig import node_arguments, wait_until
from worlds.designed_sessions import measured
from worlds.stopping_scene import world

from remaster_ros.collection.events import (
    ArmHalted,
    ArmStopped,
    ConfigurationEnded,
    EventRecord,
    OptimizerState,
    PlannerState,
    PoseAnnounced,
    RecorderState,
    encode,
)
from remaster_ros.session.cells.workcell import config_path
from remaster_ros.session.records.reader import write_session

pytestmark = pytest.mark.ros
SEED = 21


def cell_with_goal(folder, goal):
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots'))).replace(
        'poses:\n', f'poses:\n  joint_std_deg: {goal}\n', 1
    )
    path = folder / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def test_the_optimizer_reports_what_is_known_and_ends_only_its_own_plan(start, client, tmp_path):
    from std_msgs.msg import String

    from remaster_ros.nodes.status import LATCHED, RELIABLE, listen

    print('seed', SEED)
    of = world(3)
    rng = np.random.default_rng(SEED)
    session, _ = measured(of.chain, of.urdf, (of.q, of.pose), of.sensors, rng)
    rows = session.measurements
    timed = replace(
        rows, stamp_s=12.0 * rows.configuration, temperature_c=np.full(len(rows), 20.0)
    )
    folder = tmp_path / 'session'
    write_session(folder, replace(session, measurements=timed))
    goal = float(np.degrees(of.goals[2]))
    start(
        'remaster_ros.nodes.optimizer',
        *node_arguments(
            session=folder,
            out=tmp_path / 'fit',
            cell=cell_with_goal(tmp_path, goal),
            look_every=12,
        ),
    )
    states, found = [], []
    listen(client, lambda record: states.append(record.body))
    client.create_subscription(
        String, 'remaster/precision', lambda m: found.append(json.loads(m.data)), LATCHED
    )
    publisher = client.create_publisher(String, 'remaster/events', RELIABLE)

    def say(node, body):
        publisher.publish(String(data=encode(EventRecord(node=node, body=body))))

    def of_plan(plan):
        return [s for s in states if isinstance(s, OptimizerState) and s.plan == plan]

    def turn(plan, path, condition):
        def once():
            say('/pose_planner', PlannerState(state='running', run='r', planned=len(of.q)))
            recorder = RecorderState(
                waiting_for='', session=str(path), observations=len(rows), plan=plan
            )
            say('/recorder', recorder)
            for _ in range(5):
                client.spin_some()
            return condition()

        return once

    # The session of another folder is none of its own.
    count = len(states)
    wait_until(turn('other', tmp_path / 'else', lambda: len(states) > count + 40), 60, 'states')
    assert not found
    wait_until(turn('mine', folder, lambda: any(s.enough for s in of_plan('mine'))), 60, 'the end')
    wait_until(turn('mine', folder, lambda: found and found[-1]['enough']), 20, 'the JSON')
    last = found[-1]
    assert last['format'] == 'remaster-precision/1'
    assert last['goal'] == {'joint_std_deg': pytest.approx(goal), 'tool_std_mm': None}
    assert last['planned_configurations'] == len(of.q)
    assert [look['configurations'] for look in last['looks']] == list(
        range(12, last['looks'][-1]['configurations'] + 1, 12)
    )
    assert last['looks'][-1]['joint_rms_deg'] <= goal < last['looks'][0]['joint_rms_deg']
    assert last['looks'][-1]['minutes'] == pytest.approx(
        0.2 * (last['looks'][-1]['configurations'] - 1), abs=1e-3
    )
    # Of another plan in the same folder nothing is known yet.
    assert not of_plan('other') or not any(s.enough for s in of_plan('other'))


@pytest.mark.qualify
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_collection_that_knows_enough_ends_as_any_other(start, client, tmp_path):
    from std_msgs.msg import String

    from remaster_ros.nodes.status import RELIABLE

    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], candidates=5, held_out=2)
    publisher = client.create_publisher(String, 'remaster/events', RELIABLE)

    def fitted():
        return {
            e.pose
            for e in cell.events
            if isinstance(e, PoseAnnounced) and e.split == 'optimization'
        }

    cell.until(lambda: len(fitted()) > 0, 'the first pose to fit')
    plan = cell.said['pose_planner']['plan']
    for name, known in (('another', True), (plan, False), (plan, True)):
        body = OptimizerState(plan=name, enough=known)
        publisher.publish(String(data=encode(EventRecord(node='/optimizer', body=body))))
    session = cell.complete()
    # The pose under way was finished, those held out came after it.
    poses = fitted()
    assert len(poses) < 4
    announced = [e for e in cell.events if isinstance(e, PoseAnnounced)]
    m = session.measurements
    assert set(m.pose[~m.is_validation].tolist()) == poses
    assert m.is_validation.any()
    ended = [e for e in cell.events if isinstance(e, ConfigurationEnded)]
    solutions = {(e.stamp, i) for e in announced for i in range(len(e.ids))}
    assert {(e.stamp, e.solution) for e in ended} == solutions, 'nothing was left half done'
    assert not [e for e in cell.events if isinstance(e, (ArmHalted, ArmStopped))]
    said = cell.said['pose_planner']
    assert said['state'] == 'complete'
    assert int(said['dropped_enough is known']) >= 1
    assert said['poses_done'] == said['poses']
