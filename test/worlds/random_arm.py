# SPDX-License-Identifier: Apache-2.0
"""Random arms as URDF text for the tests: any axes, fixed joints and masses in between."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np


def random_arm_urdf(
    rng: np.random.Generator, joints: int = 6, slides: Collection[int] = ()
) -> str:
    """Return a URDF whose chain base_link … tool has ``joints`` moving and some fixed joints.

    Those with the indices ``slides`` (0 is the base's) are prismatic.
    """

    def numbers(values):
        return ' '.join(f'{value:.17g}' for value in values)

    def link(name):
        return (
            f'<link name="{name}"><inertial><origin xyz="{numbers(rng.normal(0, 0.2, 3))}"'
            f' rpy="{numbers(rng.normal(0, 1, 3))}"/><mass value="{rng.uniform(0.1, 5):.17g}"/>'
            '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
        )

    def joint(name, kind, parent, child):
        return (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{numbers(rng.normal(0, 0.3, 3))}"'
            f' rpy="{numbers(rng.normal(0, 2, 3))}"/>'
            f'<axis xyz="{numbers(rng.normal(0, 1, 3))}"/>'
            '<limit lower="-3" upper="3" velocity="2" effort="10"/></joint>'
        )

    parts = [link('base_link')]
    parent = 'base_link'
    for i in range(1, joints + 1):
        kind = 'prismatic' if i - 1 in slides else 'revolute'
        # A fixed joint before, and a side branch with a gripper's finger after the link.
        parts += [link(f'mount_{i}'), joint(f'fixed_{i}', 'fixed', parent, f'mount_{i}')]
        parts += [link(f'link_{i}'), joint(f'joint_{i}', kind, f'mount_{i}', f'link_{i}')]
        parts += [link(f'finger_{i}'), joint(f'side_{i}', 'fixed', f'link_{i}', f'finger_{i}')]
        parent = f'link_{i}'
    parts += [link('tool'), joint('tool_joint', 'fixed', parent, 'tool')]
    return '<robot name="random">' + ''.join(parts) + '</robot>'
