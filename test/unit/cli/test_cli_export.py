# SPDX-License-Identifier: Apache-2.0
"""``remaster export``: each form, read by an independent program, is the arm as it was found.

Pinocchio reads URDFs, xacro makes them, urchin reads ``<calibration>``. Of ros2_control's
transmission_interface there is no wheel: its formula stands here.
"""

import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rigs.command_line import refusal, remaster
from worlds.compensation_files import arm, save
from worlds.robot_descriptions import ROBOTS
from worlds.sliding_cells import LWR, lift, rail, telescope

pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

import pinocchio

from remaster_ros.compensation.arm_model import Function, Geometry, JointTerm
from remaster_ros.compensation.file import read_compensation
from remaster_ros.session.cells.robot_description import read_description
from remaster_ros.types import Controller, PadJoint

UR = ROBOTS['ur5e']()
NAMES = ['shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint']
NAMES += [f'wrist_{i}_joint' for i in (1, 2, 3)]
LINKS = ['shoulder', 'upper_arm', 'forearm', 'wrist_1', 'wrist_2', 'wrist_3']
KEYS = ['x', 'y', 'z', 'roll', 'pitch', 'yaw']
HALF_DEGREE = np.radians(0.5)


def reached(urdf: str, q: np.ndarray, names=NAMES, base='base_link', tip='tool0') -> np.ndarray:
    """Return where pinocchio has the tip in the base, (n, 4, 4)."""
    model = pinocchio.buildModelFromXML(urdf)
    data = model.createData()
    frames = [model.getFrameId(link) for link in (base, tip)]
    places = []
    for row in q:
        full = pinocchio.neutral(model)
        for name, angle in zip(names, row, strict=True):
            joint = model.joints[model.getJointId(name)]
            # Of a continuous joint it takes cosine and sine.
            at = slice(joint.idx_q, joint.idx_q + joint.nq)
            full[at] = angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
        pinocchio.framesForwardKinematics(model, data, full)
        first, last = (data.oMf[frame] for frame in frames)
        places.append((first.inverse() * last).homogeneous)
    return np.array(places)


def configurations(k=6, count=40):
    return np.random.default_rng(7).uniform(-2.0, 2.0, (count, k))


