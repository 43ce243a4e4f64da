# SPDX-License-Identifier: Apache-2.0
"""Orientations in any form are read as the arm turned, or left out with a sentence."""

import numpy as np
import pytest
from foreign.tables import MARKER, measured, text, write
from scipy.spatial.transform import Rotation
from worlds.sliding_cells import rail

from remaster_ros.kinematics.serial_chain import SerialChain

ROWS = 24
AXES = [f'A{i}' for i in range(1, 7)]
SENSOR = Rotation.from_rotvec([0.4, -1.1, 0.7])
ON_TOOL = Rotation.from_rotvec([0.3, -0.4, 0.2])


@pytest.fixture(scope='module')
def arm():
    return measured(rows=ROWS)


def poses_of(arm, on_tool=False, sensor=SENSOR):
    """Return where the body is, mm, and how it is turned, in a sensor that stands or is on it."""
    T = arm.chain.forward(arm.q + arm.offsets)
    tool = Rotation.from_matrix(T[:, :3, :3])
    turned = sensor * tool * ON_TOOL
    place = sensor.apply(T[:, :3, 3] + tool.apply(MARKER)) + [2.0, 1.0, 0.5]
    if on_tool:
        turned, place = turned.inv(), -turned.inv().apply(place)
    return 1e3 * place, turned


def table_of(arm, names, values, place):
    columns = [*np.rad2deg(arm.q).T, *place.T, *np.asarray(values).T]
    return text([*AXES, 'X', 'Y', 'Z', *names], columns, ';')


WAYS = {
    'a quaternion w, x, y, z': (('Q0', 'Q1', 'Q2', 'Q3'), lambda r: r.as_quat()[:, [3, 0, 1, 2]]),
    'a quaternion x, y, z, w': (('q1', 'q2', 'q3', 'q4'), lambda r: r.as_quat()),
    'a rotation vector, rad': (('rvec_x', 'rvec_y', 'rvec_z'), lambda r: r.as_rotvec()),
    'a rotation vector, deg': (('Rx', 'Ry', 'Rz'), lambda r: np.rad2deg(r.as_rotvec())),
    'angles about fixed axes xyz, rad': (('roll', 'pitch', 'yaw'), lambda r: r.as_euler('xyz')),
    'angles about fixed axes xyz, deg': (
        ('Roll [deg]', 'Pitch [deg]', 'Yaw [deg]'),
        lambda r: r.as_euler('xyz', degrees=True),
    ),
    "angles about turned axes z, y', x'', deg": (
        ('A', 'B', 'C'),
        lambda r: r.as_euler('ZYX', degrees=True),
    ),
    "angles about turned axes x, y', z'', deg": (
        ('omega', 'phi', 'kappa'),
        lambda r: r.as_euler('XYZ', degrees=True),
    ),
    "angles about turned axes z, y', z'', rad": (
        ('Euler X', 'Euler Y', 'Euler Z'),
        lambda r: r.as_euler('ZYZ'),
    ),
}


@pytest.mark.parametrize('on_tool', [False, True])
@pytest.mark.parametrize('way', WAYS)
def test_an_orientation_is_read_as_the_arm_turned(way, on_tool, arm, tmp_path, imported):
    names, values = WAYS[way]
    place, turned = poses_of(arm, on_tool)
    path = write(tmp_path, 't.csv', table_of(arm, names, values(turned), place))
    (out, _), session = imported(arm.urdf, path, *['--on-tool'] * on_tool)
    assert f'read as {way}, which turns as the arm did' in out
    got = Rotation.from_quat(session.measurements.orientation)
    wanted = turned.inv() if on_tool else turned
    assert (got.inv() * wanted).magnitude().max() < 1e-5


@pytest.mark.parametrize('names', [('qx', 'qy', 'qz', 'qw'), ('qi', 'qj', 'qk', 'qr')])
def test_letters_tell_it(names, arm, tmp_path, imported):
    place, turned = poses_of(arm)
    path = write(tmp_path, 't.csv', table_of(arm, names, turned.as_quat(), place))
    (out, _), session = imported(arm.urdf, path)
    assert 'read as' not in out
    got = Rotation.from_quat(session.measurements.orientation)
    assert (got.inv() * turned).magnitude().max() < 1e-5


@pytest.mark.parametrize(
    ('names', 'way', 'whose', 'words'),
    [
        (('A', 'B', 'C'), "angles about turned axes z, y', x'', deg", 'robot', 'the robot itself'),
        (('qx', 'qy', 'qz', 'qw'), 'a quaternion x, y, z, w', 'robot', 'the robot itself'),
        (('qx', 'qy', 'qz', 'qw'), 'a quaternion x, y, z, w', 'other', 'in another frame'),
        (('qx', 'qy', 'qz', 'qw'), 'a quaternion x, y, z, w', 'nobody', 'otherwise than the arm'),
        (('rx', 'ry', 'rz'), 'a rotation vector, rad', 'other', 'turn otherwise than the arm'),
        (('rx', 'ry', 'rz'), 'a rotation vector, rad', 'nobody', 'turn otherwise than the arm'),
        (('q1', 'q2', 'q3', 'q4'), 'a rotation vector, rad', 'nobody', 'are no quaternions'),
    ],
)
def test_what_is_not_the_bodys_is_left_out(names, way, whose, words, arm, tmp_path, imported):
    place, turned = poses_of(arm)
    turned = {
        'robot': Rotation.from_matrix(arm.chain.forward(arm.q)[:, :3, :3]),
        'other': poses_of(arm, sensor=Rotation.identity())[1],
        'nobody': Rotation.random(ROWS, random_state=3),
    }[whose]
    values = WAYS[way][1](turned)
    values = np.column_stack((values, values))[:, : len(names)]
    path = write(tmp_path, 't.csv', table_of(arm, names, values, place))
    (out, _), session = imported(arm.urdf, path)
    assert words in out
    assert 'left out' in out
    assert session.measurements.orientation is None


def test_an_arm_on_a_rail(tmp_path, imported):
    chain = SerialChain.from_urdf(rail(), 'base_link', 'tool')
    rng = np.random.default_rng(2)
    q = rng.uniform(
        np.maximum(chain.lower, -1.5), np.minimum(chain.upper, 1.5), (ROWS, len(chain))
    )
    T = chain.forward(q + rng.normal(0.0, 3e-3, len(chain)) * ~chain.slides)
    tool = Rotation.from_matrix(T[:, :3, :3])
    place = SENSOR.apply(T[:, :3, 3] + tool.apply(MARKER)) + [2.0, 1.0, 0.5]
    names = [f'{n} [{"m" if s else "rad"}]' for n, s in zip(chain.joint_names, chain.slides)]
    angles = (SENSOR * tool * ON_TOOL).as_euler('xyz', degrees=True)
    header = [*names, 'X [m]', 'Y [m]', 'Z [m]', 'roll', 'pitch', 'yaw']
    table = write(tmp_path, 't.csv', text(header, [*q.T, *place.T, *angles.T], ';'))
    links = ('--base-link', 'base_link', '--tip-link', 'tool')
    (out, _), session = imported(rail(), table, *links)
    assert 'read as angles about fixed axes xyz, deg' in out
    assert session.measurements.orientation is not None
