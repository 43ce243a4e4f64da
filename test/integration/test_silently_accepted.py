# SPDX-License-Identifier: Apache-2.0
"""What was taken without a word, or refused with the wrong one: one line that names the remedy."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import ROOT, refusal, remaster, run
from worlds import robot_descriptions

from remaster_ros.kinematics.transforms import transform
from remaster_ros.session.records.reader import read_chain, read_session, write_session
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor


def cell_with(folder: Path, *changes: tuple[str, str]) -> Path:
    """Copy the demo's cell with its robot, and change its text."""
    (folder / 'cells').mkdir(parents=True, exist_ok=True)
    shutil.copytree(ROOT / 'config' / 'robots', folder / 'robots', dirs_exist_ok=True)
    text = (ROOT / 'config' / 'cells' / 'demo.yaml').read_text(encoding='utf-8')
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path = folder / 'cells' / 'mine.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def simulate(cell: Path, *options: object) -> tuple[object, ...]:
    return ('simulate', cell.parent / 'out', '--cell', cell, '--poses', 8, *options)


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('made') / 'session'
    remaster('simulate', folder, '--poses', 12, '--validation', 4, '--quiet')
    return folder


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('marker_std_m: 0.5e-3', 'marker_std_m: 0.5', 'if millimetres were meant, write 0.0005'),
        ('azimuth_deg: [0.0, 360.0]', 'azimuth_deg: [-1.05, 1.05]', 'write -60.16, 60.16'),
        ('roll_deg: [0.0, 360.0]', 'roll_deg: [0, 6.2832]', 'write 0, 360'),
        ('azimuth_deg: [0.0, 360.0]', 'azimuth_deg: [60, -60]', 'from 60 down to -60'),
        ('radius_m: [0.2, 0.5]', 'radius_m: [200, 500]', 'if millimetres were meant, write 0.2'),
        ('height_m: [0.4, 0.8]', 'height_m: [0.4, 800]', 'if millimetres were meant, write 0.8'),
        (
            'radius_m: [0.2, 0.5]',
            'radius_m: [-0.2, 0.5]',
            'radius_m is -0.2; it must be from 0 to 10 m',
        ),
        ('sir: [0.1, 0.0, 0.0]', 'sir: [100, 0.0, 0.0]', 'if millimetres were meant, write 0.1'),
        ('[1.9, 0.0, 1.3]', '[1900, 0.0, 1300]', 'if millimetres were meant, write 1.9'),
        ('max_angle_deg: 60.0', 'max_angle_deg: 1.05', 'if radians were meant, write 60.16'),
        ('link_radius_m: 0.075', 'link_radius_m: 75', 'if millimetres were meant, write 0.075'),
    ],
)
def test_a_number_in_another_unit(old: str, new: str, words: str, tmp_path: Path) -> None:
    line = refusal(*simulate(cell_with(tmp_path, (old, new))))
    assert 'mine.yaml: ' in line
    assert new.split(':')[0].split(' ')[0] in line or 'rough_position_m' in line
    assert words in line


def test_narrow_ranges_of_degrees_that_begin_elsewhere_are_taken(tmp_path: Path) -> None:
    """The shipped cell itself is taken everywhere else; held at one angle is no range at all."""
    cell = cell_with(tmp_path, ('roll_deg: [0.0, 360.0]', 'roll_deg: [1.0, 1.0]'))
    assert run(*simulate(cell, '--poses', 30)).returncode in (0, 2)
    line = refusal(*simulate(cell_with(tmp_path, ('marker_std_m', 'marker_stdm'))))
    assert 'marker_stdm' in line


def test_markers_of_a_session_in_another_unit(session: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(session, tmp_path / 's'))
    header = copy / 'session.yaml'
    text = header.read_text(encoding='utf-8')
    header.write_text(text.replace('marker_std_m: 0.0005', 'marker_std_m: 0.5'), encoding='utf-8')
    line = refusal('fit', copy, '--out', tmp_path / 'out')
    assert 'session.yaml: marker_std_m is 0.5; it must be from 0 to 0.4 m' in line
    assert 'if millimetres were meant, write 0.0005; 0.3 where nothing is known' in line


def test_ten_degrees_are_not_simulated(tmp_path: Path) -> None:
    line = refusal('simulate', tmp_path / 'out', '--offset-std-deg', 10)
    assert '--offset-std-deg: 10 is more than 2 deg' in line


