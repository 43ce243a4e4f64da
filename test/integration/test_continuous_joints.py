# SPDX-License-Identifier: Apache-2.0
"""An arm with joints that turn without end, as many wrists do, through the commands of the job."""

import json

import numpy as np
import pytest
from rigs.command_line import remaster
from worlds.simple_cells import four_markers

from remaster_ros.planning import moving_design, planned_design, pose_design
from remaster_ros.session.cells.workcell import config_path, read_cell

CONTINUOUS = ('joint_1', 'joint_3', 'joint_5', 'joint_7')
MEASURED = ('joint_2', 'joint_3', 'joint_4', 'joint_5', 'joint_6')


@pytest.fixture(scope='module')
def cell(tmp_path_factory):
    """Return the path of a cell file: four markers, and every other joint without limits."""
    folder = tmp_path_factory.mktemp('continuous')
    urdf = config_path('robots/lwr4plus.urdf').read_text(encoding='utf-8')
    for name in CONTINUOUS:
        old = f'<joint name="{name}" type="revolute">'
        assert old in urdf
        urdf = urdf.replace(old, f'<joint name="{name}" type="continuous">')
    (folder / 'arm.urdf').write_text(urdf, encoding='utf-8')
    robot = {'urdf': 'arm.urdf', 'base_link': 'base_link', 'tip_link': 'tool'}
    return four_markers(folder / 'cell.yaml', robot=robot)


@pytest.fixture(scope='module')
def session(cell):
    folder = cell.parent / 'session'
    given = ('--poses', 40, '--validation', 20, '--seed', 3)
    remaster('simulate', folder, '--cell', cell, *given, '--quiet')
    return folder


def test_offsets_are_fitted_and_every_form_of_them_is_written(session, tmp_path):
    remaster('fit', session, '--out', tmp_path / 'fit', '--quiet')
    fit = json.loads((tmp_path / 'fit/fit.json').read_text(encoding='utf-8'))
    truth = json.loads((session / 'truth.json').read_text(encoding='utf-8'))
    true = {row['joint']: row['offset_deg'] for row in truth['joint_offsets']}
    for row in fit['joint_offsets']:
        if row['joint'] in MEASURED:
            # Five of them: beyond 4.5 std by chance once in 30,000 seeds.
            assert abs(row['mean_deg'] - true[row['joint']]) < 4.5 * row['std_deg']
    applied = tmp_path / 'fit/apply/compensation.json'
    for form in ('urdf', 'json', 'csv', 'pad'):
        remaster('export', applied, '--to', form, '--out', tmp_path / form, '--quiet')
    targets = tmp_path / 'targets.csv'
    rows = '\n'.join(','.join(['400', '20', '-500', '60', '30', '40', '10']) for _ in range(2))
    names = ','.join(f'joint_{i} [deg]' for i in range(1, 8))
    targets.write_text(f'{names}\n{rows}\n', encoding='utf-8')
    remaster('compensate', applied, targets, '--out', tmp_path / 'corrected.csv', '--quiet')


def test_causes_are_sought(session, tmp_path):
    remaster('discover', session, '--out', tmp_path / 'd', '--quiet')
    assert (tmp_path / 'd/report.html').exists()


@pytest.mark.parametrize('moving', [(), ('--moving', 24)], ids=['stop and go', 'moving'])
def test_poses_and_curves_are_planned(moving, cell, tmp_path, monkeypatch):
    monkeypatch.setattr(planned_design, 'POOL_CANDIDATES', 60)
    monkeypatch.setattr(pose_design, 'EFFORT', 300)
    monkeypatch.setattr(moving_design, 'EXCHANGES', 15)
    out, _ = remaster('plan', cell, *moving, '--out', tmp_path / 'plan.html', '--json')
    assert json.loads(out)
    assert (tmp_path / 'plan.html').exists()


def test_a_cell_is_proposed(cell, tmp_path):
    given = ('--out', tmp_path / 'proposed.yaml', '--no-plan', '--quiet')
    remaster('init', cell.parent / 'arm.urdf', *given)
    chain = read_cell(tmp_path / 'proposed.yaml').chain()
    assert int(np.isinf(chain.upper).sum()) == len(CONTINUOUS)
