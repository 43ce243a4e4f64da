# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions become cell files in which poses can be planned, without an edit."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.robot_descriptions import ROBOTS, Description, xarm7

from remaster_ros.cli import init
from remaster_ros.cli import plan as plan_verb
from remaster_ros.cli.plan import free_start
from remaster_ros.compensation.arm_model import Geometry
from remaster_ros.compensation.export import calibrated_urdf
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning import planned_design, pose_design
from remaster_ros.session.cells.workcell import read_cell

CASES = Path(__file__).parents[4] / 'shared' / 'cases'
XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Fewer poses to try and to choose from: what is proposed and planned is the same in kind."""
    monkeypatch.setattr(init, 'TRIED', 60)
    monkeypatch.setattr(planned_design, 'POOL_CANDIDATES', 60)
    monkeypatch.setattr(pose_design, 'EFFORT', 300)


@pytest.fixture
def do(tmp_path):
    def init_verb(*args, out='cell.yaml', status=0):
        printed = remaster('init', *args, '--out', tmp_path / out, status=status)
        assert status == 0 or printed.stderr.count('\n') == 1
        return printed

    return init_verb


def written(folder, description: Description, name='robot.urdf'):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(description.urdf)
    return path


@pytest.mark.parametrize(
    ('robot', 'held_joint'),
    [
        pytest.param('ur5e', '', marks=pytest.mark.qualify),
        ('irb120', ''),
        pytest.param('panda', 'panda_joint5', marks=pytest.mark.qualify),
        pytest.param('iiwa14', 'lbr_A3', marks=pytest.mark.qualify),
        pytest.param('xarm7', 'joint5', marks=pytest.mark.qualify),
    ],
)
def test_known_arms_go_to_a_finished_plan_without_an_edit(robot, held_joint, do, tmp_path):
    """Two commands: a cell file, and the page of its plan. The UR is a xacro file."""
    description = {**ROBOTS, 'xarm7': xarm7}[robot]()
    is_xacro = robot == 'ur5e'
    path = (macro if is_xacro else written)(tmp_path, description)
    arguments = ['name:=mine'] if is_xacro else []
    found = json.loads(do(path, *arguments, '--json').stdout)
    assert (found['held_joint'] or '') == held_joint
    cell = read_cell(tmp_path / 'cell.yaml')
    assert cell.held_joint == held_joint
    assert (cell.robot.base_link, cell.robot.tip_link) == (found['base_link'], found['tip_link'])
    plan = found['plan']
    print(robot, plan)
    assert plan['configurations'] > plan['poses'] > 10
    # Of 60 to fit, 60 further ones that the design chooses from, and 60 held out.
    assert plan['poses'] + sum(plan['dropped'].values()) == 180
    assert list(plan['expected_std_deg']) == list(cell.chain().joint_names)
    # Whoever has just met this arm is shown what it will do.
    assert cell.confirm
    poses = 40 if robot == 'panda' else 8
    few = ('--poses', poses, '--validation', 3, '--reference-every', 0, '--seed', 1)
    page = tmp_path / 'plan.html'
    output = remaster('plan', tmp_path / 'cell.yaml', *few, '--json', '--out', page).stdout
    plan = json.loads(output)
    html = page.read_text(encoding='utf-8')
    assert f'{plan["configurations"]} configurations at {plan["poses"]} poses in ' in html
    assert plan['robot_time_s'] > 10.0
    # The visual meshes of these descriptions are in packages that are not here.
    assert 'package://a' in html
    assert 'drawn as the collision checks have them' in html


def test_the_held_joint_is_the_one_with_the_most_solutions(do, tmp_path):
    do(written(tmp_path, ROBOTS['iiwa14']()), '--no-plan')
    text = (tmp_path / 'cell.yaml').read_text().replace('\n# ', ' ')
    tried = dict(
        part.rsplit(' ', 1)
        for part in text.split('on average: ')[1].split('. Several')[0].split(', ')
        if 'none' not in part
    )
    assert max(tried, key=lambda name: float(tried[name])) == 'lbr_A3'
    assert 'lbr_A4 none (singular everywhere)' in text


def macro(folder, description, package='my_arm'):
    """Write a description in xacro, with an argument, as a package in a folder of another name."""
    home = folder / 'src' / 'clone_of_it'
    (home / 'urdf').mkdir(parents=True)
    (home / 'package.xml').write_text(f'<package><name>{package}</name></package>')
    body = description.urdf[
        description.urdf.index('<material') : description.urdf.index('</robot>')
    ]
    (home / 'urdf' / 'arm.xacro').write_text(f'<robot {XACRO}>{body}</robot>')
    (home / 'urdf' / 'robot.urdf.xacro').write_text(
        f'<robot name="$(arg name)" {XACRO}>'
        f'<xacro:include filename="$(find {package})/urdf/arm.xacro"/></robot>'
    )
    return home / 'urdf' / 'robot.urdf.xacro'


def test_xacro_is_expanded_beside_the_cell_with_packages_found_by_their_name(do, tmp_path):
    path = macro(tmp_path, ROBOTS['irb120']())
    error = do(path, status=2).stderr
    assert 'Undefined substitution argument name; give it behind the file: name:=VALUE' in error
    do(path, 'name:=mine', '--no-plan')
    cell = read_cell(tmp_path / 'cell.yaml')
    assert cell.robot.urdf == 'robot.urdf'
    assert cell.chain().name == 'mine'
    assert 'xacro:' not in cell.urdf_text.split('-->', 1)[1]


@pytest.mark.parametrize('name', ['arm.urdf.xacro', 'arm.urdf'])
@pytest.mark.parametrize('verb', ['init', 'import'])
def test_a_description_runs_no_command(tmp_path, verb, name):
    canary = tmp_path / 'canary'
    urdf = ROBOTS['irb120']().urdf.replace('<robot ', f'<robot {XACRO} ')
    popen = "[c for c in ().__class__.__base__.__subclasses__() if c.__name__ == 'Popen'][0]"
    shell = f"${{(lambda: {popen}('touch {canary}', shell=True).wait())()}}"
    path = tmp_path / name
    path.write_text(
        urdf.replace(
            '</robot>', f'<xacro:property name="a" value="{shell}"/><link name="${{a}}"/></robot>'
        )
    )
    table = tmp_path / 'table.csv'
    table.write_text('A1;A2;A3;A4;A5;A6;X;Y;Z\n1;2;3;4;5;6;7;8;9\n')
    out = tmp_path / 'out'
    args = [path, '--out', out] if verb == 'init' else [table, '--urdf', path, '--out', out]
    error = refusal(verb, *args)
    assert name in error
    assert ('a lambda' if name.endswith('xacro') else 'let its name end in .xacro') in error
    assert not canary.exists()
    assert not out.exists()


def test_a_package_that_is_elsewhere_is_asked_for_and_found(do, tmp_path, monkeypatch):
    path = macro(tmp_path, ROBOTS['irb120']())
    elsewhere = tmp_path / 'elsewhere'
    (tmp_path / 'src' / 'clone_of_it').rename(elsewhere)
    moved_file = tmp_path / 'apart' / 'robot.urdf.xacro'
    moved_file.parent.mkdir()
    (elsewhere / 'urdf' / path.name).rename(moved_file)
    (elsewhere / 'package.xml').rename(elsewhere / 'package.xml.off')
    error = do(moved_file, 'name:=mine', status=2).stderr
    assert 'it needs the ROS package my_arm' in error
    assert '--package-path' in error
    (elsewhere / 'package.xml.off').rename(elsewhere / 'package.xml')
    # Given relative to where the command is run, not to the xacro file.
    monkeypatch.chdir(tmp_path)
    do(moved_file, 'name:=mine', '--package-path', 'elsewhere', '--no-plan')


def test_meshes_are_found_or_named(do, tmp_path):
    description = ROBOTS['irb120']()
    mesh = '<geometry><mesh filename="package://abb/meshes/{}.stl"/></geometry>'
    cylinder = '<geometry><cylinder radius="0.06" length="0.2"/></geometry>'
    urdf = description.urdf.replace(cylinder, mesh.format('part'), 1)
    assert urdf != description.urdf
    robot = tmp_path / 'robots' / 'robot.urdf'
    robot.parent.mkdir()
    robot.write_text(urdf)
    out = do(robot, '--no-plan').stdout
    assert '1 meshes were not found, such as package://abb/meshes/part.stl' in out
    assert '#   package://abb/meshes/part.stl' in (tmp_path / 'cell.yaml').read_text()

    import trimesh

    folder = tmp_path / 'workspace' / 'abb' / 'meshes'
    folder.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.1, 0.2)).export(folder / 'part.stl')
    given = ('--package-path', tmp_path / 'workspace', '--no-plan')
    assert 'not found' not in do(robot, *given, out='found.yaml').stdout
    cell = read_cell(tmp_path / 'found.yaml')
    assert cell.mesh_path == [str(tmp_path / 'workspace')]
    cell.collision_model(cell.chain())


def test_what_cannot_be_is_refused_in_one_line(do, tmp_path):
    robot = written(tmp_path, ROBOTS['irb120']())
    for args, words in (
        ([robot, '--tip-link', 'tool'], "there is no link 'tool'; it has base_link"),
        ([robot, '--tip-link', 'link_2'], 'has 2 joints between'),
        ([robot, '--sensors', 'traker'], "did you mean 'tracker'?"),
        ([robot, 'name=x'], "'name=x' is not NAME:=VALUE"),
        ([tmp_path / 'nothing.urdf'], 'no such file'),
    ):
        assert words in do(*args, status=2).stderr
        assert not (tmp_path / 'cell.yaml').exists()
    do(robot, '--no-plan')
    assert 'already there, and not overwritten' in do(robot, status=2).stderr


def test_a_place_and_both_sensors_can_be_told(do, tmp_path):
    robot = written(tmp_path, ROBOTS['ur5e']())
    both = ('--sensors', 'mocap,tracker', '--sensor-at', 0, -2.5, 1)
    do(robot, *both, '--no-floor', '--no-plan')
    cell = read_cell(tmp_path / 'cell.yaml')
    assert list(cell.sensors) == ['mocap', 'tracker']
    assert cell.aim_at == 'mocap'
    np.testing.assert_allclose(cell.sensors['mocap'].rough_position_m, [0.0, -2.5, 1.0])
    assert cell.floor_z_m is None


def test_an_arm_that_lies_on_the_floor_at_zero_is_planned_from_elsewhere(do, tmp_path):
    """A UR's zero is stretched out; no way to anywhere is free from there."""
    do(written(tmp_path, ROBOTS['ur5e']()), '--no-plan')
    cell = read_cell(tmp_path / 'cell.yaml')
    model = cell.planning_scene(cell.chain()).model
    assert model.reasons(np.zeros((1, 6)))[0] == 'hits the floor'
    assert model.reasons(free_start(model, 0)[None])[0] == ''
    few = ('--poses', 4, '--validation', 0, '--reference-every', 0, '--json')
    output = remaster('plan', tmp_path / 'cell.yaml', *few).stdout
    assert json.loads(output)['configurations'] > 0


