# SPDX-License-Identifier: Apache-2.0
"""In the loop: the optimizer looks for causes on request; a demo hides one and opens the truth."""

import json
import subprocess
import sys

import pytest
import yaml
from rigs.command_line import refusal, remaster
from rigs.ros_rig import call, node_arguments, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.mark.qualify
def test_the_optimizer_discovers_on_request(start, client, tmp_path):
    session, out = tmp_path / 'session', tmp_path / 'discovery'
    remaster(
        'simulate', session, '--poses', '30', '--validation', '15', '--seed', '1',
        '--sensors', 'mocap', '--effect', 'joint_compliance@2:0.8',
    )  # fmt: skip
    node = start(
        'remaster_ros.nodes.optimizer',
        *node_arguments(session=session, discovery=out, figures=False),
    )
    response = call(client, '/remaster/discover', timeout_s=300)
    assert response.success, response.message
    assert response.message == str(out / 'discovery.json')
    found = json.loads((out / 'discovery.json').read_text())
    assert [(effect['name'], effect['joints']) for effect in found['effects']] == [
        ('joint_compliance', [2])
    ]
    true = json.loads((session / 'truth.json').read_text())['effects'][0]['values'][0]
    (parameter,) = found['effects'][0]['parameters']
    assert abs(parameter['value'] - true) < 4 * parameter['std']
    # What cannot be answered is said in a line, and the node lives on.
    (session / 'observations.csv').unlink()
    response = call(client, '/remaster/discover')
    assert not response.success
    assert 'observations.csv' in response.message
    assert '\n' not in response.message
    wait_until(lambda: node.poll() is None, 1.0, 'the optimizer to live on')


@pytest.mark.qualify
def test_a_healthy_arm_is_answered_with_figures_and_again(start, client, tmp_path):
    """Nothing is there to be drawn as a cause, and the optimizer is there for the next call."""
    session, out = tmp_path / 'session', tmp_path / 'discovery'
    remaster(
        'simulate', session, '--poses', '20', '--validation', '10', '--seed', '1',
        '--sensors', 'mocap',
    )  # fmt: skip
    start('remaster_ros.nodes.optimizer', *node_arguments(session=session, discovery=out))
    for _ in range(2):
        response = call(client, '/remaster/discover', timeout_s=200)
        assert response.success, response.message
        assert response.message == str(out / 'report.html')
    assert json.loads((out / 'discovery.json').read_text())['verdict'] == 'none'
    assert 'None is named. Every combination' in (out / 'report.html').read_text()


@pytest.mark.qualify
def test_a_demo_finds_what_is_hidden_and_opens_the_truth_at_the_end(ros_environment, tmp_path):
    out = tmp_path / 'out'
    process = subprocess.run(
        [
            sys.executable, '-m', 'remaster_ros.cli.main', 'demo', '--out', str(out),
            '--seed', '5', '--candidates', '14', '--no-figures',
            '--hide', 'joint_compliance@2:1.0',
        ],
        env={**ros_environment, 'COLUMNS': '200'},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )  # fmt: skip
    logs = ''.join(path.read_text() for path in (out / 'log').glob('*.log'))
    assert process.returncode == 0, process.stdout + process.stderr + logs
    print(process.stdout)
    truth = yaml.safe_load((out / 'truth.yaml').read_text())
    assert [effect['kind'] for effect in truth['effects']] == ['joint_compliance']
    found = json.loads((out / 'discovery' / 'discovery.json').read_text())
    assert ('joint_compliance', [2]) in [(e['name'], e['joints']) for e in found['effects']]
    gain = found['gain']
    assert gain['held_out_rms_after_m'] < 0.5 * gain['held_out_rms_before_m']
    assert 'joint_compliance joint 2' in process.stdout
    assert 'compliance_2' in process.stdout
    # Nothing that estimates has read it: it is written when all of them have ended.
    written = (out / 'truth.yaml').stat().st_mtime
    assert written >= (out / 'discovery' / 'discovery.json').stat().st_mtime


def test_nothing_that_cannot_be_hidden_starts_a_demo(tmp_path):
    out = tmp_path / 'out'
    said = refusal('demo', '--out', out, '--hide', 'bad_luck', '--quiet')
    assert "'bad_luck' is nothing to hide" in said
