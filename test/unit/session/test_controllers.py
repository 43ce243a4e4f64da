# SPDX-License-Identifier: Apache-2.0
"""How a pad writes the joints is kept in session.yaml, and refused where it cannot be so."""

from dataclasses import replace

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.kinematics.pad_angles import PadAngles, pad_in_words
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.session.strict_yaml import dump_yaml, load_yaml
from remaster_ros.types import Controller, PadJoint

PADS = {
    'joint_1': PadJoint('A1', 'rad', -1, 90.25),
    'joint_2': PadJoint('Achse 2', 'gon', coupling={'joint_1': -1}),
}


def test_it_is_read_as_it_was_written(session, tmp_path):
    controller = Controller(PADS, 'KUKA')
    write_session(tmp_path / 's', replace(session, controller=controller))
    assert read_session(tmp_path / 's').controller == controller
    # A session without it, as all older ones are, has none.
    write_session(tmp_path / 'old', session)
    assert 'controller' not in (tmp_path / 'old' / 'session.yaml').read_text()
    assert read_session(tmp_path / 'old').controller is None


@pytest.mark.parametrize(
    ('joints', 'words'),
    [
        ({'joint_9': {'name': 'A9'}}, "'joint_9' is not among the URDF's joints"),
        ({'joint_1': {'name': ' '}}, 'controller.joints.joint_1.name'),
        ({'joint_1': {}}, 'name'),
        ({'joint_1': {'name': 'A1', 'unit': 'mm'}}, 'unit'),
        ({'joint_1': {'name': 'A1', 'sign': 2}}, 'sign'),
        ({'joint_1': {'name': 'A1', 'zero_deg': 400.0}}, 'zero_deg is 400; it must be'),
        ({'joint_1': {'name': 'A1', 'zero_deg': float('nan')}}, 'not a finite number'),
        ({'joint_1': {'name': 'A'}, 'joint_2': {'name': 'A'}}, 'given to two joints'),
        ({'joint_1': {'name': 'A', 'coupling': {'joint_2': 1}}}, "'joint_2' is not among"),
        (
            {
                'joint_1': {'name': 'A', 'coupling': {'joint_2': 1}},
                'joint_2': {'name': 'B', 'coupling': {'joint_1': 1}},
            },
            'coupled to itself',
        ),
        ({}, 'none given'),
    ],
)
def test_what_cannot_be_is_refused(session, tmp_path, joints, words):
    write_session(tmp_path / 's', session)
    path = tmp_path / 's' / 'session.yaml'
    content = load_yaml(path.read_text())
    path.write_text(dump_yaml({**content, 'controller': {'joints': joints}}))
    with pytest.raises(InputError) as caught:
        read_session(tmp_path / 's')
    assert str(path) in str(caught.value)
    assert words in str(caught.value)


def test_angles_go_to_the_urdf_and_back():
    pad = PadAngles.of(Controller(PADS), ['joint_1', 'joint_2'])
    shown = np.array([[0.3, -0.2], [-1.1, 0.7]])
    q = pad.to_urdf(shown)
    np.testing.assert_allclose(q[:, 0], np.radians(90.25) - shown[:, 0])
    np.testing.assert_allclose(q[:, 1], shown[:, 1] - shown[:, 0])
    np.testing.assert_allclose(pad.to_pad(q), shown)
    assert pad_in_words(Controller(PADS)) == ['joint_1 = -A1 + 90.25°', 'joint_2 = Achse 2 - A1']
