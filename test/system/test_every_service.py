# SPDX-License-Identifier: Apache-2.0
"""Every service answers in every state: done, refused with the reason, nothing to do."""

import json

import numpy as np
import pytest
from rigs.command_line import remaster
from rigs.ros_rig import call, found, node_arguments, wait_until

from remaster_ros.session.records.reader import read_session, write_session

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


def simulated(folder, *options):
    remaster(
        'simulate', folder, '--poses', 16, '--validation', 8, '--seed', 3, '--sensors', 'mocap',
        *options,
    )  # fmt: skip
    return folder


def refused(client, service, *words):
    response = call(client, service, timeout_s=200)
    assert not response.success
    assert '\n' not in response.message
    for word in words:
        assert word in response.message, response.message


def test_the_optimizer_writes_figures_and_report_whatever_the_verdict(start, client, tmp_path):
    session = simulated(tmp_path / 'session', '--effect', 'encoder_scale@2:0.4')
    fit, causes = tmp_path / 'fit', tmp_path / 'causes'
    start(
        'remaster_ros.nodes.optimizer',
        *node_arguments(session=session, out=fit, discovery=causes),
    )
    for service, out in (('/remaster/fit', fit), ('/remaster/discover', causes)):
        response = call(client, service, timeout_s=300)
        assert response.success, response.message
        assert response.message == str(out / 'report.html')
        assert list((out / 'figures').glob('*.svg'))
    assert json.loads((causes / 'discovery.json').read_text())['verdict'] == 'undetermined'
    # What the data do not allow is an answer too.
    full_session = read_session(session)
    few = full_session.select(np.flatnonzero(full_session.measurements.pose < 2))
    for path in session.iterdir():
        path.unlink()
    write_session(session, few)
    for service in ('/remaster/fit', '/remaster/discover'):
        refused(client, service, 'at least 3 are needed')


def test_a_second_call_while_the_first_is_at_work_is_answered(start, client, tmp_path):
    session = simulated(tmp_path / 'session')
    start(
        'remaster_ros.nodes.optimizer',
        *node_arguments(session=session, out=tmp_path / 'fit', discovery=tmp_path / 'causes'),
    )
    from std_srvs.srv import Trigger

    callers = [client.create_client(Trigger, f'/remaster/{n}') for n in ('discover', 'fit')]
    found(*callers)
    # Which of two services is served first is not determined.
    asked = [caller.call_async(Trigger.Request()) for caller in callers]
    wait_until(lambda: client.spin_some() or any(f.done() for f in asked), 60, 'an answer')
    refusal = next(future for future in asked if future.done())
    assert not refusal.result().success
    assert refusal.result().message == 'a fit is under way'
    wait_until(lambda: client.spin_some() or all(f.done() for f in asked), 300, 'both answers')
    (accepted,) = (future for future in asked if future is not refusal)
    assert accepted.result().success, accepted.result().message


def test_without_a_robot_planner_recorder_and_bridge_say_so(start, client, tmp_path):
    session = tmp_path / 'session'
    nodes = [
        start('remaster_ros.nodes.pose_planner', *node_arguments(session=session)),
        start('remaster_ros.nodes.recorder', *node_arguments(session=session)),
        start(
            'remaster_ros.nodes.robot_bridge',
            *node_arguments(cell='demo', emergency_stop_topic='none'),
        ),
    ]
    refused(client, '/remaster/collect', 'no joint_states yet: is the robot running?')
    refused(client, '/remaster/pause', 'not running, but ')
    refused(client, '/remaster/register', 'no joint_states yet: is the robot running?')
    cleared = call(client, '/remaster/clear_halt')
    assert cleared.message
    assert '\n' not in cleared.message
    stopped = call(client, '/remaster/stop')
    assert (stopped.success, stopped.message) == (True, 'stopped')
    assert all(node.poll() is None for node in nodes)
