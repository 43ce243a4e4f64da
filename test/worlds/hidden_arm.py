# SPDX-License-Identifier: Apache-2.0
"""The arm of the hidden world: kinematics and gravity by pinocchio.

Joints are counted from 1 in everything that leaves this module as a joint's number; arrays are
indexed from 0.
"""

from __future__ import annotations

import numpy as np
import pytest

from remaster_ros.simulation.world_model import ArmState
from remaster_ros.types import FloatArray

# Of whatever test needs this arm.
pin = pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

GRAVITY = np.array([0.0, 0.0, -9.81])


class PinocchioArm:
    """A serial arm read from its URDF by pinocchio.

    Parameters
    ----------
    urdf
        The URDF's text; its root link is frame R.
    tip_link
        Frame T.
    """

    def __init__(self, urdf: str, tip_link: str = 'tool') -> None:
        self.model = pin.buildModelFromXML(urdf)
        self.model.gravity.linear = GRAVITY
        self._data = self.model.createData()
        self._tip = self.model.getFrameId(tip_link)
        self.joints = self.model.nq
        names = [joint.shortname() for joint in self.model.joints.tolist()[1:]]
        self.slides = np.array([name.startswith('JointModelP') for name in names])

    def state(self, q: FloatArray) -> ArmState:
        """Where every joint is for true joint angles q, rad, (n, k)."""
        n, k, data = len(q), self.joints, self._data
        origin, axis = np.empty((n, k, 3)), np.empty((n, k, 3))
        before, after = np.empty((n, k, 3, 3)), np.empty((n, k, 3, 3))
        tool_origin, tool = np.empty((n, 3)), np.empty((n, 3, 3))
        for i, angles in enumerate(q):
            # Joint Jacobians in the world frame: their lower half is the axes, the upper one that
            # of what slides.
            columns = pin.computeJointJacobians(self.model, data, angles).T
            axis[i] = np.where(self.slides[:, None], columns[:, :3], columns[:, 3:])
            placed = pin.updateFramePlacement(self.model, data, self._tip)
            tool_origin[i], tool[i] = placed.translation, placed.rotation
            for j in range(k):
                origin[i, j] = data.oMi[j + 1].translation
                after[i, j] = data.oMi[j + 1].rotation
                stands = data.oMi[self.model.parents[j + 1]] * self.model.jointPlacements[j + 1]
                before[i, j] = stands.rotation
                if self.slides[j]:
                    origin[i, j] = stands.translation
        return ArmState(origin, before, after, axis, tool_origin, tool)

    def gravity_torque(self, q: FloatArray) -> FloatArray:
        """Torque with which gravity turns each joint its own way, N m, (n, k)."""
        # Pinocchio gives what the motors need to hold the arm: the opposite.
        return np.array(
            [-pin.computeGeneralizedGravity(self.model, self._data, angles) for angles in q]
        )

    def potential_energy(self, q: FloatArray) -> FloatArray:
        """Energy of the links in gravity's field, J, (n,)."""
        return np.array(
            [pin.computePotentialEnergy(self.model, self._data, angles) for angles in q]
        )

    def base_moment(self, q: FloatArray) -> FloatArray:
        """Moment of the moving links' weight about the base's origin, N m, (n, 3)."""
        mass = sum(inertia.mass for inertia in self.model.inertias.tolist()[1:])
        centers = np.array([pin.centerOfMass(self.model, self._data, angles) for angles in q])
        return np.cross(centers, mass * GRAVITY)

    def carried_moment(self, q: FloatArray) -> FloatArray:
        """Gravity's moment on what each joint carries about its origin, in R, N m, (n, k, 3)."""
        moments = np.zeros((len(q), self.joints, 3))
        for i, angles in enumerate(q):
            # Of the subtree of each joint, its centre in the joint's own frame.
            pin.centerOfMass(self.model, self._data, angles, True)
            for j in range(self.joints):
                turn = self._data.oMi[j + 1].rotation
                arm = turn @ self._data.com[j + 1]
                moments[i, j] = np.cross(self._data.mass[j + 1] * arm, GRAVITY)
        return moments

    def segments(self) -> FloatArray:
        """From each joint's origin to the next one's, the last to the tool's, m, (k + 1, 3).

        Segment j is fixed in the frame after joint j; segment 0, before joint 1, in the base.
        """
        placements = [self.model.jointPlacements[j + 1].translation for j in range(self.joints)]
        tip = self.model.frames[self._tip].placement.translation
        return np.array([*placements, tip])


