# SPDX-License-Identifier: Apache-2.0
"""/remaster/check: eight configurations, visited by real nodes, and judged against a baseline."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rigs.collection_rig import SEED, Cell
from rigs.command_line import remaster
from rigs.ros_rig import call
from worlds.compensation_files import save

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.setup import make_world

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


def baseline(folder):
    """Write the compensation.json of the arm that the world of the rig hides."""
    cell = read_cell('demo')
    truth = make_world(folder / 'twin', cell, SEED, 1.0).truth
    model = replace(
        ArmModel.nominal(cell.chain()),
        joint_offsets=truth.joint_offsets,
        T_R_N={'mocap': truth.sensors['mocap'].T_R_N},
        markers=dict(truth.markers),
    )
    return save(folder, model, cell.urdf_text)


def test_eight_configurations_are_visited_and_judged(start, client, tmp_path):
    table, history = tmp_path / 'check.csv', tmp_path / 'arm.jsonl'
    few = ('--poses', 8, '--validation', 4, '--reference-every', 0)
    done = remaster('plan', 'demo', *few, '--check', table, '--json')
    expected = json.loads(done.stdout)['check']
    given = {'compensation': baseline(tmp_path), 'check_poses': table, 'history': history}
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], collect=False, judged=given)
    said = []

    def begun():
        said.append(call(client, '/remaster/check'))
        return said[-1].success

    cell.until(begun, 'the bridge to be known')
    # Before the arm moves: how long, and which change is found.
    words = said[-1].message
    assert words.startswith('8 configurations follow, some ')
    assert 'joint_1: none: looks like a sensor that was moved' in words
    size = expected['detectable_mm']['joint_2']
    shown_mm = float(words.partition('joint_2: ')[2].split()[0])
    assert abs(shown_mm / size - 1.0) < 0.3

    session = cell.complete()
    m = session.measurements
    q = np.radians(np.loadtxt(table, delimiter=',', skiprows=1))
    np.testing.assert_allclose(m.q, q, atol=1e-3)
    assert m.is_validation.all()
    # With the first way and a settle time that the rig has shorter: still within the limit.
    assert m.stamp_s[-1] - m.stamp_s[0] < 90.0
    cell.until(lambda: cell.said['pose_planner']['verdict'], 'the verdict')
    answer = call(client, '/remaster/check')
    assert answer.success
    assert answer.message.startswith('unchanged: ')
    (line,) = history.read_text().splitlines()
    assert json.loads(line)['session'] == 'session'
    assert 'unchanged' in (tmp_path / 'session.check.html').read_text()
    assert 'holds something else' in call(client, '/remaster/verify').message
