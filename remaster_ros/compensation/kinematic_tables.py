"""An arm's constant geometry as tables: Denavit-Hartenberg, Hayati, and products of exponentials.

With q the reported angles of k joints::

    DH:   tool = base · S_1(q_1) · … · S_{k-1}(q_{k-1}) · Rz(q_k + theta_k) · end
          S = Rz(q + theta) · Tz(d) · Tx(a) · Rx(alpha)                   dh
          S = Rz(q + theta) · Tx(a) · Rx(alpha) · Ry(beta)                hayati
    POE:  tool = exp([s_1] q_1) · … · exp([s_k] q_k) · home,  s = (w, v), in the base frame

A step between joints whose nominal axes are parallel is Hayati's, since ``d`` has no bounds there.
Base and end are x y z in m and roll pitch yaw in rad, Rz(yaw) · Ry(pitch) · Rx(roll).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.export import rpy_of
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    rotation_vector_to_matrix,
    transform,
    with_z_along,
)
from remaster_ros.types import FloatArray

# Errors of d are those of the axes' places divided by the sine of the angle between them.
PARALLEL_RAD = 0.1
X, Y, Z = np.eye(3)
TURNS = ('theta', 'alpha', 'beta', 'roll', 'pitch', 'yaw')


@dataclass(frozen=True)
class Row:
    """One number of a table."""

    table: str  # ``dh``, ``hayati`` or ``poe``
    part: str  # A joint, ``base``, ``end`` or ``home``
    # Its name and unit
    parameter: str
    unit: str
    # Of the nominal robot, and what is to be added
    nominal: float
    delta: float


def tables(model: ArmModel) -> list[Row]:
    """Return the numbers of all tables of an arm without terms."""
    names = model.chain.joint_names
    nominal = ArmModel.nominal(model.chain)
    before, after = _Axes(nominal), _Axes(model)
    parallel = np.linalg.norm(np.cross(before.along[:-1], before.along[1:]), axis=1) < np.sin(
        PARALLEL_RAD
    )
    rows = []
    for (table, part, values), (_, _, found) in zip(
        [*_dh(before, parallel, names), *_poe(before, names)],
        [*_dh(after, parallel, names), *_poe(after, names)],
        strict=True,
    ):
        for parameter, value in values.items():
            turn = parameter in TURNS
            delta = found[parameter] - value
            if turn:
                delta = float(np.angle(np.exp(1j * delta)))
            unit = 'rad' if turn else '' if parameter.startswith('w') else 'm'
            rows.append(Row(table, part, parameter, unit, value, delta))
    return rows


class _Axes:
    """Lines of the joints' axes in R at reported zero, and what stands at both ends."""

    def __init__(self, model: ArmModel) -> None:
        state = model.state(np.zeros((1, model.joints)))
        before = state.before[0]
        self.along = np.einsum('kij,kj->ki', before[:, :3, :3], model.chain.axes)
        self.points = before[:, :3, 3]
        first = with_z_along(model.chain.axes[0])
        self.base = transform(before[0, :3, :3] @ first, before[0, :3, 3])
        self.tool = state.tool[0]
        self.last_turn = float(model.joint_offsets[-1])


def _dh(
    axes: _Axes, parallel: Sequence[bool], names: Sequence[str]
) -> list[tuple[str, str, dict[str, float]]]:
    frame = axes.base
    rows = [('dh', 'base', _placed(frame))]
    for i, name in enumerate(names[:-1]):
        x, y, z = frame[:3, :3].T @ axes.along[i + 1]
        origin = apply(inverse(frame), axes.points[i + 1])
        if parallel[i]:
            met = origin - origin[2] / z * np.array([x, y, z])
            a, theta = float(np.hypot(met[0], met[1])), float(np.arctan2(met[1], met[0]))
            across = rotation_vector_to_matrix(-theta * Z) @ (x, y, z)
            alpha, beta = np.arctan2(-across[1], across[2]), np.arcsin(across[0])
            step = transform(np.eye(3), a * X)
            step[:3, :3] = rotation_vector_to_matrix(alpha * X) @ rotation_vector_to_matrix(
                beta * Y
            )
            values = {'theta': theta, 'a': a, 'alpha': float(alpha), 'beta': float(beta)}
        else:
            # The common normal is that of z and the next axis, whichever way they pass.
            sine = np.hypot(x, y)
            normal = np.array([-y, x, 0.0]) / sine
            t = float(origin @ np.cross(Z, normal)) / sine
            a, d = float(origin @ normal), float(origin[2] + t * z)
            theta, alpha = float(np.arctan2(x, -y)), float(np.arctan2(sine, z))
            step = transform(rotation_vector_to_matrix(alpha * X), (a, 0.0, d))
            values = {'theta': theta, 'd': d, 'a': a, 'alpha': alpha}
        rows.append(('hayati' if parallel[i] else 'dh', name, values))
        frame = frame @ transform(rotation_vector_to_matrix(theta * Z), np.zeros(3)) @ step
    turned = frame @ transform(rotation_vector_to_matrix(axes.last_turn * Z), np.zeros(3))
    rows.append(('dh', names[-1], {'theta': axes.last_turn}))
    return [*rows, ('dh', 'end', _placed(inverse(turned) @ axes.tool))]


def _poe(axes: _Axes, names: Sequence[str]) -> list[tuple[str, str, dict[str, float]]]:
    rows = []
    for name, w, point in zip(names, axes.along, axes.points, strict=True):
        screw = [*w.tolist(), *np.cross(point, w).tolist()]
        keys = ('wx', 'wy', 'wz', 'vx', 'vy', 'vz')
        rows.append(('poe', name, dict(zip(keys, screw, strict=True))))
    return [*rows, ('poe', 'home', _placed(axes.tool))]


def _placed(T: FloatArray) -> dict[str, float]:
    values = (*T[:3, 3].tolist(), *rpy_of(T[:3, :3]))
    return dict(zip(('x', 'y', 'z', 'roll', 'pitch', 'yaw'), values, strict=True))
