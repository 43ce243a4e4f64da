# SPDX-License-Identifier: Apache-2.0
"""Cell files and meshes: what the arm must not hit, as a user writes it."""

import numpy as np
import pytest
import trimesh
import yaml
from worlds.simple_cells import write_cell

from remaster_ros.errors import InputError
from remaster_ros.session.cells.meshes import mesh_reader, read_mesh
from remaster_ros.session.cells.workcell import config_path, read_cell

SIZE = np.array([0.1, 0.2, 0.3])
ROBOT = {'urdf': 'arm.urdf', 'base_link': 'base_link', 'tip_link': 'tool'}


def model_of(path):
    cell = read_cell(path)
    return cell.collision_model(cell.chain())


def test_keys_reach_the_model(tmp_path):
    table = {'center_m': [0.6, 0.0, 0.2], 'size_m': [0.4, 0.8, 0.4], 'yaw_deg': 90.0}
    probe = {'radius_m': 0.02, 'length_m': 0.25, 'center_m': [0, 0, 0.125]}
    path = write_cell(
        tmp_path / 'cell.yaml',
        obstacles={'table': table},
        tool={'probe': probe, 'knob': {'radius_m': 0.03}, 'plate': {'size_m': [0.1, 0.1, 0.01]}},
        floor_z_m=-0.5,
        clearance_m=0.012,
        unknown_offset_deg=0.5,
        acceleration_limit_rad_s2=[1.0, 2, 3, 4, 5, 6, 7],
    )
    cell = read_cell(path)
    chain = cell.chain()
    model = cell.collision_model(chain)
    assert (model.margin, model.floor_z) == (0.012, -0.5)
    assert model.unknown_offset == pytest.approx(np.deg2rad(0.5))
    assert cell.collision_model(chain, 0.001).unknown_offset == 0.001
    names = {body.name: body for body in model.bodies}
    box = names['obstacle table']
    corners = box.outline
    np.testing.assert_allclose(corners.max(axis=0), [1.0, 0.2, 0.4], atol=1e-12)
    assert (box.link, box.role) == (0, 'obstacle')
    tip = chain.T_fixed[-1][2, 3]
    assert names['tool probe'].outline[:, 2].max() == pytest.approx(tip + 0.25)
    assert names['tool knob'].shape.kind == 'sphere'
    assert names['tool plate'].shape.kind == 'box'
    assert names['marker sir'].link == 7
    np.testing.assert_array_equal(cell.acceleration_limits(chain), [1, 2, 3, 4, 5, 6, 7])
    assert 'obstacle table' in model.trouble(np.deg2rad([0, -90.0, 0, 0, 0, 0, 0]))


def test_without_a_floor_and_with_one_acceleration_for_all(tmp_path):
    path = write_cell(tmp_path / 'cell.yaml', floor_z_m=None)
    cell = read_cell(path)
    model = cell.collision_model(cell.chain())
    assert model.trouble(np.deg2rad([0, 115.0, 0, 0, 0, 0, 0])) == ''
    np.testing.assert_array_equal(cell.acceleration_limits(cell.chain()), [5.0] * 7)