@pytest.mark.parametrize('options', [(), ('--no-plan',)])
def test_a_cell_in_which_fewer_than_ten_poses_can_be_planned_ends_with_status_1(
    options, do, tmp_path
):
    """An arm whose joints hardly turn."""
    text = re.sub('upper="[^"]*"', 'upper="0.2"', ROBOTS['irb120']().urdf)
    robot = tmp_path / 'stiff.urdf'
    robot.write_text(re.sub('lower="[^"]*"', 'lower="-0.2"', text))
    error = do(robot, *options, status=1).stderr
    assert 'poses can be planned in this cell, and a calibration needs 10; correct' in error
    assert (tmp_path / 'cell.yaml').exists()


def gantry(between: str = '') -> str:
    """Return a URDF of three slides and three wrist axes, with something that the base carries."""
    slides = [
        (f'{axis}_axis', 'prismatic', unit, origin, travel)
        for axis, unit, origin, travel in (
            ('x', '1 0 0', '0 0 0', 0.6),
            ('y', '0 1 0', '0 0 0', 0.5),
            ('z', '0 0 1', '0 0 0.8', 0.3),
        )
    ]
    wrist = [
        (name, 'revolute', unit, '0 0 0.1', turn)
        for name, unit, turn in (('a', '0 0 1', 2.9), ('b', '0 1 0', 1.9), ('c', '0 0 1', 2.9))
    ]
    small = '<collision><geometry><box size="0.04 0.04 0.04"/></geometry></collision>'
    parts, parent = [f'<link name="base">{between}</link>'], 'base'
    for name, kind, unit, origin, most in (*slides, *wrist):
        child = 'tool0' if name == 'c' else f'{name}_link'
        parts.append(
            f'<link name="{child}">{small}</link><joint name="{name}" type="{kind}">'
            f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}"/>'
            f'<axis xyz="{unit}"/><limit lower="{-most}" upper="{most}" velocity="1" effort="1"/>'
            '</joint>'
        )
        parent = child
    return f'<robot name="gantry">{"".join(parts)}</robot>'


