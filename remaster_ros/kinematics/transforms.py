"""Rigid transforms SE(3) on arrays: any number of leading dimensions, which broadcast.

``T_a_b`` maps coordinates of frame b to frame a: ``p_a = apply(T_a_b, p_b)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError
from remaster_ros.types import FloatArray

# SciPy has rotations too; importing them takes longer than a fit.


def transform(rotation: ArrayLike, translation: ArrayLike) -> FloatArray:
    """Assemble homogeneous transforms.

    Parameters
    ----------
    rotation
        Rotation matrices, (..., 3, 3).
    translation
        Translations, m, (..., 3).

    Returns
    -------
    ndarray
        (..., 4, 4).
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
    """Turn rotation vectors (axis times angle, rad), (..., 3), into matrices (..., 3, 3)."""
    vectors = np.asarray(rotation_vector, dtype=float)
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    # Rodrigues: I + sin(a) / a K + (1 - cos(a)) / a² K², K the vector's cross-product matrix.
    K = np.zeros((*vectors.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -z, y, -x
    K -= np.swapaxes(K, -1, -2)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + first * K + second * (K @ K)


def matrix_to_rotation_vector(rotation: ArrayLike) -> FloatArray:
    """Turn rotation matrices (..., 3, 3) into rotation vectors (..., 3) of angle 0 to pi, rad."""
    quaternion = quaternion_xyzw(rotation)
    sine = np.linalg.norm(quaternion[..., :3], axis=-1, keepdims=True)
    half = np.arctan2(sine, quaternion[..., 3:])
    # Without any turn 2 sin(half) = angle.
    safe = np.where(sine > 0.0, sine, 1.0)
    return quaternion[..., :3] * np.where(sine > 0.0, 2.0 * half / safe, 2.0)


def quaternion_xyzw(rotation: ArrayLike) -> FloatArray:
    """Turn rotation matrices (..., 3, 3) into unit quaternions x, y, z, w (..., 4) with w >= 0."""
    R = np.asarray(rotation, dtype=float)
    trace = np.trace(R, axis1=-2, axis2=-1)
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    # The outer product of the quaternion with itself, times 4: any of its rows will do, the one
    # of the largest component loses nothing.
    product = np.empty((*R.shape[:-2], 4, 4))
    product[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    product[..., range(3), range(3)] = 1.0 + 2.0 * diagonal - trace[..., None]
    product[..., 3, 3] = 1.0 + trace
    for i, j, k in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
        product[..., i, 3] = product[..., 3, i] = R[..., j, k] - R[..., k, j]
    largest = np.argmax(np.diagonal(product, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(product, largest[..., None, None], axis=-2)[..., 0, :]
    # q and -q are the same rotation; one sign makes files and messages comparable.
    sign = np.where(quaternion[..., 3:] < 0.0, -1.0, 1.0)
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.asarray(sign * quaternion / length, dtype=float)


def matrix_from_quaternion_xyzw(quaternion: ArrayLike) -> FloatArray:
    """Turn quaternions x, y, z, w (..., 4) of any length but zero into matrices (..., 3, 3)."""
    quaternions = np.asarray(quaternion, dtype=float)
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not np.all(length > 0.0):
        raise ValueError('a quaternion of length zero is no rotation')
    x, y, z, w = np.moveaxis(quaternions / length, -1, 0)
    return np.stack(
        (
            np.stack((1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)), axis=-1),
            np.stack((2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)), axis=-1),
            np.stack((2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)), axis=-1),
        ),
        axis=-2,
    )


def matrix_from_rpy(rpy: ArrayLike) -> FloatArray:
    """Turn roll, pitch, yaw (..., 3) in rad, URDF's Rz(yaw) Ry(pitch) Rx(roll), into matrices."""
    angles = np.asarray(rpy, dtype=float)
    roll, pitch, yaw = (
        rotation_vector_to_matrix(angles[..., axis, None] * np.eye(3)[axis]) for axis in range(3)
    )
    return yaw @ pitch @ roll


def looking_at(position: ArrayLike, target: ArrayLike, roll_rad: float = 0.0) -> FloatArray:
    """Return the rotation of a sensor at one point that looks at another along its z axis.

    Parameters
    ----------
    position, target
        Where it stands and what it looks at, m, (3,).
    roll_rad
        Turn about its z axis; without one its x axis is level.

    Returns
    -------
    ndarray
        (3, 3).

    Raises
    ------
    InputError
        The two are one point.
    """
    position, target = np.asarray(position, dtype=float), np.asarray(target, dtype=float)
    line = target - position
    distance = np.linalg.norm(line)
    if not distance > 0.0:
        raise InputError(f'a sensor at {position} m cannot look at {target} m: give another place')
    z = line / distance
    x = np.cross((0.0, 0.0, 1.0), z)
    # Straight up or down every x axis is level.
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-9 else np.array((1.0, 0.0, 0.0))
    aimed = np.column_stack((x, np.cross(z, x), z))
    return aimed @ rotation_vector_to_matrix((0.0, 0.0, roll_rad))


def rotation_angle(rotation: ArrayLike) -> FloatArray:
    """Return the angle of rotation matrices (..., 3, 3), rad, (...): exact near zero too.

    From the antisymmetric part (sine) and the trace (cosine): the arc cosine alone would lose
    angles below 1e-8 rad.
    """
    R = np.asarray(rotation, dtype=float)
    sine_axis = np.stack(
        (
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ),
        axis=-1,
    )
    cosine = np.trace(R, axis1=-2, axis2=-1) - 1.0
    return np.arctan2(np.linalg.norm(sine_axis, axis=-1), cosine)


def twist_logarithm(T: ArrayLike) -> FloatArray:
    """Return the screw motions that make transforms: the SE(3) logarithm.

    Turning by a twist's rotation while shifting by its translation, steadily, from identity,
    arrives at T. A turn about any line gives a twist along that line's screw, however large.

    Parameters
    ----------
    T
        Rigid transforms of angles below pi, (..., 4, 4).

    Returns
    -------
    ndarray
        Translation part, m, then rotation vector, rad, (..., 6).
    """
    T = np.asarray(T, dtype=float)
    rotation = matrix_to_rotation_vector(T[..., :3, :3])
    translation = T[..., :3, 3]
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    near = angle < 1e-4
    half = np.where(near, 1.0, angle) / 2
    # (1 - x cot x) / (2 x)^2 with x half the angle; its series is 1/12 + x^2/180.
    weight = np.where(near, 1 / 12, (1 - half / np.tan(half)) / (4 * half**2))
    turned = np.cross(rotation, translation)
    linear = translation - turned / 2 + weight * np.cross(rotation, turned)
    return np.concatenate((linear, rotation), axis=-1)
