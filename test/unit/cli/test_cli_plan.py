# SPDX-License-Identifier: Apache-2.0
"""`remaster plan`: what is printed, as text and as JSON, and what is refused."""

import json
import re

import pytest
from rigs.command_line import refusal, remaster
from worlds.discovery_files import discovery_content, effect, look_alike
from worlds.simple_cells import edited_cell, four_markers
from worlds.sliding_cells import rail, sliding_cell

from remaster_ros.planning import moving_design, planned_design, pose_design, tour_planner


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(planned_design, 'POOL_CANDIDATES', 60)
    monkeypatch.setattr(pose_design, 'EFFORT', 300)
    monkeypatch.setattr(moving_design, 'EXCHANGES', 15)


HYPERCUBE = '  design: latin_hypercube\n'


def cell_with(folder, poses):
    keys = poses if 'design:' in poses else HYPERCUBE + poses
    return edited_cell(folder / 'cell.yaml', (HYPERCUBE, keys))


def as_json(*args):
    out, err = remaster('plan', *args, '--json')
    assert err == ''
    return json.loads(out)


FEW = ('--poses', 16, '--validation', 16)


def test_the_object_says_what_is_planned():
    found = as_json('demo', *FEW, '--reference-every', 0)
    assert found['poses'] == sum(part['poses'] for part in found['splits'].values())
    assert found['configurations'] == sum(part['visits'] for part in found['splits'].values())
    assert (
        found['poses'] + sum(found['dropped'].values())
        == 32 + found['splits']['registration']['poses']
    )
    assert found['splits']['registration']['visits'] == 3
    assert found['goal'] is None
    std = found['expected_std_deg']
    assert list(std) == [f'joint_{i}' for i in range(1, 8)]
    assert std['joint_1'] is None
    assert 0.0 < std['joint_2'] < 0.1
    assert 0.0 < found['expected_tool_std_mm'] < 1.0
    assert found['max_tool_speed_m_s'] <= 0.25
    assert found['robot_time_s'] > 3.5 * found['configurations']


def test_an_optimal_design_is_as_precise_in_less_time(tmp_path):
    full_plan = as_json('demo', *FEW)
    path = cell_with(tmp_path, '  design: optimal\n  solutions: chosen\n  order: fastest\n')
    optimal = as_json(path, *FEW)
    assert optimal['goal']['reached']
    assert (
        optimal['expected_rms_std_deg'] <= max(full_plan['expected_rms_std_deg'], 0.005) * 1.0001
    )
    assert optimal['configurations'] < full_plan['configurations']
    assert optimal['robot_time_s'] < full_plan['robot_time_s']
    assert optimal['dropped']['not needed by the design'] > 0


def test_people_read_a_subject_a_line():
    out, err = remaster('plan', 'demo', *FEW)
    assert err == ''
    for words in (
        'to fit: ',
        'held out: ',
        'references: ',
        'dropped poses: ',
        'registration: ',
        'robot time of the whole session: ',
    ):
        assert words in out
    assert 'joint_1              not identifiable' in out
    assert remaster('plan', 'demo', *FEW, '--quiet').stdout == ''


def test_the_time_is_that_of_the_stated_speeds():
    slow = as_json('demo', *FEW)
    fast = as_json('demo', *FEW, '--cartesian-speed-limit', 0)
    assert fast['robot_time_s'] < slow['robot_time_s']
    assert fast['max_tool_speed_m_s'] > 0.25
    patient = as_json('demo', *FEW, '--settle', 5)
    more = patient['robot_time_s'] - slow['robot_time_s']
    assert more == pytest.approx(2.0 * slow['configurations'], abs=0.2)


@pytest.mark.parametrize(
    ('poses', 'words'),
    [
        ('  design: best\n', 'poses.design'),
        (
            '  design: optimal\n  tool_box: {center_m: [3, 0, 0], size_m: [1, 1, 1]}\n',
            'no configuration has the tool in poses.tool_box',
        ),
    ],
)
def test_a_wrong_cell_is_one_line(tmp_path, poses, words):
    assert words in refusal('plan', cell_with(tmp_path, poses), *FEW)


def test_too_few_poses_are_told_from_too_few_measurements():
    few = ('--poses', 2, '--validation', 0, '--reference-every', 0)
    err = refusal('plan', 'demo', *few, status=1)
    assert '1 poses to fit can be visited, too few' in err
    assert 'plan more candidates, or widen their ranges in the cell file' in err


def test_a_cell_without_reachable_poses_is_one_line(tmp_path):
    far = ('radius_m: [0.2, 0.5]', 'radius_m: [3.0, 3.5]')
    path = edited_cell(tmp_path / 'cell.yaml', far)
    assert 'no pose is left to fit on' in refusal('plan', path, status=1)