NO_WAY = r': a free way leads to 0 of the \d+ poses that were tried in this cell, and'
WALLS = ''.join(
    f'<collision><origin xyz="{x} 0 1.0"/><geometry><box size="0.02 3 3"/></geometry></collision>'
    for x in (-0.15, 0.15)
)


@pytest.mark.qualify
def test_a_gantry_between_walls_ends_with_status_1(do, tmp_path):
    """It could stand beyond them, where all the poses are, and does not get there."""
    robot = tmp_path / 'gantry.urdf'
    robot.write_text(gantry(WALLS))
    printed, error = do(robot, status=1)
    assert int(re.search(r'to fit: .* at (\d+) poses', printed)[1]) >= 10
    assert re.search(NO_WAY, error)
    assert 'give what slides its collision geometry in the URDF' in error
    assert 'every way, in 3-D' not in printed


@pytest.mark.parametrize('options', [('--no-plan',), ()])
def test_poses_that_no_free_way_leads_to_are_none_that_can_be_planned(
    options, do, tmp_path, monkeypatch
):
    """The arm can stand nowhere else than it begins: deep in the floor, from where none leads."""
    start = np.radians([0.0, 90.0, 60.0, 0.0, 0.0, 0.0])
    for module in (init, plan_verb):
        monkeypatch.setattr(module, 'free_start', lambda model, seed: start)
    error = do(written(tmp_path, ROBOTS['irb120']()), *options, status=1).stderr
    assert re.search(NO_WAY, error)
    assert 'what slides' not in error
    if not options:
        # The verb that it names agrees.
        said = refusal('plan', tmp_path / 'cell.yaml', status=1)
        assert 'no configuration can be reached' in said