def test_offsets_of_ten_degrees_lead_to_a_warning(tmp_path: Path) -> None:
    robot = robot_descriptions.ur5e()
    chain = read_chain(robot.urdf, tmp_path, robot.base_link, robot.tip_link)
    rng = np.random.default_rng(3)
    made, _ = simulate_session(
        chain,
        robot.urdf,
        rng,
        poses=[rng.uniform(-2.5, 2.5, (4, 6)) for _ in range(20)],
        validation_poses=[rng.uniform(-2.5, 2.5, (4, 6)) for _ in range(8)],
        sensors={'mocap': SimulatedSensor('sir', transform(np.eye(3), (2.0, 0.3, 1.0)))},
        markers={'sir': np.array([0.1, 0.0, 0.02])},
        joint_offsets=np.radians([0.0, 0.1, 10.0, -0.2, 0.3, 0.0]),
    )
    write_session(tmp_path / 's', made)
    out = tmp_path / 'fit'
    process = remaster('fit', tmp_path / 's', '--out', out)
    (warning,) = [line for line in process.stderr.splitlines() if line.startswith('WARNING')]
    assert 'elbow_joint: an offset of 10.0' in warning
    assert 'check joint order, signs and units' in warning
    page = (out / 'report.html').read_text(encoding='utf-8')
    assert 'class="verdict bad"' in page
    assert 'Do not apply the offsets yet' in page
    for path in (out / 'apply').iterdir():
        assert 'CHECK FIRST: elbow_joint: an offset of 10.0' in path.read_text(), path.name
    # Tenths of a degree are what is looked for.
    assert 'wrist_1_joint: an offset' not in page


def test_a_xacro_file_is_named_as_such(session: Path, tmp_path: Path) -> None:
    xacro = tmp_path / 'arm.urdf.xacro'
    xacro.write_text(
        '<?xml version="1.0"?>\n'
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm">\n'
        '  <xacro:include filename="$(find arm)/urdf/arm_macro.xacro"/>\n'
        '  <xacro:arm prefix=""/>\n</robot>\n',
        encoding='utf-8',
    )
    line = refusal('simulate', tmp_path / 'out', '--robot', xacro)
    assert 'arm.urdf.xacro: URDF: this is xacro' in line
    assert 'expand it: remaster init FILE (or ros2 run xacro xacro FILE > robot.urdf)' in line
    copy = Path(shutil.copytree(session, tmp_path / 's'))
    shutil.copy(xacro, copy / 'robot.urdf')
    assert 'robot.urdf: URDF: this is xacro' in refusal('fit', copy, '--out', tmp_path / 'fit')


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda t: t.replace('.', '!').replace(',', ';').replace('!', ','), 'by semicolons'),
        (lambda t: t.replace(',', ';'), 'by semicolons'),
        (lambda t: t.replace(',', '\t'), 'by tabs'),
    ],
    ids=['semicolons and decimal commas', 'semicolons', 'tabs'],
)
def test_another_separator_is_named(change, words: str, session: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(session, tmp_path / 's'))
    rows = copy / 'observations.csv'
    rows.write_text(change(rows.read_text(encoding='utf-8')), encoding='utf-8')
    line = refusal('fit', copy, '--out', tmp_path / 'out')
    assert f'observations.csv, line 1: columns are separated {words}; save it with commas' in line


@pytest.mark.parametrize('encoding', ['utf-16', 'utf-16-le', 'utf-16-be'])
@pytest.mark.parametrize('name', ['observations.csv', 'session.yaml', 'robot.urdf'])
def test_utf_16_is_named(name: str, encoding: str, session: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(session, tmp_path / 's'))
    text = (copy / name).read_text(encoding='utf-8')
    (copy / name).write_text(text, encoding=encoding)
    line = refusal('fit', copy, '--out', tmp_path / 'out')
    assert f'{name}: this is UTF-16 text; save the file as UTF-8' in line


@pytest.mark.parametrize('empty', ['', 'null', '~', '""'])
def test_six_joints_with_an_empty_held_joint(empty: str, tmp_path: Path) -> None:
    robot = robot_descriptions.irb120()
    (tmp_path / 'irb120.urdf').write_text(robot.urdf, encoding='utf-8')
    cell = cell_with(
        tmp_path,
        ('../robots/lwr4plus.urdf', str(tmp_path / 'irb120.urdf')),
        ('tip_link: tool', 'tip_link: tool0'),
        ('held_joint: joint_3', f'held_joint: {empty}'),
        ('held_values_deg: [0.0]', 'held_values_deg:' if empty != '""' else 'held_values_deg: []'),
    )
    out = tmp_path / 'session'
    remaster('simulate', out, '--cell', cell, '--poses', 30, '--validation', 8)
    assert read_session(out).measurements.q.shape[1] == 6