def same(found, wanted):
    """1e-6 m and rad."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)


def as_xacro(folder: Path) -> tuple[Path, Path, str]:
    """Return a UR as xacro that reads a kinematics file, that file, and the URDF of both.

    The file is of an arm with a calibration of its own, as ur_calibration writes it.
    """
    rng = np.random.default_rng(3)
    text, kinematics = UR.urdf, {}
    for name, link in zip(NAMES, LINKS, strict=True):
        pattern = re.compile(
            rf'(<joint name="{name}" type="revolute">\s*)<origin rpy="([^"]*)" xyz="([^"]*)"/>'
        )
        found = pattern.search(text)
        assert found is not None
        values = [float(v) for v in (*found[3].split(), *found[2].split())]
        values = (np.array(values) + 1e-3 * rng.standard_normal(6)).tolist()
        kinematics[link] = dict(zip(KEYS, values, strict=True))
        use = [f"${{k['{link}']['{key}']}}" for key in KEYS]
        origin = f'<origin rpy="{" ".join(use[3:])}" xyz="{" ".join(use[:3])}"/>'
        text = text[: found.start()] + found[1] + origin + text[found.end() :]
    text = text.replace('<robot ', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1)
    text = text.replace(
        '<material name="grey">',
        '<xacro:arg name="kinematics_params" default="none.yaml"/>'
        '<xacro:property name="k" value="${xacro.load_yaml(\'$(arg kinematics_params)\')'
        '[\'kinematics\']}"/><material name="grey">',
        1,
    )
    path, calibration = folder / 'ur.urdf.xacro', folder / 'my_kinematics.yaml'
    path.write_text(text, encoding='utf-8')
    calibration.write_text(
        yaml.safe_dump({'kinematics': {**kinematics, 'hash': 'calib_49578960957000'}}),
        encoding='utf-8',
    )
    return path, calibration, read_description(path, {'kinematics_params': str(calibration)})


RAIL = (
    '<link name="hall"/><joint name="rail" type="prismatic"><parent link="hall"/>'
    '<child link="world"/><axis xyz="1 0 0"/>'
    '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
)


# All at once, and by themselves those whose angles have another order of turns behind them.
@pytest.mark.parametrize('joint', [None, 1, 4])
def test_a_ur_with_half_a_degree_at_each_joint(tmp_path, joint):
    xacro, calibration, urdf = as_xacro(tmp_path)
    offsets = np.zeros(6)
    offsets[slice(None) if joint is None else joint] = HALF_DEGREE
    file = save(tmp_path, arm(urdf, tip='tool0', joint_offsets=offsets), urdf)
    out = tmp_path / 'out'
    export(file, 'ur', out, '--base', calibration)
    new = out / calibration.name
    written, before = (yaml.safe_load(p.read_text())['kinematics'] for p in (new, calibration))
    assert written['hash'] == before['hash']
    changed = {link for link in LINKS if written[link] != before[link]}
    assert changed == set(LINKS if joint is None else [LINKS[joint]])
    q = configurations()
    same(
        reached(read_description(xacro, {'kinematics_params': str(new)}), q),
        reached(urdf, q + offsets),
    )
    assert 'nothing that can be corrected' in (out / 'left_out.txt').read_text()


@pytest.mark.parametrize('rail_m', [0.0, 2e-3])
def test_a_ur_on_a_rail(tmp_path, rail_m):
    """Its own file has no place for the rail's zero, which is left out and said."""
    xacro, calibration, urdf = as_xacro(tmp_path)
    carried = urdf.replace('</robot>', RAIL)
    q = np.column_stack((np.linspace(-0.5, 0.5, 40), configurations()))
    offsets = np.array([rail_m, *(6 * [HALF_DEGREE])])
    model = arm(carried, base='hall', tip='tool0', joint_offsets=offsets)
    out = tmp_path / 'out'
    export(save(tmp_path, model, carried), 'ur', out, '--base', calibration)
    arguments = {'kinematics_params': str(out / calibration.name)}
    made = read_description(xacro, arguments).replace('</robot>', RAIL)
    names = ['rail', *NAMES]
    same(
        reached(made, q, names, base='hall'),
        reached(carried, q + [0.0, *offsets[1:]], names, base='hall'),
    )
    said = (out / 'left_out.txt').read_text()
    assert ('zero and place of rail' in said) == (rail_m > 0.0)
    assert ('nothing that can be corrected' in said) == (rail_m == 0.0)


def test_the_makers_description_of_a_ur(tmp_path):
    """In an environment that has ur_description: its own xacro and files."""
    try:
        from ament_index_python.packages import get_package_share_directory

        share = Path(get_package_share_directory('ur_description'))
    except Exception:
        pytest.skip('the ROS package ur_description is not installed')
    makers_description(tmp_path, share)


def makers_description(tmp_path: Path, share: Path, ur_type: str = 'ur5e') -> None:
    xacro, calibration = share / 'urdf/ur.urdf.xacro', tmp_path / 'own.yaml'
    calibration.write_text((share / f'config/{ur_type}/default_kinematics.yaml').read_text())

    def urdf(kinematics):
        arguments = {'ur_type': ur_type, 'name': 'ur', 'kinematics_params': str(kinematics)}
        return read_description(xacro, arguments, [share], trusted=True)

    offsets = np.full(6, HALF_DEGREE)
    text = urdf(calibration)
    file = save(tmp_path, arm(text, tip='tool0', joint_offsets=offsets), text)
    out = export(file, 'ur', tmp_path / 'out', '--base', calibration)
    q = configurations()
    same(reached(urdf(out / 'own.yaml'), q), reached(text, q + offsets))


