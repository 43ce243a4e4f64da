# SPDX-License-Identifier: Apache-2.0
"""Accelerations and inertial torques against pinocchio."""

import re

import numpy as np
import pytest
from worlds.hidden_arm import pin, six_joint_arm

from remaster_ros.kinematics.moving_links import MovingLinks
from remaster_ros.kinematics.serial_chain import SerialChain


@pytest.mark.parametrize('slide', [False, True])
def test_torques_and_accelerations_are_pinocchios(slide):
    # Masses are points, one for each link that moves by itself.
    urdf = re.sub(r'<inertia .*?/>', '', six_joint_arm())
    urdf = re.sub(r'<link name="tool">.*?</link>', '<link name="tool"/>', urdf)
    if slide:
        urdf = re.sub(r'(name="joint_3" type=)"revolute"', r'\1"prismatic"', urdf)
    chain = SerialChain.from_urdf(urdf, 'base_link', 'tool')
    points = re.sub(
        r'</inertial>',
        '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>',
        urdf,
    )
    model = pin.buildModelFromXML(points)
    model.gravity.linear = np.zeros(3)
    data = model.createData()
    rng = np.random.default_rng(3)
    q, v, a = rng.uniform(-1.0, 1.0, (3, 20, 6))
    moving = MovingLinks.of(chain, q, v, a)
    torque = np.array([-pin.rnea(model, data, *state) for state in zip(q, v, a, strict=True)])
    np.testing.assert_allclose(moving.inertial_torque(), torque, atol=1e-9)
    place = np.array([0.05, -0.02, 0.1])
    tip = model.getFrameId('tool')
    expected = []
    for state in zip(q, v, a, strict=True):
        pin.forwardKinematics(model, data, *state)
        frame = pin.updateFramePlacement(model, data, tip)
        moved = pin.SE3(frame.rotation, frame.translation + frame.rotation @ place)
        parent = model.frames[tip].parentJoint
        local = data.oMi[parent].inverse() * moved
        model.addFrame(pin.Frame('m', parent, local, pin.FrameType.OP_FRAME))
        data2 = model.createData()
        pin.forwardKinematics(model, data2, *state)
        pin.updateFramePlacements(model, data2)
        at = model.nframes - 1
        expected.append(
            pin.getFrameClassicalAcceleration(
                model, data2, at, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            ).linear
        )
    points_R = chain.positions(q, place)
    np.testing.assert_allclose(moving.point_acceleration(points_R), expected, atol=1e-9)
