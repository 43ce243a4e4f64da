# SPDX-License-Identifier: Apache-2.0
"""``remaster export --to tf``: registrations as static transforms, of a camera on the tool too."""

import json
import re
import shlex
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rigs.command_line import refusal, remaster
from scipy.spatial.transform import Rotation

import remaster_ros
from remaster_ros.compensation.file import read_compensation
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.session.records.reader import write_session


def pose(values):
    """4x4 pose of x y z qx qy qz qw."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    return T


def launched(folder):
    """(parent, child) -> pose, by the arguments of the launch file's nodes."""
    found = {}
    for node in ElementTree.parse(folder / 'static_transforms.launch.xml').getroot():
        assert (node.get('pkg'), node.get('exec')) == ('tf2_ros', 'static_transform_publisher')
        words = shlex.split(node.get('args'))
        given = dict(zip(words[::2], words[1::2], strict=True))
        numbers = [float(given[f'--{name}']) for name in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')]
        found[given['--frame-id'], given['--child-frame-id']] = pose(numbers)
    return found


def published(folder):
    """(parent, child) -> pose, by the YAML as geometry_msgs/TransformStamped."""
    found = {}
    for entry in yaml.safe_load((folder / 'static_transforms.yaml').read_text())['transforms']:
        assert entry.keys() == {'header', 'child_frame_id', 'transform'}
        place, turn = entry['transform']['translation'], entry['transform']['rotation']
        numbers = [*(place[axis] for axis in 'xyz'), *(turn[axis] for axis in 'xyzw')]
        found[entry['header']['frame_id'], entry['child_frame_id']] = pose(numbers)
    return found


@pytest.fixture(scope='module', params=[False, True], ids=['standing', 'on_tool'])
def fitted(request, tmp_path_factory):
    """A session with its truth, and the folder of its fit."""
    folder = tmp_path_factory.mktemp('tf')
    made = remaster_ros.simulate(
        poses=12,
        validation_poses=4,
        sensors=['mocap'],
        orientation_noise_rad=2e-4,
        on_tool=request.param,
        seed=4,
    )
    write_session(folder / 'session', made.session)
    remaster('fit', folder / 'session', '--out', folder / 'fit', '--no-figures', '--quiet')
    return made, folder / 'fit', folder / 'session'


def test_the_transforms_lead_from_the_arm_to_what_was_measured(fitted, tmp_path):
    """Through the exported frames each measurement is where the corrected arm has it."""
    made, fit, _ = fitted
    file = fit / 'apply' / 'compensation.json'
    printed = remaster('export', file, '--to', 'tf', '--out', tmp_path / 'tf', '--json')
    frames = launched(tmp_path / 'tf')
    same = published(tmp_path / 'tf')
    assert frames.keys() == same.keys()
    for key, T in frames.items():
        np.testing.assert_allclose(same[key], T, atol=1e-8)
    base, tip = made.session.base_link, made.session.tip_link
    on_tool = bool(made.session.on_tool)
    assert frames.keys() == (
        {(tip, 'mocap'), (base, 'mocap_board')} if on_tool else {(base, 'mocap')}
    )
    model, m = read_compensation(file).model, made.session.measurements
    assert isinstance(model.chain, SerialChain)
    tool = model.state(m.q).tool
    if on_tool:
        # The pose of the camera in the frame of the board, as the arm and as the camera have it.
        expected = inverse(frames[base, 'mocap_board']) @ tool @ frames[tip, 'mocap']
        turn = Rotation.from_matrix(expected[:, :3, :3]).inv() * Rotation.from_quat(m.orientation)
        assert np.sqrt(np.mean(turn.magnitude() ** 2)) < 1e-3
        points = expected[:, :3, 3]
    else:
        marker = model.markers['sir']
        seen = tool[:, :3, :3] @ marker + tool[:, :3, 3]
        back = inverse(frames[base, 'mocap'])
        points = seen @ back[:3, :3].T + back[:3, 3]
    # Simulated: 0.1 mm a reading and 0.2 mm a pose on each axis, and the noise of the orientation
    # at the lever of the distance, some 2 m.
    error = np.linalg.norm(points - m.position, axis=1)
    assert np.sqrt(np.mean(error**2)) < 1.5e-3
    stated = {entry['child']: entry for entry in json.loads(printed.stdout)['transforms']}
    assert all(0.0 < std < 5e-3 for entry in stated.values() for std in entry['std_m'])


def test_a_frame_can_have_another_name(fitted, tmp_path):
    _, fit, _ = fitted
    file = fit / 'apply' / 'compensation.json'
    out = tmp_path / 'tf'
    remaster('export', file, '--to', 'tf', '--frame', 'mocap=bar_optical', '--out', out, '--quiet')
    assert 'bar_optical' in {child for _, child in launched(out)}
    for wrong, named in (
        ('mocab=a', "'mocab' is not among the sensors .mocap.*mocap"),
        ('mocap=/a', "'/a' is no name"),
        ('mocap=base_link', "two frames have the name 'base_link'"),
    ):
        words = ('export', file, '--to', 'tf', '--frame', wrong, '--out', tmp_path / 'no')
        assert re.search(named, refusal(*words))
    said = refusal('export', file, '--to', 'json', '--frame', 'mocap=a', '--out', tmp_path / 'no')
    assert '--frame goes with --to tf' in said


def test_a_turn_that_is_not_known_is_not_made_up(fitted, tmp_path):
    """A file of positions alone, or of an earlier version, yields no frame of a camera."""
    made, fit, _ = fitted
    content = json.loads((fit / 'apply' / 'compensation.json').read_text())
    path = tmp_path / 'compensation.json'
    words = ('export', path, '--to', 'tf', '--out', tmp_path / 'no')
    mounts = content.pop('on_tool')
    path.write_text(json.dumps(content))
    assert 'made by an earlier version' in refusal(*words)
    if made.session.on_tool:
        del mounts['mocap']['rotation_xyzw']
        path.write_text(json.dumps({**content, 'on_tool': mounts}))
        assert 'how mocap is turned on the tool is not in this file' in refusal(*words)


def test_discover_says_which_sensors_are_on_the_tool(fitted, tmp_path):
    made, _, session = fitted
    if not made.session.on_tool:
        pytest.skip('of a camera on the tool')
    out = tmp_path / 'found'
    remaster('discover', session, '--out', out, '--no-figures', '--quiet')
    file = out / 'apply' / 'compensation.json'
    words = ('export', file, '--to', 'tf', '--out', tmp_path / 'no')
    assert 'how mocap is turned on the tool is not in this file' in refusal(*words)