@pytest.fixture(scope='module')
def erring(tmp_path_factory):
    """Return the folder, arm and URDF of a UR with offsets, lengths and tilts."""
    folder = tmp_path_factory.mktemp('erring')
    xacro, calibration, urdf = as_xacro(folder)
    rng = np.random.default_rng(5)
    geometry = Geometry(3e-4 * rng.standard_normal((7, 3)), 5e-4 * rng.standard_normal((7, 3)))
    geometry.shifts[6] = geometry.turns[6] = 0.0
    offsets = np.radians(0.3) * rng.standard_normal(6)
    model = arm(urdf, tip='tool0', joint_offsets=offsets, geometry=geometry)
    return save(folder, model, urdf), model, urdf, xacro, calibration


def export(file, form, out, *more):
    remaster('export', file, '--to', form, '--out', out, '--quiet', *more)
    return out


@pytest.mark.parametrize('form', ['urdf', 'ur', 'json', 'csv'])
def test_lengths_and_tilts_too(erring, tmp_path, form):
    file, model, _, xacro, calibration = erring
    q = configurations()
    out = export(file, form, tmp_path / 'o', *(['--base', calibration] if form == 'ur' else []))
    wanted = model.state(q).tool
    if form == 'urdf':
        same(reached((out / 'robot_calibrated.urdf').read_text(), q), wanted)
    elif form == 'ur':
        made = read_description(
            xacro, {'kinematics_params': str(out / calibration.name)}, trusted=True
        )
        same(reached(made, q), wanted)
    else:
        if form == 'json':
            rows = json.loads((out / 'kinematics.json').read_text())['rows']
        else:
            with (out / 'kinematics.csv').open() as lines:
                rows = list(csv.DictReader(lines))
        # The wrist of a UR has crossing axes, its shoulder and forearm parallel ones.
        assert {row['table'] for row in rows} == {'dh', 'hayati', 'poe'}
        for which, truth in (('calibrated', wanted), ('nominal', model.chain.forward(q))):
            same(by_dh(rows, which, q), truth)
            same(by_poe(rows, which, q), truth)
    assert 'nothing that can be corrected' in (out / 'left_out.txt').read_text()


def numbers(rows, tables, part, which):
    return {
        row['parameter']: float(row['nominal'])
        + (float(row['delta']) if which == 'calibrated' else 0.0)
        for row in rows
        if row['table'] in tables and row['part'] == part
    }


def se3(values):
    turn = pinocchio.rpy.rpyToMatrix(*(values[key] for key in KEYS[3:]))
    return pinocchio.SE3(turn, np.array([values[key] for key in KEYS[:3]]))


@pytest.mark.parametrize('name', ['rail', 'lift', 'telescope', 'last'])
def test_tables_of_an_arm_that_slides(tmp_path, name):
    """Before all other joints, upright before a parallel one, amid them, and the last."""
    last = LWR.replace('name="joint_7" type="revolute"', 'name="joint_7" type="prismatic"')
    urdf = {'rail': rail(), 'lift': lift(), 'telescope': telescope(), 'last': last}[name]
    plain, rng = arm(urdf), np.random.default_rng(5)
    k = plain.joints
    geometry = Geometry.none(k)
    geometry.shifts[:k], geometry.turns[:k] = 1e-3 * rng.standard_normal((2, k, 3))
    offsets = 5e-3 * rng.standard_normal(k) * plain.chain.per_radian
    file = save(tmp_path, arm(urdf, joint_offsets=offsets, geometry=geometry), urdf)
    model, chain = read_compensation(file).model, plain.chain
    rows = json.loads((export(file, 'json', tmp_path / 'o') / 'kinematics.json').read_text())
    q = configurations(k)
    for which, truth in (('calibrated', model.state(q).tool), ('nominal', chain.forward(q))):
        same(by_dh(rows['rows'], which, q, chain), truth)
        same(by_poe(rows['rows'], which, q, chain.joint_names), truth)
    slide = chain.joint_names[int(np.argmax(chain.slides))]
    units = {row['parameter']: row['unit'] for row in rows['rows'] if row['part'] == slide}
    assert (units['wx'], units['vx']) == ('', '')


