# SPDX-License-Identifier: Apache-2.0
"""Where an arm has its tool by its compensation.json: NumPy, the file and the URDF in it.

    python evaluate_compensation.py compensation.json 0.1 -0.5 0.6 0.2 0.9 0.3 0.0

docs/files.md states each key. Copy it: nothing of remaster_ros is needed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np


def rotation(vector: Any) -> np.ndarray:
    """Return the rotation matrix of a rotation vector, rad."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def pose(R: np.ndarray, t: Any) -> np.ndarray:
    """Return a 4 x 4 transform."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def quaternion(xyzw: Any) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion."""
    x, y, z, w = xyzw
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2.0 * w * K + 2.0 * K @ K


def splines(x: float, knots: Any, degree: int) -> np.ndarray:
    """Return all B-splines of a degree at x, by the recursion of Cox and de Boor."""
    t = np.asarray(knots, dtype=float)
    x = min(max(x, t[degree]), t[-degree - 1])
    # The last interval holds its right end.
    k = min(int(np.searchsorted(t, x, side='right')) - 1, len(t) - degree - 2)
    found = np.eye(len(t) - 1)[k]
    for d in range(1, degree + 1):
        left, right = t[d:-1] - t[: -d - 1], t[d + 1 :] - t[1:-d]
        rise = np.divide(x - t[: -d - 1], left, out=np.zeros(len(left)), where=left > 0)
        fall = np.divide(t[d + 1 :] - x, right, out=np.zeros(len(right)), where=right > 0)
        found = rise * found[:-1] + fall * found[1:]
    return found


