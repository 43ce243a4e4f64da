# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions as their makers ship them once xacro has expanded them, for the tests.

The kinematics are the published ones. Around them stands what such files hold besides the arm and
what a reader or writer of URDF must leave alone: ``<transmission>``, ``<ros2_control>`` and
``<gazebo>`` blocks that name the joints again, fixed joints with an axis of 0 0 0, frames beside
the arm, a gripper whose second finger mimics the first, a cover that mimics a joint of the arm,
materials, meshes, safety controllers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

PI = math.pi


@dataclass(frozen=True)
class Joint:
    """A joint of the arm: origin in its parent (m, rad), unit axis, limits (rad)."""

    name: str
    xyz: Sequence[float]
    rpy: Sequence[float]
    axis: Sequence[float]
    lower: float
    upper: float


@dataclass(frozen=True)
class Description:
    """A robot description and its ends.

    Attributes
    ----------
    urdf
        The text.
    base_link, tip_link
        Between which the arm is.
    """

    urdf: str
    base_link: str
    tip_link: str


def numbers(values: Sequence[float]) -> str:
    return ' '.join(f'{value:.16g}' for value in values)


def link(name: str, mass_kg: float | None = 1.0, mesh: str = '') -> str:
    """Return a link with inertia, mesh and material; a bare frame where the mass is None."""
    if mass_kg is None:
        return f'  <link name="{name}"/>'
    mesh = mesh or f'package://a_robot/meshes/visual/{name}.dae'
    return f"""  <link name="{name}">
    <inertial>
      <mass value="{mass_kg}"/>
      <origin xyz="0.01 0 0.05" rpy="0 0 0"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>
    </inertial>
    <visual>
      <origin xyz="0 0 0.1" rpy="{numbers((PI / 2, 0, -PI / 2))}"/>
      <geometry><mesh filename="{mesh}" scale="0.001 0.001 0.001"/></geometry>
      <material name="grey"/>
    </visual>
    <collision>
      <geometry><cylinder radius="0.06" length="0.2"/></geometry>
    </collision>
  </link>"""


def fixed(
    parent: str,
    child: str,
    xyz: Sequence[float] = (0, 0, 0),
    rpy: Sequence[float] = (0, 0, 0),
    extra: str = '',
) -> str:
    return f"""  <joint name="{parent}-{child}" type="fixed">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/>{extra}
  </joint>"""


def arm(joints: Sequence[Joint], links: Sequence[str], soft_margin: float = 0.0) -> str:
    """Return joints that hang on each other; ``links`` is one longer."""
    parts = []
    for joint, parent, child in zip(joints, links, links[1:], strict=False):
        soft = (
            f'\n    <safety_controller soft_lower_limit="{joint.lower + soft_margin}" '
            f'soft_upper_limit="{joint.upper - soft_margin}" k_position="20" k_velocity="0"/>'
            if soft_margin
            else ''
        )
        parts.append(f"""  <joint name="{joint.name}" type="revolute">
    <origin rpy="{numbers(joint.rpy)}" xyz="{numbers(joint.xyz)}"/>
    <parent link="{parent}"/>
    <child link="{child}"/>
    <axis xyz="{numbers(joint.axis)}"/>
    <limit effort="80" lower="{joint.lower}" upper="{joint.upper}" velocity="2.5"/>{soft}
    <dynamics damping="0.1" friction="0.0"/>
  </joint>""")
    return '\n'.join(parts)


def transmissions(names: Sequence[str]) -> str:
    """Return what Gazebo and ROS 1 drivers want: a joint of the same name in each."""
    return '\n'.join(
        f"""  <transmission name="{name}_transmission">
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="{name}"><hardwareInterface>PositionJointInterface</hardwareInterface></joint>
    <actuator name="{name}_motor"><mechanicalReduction>1</mechanicalReduction></actuator>
  </transmission>"""
        for name in names
    )