def by_dh(rows, which, q, chain=None):
    """Read with pinocchio: a model of joints about Z, with what stands between them."""
    names = NAMES if chain is None else chain.joint_names
    slides = np.zeros(len(names), bool) if chain is None else chain.slides
    model = pinocchio.Model()
    tables = ('dh', 'hayati')
    before, parent = se3(numbers(rows, tables, 'base', which)), 0
    for name, slide in zip(names, slides, strict=True):
        kind = pinocchio.JointModelPZ() if slide else pinocchio.JointModelRZ()
        parent = model.addJoint(parent, kind, before, name)
        v = numbers(rows, tables, name, which)
        turns = (
            pinocchio.utils.rotate('z', v.get('theta', 0.0)),
            pinocchio.utils.rotate('x', v.get('alpha', 0.0))
            @ pinocchio.utils.rotate('y', v.get('beta', 0.0)),
        )
        shift = np.array([v.get('a', 0.0), 0.0, v.get('d', 0.0)])
        before = pinocchio.SE3(turns[0], np.zeros(3)) * pinocchio.SE3(turns[1], shift)
    end = before * se3(numbers(rows, tables, 'end', which))
    data = model.createData()
    places = []
    for row in q:
        pinocchio.forwardKinematics(model, data, row)
        places.append((data.oMi[parent] * end).homogeneous)
    return np.array(places)


def by_poe(rows, which, q, names=NAMES):
    places = []
    for row in q:
        at = pinocchio.SE3.Identity()
        for name, angle in zip(names, row, strict=True):
            v = numbers(rows, ('poe',), name, which)
            w = np.array([v['wx'], v['wy'], v['wz']])
            linear = np.array([v['vx'], v['vy'], v['vz']])
            at = at * pinocchio.exp6(pinocchio.Motion(linear * angle, w * angle))
        places.append((at * se3(numbers(rows, ('poe',), 'home', which))).homogeneous)
    return np.array(places)


CONTROL = """<robot name="r">{links}<ros2_control name="s" type="system">
  <hardware><plugin>a/B</plugin></hardware>{joints}{transmissions}</ros2_control></robot>"""


def with_transmissions(urdf: str, old: float) -> str:
    """Return the URDF with transmissions inside of ros2_control, joint 1's with an offset."""
    parts = [
        f'<transmission name="t{i}"><plugin>transmission_interface/SimpleTransmission</plugin>'
        f'<actuator name="a{i}" role="actuator1"/><joint name="{name}" role="joint1">'
        '<mechanical_reduction>50.0</mechanical_reduction>'
        f'{f"<offset>{old}</offset>" if i == 0 else ""}</joint></transmission>'
        for i, name in enumerate(NAMES)
    ]
    return urdf.replace('</ros2_control>', f'{"".join(parts)}</ros2_control>', 1)


def only_offsets(tmp_path, **more):
    offsets = np.radians([0.5, -0.4, 0.3, -0.2, 0.6, 0.1])
    model = arm(UR.urdf, tip='tool0', joint_offsets=offsets)
    return save(tmp_path, model, UR.urdf, **more), offsets


def test_transmissions_give_the_true_angle(tmp_path):
    file, offsets = only_offsets(tmp_path)
    base = tmp_path / 'control.urdf'
    base.write_text(with_transmissions(UR.urdf, 0.25), encoding='utf-8')
    out = export(file, 'ros2_control', tmp_path / 'o', '--base', base)
    text = (out / 'control.urdf').read_text()
    root = ElementTree.fromstring(text)
    q, angles = configurations(), []
    for i, name in enumerate(NAMES):
        (joint,) = root.findall(f".//ros2_control/transmission/joint[@name='{name}']")
        old = 0.25 if i == 0 else 0.0
        actuator = 50.0 * (q[:, i] - old)
        # simple_transmission.hpp: joint = actuator / reduction + offset.
        reduction = float(joint.findtext('mechanical_reduction', '1'))
        angles.append(actuator / reduction + float(joint.findtext('offset', '0')))
    same(reached(UR.urdf, np.transpose(angles)), reached(UR.urdf, q + offsets))
    assert 'no controller manager' in text
    # A reader of URDF takes it as before.
    same(reached(text, q), reached(UR.urdf, q))