def test_six_joints_of_which_one_is_held(tmp_path: Path) -> None:
    robot = robot_descriptions.irb120()
    (tmp_path / 'irb120.urdf').write_text(robot.urdf, encoding='utf-8')
    cell = cell_with(
        tmp_path,
        ('../robots/lwr4plus.urdf', str(tmp_path / 'irb120.urdf')),
        ('tip_link: tool', 'tip_link: tool0'),
    )
    assert 'hold none of six or fewer, one of seven' in refusal(*simulate(cell))


def test_a_copied_cell_names_the_path_that_was_tried(tmp_path: Path) -> None:
    cell = tmp_path / 'mine.yaml'
    shutil.copy(ROOT / 'config' / 'cells' / 'demo.yaml', cell)
    line = refusal('simulate', tmp_path / 'out', '--cell', cell)
    assert f'{tmp_path.parent.resolve()}/robots/lwr4plus.urdf: no such file' in line
    assert "mine.yaml is '../robots/lwr4plus.urdf', which is relative to that file" in line
    assert 'absolute path' in line


def test_a_robot_that_the_links_do_not_fit_is_named(tmp_path: Path) -> None:
    line = refusal(*simulate(cell_with(tmp_path, ('tip_link: tool', 'tip_link: hand'))))
    assert "lwr4plus.urdf: URDF: there is no link 'hand'" in line


def test_seven_joints_of_which_the_wrong_one_is_held(tmp_path: Path) -> None:
    """The error lists what is allowed; with one of those there is a session."""

    def cell(joint: str, degrees: float) -> Path:
        return cell_with(
            tmp_path,
            ('held_joint: joint_3', f'held_joint: {joint}'),
            ('held_values_deg: [0.0]', f'held_values_deg: [{degrees}]'),
        )

    line = refusal(*simulate(cell('joint_4', 30.0)))
    assert 'held_joint in the cell file may be ' in line
    offered = line.partition('may be ')[2].split(' or ')
    names = [words.split()[0] for words in offered]
    assert names == [f'joint_{i}' for i in (1, 3, 5, 7)]
    degrees = float(offered[-1].split('(at ')[1].split()[0])
    out = tmp_path / 'session'
    remaster(
        'simulate', out, '--cell', cell(names[-1], degrees), '--poses', 60, '--validation', 20
    )
    assert len(json.loads((out / 'truth.json').read_text())['joint_offsets']) == 7


@pytest.mark.parametrize('held_joint', ['', 'panda_joint3'])
def test_a_joint_whose_holding_leaves_no_closed_form_may_be_held(
    held_joint: str, tmp_path: Path
) -> None:
    """Nobody named: the third one."""
    description = robot_descriptions.panda()
    (tmp_path / 'arm.urdf').write_text(description.urdf, encoding='utf-8')
    cell = cell_with(
        tmp_path,
        ('../robots/lwr4plus.urdf', str(tmp_path / 'arm.urdf')),
        ('base_link: base_link', f'base_link: {description.base_link}'),
        ('tip_link: tool', f'tip_link: {description.tip_link}'),
        ('held_joint: joint_3', f'held_joint: {held_joint}'),
        ('held_values_deg: [0.0]', 'held_values_deg: [30.0]'),
    )
    out = tmp_path / 'session'
    remaster('simulate', out, '--cell', cell, '--poses', 30, '--validation', 8)
    assert len(json.loads((out / 'truth.json').read_text())['joint_offsets']) == 7


def test_a_small_session_is_still_read(session: Path, tmp_path: Path) -> None:
    """Neither zeros that a power cut leaves nor a quoted header are taken for something else."""
    measurements = read_session(session).measurements
    full_session = read_session(session)
    write_session(
        tmp_path / 's', replace(full_session, measurements=measurements.select(np.arange(4)))
    )
    rows = tmp_path / 's' / 'observations.csv'
    rows.write_bytes(rows.read_bytes() + b'\0' * 200)
    assert len(read_session(tmp_path / 's').measurements) == 4
