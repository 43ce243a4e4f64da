# SPDX-License-Identifier: Apache-2.0
"""Small arms: planar ones of links that are easy to reckon with, and any that joints make."""

from __future__ import annotations

from remaster_ros.kinematics.serial_chain import SerialChain


def planar_arm(links, axis='0 1 0', limit=None):
    """Return an arm of 0.3 m links in the X-Z plane: positive angles turn from Z towards X."""
    kind = 'continuous' if limit is None else 'revolute'
    bounds = '' if limit is None else f'<limit lower="{-limit}" upper="{limit}"/>'
    parts = ['<link name="link_0"/>']
    for i in range(1, links + 1):
        parts.append(
            f'<link name="link_{i}"/><joint name="joint_{i}" type="{kind}">{bounds}'
            f'<parent link="link_{i - 1}"/><child link="link_{i}"/>'
            f'<origin xyz="0 0 0.3"/><axis xyz="{axis}"/></joint>'
        )
    parts.append(
        f'<link name="tool"/><joint name="tool_joint" type="fixed"><parent link="link_{links}"/>'
        '<child link="tool"/><origin xyz="0 0 0.3"/></joint>'
    )
    return SerialChain.from_urdf('<robot name="planar">' + ''.join(parts) + '</robot>')


def jointed_arm(*joints: tuple[str, str, str, str]) -> str:
    """Return a URDF of joints (kind, axis, xyz, rpy), base to tool."""
    parts, parent = ['<link name="base"/>'], 'base'
    for i, (kind, axis, xyz, rpy) in enumerate(joints, start=1):
        low, high = (0.1, 0.5) if kind == 'prismatic' else (-2.2, 2.2)
        child = 'tool0' if i == len(joints) else f'l{i}'
        parts.append(
            f'<link name="{child}"/><joint name="j{i}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" velocity="1" effort="1"/></joint>'
        )
        parent = child
    return f'<robot name="slider">{"".join(parts)}</robot>'


# A Stanford arm: its third joint slides behind two that turn, along an axis that is tilted.
STANFORD = jointed_arm(
    ('revolute', '0 0 1', '0 0 0.4', '0 0 0'),
    ('revolute', '0 0 1', '0 0.15 0', '-1.5708 0 0'),
    ('prismatic', '0.1 0 1', '0 0 0.1', '1.5708 0.1 0'),
    ('revolute', '0 0 1', '0 0 0', '0 0 0'),
    ('revolute', '0 0 1', '0 0.05 0', '-1.5708 0 0'),
    ('revolute', '0 0 1', '0 0 0.1', '1.5708 0 0'),
)
