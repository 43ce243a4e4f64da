# SPDX-License-Identifier: Apache-2.0
"""All inverse-kinematics solutions by a second method: Newton's from random starts, by pinocchio.

Nothing of the package is used: kinematics and derivatives are pinocchio's, of the URDF's text.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

# Near a fold of the workspace two solutions are known to the square root of what is left of the
# pose; nearer than this, rad, they count as one.
SAME_RAD = 1e-3


def with_errors(urdf: str, length_m: float, tilt_rad: float, rng: np.random.Generator) -> str:
    """Return a URDF whose moving joints are shifted and tilted at random, by so much an axis."""
    robot = ElementTree.fromstring(urdf)
    for joint in robot.findall('joint'):
        if joint.get('type') != 'revolute' or joint.find('mimic') is not None:
            continue
        origin = joint.find('origin')
        assert origin is not None
        xyz, rpy = (np.array(origin.get(key).split(), dtype=float) for key in ('xyz', 'rpy'))
        turn = Rotation.from_euler('xyz', rpy) * Rotation.from_rotvec(rng.normal(0, tilt_rad, 3))
        for key, value in (
            ('xyz', xyz + rng.normal(0, length_m, 3)),
            ('rpy', turn.as_euler('xyz')),
        ):
            origin.set(key, ' '.join(f'{number:.16g}' for number in value))
    return ElementTree.tostring(robot, encoding='unicode')


class InverseJudge:
    """An arm read by pinocchio, some of whose joints are held.

    Parameters
    ----------
    urdf
        The text; its root is the base.
    base, tip
        Links between which the arm is.
    joints
        Names of its joints; all others are locked at zero.
    held
        Index of a joint -> where it is held, rad.
    """

    def __init__(
        self,
        urdf: str,
        base: str,
        tip: str,
        joints: tuple[str, ...],
        held_values: Mapping[int, float],
    ) -> None:
        model = pin.buildModelFromXML(urdf)
        locked = [
            model.getJointId(name)
            for name in model.names.tolist()[1:]
            if name not in joints or joints.index(name) in held_values
        ]
        at = pin.neutral(model)
        for joint, value in held_values.items():
            at[model.joints[model.getJointId(joints[joint])].idx_q] = value
        self.model = pin.buildReducedModel(model, locked, at)
        self.data = self.model.createData()
        self.tip = self.model.getFrameId(tip)
        self._at = np.array(
            [
                self.model.joints[self.model.getJointId(name)].idx_q
                for i, name in enumerate(joints)
                if i not in held_values
            ]
        )
        kinds = [joint.shortname() for joint in self.model.joints][1:]
        self._slides = np.array(['JointModelP' in kind for kind in kinds])
        neutral = pin.neutral(self.model)
        pin.framesForwardKinematics(self.model, self.data, neutral)
        self._base = self.data.oMf[self.model.getFrameId(base)].copy()

    def tool(self, free: FloatArray) -> pin.SE3:
        """Return T_R_T at positions of the joints that are not held, (k,)."""
        q = np.empty(self.model.nq)
        q[self._at] = free
        pin.framesForwardKinematics(self.model, self.data, q)
        return self._base.actInv(self.data.oMf[self.tip])

    def left(self, free: FloatArray, T: FloatArray) -> tuple[float, float]:
        """Return how far the tool is from T (4, 4), m and rad."""
        screw = pin.log6(pin.SE3(T).actInv(self.tool(free))).vector
        return float(np.linalg.norm(screw[:3])), float(np.linalg.norm(screw[3:]))

    def solutions(self, T: FloatArray, starts: int, rng: np.random.Generator) -> FloatArray:
        """Return the distinct solutions in [-pi, pi] that random starts arrive at, (m, k)."""
        found: list[FloatArray] = []
        goal = self._base * pin.SE3(T)
        for q in rng.uniform(-np.pi, np.pi, (starts, self.model.nq)):
            for _ in range(80):
                pin.computeJointJacobians(self.model, self.data, q)
                pin.updateFramePlacement(self.model, self.data, self.tip)
                J = pin.getFrameJacobian(self.model, self.data, self.tip, pin.LOCAL)
                screw = pin.log6(self.data.oMf[self.tip].actInv(goal)).vector
                size = screw @ screw
                if size < 1e-22:
                    turned = (q + np.pi) % (2 * np.pi) - np.pi
                    free = np.where(self._slides, q, turned)[self._at]
                    if not found or np.min(apart(free, np.array(found))) > SAME_RAD:
                        found.append(free)
                    break
                damped = J.T @ J + min(0.02 * size, 0.1) * np.eye(self.model.nv)
                step = np.linalg.solve(damped, J.T @ screw)
                q = q + step * min(1.0, 0.7 / max(np.max(np.abs(step)), 1e-300))
        return np.array(found).reshape(-1, self.model.nq)


def apart(q: FloatArray, solutions: FloatArray) -> FloatArray:
    """Return the largest joint difference of q (k,) to each of solutions (n, k), modulo turns."""
    return np.max(np.abs((solutions - q + np.pi) % (2 * np.pi) - np.pi), axis=-1)
