"""Services while the nodes run: pause and go on without loss, fit and hear the latched offsets."""

import json
import time

import numpy as np
import pytest
from command_line import remaster
from conftest import call, node_arguments, wait_until

from remaster_ros.storage.session import read_session

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]


def test_pause_stops_the_arm_at_once_and_going_on_loses_nothing(start, client, tmp_path):
    from sensor_msgs.msg import JointState

    out = tmp_path / 'out'
    demo = start(
        'remaster_ros.cli.main', 'demo', '--out', out, '--candidates', '6', '--no-figures',
        '--seed', '3',
    )  # fmt: skip
    states = []
    client.create_subscription(
        JointState,
        '/joint_states',
        lambda m: states.append((time.monotonic(), np.max(np.abs(m.velocity)))),
        50,
    )
    rows = out / 'session' / 'observations.csv'

    def moving_after_some_rows():
        assert demo.poll() is None, demo.communicate()
        client.spin_some()
        return rows.exists() and rows.read_text().count('\n') > 4 and states[-1][1] > 0.1

    wait_until(moving_after_some_rows, 120, 'a moving arm')
    paused_at = time.monotonic()
    assert call(client, '/remaster/pause').success
    while time.monotonic() < paused_at + 4.0:
        client.spin_some()
    # 2 s of wall time, ten times the braking at ten times the clock, on a machine that is busy.
    late = [speed for stamp, speed in states if stamp > paused_at + 2.0]
    assert len(late) > 20
    assert max(late) < 1e-3
    before = rows.read_text()
    while time.monotonic() < paused_at + 6.0:
        client.spin_some()
    assert rows.read_text() == before

    assert call(client, '/remaster/collect').success
    wait_until(lambda: demo.poll() is not None, 150, 'the demo to end')
    assert demo.returncode == 0, demo.stderr.read()
    m = read_session(out / 'session').measurements
    pairs = list(zip(m.configuration.tolist(), m.sensor.tolist()))
    assert len(set(pairs)) == len(pairs) == 2 * len(set(m.configuration.tolist()))
    # Nothing twice: no two configurations of a pose within 1 mrad of each other.
    first = m.sensor == 0
    for pose in set(m.pose.tolist()):
        q = m.q[first & (m.pose == pose)]
        distance = np.max(np.abs(q[:, None] - q), axis=-1)
        assert np.all(distance[~np.eye(len(q), dtype=bool)] > 1e-3)


def test_the_optimizer_fits_and_publishes_latched(start, client, tmp_path):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState

    session, out = tmp_path / 'session', tmp_path / 'fit'
    made = remaster('simulate', session, '--poses', '20', '--validation', '5', '--seed', '1')
    assert made.returncode == 0
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
    made = remaster('simulate', session, '--poses', '20', '--validation', '5', '--seed', '2')
    assert made.returncode == 0
    assert remaster('fit', session, '--out', tmp_path / 'fit', '--no-figures').returncode == 0
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


def test_a_fit_of_no_session_says_why(start, client, tmp_path):
    start('remaster_ros.nodes.optimizer', *node_arguments(session=tmp_path / 'none'))
    response = call(client, '/remaster/fit')
    assert not response.success
    assert str(tmp_path / 'none') in response.message
