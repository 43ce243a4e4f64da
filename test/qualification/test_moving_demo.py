# SPDX-License-Identifier: Apache-2.0
"""`remaster demo --moving`: real nodes, an arm with dynamics, offsets from half a minute of it.

Three minutes at the speed of a real arm; the figures stand in benchmarks/RESULTS.md.
"""

import json
import subprocess
import sys

import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.reader import read_session

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.qualify, pytest.mark.timeout(1200)]

SEED, SECONDS = 1, 30.0
CHAIN = read_cell('moving').chain()


@pytest.fixture(scope='module')
def demo(ros_environment, tmp_path_factory):
    out = tmp_path_factory.mktemp('moving') / 'out'
    print(f'seed {SEED}')
    command = [sys.executable, '-m', 'remaster_ros.cli.main', 'demo', '--moving', str(SECONDS)]
    done = subprocess.run(
        [*command, '--seed', str(SEED), '--out', str(out), '--no-figures'],
        env={**ros_environment, 'COLUMNS': '300'},
        capture_output=True,
        text=True,
        timeout=1100,
        check=False,
    )
    logs = ''.join(path.read_text() for path in (out / 'log').glob('*.log'))
    assert done.returncode == 0, done.stdout + done.stderr + logs
    return out, done.stdout


def test_the_offsets_are_the_hidden_ones(demo):
    out, _ = demo
    fit = json.loads((out / 'fit' / 'fit.json').read_text())
    truth = np.degrees(yaml.safe_load((out / 'truth.yaml').read_text())['joint_offsets'])
    known = [(row, at) for row, at in zip(fit['joint_offsets'], truth) if row['identifiable']]
    assert [row['joint'] for row, _ in known] == [f'joint_{i}' for i in range(2, 7)]
    z = [(row['mean_deg'] - at) / row['std_if_exactly_drawn_deg'] for row, at in known]
    print('off, in standard deviations of an arm as drawn', np.round(z, 2))
    # Five normal numbers are longer than this in 1 of 1,000 sessions.
    assert np.sum(np.square(z)) < 20.5
    assert max(row['std_if_exactly_drawn_deg'] for row, _ in known) < 0.0035


def test_standstills_prove_it(demo):
    out, printed = demo
    proof = json.loads((out / 'fit' / 'fit.json').read_text())['motion_proof']
    assert proof['poses'] >= 8
    assert f'{proof["standstill_mm"]:.3f} mm' in printed
    assert proof['standstill_mm'] < 0.1
    moving = read_session(out / 'moving').measurements
    at_rest = np.all(moving.velocity == 0.0, axis=1)
    assert np.all(moving.is_validation[at_rest])
    assert len(np.unique(moving.pose[at_rest])) == proof['poses']


def test_the_arm_kept_the_speeds_of_its_joints(demo):
    out, _ = demo
    fastest = np.zeros(len(CHAIN))
    for message in BagReader(out / 'session' / 'bag'):
        if message.topic == '/joint_states':
            state = deserialize_message(message.cdr, JointState)
            # Drivers list joints in an order of their own.
            order = [list(state.name).index(name) for name in CHAIN.joint_names]
            fastest = np.maximum(fastest, np.abs(np.asarray(state.velocity)[order]))
    share = fastest / CHAIN.velocity_limits
    # A servo overshoots, and the reports' noise comes on top.
    assert 0.15 < np.max(share) < 1.1 * 0.3
