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


def _text(numbers: tuple[float, ...]) -> str:
    return ' '.join(f'{number:g}' for number in numbers)