class Arm:
    """An arm by its compensation.json; change what stands in ``data`` to see what it does."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data
        robot = data['robot']
        self.names = robot['joint_names']
        elements = ElementTree.fromstring(robot['urdf']).findall('joint')
        by_child = {joint.find('child').get('link'): joint for joint in elements}  # type: ignore
        link, way = robot['tip_link'], []
        while link != robot['base_link']:
            way.append(by_child[link])
            link = way[-1].find('parent').get('link')
        # Nominal origin of each joint in the frame after the joint before; last that of the tool.
        self.origins, self.axes, self.slides = [np.eye(4)], [], []
        for joint in reversed(way):
            origin, axis = joint.find('origin'), joint.find('axis')
            at = {} if origin is None else origin.attrib
            roll, pitch, yaw = np.diag(np.array(at.get('rpy', '0 0 0').split(), float))
            R = rotation(yaw) @ rotation(pitch) @ rotation(roll)
            T = pose(R, np.array(at.get('xyz', '0 0 0').split(), float))
            self.origins[-1] = self.origins[-1] @ T
            if joint.get('type') != 'fixed':
                given = '1 0 0' if axis is None else axis.attrib['xyz']
                direction = np.array(given.split(), float)
                self.axes.append(direction / np.linalg.norm(direction))
                self.slides.append(joint.get('type') == 'prismatic')
                self.origins.append(np.eye(4))

    def moved(self, j: int, value: float) -> np.ndarray:
        """Return the motion of joint j."""
        along = value * self.axes[j]
        return pose(np.eye(3), along) if self.slides[j] else pose(rotation(along), np.zeros(3))

    def gravity(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return gravity's torques (k,), its moment on the base (3,) and on each link (k, 3).

        Of the nominal arm at reported angles and offsets. A torque is that of gravity about the
        axis, not that of the motor against it; of a joint that slides the force along it.
        """
        frames, frame, g = [], np.eye(4), np.array(self.data['gravity_m_s2'])
        for j, value in enumerate(q + self.offsets):
            frame = frame @ self.origins[j] @ self.moved(j, value)
            frames.append(frame)
        mass = [part['mass_kg'] for part in self.data['masses']]
        center = [
            (T @ [*part['center_m'], 1.0])[:3]
            for T, part in zip(frames, self.data['masses'], strict=True)
        ]
        torque, moments = [], []
        for j, T in enumerate(frames):
            beyond = range(j, len(frames))
            moment = sum(np.cross(center[i] - T[:3, 3], mass[i] * g) for i in beyond)
            force = sum(mass[i] for i in beyond) * g
            torque.append((T[:3, :3] @ self.axes[j]) @ (force if self.slides[j] else moment))
            moments.append(moment)
        on_base = sum(np.cross(c, m * g) for c, m in zip(center, mass, strict=True))
        return np.array(torque), np.asarray(on_base), np.array(moments)

    @property
    def offsets(self) -> np.ndarray:
        """Zero-offsets, rad or m, (k,)."""
        joints = self.data['joints']
        return np.array([one['offset_m' if 'offset_m' in one else 'offset_rad'] for one in joints])

    def value(self, term: dict[str, Any], q: np.ndarray, torque: Any, warm: float) -> np.ndarray:
        """Return what a term adds for each of its coefficients if that is 1."""
        of, driver = term.get('driver_joint'), term['driver']
        j = self.names.index(of) if of else -1
        x = {'angle': q[j], 'gravity_torque': torque[j], 'temperature': warm, 'none': 0.0}[driver]
        form, order = term['form'], term.get('order', 0)
        if form == 'bspline':
            start = term.get('turn_start_rad')
            x = x if start is None else start + (x - start) % (2.0 * np.pi)
            keys = ('knots_rad', 'knots_m', 'knots')
            return splines(x, next(term[key] for key in keys if key in term), term['degree'])
        simple = {'constant': 1.0, 'linear': x, 'quadratic': x**2}
        waves = {'sin': np.sin(order * x), 'cos': np.cos(order * x)}
        return np.array([{**simple, **waves}[form]])

    def tool(self, q: Any, temperature_c: float | None = None) -> np.ndarray:
        """Return where the arm has its tool in the base frame at reported angles, (4, 4)."""
        data, q = self.data, np.asarray(q, dtype=float)
        torque, on_base, moments = self.gravity(q)
        heat = data.get('temperature')
        given = heat and (heat['measured_at_c'] if temperature_c is None else temperature_c)
        warm = given - heat['reference_c'] if heat else 0.0
        shifts = {name: np.zeros(6) for name in (*self.names, 'tool')}
        for times, part in ((1.0, data['geometry']), (warm, heat or {'origins': []})):
            for one in part['origins']:
                shifts[one['at']] += times * np.array([*one['shift'], *one['turn']])
        turn = np.zeros(3)
        for term in data.get('base_terms', []):
            is_moment = term['driver'] == 'gravity_moment'
            unit = on_base if is_moment else self.value(term, q, torque, warm)
            turn += unit * np.array(term['coefficients'])
        frame = pose(rotation(turn), np.zeros(3))
        for j, joint in enumerate(data['joints']):
            angle = q[j] + self.offsets[j]
            for term in joint['terms']:
                angle += self.value(term, q, torque, warm) @ term['coefficients']
            frame = frame @ self.origin(j, shifts[self.names[j]]) @ self.moved(j, angle)
            soft = data['masses'][j].get('lateral_compliance', 0.0)
            axis = frame[:3, :3] @ self.axes[j]
            across = moments[j] - (moments[j] @ axis) * axis
            frame[:3, :3] = rotation(soft * across) @ frame[:3, :3]
        return frame @ self.origin(len(self.names), shifts['tool'])

    def origin(self, j: int, shift: np.ndarray) -> np.ndarray:
        """Return the origin of a joint, or of the tool, that is shifted and turned."""
        T = self.origins[j]
        return pose(T[:3, :3] @ rotation(shift[3:]), T[:3, 3] + shift[:3])

    def nominal(self, q: Any) -> np.ndarray:
        """Return where the nominal robot has its tool."""
        frame = np.eye(4)
        for j, angle in enumerate(q):
            frame = frame @ self.origins[j] @ self.moved(j, angle)
        return frame @ self.origins[-1]

    def seen(self, q: Any, sensor: str, marker: str, T: float | None = None) -> np.ndarray:
        """Return where a sensor sees a marker at reported angles, in the sensor's frame, (3,)."""
        frame, place = self.data['base_frame'][sensor], self.data['tool'][marker]['position_m']
        point = (self.tool(q, T) @ [*place, 1.0])[:3]
        return quaternion(frame['rotation_xyzw']).T @ (point - frame['translation_m'])


def command(arm: Arm, wanted: Any, most: float = np.radians(2.0)) -> np.ndarray:
    """Return what to command so that the tool is where the nominal robot has it at wanted angles.

    By Newton steps, each joint changed by ``most`` at the most: away from singularities it is what
    remaster commands, near them what it commands is a better point of that bound.
    """
    wanted = np.asarray(wanted, dtype=float)
    target, change = arm.nominal(wanted), np.zeros(len(wanted))

    def error(change: np.ndarray) -> np.ndarray:
        reached = arm.tool(wanted + change)
        R = reached[:3, :3] @ target[:3, :3].T
        turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        return np.concatenate((reached[:3, 3] - target[:3, 3], turn))

    for _ in range(10):
        J = slope(error, change, 1e-6)
        change = np.clip(np.linalg.pinv(J, 1e-4) @ (J @ change - error(change)), -most, most)
    return wanted + change


def slope(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float) -> np.ndarray:
    """Return the Jacobian of a function by central differences."""
    steps = step * np.eye(len(x))
    return np.stack([(function(x + s) - function(x - s)) / (2 * step) for s in steps], axis=1)


if __name__ == '__main__':
    with open(sys.argv[1], encoding='utf-8') as file:
        found = Arm(json.load(file))
    angles = np.array(sys.argv[2:], dtype=float)
    print('tool at these reported angles:', found.tool(angles)[:3, 3])
    print('to command for it as wanted:', command(found, angles))