@pytest.mark.parametrize(
    ('keys', 'message'),
    [
        ({'obstacles': {'table': {'center_m': [0, 0, 0]}}}, 'size_m'),
        ({'obstacles': {'table': {'center_m': [0, 0], 'size_m': [1, 1, 1]}}}, 'obstacles'),
        (
            {'obstacles': {'table': {'center_m': [0, 0, 0], 'size_m': [1, -1, 1]}}},
            'obstacles.table: collision: a box with sizes .* 3 positive m',
        ),
        ({'obstacles': {'t': {'center_m': [0, 0, 0], 'size_m': [1, 1, 1], 'yaw': 3}}}, 'yaw'),
        ({'tool': {'probe': {'length_m': 0.1}}}, 'tool.probe: give size_m'),
        ({'tool': {'probe': {'radius_m': 0.1, 'size_m': [1, 1, 1]}}}, 'tool.probe: give size_m'),
        ({'tool': {'probe': {'radius_m': 0.0}}}, 'tool.probe: .*sphere'),
        ({'clearance_m': 0.001}, 'clearance_m is 0.001; it must be from 0.005'),
        (
            {'unknown_offset_deg': -1.0},
            'unknown_offset_deg is -1; it must be from 0 to 10 degrees',
        ),
        ({'floor_z_m': float('nan')}, 'floor_z_m: nan is not a finite number'),
        ({'floor_z_m': 'ground'}, 'floor_z_m'),
        ({'marker_radius_m': 0.0}, 'marker_radius_m is 0; it must be above 0 m'),
        ({'acceleration_limit_rad_s2': [5.0, 5.0]}, 'has 2 values; .* 7 joints'),
        ({'acceleration_limit_rad_s2': 0.0}, 'it must be from 0.01 to 1000 rad/s²'),
    ],
)
def test_wrong_keys_are_named(tmp_path, keys, message):
    path = write_cell(tmp_path / 'cell.yaml', **keys)
    with pytest.raises(InputError, match=message) as caught:
        read_cell(path)
    assert str(path) in str(caught.value)


# Meshes


@pytest.mark.parametrize('kind', ['stl', 'stl_ascii', 'obj', 'dae'])
def test_each_format_is_read(tmp_path, kind):
    data = trimesh.creation.box(SIZE).export(file_type=kind)
    path = tmp_path / f'part.{kind.split("_")[0].upper()}'
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    vertices = read_mesh(path)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), SIZE, atol=1e-6)


def test_a_collada_file_says_how_long_its_unit_is(tmp_path):
    data = trimesh.creation.box(1000 * SIZE).export(file_type='dae')
    marked = data.replace(b'<up_axis>', b'<unit name="millimeter" meter="0.001"/><up_axis>')
    assert marked != data
    (tmp_path / 'part.dae').write_bytes(marked)
    np.testing.assert_allclose(np.ptp(read_mesh(tmp_path / 'part.dae'), axis=0), SIZE, atol=1e-6)


@pytest.mark.parametrize(
    ('name', 'where'),
    [
        ('package://arm_description/meshes/part.stl', 'ament'),
        ('package://arm_description/meshes/part.stl', 'mesh_path'),
        ('package://arm_description/meshes/part.stl', 'beside'),
        ('part.stl', 'mesh_path'),
        ('part.stl', 'beside'),
    ],
)
def test_meshes_are_found(tmp_path, monkeypatch, name, where):
    package = tmp_path / 'ws' / 'share' / 'arm_description'
    (package / 'meshes').mkdir(parents=True)
    (package / 'urdf').mkdir()
    trimesh.creation.box(SIZE).export(package / 'meshes' / 'part.stl')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'ws') if where == 'ament' else '')
    urdf = tmp_path / 'arm.urdf'
    search = []
    if name == 'part.stl':
        # A plain name: beside the URDF, or in a folder of mesh_path.
        search = [package / 'meshes'] if where == 'mesh_path' else []
        urdf = package / 'meshes' / 'arm.urdf' if where == 'beside' else urdf
    elif where == 'mesh_path':
        search = [tmp_path / 'ws' / 'share']
    elif where == 'beside':
        urdf = package / 'urdf' / 'arm.urdf'
    vertices = mesh_reader(urdf, search)(name)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), SIZE, atol=1e-6)


@pytest.mark.parametrize(
    ('name', 'content', 'message'),
    [
        ('package://nowhere/part.stl', None, 'no mesh package://nowhere/part.stl .*mesh_path'),
        ('http://example.org/part.stl', None, 'cannot be fetched'),
        ('part.step', b'x', 'a format that is not read; use .stl'),
        ('part.stl', b'solid\nnothing\n', 'part.stl: '),
        ('part.obj', b'\x00\xff' * 100, 'part.obj: '),
        ('part.dae', b'<COLLADA', 'part.dae: no DAE mesh'),
        ('part.stl', b'', 'part.stl: '),
    ],
)
def test_what_is_no_mesh_is_one_line(tmp_path, monkeypatch, name, content, message):
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        mesh_reader(tmp_path / 'arm.urdf')(name)
    assert '\n' not in str(caught.value)


