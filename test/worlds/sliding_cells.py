# SPDX-License-Identifier: Apache-2.0
"""Arms with a joint that slides, and cells for them: a rail, a SCARA, a lift, a telescope."""

from __future__ import annotations

import re
from pathlib import Path

from worlds.simple_cells import write_cell

from remaster_ros.session.cells.workcell import config_path

LWR = config_path('robots/lwr4plus.urdf').read_text(encoding='utf-8')


def _slide(axis: str, low: float, high: float, velocity: float = 0.5) -> str:
    return (
        f'<axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" velocity="{velocity}" effort="100"/></joint>'
    )


def _carried(text: str, name: str, axis: str, low: float, high: float, origin: str) -> str:
    """Put an arm on a carriage that slides on its base."""
    text = text.replace('<parent link="base_link"/>', '<parent link="carriage"/>', 1)
    # What it slides on lies below it.
    body = '<collision><origin xyz="0 0 -0.1"/><geometry><box size="0.3 1.6 0.05"/></geometry>'
    text = text.replace('<link name="base_link">', f'<link name="base_link">{body}</collision>')
    return text.replace(
        '</robot>',
        f'<link name="carriage"/><joint name="{name}" type="prismatic">'
        f'<parent link="base_link"/><child link="carriage"/><origin xyz="{origin}"/>'
        f'{_slide(axis, low, high)}</robot>',
    )


def _with_joint_3(text: str, kind: str, tail: str) -> str:
    """Replace the joint that rolls the upper arm."""
    found = re.search(r'<joint name="joint_3".*?</joint>', text, re.DOTALL)
    assert found is not None
    joint = found.group(0).replace('"revolute"', f'"{kind}"')
    joint = re.sub(r'<axis.*</joint>', tail, joint, flags=re.DOTALL)
    return text.replace(found.group(0), joint)


def rail() -> str:
    """Return a rail of 1.2 m before six joints that turn."""
    six = _with_joint_3(LWR, 'fixed', '</joint>')
    return _carried(six, 'rail', '0 1 0', -0.6, 0.6, '0 0 0')


def lift() -> str:
    """Return a lift of 0.35 m, as of a robot's torso, before seven joints that turn."""
    return _carried(LWR, 'lift', '0 0 1', 0.0, 0.35, '0 0 0.3')


def telescope() -> str:
    """Return an arm of six joints that turn, whose upper arm slides out by 0.1 m or in."""
    # A link with a body: without one it would have a rod as long as the way of the slide.
    tube = '<cylinder radius="0.06" length="0.2"/>'
    body = f'<collision><origin xyz="0 0 0.1"/><geometry>{tube}</geometry></collision>'
    text = LWR.replace('<link name="link_3">', f'<link name="link_3">{body}')
    return _with_joint_3(text, 'prismatic', _slide('0 0 1', -0.1, 0.1))


def scara() -> str:
    """Return three axes and a slide, all upright."""
    joints = (
        ('j1', 'revolute', '0 0 0.6', -2.2, 2.2, 2.0),
        ('j2', 'revolute', '0.35 0 0', -2.2, 2.2, 2.0),
        ('lift', 'prismatic', '0.3 0 0.05', -0.2, 0.1, 0.6),
        ('j4', 'revolute', '0 0 -0.3', -3.0, 3.0, 3.0),
    )
    text, parent = '<robot name="scara"><link name="base_link"/>', 'base_link'
    for i, (name, kind, origin, low, high, velocity) in enumerate(joints, start=1):
        child = 'tool' if i == len(joints) else f'link_{i}'
        text += (
            f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{origin}"/><axis xyz="0 0 1"/><limit '
            f'lower="{low}" upper="{high}" velocity="{velocity}" effort="1"/></joint>'
        )
        parent = child
    return f'{text}</robot>'


def sliding_cell(folder: Path, urdf: str, **changes) -> Path:
    """Write a cell of such an arm, the demo's but for these keys; return its path."""
    (folder / 'arm.urdf').write_text(urdf, encoding='utf-8')
    robot = {'urdf': 'arm.urdf', 'base_link': 'base_link', 'tip_link': 'tool'}
    held_joint = {'held_joint': '', 'held_values_deg': []}
    return write_cell(folder / 'cell.yaml', **{'robot': robot, **held_joint, **changes})