def ros2_control(joints: Sequence[Joint]) -> str:
    rows = '\n'.join(
        f"""    <joint name="{joint.name}">
      <command_interface name="position">
        <param name="min">{joint.lower}</param>
        <param name="max">{joint.upper}</param>
      </command_interface>
      <state_interface name="position"><param name="initial_value">0.0</param></state_interface>
      <state_interface name="velocity"/>
    </joint>"""
        for joint in joints
    )
    return f"""  <ros2_control name="arm_system" type="system">
    <hardware><plugin>mock_components/GenericSystem</plugin></hardware>
{rows}
  </ros2_control>"""


def gazebo(joints: Sequence[Joint], links: Sequence[str]) -> str:
    parts = [
        f'  <gazebo reference="{name}"><material>Gazebo/Orange</material></gazebo>'
        for name in links
    ]
    parts += [
        f'  <gazebo reference="{joint.name}"><provideFeedback>true</provideFeedback></gazebo>'
        for joint in joints
    ]
    return '\n'.join(parts)


def document(name: str, *parts: str, xmlns: str = '') -> str:
    return '\n'.join(
        [
            '<?xml version="1.0" ?>',
            '<!-- ================================================================ -->',
            f'<!-- |    This document was made by a generator from {name}.urdf.xacro    -->',
            f'<robot name="{name}"{xmlns}>',
            '  <material name="grey"><color rgba="0.7 0.7 0.7 1.0"/></material>',
            *parts,
            '</robot>',
            '',
        ]
    )


def ur5e() -> Description:
    """Universal Robots UR5e: ros2_control comes before the joints, frames stand beside the arm."""
    names = ('shoulder_pan', 'shoulder_lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3')
    places = (
        ((0, 0, 0.1625), (0, 0, 0)),
        ((0, 0, 0), (PI / 2, 0, 0)),
        ((-0.425, 0, 0), (0, 0, 0)),
        ((-0.3922, 0, 0.1333), (0, 0, 0)),
        ((0, -0.0997, 0), (PI / 2, 0, 0)),
        ((0, 0.0996, 0), (PI / 2, PI, PI)),
    )
    joints = [
        Joint(f'{name}_joint', xyz, rpy, (0, 0, 1), *limits)
        for name, (xyz, rpy), limits in zip(
            names,
            places,
            [(-PI, PI) if name == 'elbow' else (-2 * PI, 2 * PI) for name in names],
            strict=True,
        )
    ]
    links = ['base_link_inertia', 'shoulder_link', 'upper_arm_link', 'forearm_link']
    links += [f'wrist_{i}_link' for i in (1, 2, 3)]
    urdf = document(
        'ur',
        ros2_control(joints),
        *(link(name, None) for name in ('world', 'base_link', 'ft_frame', 'base')),
        *(link(name, None) for name in ('flange', 'tool0')),
        *(link(name) for name in links),
        fixed('world', 'base_link', extra='\n    <axis xyz="0 0 0"/>'),
        fixed('base_link', 'base_link_inertia', rpy=(0, 0, PI)),
        arm(joints, links, soft_margin=0.15),
        fixed('wrist_3_link', 'ft_frame', rpy=(PI, 0, 0)),
        fixed('base_link', 'base', rpy=(0, 0, PI)),
        fixed('wrist_3_link', 'flange', rpy=(0, -PI / 2, -PI / 2)),
        fixed('flange', 'tool0', rpy=(PI / 2, 0, PI / 2)),
        transmissions([joint.name for joint in joints]),
    )
    return Description(urdf, 'base_link', 'tool0')