@pytest.mark.qualify
def test_an_arm_of_five_axes_is_planned(do, tmp_path):
    printed, error = do(written(tmp_path, ROBOTS['irb120']()), '--tip-link', 'link_5')
    assert error == ''
    assert '5 joints between base_link and link_5' in printed
    assert 'takes few of all poses' in printed
    assert int(re.search(r'to fit: .* at (\d+) poses', printed)[1]) >= 10
    # The first and the last joint are the gauge of a marker without an orientation.
    unseen = re.findall(r'(\w+) +not identifiable', printed)
    assert unseen == ['joint_1', 'joint_5']


@pytest.mark.skipif(not CASES.is_dir(), reason='the descriptions of ../shared/cases are not here')
def test_a_five_axis_arm_with_a_gripper_is_prepared_and_planned(do, tmp_path):
    found = json.loads(do(CASES / 'so101.urdf', '--json').stdout)
    assert (found['base_link'], found['tip_link']) == ('base_link', 'gripper_frame_link')
    plan = found['plan']
    assert len(plan['expected_std_deg']) == 5
    assert plan['splits']['optimization']['poses'] >= 10
    assert plan['splits']['validation']['poses'] >= 10
    assert read_cell(tmp_path / 'cell.yaml').link_radius_m < 0.04


@pytest.mark.skipif(not CASES.is_dir(), reason='the descriptions of ../shared/cases are not here')
def test_a_scara_is_prepared_and_planned(do, tmp_path):
    found = json.loads(do(CASES / 'scara.urdf', '--json').stdout)
    assert (found['base_link'], found['tip_link']) == ('base_link', 'tool0')
    text = (tmp_path / 'cell.yaml').read_text()
    assert 'CHECK: the arm cannot turn its tool to the sensor' in text
    assert 'j3 0 to 200 mm' in text.replace('\n# ', ' ')
    plan = found['plan']
    assert plan['splits']['optimization']['poses'] >= 10
    # All of its axes are parallel: only the elbow's angle is seen by a marker.
    assert plan['expected_std_mm'] == {'j3': None}
    assert {name for name, std in plan['expected_std_deg'].items() if std} == {'j2'}