def test_parameters_of_drivers_have_the_other_sign(tmp_path):
    file, offsets = only_offsets(tmp_path)
    out = export(file, 'ros2_control', tmp_path / 'o', '--driver-param')
    root = ElementTree.fromstring((out / 'robot.urdf').read_text())
    q = configurations()
    # dynamixel_hardware: reported = raw - offset.
    given = [
        float(root.findtext(f".//ros2_control/joint[@name='{n}']/param[@name='offset']", ''))
        for n in NAMES
    ]
    same(reached(UR.urdf, q - given), reached(UR.urdf, q + offsets))


def test_rising_is_added_to_what_is_there(tmp_path):
    urchin = pytest.importorskip('urchin', reason='reads <calibration>: pip install urchin')
    file, offsets = only_offsets(tmp_path)
    base = tmp_path / 'cal.urdf'
    text = UR.urdf.replace(
        '<joint name="elbow_joint" type="revolute">',
        '<joint name="elbow_joint" type="revolute"><calibration rising="0.1"/>',
        1,
    )
    base.write_text(text, encoding='utf-8')
    out = export(file, 'rising', tmp_path / 'o', '--base', base)
    changed = (out / 'cal.urdf').read_text()
    joints = {}
    for element in ElementTree.fromstring(changed).findall('joint'):
        if element.get('name') in NAMES:
            found = urchin.JointCalibration._from_xml(element.find('calibration'), '')
            joints[element.get('name')] = found.rising
    rising = np.array([joints[name] for name in NAMES])
    before = np.array([0.1 if name == 'elbow_joint' else 0.0 for name in NAMES])
    q = configurations()
    # robot_calibration: added to the position read.
    same(reached(UR.urdf, q - before + rising), reached(UR.urdf, q + offsets))


def test_the_pad(tmp_path):
    controller = Controller(
        {'elbow_joint': PadJoint('J3', sign=-1), 'wrist_1_joint': PadJoint('J4')}, 'FANUC'
    )
    file, _ = only_offsets(tmp_path, controller=controller, known=[False, *[True] * 5])
    motors = ['--motor', 'elbow_joint=1000,100,-1', '--motor', 'shoulder_pan_joint=5,1,1']
    out = export(file, 'pad', tmp_path / 'o', *motors)
    text = (out / 'remaster.txt').read_text()
    (row,) = [line for line in text.splitlines() if line.split()[:1] == ['J3']]
    # The pad counts the other way: it has to show 0.3 degrees less.
    assert row.split()[-4:] == ['+0.3000', 'deg', '+0.0000', 'deg']
    assert 'shoulder_pan_joint: not told' in text
    assert 'offset_layer' not in text
    for maker in ('kuka', 'abb', 'fanuc', 'yaskawa'):
        page = (out / f'pad_{maker}.md').read_text()
        assert 'Nothing on this page was tried' in page
        assert all(word in page for word in ('Where:', 'Sign and unit:', 'Coupled axes:', 'Undo:'))
    numbers = (out / 'motor_numbers.txt').read_text()
    # By -0.3 degrees on the pad, of 100 counts, falling: +30.
    assert 'new 1030.000' in numbers
    assert 'shoulder_pan_joint: no number' in numbers
    assert not (export(file, 'pad', tmp_path / 'p') / 'motor_numbers.txt').exists()