def test_a_cell_with_meshes(tmp_path):
    """Links with meshes are their hulls, the others capsules; a missing mesh is an error."""
    (tmp_path / 'meshes').mkdir()
    mesh = trimesh.creation.cylinder(0.05, 0.3)
    mesh.export(tmp_path / 'meshes' / 'link_3.stl')
    text = config_path('robots/lwr4plus.urdf').read_text(encoding='utf-8')
    collision = (
        '<collision><origin xyz="0 0 0.1"/><geometry><mesh filename="package://lwr/link_3.stl"/>'
        '</geometry></collision>'
    )
    text = text.replace('<link name="link_3">', f'<link name="link_3">{collision}')
    (tmp_path / 'arm.urdf').write_text(text, encoding='utf-8')
    path = write_cell(tmp_path / 'cell.yaml', robot=ROBOT)
    with pytest.raises(InputError, match=r'package://lwr/link_3\.stl'):
        model_of(path)
    cell = read_cell(path)
    simulated = cell.collision_model(cell.chain(), without_meshes=True)
    assert 'the link of joint_3' in {body.name for body in simulated.bodies}
    (tmp_path / 'meshes').rename(tmp_path / 'lwr')
    model = model_of(write_cell(tmp_path / 'cell.yaml', robot=ROBOT, mesh_path=['.']))
    kinds = {body.name: body.shape.kind for body in model.bodies}
    assert kinds['link_3'] == 'hull'
    assert kinds['the link of joint_4'] == 'capsule'
    assert 'the link of joint_3' not in kinds


# Which arm and surroundings these are


def copied(folder, change=lambda text: text, **keys):
    """Return the model of a copy of the demo cell in its own folder, the URDF beside it."""
    folder.mkdir()
    urdf = config_path('robots/lwr4plus.urdf').read_text(encoding='utf-8')
    (folder / 'arm.urdf').write_text(change(urdf), encoding='utf-8')
    return read_cell(write_cell(folder / 'cell.yaml', robot=ROBOT, **keys)).model()


def test_a_copy_of_a_cell_elsewhere_is_the_same_arm(tmp_path):
    first = copied(tmp_path / 'a')
    copied(
        tmp_path / 'b',
        lambda text: f'{text}<!-- a comment -->'.replace('\n', '\r\n').replace('  <', '\t<'),
        confirm=True,
        floor_z_m=0,
    )
    path = tmp_path / 'b' / 'cell.yaml'
    keys = yaml.safe_load(path.read_text(encoding='utf-8'))
    path.write_text(yaml.safe_dump(dict(reversed(keys.items())), sort_keys=False))
    other = read_cell(path).model()
    assert (first.urdf, first.cell) == (other.urdf, other.cell)
    assert first.urdf_file == str(tmp_path / 'a' / 'arm.urdf')
    assert other.cell_file == str(tmp_path / 'b' / 'cell.yaml')


@pytest.mark.parametrize(
    'keys',
    [
        {'clearance_m': 0.02},
        {'floor_z_m': -0.1},
        {'obstacles': {'box': {'center_m': [1, 0, 0], 'size_m': [0.1, 0.1, 0.1]}}},
        {'acceleration_limit_rad_s2': 9.0},
        {'tool': {'knob': {'radius_m': 0.03}}},
        {'unknown_offset_deg': 0.5},
    ],
)
def test_whatever_a_motion_is_checked_against_counts(tmp_path, keys):
    assert copied(tmp_path / 'a').cell != copied(tmp_path / 'b', **keys).cell


def test_a_number_of_the_urdf_counts(tmp_path):
    first = copied(tmp_path / 'a')
    assert (
        first.urdf
        != copied(tmp_path / 'b', lambda text: text.replace('"0 0 1"', '"0 1 0"', 1)).urdf
    )
