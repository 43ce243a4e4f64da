# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms SE(3) on arrays: any number of leading dimensions, which broadcast.

``T_a_b`` maps coordinates of frame b to frame a: ``p_a = apply(T_a_b, p_b)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from remaster_ros.errors import InputError
from remaster_ros.types import FloatArray


def transform(rotation: ArrayLike, translation: ArrayLike) -> FloatArray:
    """Assemble homogeneous transforms (..., 4, 4).

    ``rotation``: matrices, (..., 3, 3); ``translation``: m, (..., 3).
    """
    rotation = np.asarray(rotation, dtype=float)
    translation = np.asarray(translation, dtype=float)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def inverse(T: ArrayLike) -> FloatArray:
    """Invert rigid transforms (..., 4, 4): T_a_b becomes T_b_a."""
    T = np.asarray(T, dtype=float)
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(rotation, -(rotation @ T[..., :3, 3:])[..., 0])


def apply(T: ArrayLike, points: ArrayLike) -> FloatArray:
    """Map points (..., 3) from frame b to frame a by T_a_b (..., 4, 4)."""
    T = np.asarray(T, dtype=float)
    points = np.asarray(points, dtype=float)
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def rotation_vector_to_matrix(rotation_vector: ArrayLike) -> FloatArray:
    """Convert rotation vectors (axis times angle, rad), (..., 3), to matrices (..., 3, 3)."""
    vectors = np.asarray(rotation_vector, dtype=float)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.reshape(matrices, (*vectors.shape, 3))


def matrix_to_rotation_vector(rotation: ArrayLike) -> FloatArray:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3) of angle 0 to pi, rad."""
    matrices = np.asarray(rotation, dtype=float)
    vectors = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec()
    return np.reshape(vectors, matrices.shape[:-1])


def quaternion_xyzw(rotation: ArrayLike) -> FloatArray:
    """Convert a rotation matrix (3, 3) to its unit quaternion x, y, z, w (4,) with w >= 0."""
    # q and -q are the same rotation; one sign makes files and messages comparable.
    return np.asarray(Rotation.from_matrix(np.asarray(rotation)).as_quat(canonical=True))


def matrix_from_quaternion_xyzw(quaternion: ArrayLike) -> FloatArray:
    """Convert a quaternion x, y, z, w (4,) of any length but zero to a matrix (3, 3).

    Raises ValueError if its length is zero or not finite.
    """
    quaternion = np.asarray(quaternion, dtype=float)
    if not 0.0 < np.linalg.norm(quaternion) < np.inf:
        raise ValueError(f'the quaternion {quaternion} is no rotation; give one of length 1')
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def mean_quaternion_xyzw(quaternions: ArrayLike) -> FloatArray:
    """Return the mean rotation of unit quaternions x, y, z, w (n, 4) as a quaternion, (4,).

    It minimises the sum of squared chordal distances, whatever the quaternions' signs: the
    eigenvector of the largest eigenvalue of the sum of their outer products (Markley et al.,
    "Averaging quaternions", J. Guidance 30, 2007).
    """
    values = np.asarray(quaternions, dtype=float)
    vector = np.linalg.eigh(values.T @ values)[1][:, -1]
    return np.asarray(Rotation.from_quat(vector).as_quat(canonical=True))


def inverse_poses(position: ArrayLike, xyzw: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the positions, m, (n, 3), and quaternions x, y, z, w, (n, 4), of frame a in b.

    ``position``, ``xyzw``: those of frame b in a; also one alone, (3,) and (4,).
    """
    back = Rotation.from_quat(np.asarray(xyzw, dtype=float)).inv()
    return np.asarray(-back.apply(np.asarray(position, dtype=float))), np.asarray(back.as_quat())


def matrix_from_rpy(rpy: ArrayLike) -> FloatArray:
    """Convert roll, pitch, yaw (3,), rad, to URDF's matrix Rz(yaw) Ry(pitch) Rx(roll), (3, 3)."""
    return np.asarray(Rotation.from_euler('xyz', rpy).as_matrix())


def with_z_along(direction: ArrayLike) -> FloatArray:
    """Return a rotation (3, 3) whose z axis lies along a direction (3,) of any length but zero.

    Its x axis is across, and otherwise arbitrary; the same for the same direction.
    """
    z = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def looking_at(position: ArrayLike, target: ArrayLike, roll_rad: float = 0.0) -> FloatArray:
    """Return the rotation (3, 3) of a sensor whose z axis points from its position to a target.

    ``position``, ``target``: m, (3,); ``roll_rad``: rotation about its z axis; at 0 its x axis is
    level. Raises InputError if position and target coincide.
    """
    position, target = np.asarray(position, dtype=float), np.asarray(target, dtype=float)
    x, y, z = line = target - position
    if not np.linalg.norm(line) > 0.0:
        raise InputError(f'a sensor at {position} m cannot look at {target} m: give another place')
    # Euler angles about Z, the level x axis and z; looking straight up or down any azimuth does.
    level = np.hypot(x, y)
    azimuth = np.arctan2(x, -y) if level > 1e-9 * abs(z) else 0.0
    angles = azimuth, np.arctan2(level, z), roll_rad
    return np.asarray(Rotation.from_euler('ZXZ', angles).as_matrix())