def six_joint_arm() -> str:
    """Return the URDF of a small arm with six joints, an elbow and a wrist whose axes meet.

    An invented one of the size and weight of a bench-top industrial robot.
    """
    # Joint: origin, axis, limits (deg), speed; its link: mass (kg), centre of mass (m).
    rows = (
        ((0.0, 0.0, 0.29), 'z', (-165, 165), 250, 3.1, (0.0, -0.002, -0.05)),
        ((0.0, 0.0, 0.0), 'y', (-110, 110), 250, 3.9, (0.001, -0.02, 0.10)),
        ((0.0, 0.0, 0.27), 'y', (-110, 70), 250, 2.4, (0.06, -0.015, 0.058)),
        ((0.134, 0.0, 0.07), 'x', (-160, 160), 320, 1.3, (0.09, 0.0, 0.0)),
        ((0.168, 0.0, 0.0), 'y', (-120, 120), 320, 0.55, (0.0, 0.0, 0.0)),
        ((0.072, 0.0, 0.0), 'x', (-170, 170), 420, 0.2, (-0.006, 0.0, 0.0)),
    )
    axes = {'x': '1 0 0', 'y': '0 1 0', 'z': '0 0 1'}
    inertia = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/>'
    parts, parent = ['<link name="base_link"/>'], 'base_link'
    for number, (origin, axis, (low, high), speed, mass, center) in enumerate(rows, 1):
        limits = f'lower="{np.deg2rad(low):.12g}" upper="{np.deg2rad(high):.12g}"'
        parts.append(
            f'<joint name="joint_{number}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{number}"/><origin xyz="{_text(origin)}"/>'
            f'<axis xyz="{axes[axis]}"/>'
            f'<limit {limits} velocity="{np.deg2rad(speed):.12g}" effort="100"/></joint>'
            f'<link name="link_{number}"><inertial><origin xyz="{_text(center)}"/>'
            f'<mass value="{mass}"/>{inertia}</inertial></link>'
        )
        parent = f'link_{number}'
    # The tool's z axis points away from the flange, as it does on other arms.
    parts.append(
        f'<joint name="tool_joint" type="fixed"><parent link="{parent}"/><child link="tool"/>'
        f'<origin xyz="0.05 0 0" rpy="0 {np.pi / 2:.16g} 0"/></joint>'
        '<link name="tool"><inertial><origin xyz="0 0 0.01"/><mass value="0.4"/>'
        f'{inertia}</inertial></link>'
    )
    return '<robot name="six_joint_arm">' + ''.join(parts) + '</robot>'


H = np.pi / 2
# Joint: origin, roll-pitch-yaw, limits (rad); its link: mass (kg), centre of mass (m). Of Franka's
# and Universal Robots' published descriptions, with masses of that size; all axes are z.
PANDA = (
    ((0, 0, 0.333), (0, 0, 0), (-2.8973, 2.8973), 3.0, (0, -0.03, -0.07)),
    ((0, 0, 0), (-H, 0, 0), (-1.7628, 1.7628), 3.0, (0, -0.07, 0.03)),
    ((0, -0.316, 0), (H, 0, 0), (-2.8973, 2.8973), 2.5, (0.04, 0.02, -0.04)),
    ((0.0825, 0, 0), (H, 0, 0), (-3.0718, -0.0698), 2.5, (-0.04, 0.04, 0.02)),
    ((-0.0825, 0.384, 0), (-H, 0, 0), (-2.8973, 2.8973), 2.5, (0, 0.04, -0.11)),
    ((0, 0, 0), (H, 0, 0), (-0.0175, 3.7525), 1.5, (0.05, 0.01, 0)),
    ((0.088, 0, 0), (H, 0, 0), (-2.8973, 2.8973), 0.7, (0.01, 0, 0.08)),
)
UR10 = (
    ((0, 0, 0.1273), (0, 0, 0), (-np.pi, np.pi), 7.8, (0, 0, 0)),
    ((0, 0.220941, 0), (0, H, 0), (-np.pi, np.pi), 12.9, (0, 0, 0.306)),
    ((0, -0.1719, 0.612), (0, 0, 0), (-np.pi, np.pi), 3.9, (0, 0, 0.286)),
    ((0, 0, 0.5723), (0, H, 0), (-np.pi, np.pi), 2.0, (0, 0, 0)),
    ((0, 0.1149, 0), (0, 0, 0), (-np.pi, np.pi), 2.0, (0, 0, 0)),
    ((0, 0, 0.1157), (0, 0, 0), (-np.pi, np.pi), 0.2, (0, 0, 0)),
)
# Of UR10 all but the first and the fifth axis are y.
UR10_AXES = ('z', 'y', 'y', 'y', 'z', 'y')


def panda_arm() -> str:
    """Return the URDF of an arm with a Panda's lengths."""
    return _of_rows('panda', PANDA, ('z',) * 7, ((0, 0, 0.107), (0, 0, 0)))


def ur10_arm() -> str:
    """Return the URDF of an arm with a UR10's lengths; its tool looks along the last axis."""
    return _of_rows('ur10', UR10, UR10_AXES, ((0, 0.0922, 0), (-H, 0, 0)))


def _of_rows(name: str, rows: tuple, axes: tuple[str, ...], flange: tuple) -> str:
    unit = {'y': '0 1 0', 'z': '0 0 1'}
    inertia = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/>'
    parts, parent = ['<link name="base_link"/>'], 'base_link'
    for number, (xyz, rpy, (low, high), mass, center) in enumerate(rows, 1):
        parts.append(
            f'<joint name="joint_{number}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{number}"/>'
            f'{_origin(xyz, rpy)}<axis xyz="{unit[axes[number - 1]]}"/>'
            f'<limit lower="{float(low)!r}" upper="{float(high)!r}" velocity="2.5" '
            'effort="100"/></joint>'
            f'<link name="link_{number}"><inertial><origin xyz="{_text(center)}"/>'
            f'<mass value="{mass}"/>{inertia}</inertial></link>'
        )
        parent = f'link_{number}'
    xyz, rpy = flange
    parts.append(
        f'<joint name="tool_joint" type="fixed"><parent link="{parent}"/><child link="tool"/>'
        f'{_origin(xyz, rpy)}</joint>'
        '<link name="tool"><inertial><origin xyz="0 0 0.01"/><mass value="0.4"/>'
        f'{inertia}</inertial></link>'
    )
    return f'<robot name="{name}">' + ''.join(parts) + '</robot>'


def _origin(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> str:
    turn = ' '.join(repr(float(angle)) for angle in rpy)
    return f'<origin xyz="{_text(xyz)}" rpy="{turn}"/>'


def _text(numbers: tuple[float, ...]) -> str:
    return ' '.join(f'{number:g}' for number in numbers)