def test_what_is_left_out_is_stated_and_no_offset_without_its_cause(tmp_path):
    """A soft joint and its offset belong together: the offset alone is worse than none."""
    soft = JointTerm(
        1, 'joint_compliance', Function('gravity_torque', 'linear', 1), np.full(1, 1e-4)
    )
    model = arm(UR.urdf, tip='tool0', joint_terms=(soft,))
    q = np.random.default_rng(1).uniform(-2, 2, (2000, 6))
    bend = model.state(q).angles[:, 1] - q[:, 1]
    # Its offset is the negative of what the soft joint does on average.
    model = arm(
        UR.urdf, tip='tool0', joint_terms=(soft,), joint_offsets=-bend.mean() * np.eye(6)[1]
    )
    file = save(tmp_path, model, UR.urdf)
    out = tmp_path / 'o'
    output = remaster('export', file, '--to', 'rising', '--out', out, '--json').stdout
    left_out = json.loads(output)['left_out']
    root = ElementTree.fromstring((out / 'robot.urdf').read_text())
    rising = np.array(
        [float(root.find(f"joint[@name='{n}']/calibration").get('rising')) for n in NAMES]
    )

    # What remains, judged by pinocchio with base and marker fitted again.
    def remains(offsets):
        error = marker(reached(UR.urdf, q[:300] + offsets)) - marker(model.state(q[:300]).tool)
        return 1e3 * rms_refitted(error, model, q[:300])

    assert left_out['rms_mm'] == pytest.approx(remains(rising), rel=0.1)
    assert 0.1 < left_out['rms_mm'] < 0.9 * remains(model.joint_offsets)
    assert [part['what'] for part in left_out['parts']] == [
        'joint compliance of shoulder_lift_joint'
    ]
    assert left_out['parts'][0]['rms_mm'] > left_out['rms_mm']


def marker(places):
    return places[:, :3, :3] @ (0.1, 0.0, 0.02) + places[:, :3, 3]


def rms_refitted(error, model, q):
    tool = model.state(q).tool
    columns = np.zeros((len(q), 3, 9))
    columns[:, :, :3] = np.eye(3)
    columns[:, :, 3:6] = np.cross(np.eye(3), marker(tool)[:, None, :]).swapaxes(1, 2)
    columns[:, :, 6:] = tool[:, :3, :3]
    columns = columns.reshape(-1, 9)
    remainder = error.ravel() - columns @ np.linalg.lstsq(columns, error.ravel(), rcond=None)[0]
    return np.sqrt(np.mean(np.sum(remainder.reshape(-1, 3) ** 2, axis=1)))


def test_what_is_refused_is_one_line(tmp_path, erring):
    file, _ = only_offsets(tmp_path)
    calibration = erring[4]

    def refused(*args):
        out = tmp_path / 'refused'
        line = refusal('export', file, '--out', out, *args)
        assert not out.exists()
        return line

    assert '--base' in refused('--to', 'ur')
    # Of another arm: its own calibration is not in the description.
    assert 'kinematics.shoulder is not that of the robot' in refused(
        '--to', 'ur', '--base', calibration
    )
    assert "no key 'kinematics'" in refused('--to', 'ur', '--base', file)
    assert '<transmission>' in refused('--to', 'ros2_control')
    assert 'leave it out' in refused('--to', 'csv', '--base', calibration)
    assert 'DIRECTION' in refused('--to', 'pad', '--motor', 'elbow_joint=1,2')
    assert "'A9' is not among" in refused('--to', 'pad', '--motor', 'A9=1,2,1')
    broken = tmp_path / 'broken.urdf'
    broken.write_text('<robot><joint')
    assert 'not well-formed' in refused('--to', 'rising', '--base', broken)
    text = with_transmissions(UR.urdf, 0.0).replace('<offset>0.0<', '<offset>${x}<')
    broken.write_text(text)
    assert 'expand the xacro' in refused('--to', 'ros2_control', '--base', broken)


def test_another_file_of_this_program_is_refused_by_its_format(tmp_path):
    file = tmp_path / 'fit.json'
    for content, words in (
        ({'format': 'remaster-fit/1'}, "'remaster-fit/1', not 'remaster-compensation/1'"),
        ({'format': 'remaster-compensation/1'}, 'missing required field `robot`'),
        ({'format': 1}, 'Expected `str`'),
        ([], 'Expected `object`'),
    ):
        file.write_text(json.dumps(content))
        out = tmp_path / 'refused'
        line = refusal('export', file, '--to', 'urdf', '--out', out)
        assert not out.exists()
        assert words in line
        assert 'give the one in the folder apply' in line