def discovery_file(folder, look_alikes):
    """Write a discovery.json of a scale of joint 6."""
    rivals = [look_alike(name, (6,), separate_by=words) for name, words in look_alikes.items()]
    size = {'name': 'scale_6', 'value': 1e-3, 'std': 1e-4, 'unit': '1'}
    cause = effect(
        'encoder_scale', (6,), driver='own_angle', parameters=[size], confusable_with=rivals
    )
    path = folder / 'discovery.json'
    path.write_text(json.dumps(discovery_content(cause)), encoding='utf-8')
    return path


def test_what_separates_two_causes_is_added_to_the_plan(tmp_path, monkeypatch):
    monkeypatch.setattr(tour_planner, 'POOL_CANDIDATES', 40)
    look_alikes = {'encoder_eccentricity': 'the whole range', 'backlash': 'both sides'}
    path = discovery_file(tmp_path, look_alikes)
    options = (*FEW, '--reference-every', 0)
    plain = as_json('demo', *options)
    found = as_json('demo', *options, '--separate', path)
    added = found['separate']
    assert 0 < added['configurations'] == len(added['q_deg']) <= 25
    assert len(added['q_deg'][0]) == 7
    assert found['splits']['optimization']['visits'] == (
        plain['splits']['optimization']['visits'] + added['configurations']
    )
    assert found['robot_time_s'] > plain['robot_time_s']
    (pair,) = added['pairs']
    assert pair['std_apart'] > pair['std_apart_before']
    assert added['otherwise'] == ['encoder scale of joint 6 and backlash of joint 6: both sides']
    assert 'separate' not in plain
    out = remaster('plan', 'demo', *options, '--separate', path).stdout
    assert f'of these to separate causes: {added["configurations"]} configurations' in out
    assert 'poses do not separate encoder scale of joint 6 and backlash of joint 6' in out


def test_without_look_alikes_there_is_nothing_to_separate(tmp_path):
    path = discovery_file(tmp_path, {})
    said = refusal('plan', 'demo', *FEW, '--separate', path)
    assert 'none of its causes has a look-alike' in said
    assert 'none.json' in refusal('plan', 'demo', '--separate', tmp_path / 'none.json')


def test_measured_motion_is_planned_and_said(tmp_path):
    cell = four_markers(tmp_path / 'cell.yaml', poses={'joint_std_deg': 0.0005})
    found = as_json(cell, '--moving', 24)
    moving = found['moving']
    assert moving['moving_s'] == pytest.approx(sum(moving['curves_s']), abs=0.1)
    assert len(moving['curves_s']) == 8
    assert moving['share_in_sight'] > 0.99
    assert moving['max_joint_share'] <= 1.0
    assert moving['max_tool_speed_m_s'] <= 0.25
    assert moving['proof_poses'] == found['splits']['validation']['visits'] == 8
    assert found['splits']['optimization']['visits'] == 1
    assert found['splits']['registration']['visits'] == 3
    assert found['robot_time_s'] > moving['moving_s'] + 3.5 * 12
    assert 0.0 < found['expected_std_deg']['joint_2'] < 0.05
    assert moving['expected_rms_std_own_deg'] > 1.5 * found['expected_rms_std_deg']
    assert found['goal'] is None
    out, err = remaster('plan', cell, '--moving', 24)
    assert err == ''
    for words in (
        f'to fit: {moving["moving_s"]:.1f} s of motion, measured all along: 8 curves',
        'held out: 8 configurations at 8 poses, measured at standstill',
        f'robot time of the whole session: {found["robot_time_s"]:.0f} s',
        'every marker in sight: 100 % of the measured motion',
        f'fastest joint: {moving["fastest_joint"]} at ',
        'deg if each marker errs by 0.05 mm by itself, too',
        'not reached: poses.joint_std_deg 0.0005; some ',
    ):
        assert words in out
    assert 'moving' not in as_json('demo', *FEW)


def test_cells_that_cannot_be_measured_in_motion_are_refused_with_the_time_otherwise(tmp_path):
    said = refusal('plan', 'demo', *FEW, '--moving')
    assert 'mocap sees 1 marker, and motion takes 4' in said
    assert re.search(r'or measure by stop and go: some \d+\.\d min$', said)
    three = four_markers(tmp_path / 'three.yaml', count=3)
    assert 'mocap sees 3 markers, and motion takes 4' in refusal('plan', three, *FEW, '--moving')
    path = sliding_cell(tmp_path, rail())
    assert 'slides' in refusal('plan', path, *FEW, '--moving')
    four = four_markers(tmp_path / 'four.yaml')
    found = refusal('plan', four, '--moving', '--separate', 'causes.json')
    assert 'leave one of them out' in found
    assert '--moving' in refusal('plan', four, '--moving', 3)