def irb120() -> Description:
    """ABB IRB 120: axes along X and Y, transmissions for Gazebo, a cover that follows joint 2."""
    rows = (
        ((0, 0, 0), (0, 0, 1), -2.87979, 2.87979),
        ((0, 0, 0.29), (0, 1, 0), -1.91986, 1.91986),
        ((0, 0, 0.27), (0, 1, 0), -1.91986, 1.22173),
        ((0, 0, 0.07), (1, 0, 0), -2.79253, 2.79253),
        ((0.302, 0, 0), (0, 1, 0), -2.094395, 2.094395),
        ((0.072, 0, 0), (1, 0, 0), -6.98132, 6.98132),
    )
    joints = [
        Joint(f'joint_{i}', xyz, (0, 0, 0), axis, lower, upper)
        for i, (xyz, axis, lower, upper) in enumerate(rows, start=1)
    ]
    links = ['base_link', *(f'link_{i}' for i in range(1, 7))]
    cover = """  <joint name="joint_2_cover" type="revolute">
    <origin xyz="0 0.1 0" rpy="0 0 0"/>
    <parent link="link_1"/>
    <child link="cover"/>
    <axis xyz="0 1 0"/>
    <limit effort="0" lower="-3.2" upper="3.2" velocity="1"/>
    <mimic joint="joint_2" multiplier="-0.5" offset="0.1"/>
  </joint>"""
    urdf = document(
        'abb_irb120_3_58',
        transmissions([joint.name for joint in joints]),
        *(link(name, mesh=f'package://abb/meshes/{name}.stl') for name in links),
        arm(joints, links),
        link('cover', 0.1),
        cover,
        *(link(name, None) for name in ('base', 'flange', 'tool0')),
        fixed('base_link', 'base'),
        fixed('link_6', 'flange', extra='\n    <axis xyz="0 0 0"/>'),
        fixed('flange', 'tool0', rpy=(0, PI / 2, 0)),
        gazebo(joints, links),
    )
    return Description(urdf, 'base_link', 'tool0')


def panda() -> Description:
    """Franka Panda: transmissions of three kinds, links without mass, a hand that mimics."""
    quarter = PI / 2
    rows = (
        ((0, 0, 0.333), 0.0, -2.8973, 2.8973),
        ((0, 0, 0), -quarter, -1.7628, 1.7628),
        ((0, -0.316, 0), quarter, -2.8973, 2.8973),
        ((0.0825, 0, 0), quarter, -3.0718, -0.0698),
        ((-0.0825, 0.384, 0), -quarter, -2.8973, 2.8973),
        ((0, 0, 0), quarter, -0.0175, 3.7525),
        ((0.088, 0, 0), quarter, -2.8973, 2.8973),
    )
    joints = [
        Joint(f'panda_joint{i}', xyz, (roll, 0, 0), (0, 0, 1), lower, upper)
        for i, (xyz, roll, lower, upper) in enumerate(rows, start=1)
    ]
    names = [joint.name for joint in joints]
    links = [f'panda_link{i}' for i in range(8)]
    fingers = '\n'.join(
        f"""  <joint name="panda_finger_joint{i}" type="prismatic">
    <parent link="panda_hand"/>
    <child link="{side}finger"/>
    <origin xyz="0 0 0.0584" rpy="0 0 0"/>
    <axis xyz="0 {sign} 0"/>
    <limit effort="100" lower="0.0" upper="0.04" velocity="0.2"/>{mimic}
  </joint>"""
        for i, side, sign, mimic in (
            (1, 'left', 1, ''),
            (2, 'right', -1, '\n    <mimic joint="panda_finger_joint1"/>'),
        )
    )
    state = ''.join(f'\n    <joint name="{name}"><role>state</role></joint>' for name in names)
    urdf = document(
        'panda',
        *(link(name) for name in links),
        *(f'  <link name="{name}_sc"/>' for name in links),
        arm(joints, links),
        *(fixed(name, f'{name}_sc') for name in links),
        link('panda_link8', None),
        fixed('panda_link7', 'panda_link8', (0, 0, 0.107)),
        link('panda_hand', 0.7),
        link('leftfinger', 0.1),
        link('rightfinger', 0.1),
        fixed('panda_link8', 'panda_hand', rpy=(0, 0, -PI / 4)),
        fingers,
        transmissions(names),
        f'  <transmission name="panda_franka_state">{state}\n  </transmission>',
        gazebo(joints, links),
        xmlns=' xmlns:xacro="http://www.ros.org/wiki/xacro"',
    )
    return Description(urdf, 'panda_link0', 'panda_link8')