@pytest.mark.qualify
def test_a_rail_is_planned_with_the_arm_where_the_base_link_says_so(do, tmp_path, monkeypatch):
    # To look for the ways of this one takes minutes, and is for another test.
    monkeypatch.setattr(init, 'count_with_free_path', lambda *_: (10, 10))
    path = on_rail(tmp_path)
    printed = do(path, '--base-link', 'hall').stdout
    assert 'rail is held at -500 mm, 0 mm, 500 mm' in printed
    cell = read_cell(tmp_path / 'cell.yaml')
    assert cell.held_values_m == [-0.5, 0.0, 0.5]
    assert re.search(r'root mean square +[\d.]+ deg, where 4.36 mm count as a degree', printed)
    text = (tmp_path / 'cell.yaml').read_text()
    for values, words in (
        ('held_values_m: []', 'held_values_m is empty'),
        ('held_values_deg: [0.0]', 'rail slides; write held_values_m'),
    ):
        wrong = re.sub('held_values_m: .*', values, text)
        (tmp_path / 'wrong.yaml').write_text(wrong)
        with pytest.raises(InputError, match=words):
            read_cell(tmp_path / 'wrong.yaml')


def on_rail(folder):
    text = ROBOTS['irb120']().urdf.replace(
        '</robot>',
        '<link name="hall"/><joint name="rail" type="prismatic"><parent link="hall"/>'
        '<child link="base_link"/><axis xyz="1 0 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>',
    )
    path = folder / 'on_rail.urdf'
    path.write_text(text)
    return path


def test_a_rail_that_carries_the_arm_is_left_alone_and_said_so(do, tmp_path):
    printed = do(on_rail(tmp_path), '--no-plan').stdout
    assert '6 joints between base_link and tool0' in printed
    sentence = 'rail carries the whole arm, and is no joint of it here: leave it where it is'
    assert sentence in printed
    assert sentence in (tmp_path / 'cell.yaml').read_text().replace('\n# ', ' ')


