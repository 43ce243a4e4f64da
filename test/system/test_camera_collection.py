# SPDX-License-Identifier: Apache-2.0
"""A camera on the tool: its poses of a board, collected by the nodes, and fitted as such."""

import csv
import signal

import numpy as np
import pytest
import yaml
from rigs.collection_rig import Cell
from rigs.foreign_source import CAMERA_RAD, SIGMA_M, orientation
from scipy.spatial.transform import Rotation

from remaster_ros import fit
from remaster_ros.kinematics.transforms import inverse_poses
from remaster_ros.session.bag_replay import differences, record_from_bag
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.cells.workcell import config_path, read_cell

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

POSE, TOPIC = 'geometry_msgs/msg/PoseStamped', '/detector/board_pose'


def camera_cell(folder):
    """Return the demo cell with a camera on the tool in place of its sensors."""
    content = yaml.safe_load(config_path('cells/demo.yaml').read_text(encoding='utf-8'))
    content['robot']['urdf'] = str(config_path('robots/lwr4plus.urdf'))
    content['markers'] = {'lens': [0.1, 0.0, 0.0]}
    # By the name of a sensor that the fake world has.
    content['sensors'] = {
        'mocap': {
            'marker': 'lens',
            'topic': TOPIC,
            'message_type': POSE,
            'mounted_on': 'tool',
            'rough_position_m': [1.9, 0.0, 1.3],
            'max_angle_deg': 25.0,
        }
    }
    content['aim_at'] = 'mocap'
    path = folder / 'cell.yaml'
    path.write_text(yaml.safe_dump(content), encoding='utf-8')
    return path


def test_a_camera_on_the_tool_is_collected_and_fitted(start, client, tmp_path):
    path = camera_cell(tmp_path)
    cell = Cell(
        start, client, tmp_path, 'mocap', [], candidates=4, cell=path,
        foreign={'mocap': (POSE, TOPIC, 'tool')},
    )  # fmt: skip
    session = cell.complete()
    truth, m = cell.world.truth, session.measurements
    assert session.on_tool == session.oriented == {'mocap'}
    assert 'mounted_on: tool' in (cell.session / 'session.yaml').read_text(encoding='utf-8')

    # What the file has is the board in the camera's frame.
    lines = (cell.session / 'observations.csv').read_text(encoding='utf-8').splitlines()
    rows = [row for row in csv.DictReader(lines) if row['split'] != 'reference']

    def columns(*names):
        return np.array([[float(row[name]) for name in names] for row in rows])

    place = truth.without_noise(read_cell(path).chain(), 'mocap', m.q)
    turned = orientation(cell.world, 'mocap', m.q)
    board, turn = inverse_poses(place, Rotation.from_matrix(turned).as_quat())
    assert np.linalg.norm(columns('x_m', 'y_m', 'z_m') - board, axis=1).max() < 1e-3
    std = columns('std_x_m', 'std_y_m', 'std_z_m')
    assert np.median(std) == pytest.approx(SIGMA_M, rel=0.5)
    measured = Rotation.from_quat(columns(*(f'orientation_{axis}' for axis in 'xyzw')))
    assert (measured * Rotation.from_quat(turn).inv()).magnitude().max() < 6.0 * CAMERA_RAD

    found = fit(session)
    error = np.abs(found.joint_offsets - truth.joint_offsets)[found.identifiable]
    assert len(error) == 5
    assert np.all(error < 5.0 * found.joint_offsets_std[found.identifiable])
    assert found.orientations.count == len(m)

    for process in cell.nodes.values():
        process.send_signal(signal.SIGINT)
    for process in cell.nodes.values():
        process.wait(60)
    again = tmp_path / 'again'
    record_from_bag(BagReader(cell.session / 'bag'), again)
    assert not differences(cell.session, again)
