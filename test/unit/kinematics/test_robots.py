# SPDX-License-Identifier: Apache-2.0
"""The robots in config/robots, against their makers' dimensions and pinocchio."""

from pathlib import Path

import numpy as np
import pytest

from remaster_ros.kinematics.serial_chain import SerialChain

ROOT = Path(__file__).parents[3]
TABLE = ROOT.parent / 'shared' / 'robots.yaml'
ROBOTS = {'lwr4plus': 'lwr4plus', 'iiwa7': 'iiwa7_r800', 'iiwa14': 'iiwa14_r820'}
TOOL_PLATE_M = 0.05
# Where the tool plate is with all joints at zero, in base_link, m: from the maker's dimensions.
TIP_AT_ZERO = {
    'lwr4plus': (0.0, 0.0, 0.3105 + 0.4 + 0.39 + 0.078 + TOOL_PLATE_M),
    'iiwa7': (0.0, 0.0, 0.34 + 0.4 + 0.4 + 0.126 + TOOL_PLATE_M),
    'iiwa14': (0.0, 0.0, 0.36 + 0.42 + 0.4 + 0.126 + TOOL_PLATE_M),
}
SHIPPED = sorted(path.stem for path in (ROOT / 'config' / 'robots').glob('*.urdf'))


def read(robot):
    text = (ROOT / 'config' / 'robots' / f'{robot}.urdf').read_text(encoding='utf-8')
    return text, SerialChain.from_urdf(text)


def table_entry(robot):
    yaml = pytest.importorskip('yaml', reason='reading the table needs PyYAML')
    if not TABLE.exists():
        pytest.skip('the table of robots, shared/robots.yaml, is not beside this checkout')
    return yaml.safe_load(TABLE.read_text(encoding='utf-8'))['robots'][ROBOTS[robot]]


def dh_pose(rows, q):
    """Return the flange pose from classic DH rows."""
    T = np.eye(4)
    for row, angle in zip(rows, q, strict=True):
        theta = angle + np.deg2rad(row['theta_offset_deg'])
        c, s = np.cos(theta), np.sin(theta)
        ca, sa = np.cos(np.deg2rad(row['alpha_deg'])), np.sin(np.deg2rad(row['alpha_deg']))
        T = T @ [
            [c, -s * ca, s * sa, row['a'] * c],
            [s, c * ca, -c * sa, row['a'] * s],
            [0, sa, ca, row['d']],
            [0, 0, 0, 1],
        ]
    return T


@pytest.mark.parametrize('robot', ROBOTS)
def test_geometry_is_the_tables(robot):
    entry, (_, chain) = table_entry(robot), read(robot)
    plate = np.eye(4)
    plate[2, 3] = TOOL_PLATE_M
    for q in np.random.default_rng(1).uniform(-3, 3, (50, 7)):
        expected = dh_pose(entry['dh_classic'], q) @ plate
        np.testing.assert_allclose(chain.forward(q), expected, atol=1e-12)


@pytest.mark.parametrize('robot', ROBOTS)
def test_limits_are_the_tables(robot):
    entry, (_, chain) = table_entry(robot), read(robot)
    limits = np.rad2deg(np.column_stack((chain.lower, chain.upper)))
    np.testing.assert_allclose(limits, entry['joint_limits_deg'], rtol=1e-12)
    velocities = np.rad2deg(chain.velocity_limits)
    np.testing.assert_allclose(velocities, entry['velocity_limits_deg_s'], rtol=1e-12)


@pytest.mark.parametrize('robot', SHIPPED)
def test_dimensions_are_the_makers(robot):
    _, chain = read(robot)
    tip = chain.forward(np.zeros(len(chain)))[:3, 3]
    np.testing.assert_allclose(tip, TIP_AT_ZERO[robot], atol=1e-12)


@pytest.mark.parametrize('robot', SHIPPED)
def test_names_masses_and_limits(robot):
    _, chain = read(robot)
    assert chain.name == robot
    assert (chain.base_link, chain.tip_link) == ('base_link', 'tool')
    assert chain.has_inertials
    assert np.all(chain.masses > 0)
    assert np.all(np.isfinite(chain.velocity_limits))


@pytest.mark.parametrize('robot', ROBOTS)
def test_the_lbr_arms_have_one_set_of_joint_names(robot):
    _, chain = read(robot)
    assert chain.joint_names == tuple(f'joint_{i}' for i in range(1, 8))


@pytest.mark.parametrize('robot', SHIPPED)
def test_pinocchio_reads_the_same_robot(robot):
    pin = pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')
    text, chain = read(robot)
    model = pin.buildModelFromXML(text)
    data = model.createData()
    assert tuple(model.names)[1:] == chain.joint_names
    for q in np.random.default_rng(2).uniform(chain.lower, chain.upper, (20, len(chain))):
        pin.framesForwardKinematics(model, data, q)
        tool = data.oMf[model.getFrameId('tool')].homogeneous
        np.testing.assert_allclose(chain.forward(q), tool, atol=1e-13)
        holding = pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(chain.gravity_torque(q), -holding, atol=1e-11)