def iiwa14() -> Description:
    """KUKA LBR iiwa 14 R820: ros2_control with limits before the arm, axes along ±Y."""
    limits = [math.radians(angle) for angle in (170, 120, 170, 120, 170, 120, 175)]
    rows = (
        ((0, 0, 0.1475), (0, 0, 1)),
        ((0, -0.01, 0.2125), (0, 1, 0)),
        ((0, 0.01, 0.228), (0, 0, 1)),
        ((0, 0.0105, 0.192), (0, -1, 0)),
        ((0, -0.0105, 0.2075), (0, 0, 1)),
        ((0, -0.0707, 0.1925), (0, 1, 0)),
        ((0, 0.0707, 0.091), (0, 0, 1)),
    )
    joints = [
        Joint(f'lbr_A{i}', xyz, (0, 0, 0), axis, -limit, limit)
        for i, ((xyz, axis), limit) in enumerate(zip(rows, limits, strict=True), start=1)
    ]
    links = [f'lbr_link_{i}' for i in range(8)]
    urdf = document(
        'iiwa14',
        link('world', None),
        fixed('world', 'lbr_link_0', extra='\n    <axis xyz="0 0 0"/>'),
        gazebo(joints, links),
        ros2_control(joints),
        *(link(name) for name in links),
        arm(joints, links),
        link('lbr_link_ee', None),
        fixed('lbr_link_7', 'lbr_link_ee', (0, 0, 0.035)),
    )
    return Description(urdf, 'world', 'lbr_link_ee')


def xarm7() -> Description:
    """UFACTORY xArm7: seven joints, whose third one leaves no closed form when it is held."""
    quarter = PI / 2
    rows = (
        ((0, 0, 0.267), 0.0, -2 * PI, 2 * PI),
        ((0, 0, 0), -quarter, -2.059, 2.0944),
        ((0, -0.293, 0), quarter, -2 * PI, 2 * PI),
        ((0.0525, 0, 0), quarter, -0.19198, 3.927),
        ((0.0775, -0.3425, 0), quarter, -2 * PI, 2 * PI),
        ((0, 0, 0), quarter, -1.69297, PI),
        ((0.076, 0.097, 0), -quarter, -2 * PI, 2 * PI),
    )
    joints = [
        Joint(f'joint{i}', xyz, (roll, 0, 0), (0, 0, 1), lower, upper)
        for i, (xyz, roll, lower, upper) in enumerate(rows, start=1)
    ]
    links = ['link_base', *(f'link{i}' for i in range(1, 8))]
    urdf = document(
        'xarm7',
        ros2_control(joints),
        *(link(name) for name in links),
        arm(joints, links),
        link('link_eef', None),
        fixed('link7', 'link_eef'),
    )
    return Description(urdf, 'link_base', 'link_eef')


def xarm6() -> Description:
    """UFACTORY xArm6: its last three joints do not meet, by 76 mm; no closed form is near."""
    quarter = PI / 2
    rows = (
        ((0, 0, 0.267), 0.0, -2 * PI, 2 * PI),
        ((0, 0, 0), -quarter, -2.059, 2.0944),
        ((0.0535, -0.2845, 0), 0.0, -3.927, 0.19198),
        ((0.0775, 0.3425, 0), -quarter, -2 * PI, 2 * PI),
        ((0, 0, 0), quarter, -1.69297, PI),
        ((0.076, 0.097, 0), -quarter, -2 * PI, 2 * PI),
    )
    joints = [
        Joint(f'joint{i}', xyz, (roll, 0, 0), (0, 0, 1), lower, upper)
        for i, (xyz, roll, lower, upper) in enumerate(rows, start=1)
    ]
    links = ['link_base', *(f'link{i}' for i in range(1, 7))]
    urdf = document(
        'xarm6',
        *(link(name) for name in links),
        arm(joints, links),
        link('link_eef', None),
        fixed('link6', 'link_eef'),
    )
    return Description(urdf, 'link_base', 'link_eef')


ROBOTS = {'ur5e': ur5e, 'irb120': irb120, 'panda': panda, 'iiwa14': iiwa14}
