# SPDX-License-Identifier: Apache-2.0
"""Collision geometry of a URDF: on which joint it hangs, where, and what is refused."""

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_rpy, transform
from remaster_ros.kinematics.urdf_geometry import chain_bodies

COLLISION = '<collision><origin xyz="0 0 0.1"/><geometry>{}</geometry></collision>'


def urdf(base='', arm='', hand='', finger='', world=''):
    """A world, a base turned in it, one joint, and a hand with a finger that mimics another."""
    return f"""<robot name="r">
      <link name="world">{world}</link>
      <link name="base">{base}</link>
      <link name="arm">{arm}</link>
      <link name="hand">{hand}</link>
      <link name="finger">{finger}</link><link name="thumb"/><link name="tool"/>
      <joint name="stand" type="fixed"><parent link="world"/><child link="base"/>
        <origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/></joint>
      <joint name="joint_1" type="revolute"><parent link="base"/><child link="arm"/>
        <origin xyz="0 0 0.5"/><axis xyz="0 1 0"/><limit lower="-2" upper="2"/></joint>
      <joint name="wrist" type="fixed"><parent link="arm"/><child link="hand"/>
        <origin xyz="0 0 0.4"/></joint>
      <joint name="finger_joint" type="prismatic"><parent link="hand"/><child link="finger"/>
        <origin xyz="0.05 0 0"/><limit lower="0" upper="0.04"/></joint>
      <joint name="thumb_joint" type="prismatic"><parent link="hand"/><child link="thumb"/>
        <mimic joint="finger_joint"/><origin xyz="-0.05 0 0"/>
        <limit lower="0" upper="0.04"/></joint>
      <joint name="tip" type="fixed"><parent link="hand"/><child link="tool"/>
        <origin xyz="0 0 0.1"/></joint>
    </robot>"""


def read(text, meshes=None):
    chain = SerialChain.from_urdf(text, 'base', 'tool')
    reader = (meshes or {}).__getitem__
    return {body.name: body for body in chain_bodies(text, chain, reader)}


def test_what_is_fastened_to_a_link_moves_with_it():
    box = COLLISION.format('<box size="0.1 0.2 0.3"/>')
    bodies = read(urdf(base=box, arm=box, hand=box, finger=box, world=box))
    assert {name: body.link for name, body in bodies.items()} == {
        'world': 0,
        'base': 0,
        'arm': 1,
        'hand': 1,
        'finger': 1,
    }
    where = {name: body.T_link_body for name, body in bodies.items()}
    np.testing.assert_allclose(where['hand'][:3, 3], [0, 0, 0.5], atol=1e-12)
    # A gripper's joint counts as fixed at zero.
    np.testing.assert_allclose(where['finger'][:3, 3], [0.05, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(where['base'][:3, 3], [0, 0, 0.1], atol=1e-12)
    # The world as the base has it: a metre back, and turned the other way.
    back = np.linalg.inv(
        transform(matrix_from_rpy(np.array([0, 0, np.pi / 2])), np.array([1, 0, 0]))
    )
    np.testing.assert_allclose(
        where['world'], back @ transform(np.eye(3), [0, 0, 0.1]), atol=1e-12
    )


def test_every_kind_of_geometry():
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    cases = {
        '<box size="0.1 0.2 0.3"/>': ('box', [0.05, 0.1, 0.15]),
        '<cylinder radius="0.1" length="0.4"/>': ('cylinder', [0.1, 0.1, 0.2]),
        '<sphere radius="0.1"/>': ('sphere', [0.1, 0.1, 0.1]),
        '<capsule radius="0.1" length="0.4"/>': ('capsule', [0.1, 0.1, 0.3]),
        '<mesh filename="cube.stl" scale="0.1 0.2 0.3"/>': ('hull', [0.1, 0.2, 0.3]),
    }
    for element, (kind, highest) in cases.items():
        (body,) = read(urdf(arm=COLLISION.format(element)), {'cube.stl': cube}).values()
        assert body.shape.kind == kind
        support = body.shape.points.max(axis=0) + body.shape.ball
        support += body.shape.disc * np.array([1, 1, 0])
        np.testing.assert_allclose(support, highest, atol=1e-12)


@pytest.mark.parametrize(
    ('geometry', 'message'),
    [
        ('', "link 'arm' is empty"),
        ('<cone radius="1"/>', "link 'arm' is a <cone>"),
        ('<box size="0.1 0.2"/>', "size of the collision geometry of link 'arm' is '0.1 0.2'"),
        ('<box size="0.1 0.2 -1"/>', "link 'arm': collision: a box"),
        ('<sphere radius="x"/>', "'x', not a number"),
        ('<cylinder radius="0.1"/>', "no attribute 'length'"),
        ('<mesh/>', "no attribute 'filename'"),
        ('<mesh filename="cube.stl" scale="1 1 0"/>', 'all lie in one plane'),
    ],
)
def test_wrong_geometry_is_refused_by_the_link_s_name(geometry, message):
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    with pytest.raises(InputError, match=message):
        read(urdf(arm=COLLISION.format(geometry)), {'cube.stl': cube})
