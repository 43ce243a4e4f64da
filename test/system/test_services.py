# SPDX-License-Identifier: Apache-2.0
"""The optimizer on request: fit, and the latched offsets. Pausing is in test_faults.py."""

import json
import subprocess
import sys

import numpy as np
import pytest
from rigs.command_line import remaster
from rigs.ros_rig import call, node_arguments, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


def test_the_optimizer_fits_and_publishes_latched(start, client, tmp_path):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState

    session, out = tmp_path / 'session', tmp_path / 'fit'
    remaster('simulate', session, '--poses', '20', '--validation', '5', '--seed', '1')
    start(
        'remaster_ros.nodes.optimizer',
        *node_arguments(session=session, out=out, figures=False),
    )
    response = call(client, '/remaster/fit')
    assert response.success, response.message
    fit = json.loads((out / 'fit.json').read_text())
    heard = {}
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for name in ('joint_offsets', 'joint_offsets_std'):
        client.create_subscription(
            JointState, f'/remaster/{name}', lambda m, name=name: heard.update({name: m}), latched
        )

    def both():
        client.spin_some()
        return len(heard) == 2

    wait_until(both, 20, 'the latched offsets')
    rows = fit['joint_offsets']
    assert list(heard['joint_offsets'].name) == [row['joint'] for row in rows]
    for name, key in (('joint_offsets', 'mean_deg'), ('joint_offsets_std', 'std_deg')):
        expected = np.deg2rad([row[key] for row in rows])
        np.testing.assert_allclose(heard[name].position, expected, atol=1e-12)


def test_an_optimizer_started_again_publishes_the_last_fit(start, client, tmp_path):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState

    session = tmp_path / 'session'
    remaster('simulate', session, '--poses', '20', '--validation', '5', '--seed', '2')
    remaster('fit', session, '--out', tmp_path / 'fit', '--no-figures')
    start('remaster_ros.nodes.optimizer', *node_arguments(session=session, out=tmp_path / 'fit'))
    heard = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.create_subscription(JointState, '/remaster/joint_offsets', heard.append, latched)

    def any_heard():
        client.spin_some()
        return bool(heard)

    wait_until(any_heard, 30, 'the latched offsets')
    rows = json.loads((tmp_path / 'fit' / 'fit.json').read_text())['joint_offsets']
    np.testing.assert_allclose(heard[0].position, np.deg2rad([r['mean_deg'] for r in rows]))


def test_a_fit_without_a_session_is_refused_with_the_reason(start, client, tmp_path):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    start('remaster_ros.nodes.optimizer', *node_arguments(session=tmp_path / 'none'))
    shown = []
    client.create_subscription(
        DiagnosticArray, '/remaster/status', lambda array: shown.extend(array.status), 10
    )
    response = call(client, '/remaster/fit')
    assert not response.success
    assert str(tmp_path / 'none') in response.message

    def failed():
        client.spin_some()
        return shown and shown[-1].level == DiagnosticStatus.ERROR

    # A failed fit must not show as OK.
    wait_until(failed, 20, 'the status of a failed fit')
    assert str(tmp_path / 'none') in shown[-1].message


FAULTY = """
import sys
from std_srvs.srv import Trigger
from remaster_ros.nodes.running import RemasterNode, run

class Faulty(RemasterNode):
    outlives_faults = {outlives}

    def __init__(self):
        super().__init__('faulty')
        self.create_service(Trigger, '/faulty/now', self._now)
        self.create_service(Trigger, '/faulty/later', self._later)

    def _now(self, request, response):
        response.success = True
        return {{}}['causes']

    async def _later(self, request, response):
        response.success = True
        return self._now(request, response)

sys.exit(run(Faulty))
"""


def start_faulty(ros_environment, outlives):
    return subprocess.Popen(
        [sys.executable, '-c', FAULTY.format(outlives=outlives)],
        env=ros_environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize('service', ['/faulty/now', '/faulty/later'])
def test_a_fault_in_a_service_is_an_answer_and_ends_a_node_that_others_count_on(
    ros_environment, client, service
):
    node = start_faulty(ros_environment, outlives=False)
    try:
        response = call(client, service, timeout_s=20)
        node.wait(timeout=900)
    finally:
        node.kill()
        out, err = node.communicate()
    assert not response.success
    assert 'a fault of this program' in response.message
    assert "KeyError: 'causes'" in response.message
    assert '\n' not in response.message
    assert node.returncode == 2, out + err
    assert [line for line in err.splitlines() if line.startswith('error: a fault of')]
    assert 'Traceback' not in err


def test_a_node_that_outlives_faults_answers_again(ros_environment, client):
    node = start_faulty(ros_environment, outlives=True)
    try:
        for service in ('/faulty/now', '/faulty/later', '/faulty/now'):
            response = call(client, service, timeout_s=20)
            assert not response.success
            assert 'a fault of this program' in response.message
        assert node.poll() is None
    finally:
        node.kill()
        node.communicate()