def test_a_description_that_was_corrected_is_planned(do, tmp_path):
    """By zero-offsets and by changes of the joints' origins, as `remaster export` writes it."""
    description = ROBOTS['irb120']()
    chain = SerialChain.from_urdf(description.urdf, description.base_link, description.tip_link)
    seed = 8
    print('seed', seed)
    rng = np.random.default_rng(seed)
    geometry = Geometry(rng.normal(0, 2e-4, (6, 3)), rng.normal(0, 1e-3, (6, 3)))
    corrected = calibrated_urdf(description.urdf, chain, rng.normal(0, 5e-3, 6), geometry=geometry)
    path = tmp_path / 'corrected.urdf'
    path.write_text(corrected)
    found = json.loads(do(path, '--json').stdout)
    assert found['inverse_kinematics']['way'] == 'near closed form'
    assert found['plan']['splits']['optimization']['poses'] >= 10


def test_an_arm_with_its_makers_calibration_is_planned_and_its_table_is_imported(do, tmp_path):
    """Literally what docs/apply.md tells the owner of a UR."""
    urdf = ROBOTS['ur5e']().urdf
    joint = '<joint name="elbow_joint" type="revolute">\n    '
    roll = f'{joint}<origin rpy="0 0 0" xyz="-0.425 0 0"/>'
    assert urdf.count(roll) == 1
    text = urdf.replace('<robot ', f'<robot {XACRO} ').replace(
        roll,
        '<xacro:arg name="kinematics_params" default="none.yaml"/>'
        '<xacro:property name="k" value="${xacro.load_yaml(\'$(arg kinematics_params)\')}"/>'
        f'{joint}<origin rpy="${{k[\'roll\']}} 0 0" xyz="-0.425 0 0"/>',
    )
    path, calibration = tmp_path / 'ur.urdf.xacro', tmp_path / 'my_calibration.yaml'
    path.write_text(text)
    calibration.write_text('roll: 0.00179822366464\n')
    argument = f'kinematics_params:={calibration}'
    printed = do(path, argument, '--no-plan').stdout
    sentence = (
        "All joint solutions of a pose are found by Newton's method from those of the nearest arm "
        'that has a closed form, whose tool is up to '
    )
    assert sentence in printed
    assert sentence in (tmp_path / 'cell.yaml').read_text().replace('\n# ', ' ')
    found = json.loads(do(path, argument, '--json', out='again/cell.yaml').stdout)
    solved = found['inverse_kinematics']
    assert solved['way'] == 'near closed form'
    assert 0.0 < solved['closed_form_off_mm'] < 3.0
    assert 0.05 < solved['closed_form_off_deg'] < 0.3
    plain = written(tmp_path, ROBOTS['ur5e']())
    nominal = json.loads(do(plain, '--json', out='nominal.yaml').stdout)
    assert nominal['inverse_kinematics']['way'] == 'closed form'
    assert abs(found['solutions'] - nominal['solutions']) < 0.1
    assert abs(found['plan']['configurations'] - nominal['plan']['configurations']) < 15

    chain = SerialChain.from_urdf(
        urdf.replace(roll, roll.replace('rpy="0 ', 'rpy="0.00179822366464 ')),
        'base_link',
        'tool0',
    )
    rng = np.random.default_rng(5)
    q = rng.uniform(-60, 60, (20, 6))
    points = chain.positions(np.deg2rad(q), np.array([0.03, -0.02, 0.12]))
    rows = np.hstack((q, 1e3 * points + rng.normal(0, 0.03, (20, 3))))
    table, out = tmp_path / 'table.csv', tmp_path / 'session'
    lines = [';'.join(f'{value:.4f}' for value in row) for row in rows]
    table.write_text('A1;A2;A3;A4;A5;A6;X;Y;Z\n' + '\n'.join(lines) + '\n')
    arguments = [table, '--urdf', path, '--xacro-argument', argument, '--out', out]
    remaster('import', *arguments)
    assert 'rpy="0.00179822366464 0 0"' in (out / 'robot.urdf').read_text()
    remaster('import', table, '--urdf', path, '--out', out, '--xacro-argument', status=2)
    plain = written(tmp_path, ROBOTS['irb120']())
    said = refusal('import', table, '--urdf', plain, *arguments[3:])
    assert f'is no .xacro file, which alone takes arguments; leave out {argument}' in said
