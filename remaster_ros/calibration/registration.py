# SPDX-License-Identifier: Apache-2.0
"""Registration of two frames by points known in both: three points, or more by least squares."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.kinematics.transforms import apply, transform
from remaster_ros.types import FloatArray

MINIMUM_POINTS = 3
# Smallest ratio of the points' spread across their best line to that along it; below it they do
# not determine the rotation about the line.
MINIMUM_WIDTH = 0.02
# Largest number of points of which every three are tried for agreement.
TRIED_POINTS = 20


def register_points(points_R: ArrayLike, points_N: ArrayLike) -> tuple[FloatArray, float]:
    """Pose of a sensor in the robot base, from points known in both frames.

    Minimises the sum of squared distances |T_R_N p_N − p_R|² (Arun, Huang and Blostein 1987, by
    singular values, never a reflection).

    Parameters
    ----------
    points_R
        Points in the robot base R, m, (n, 3), n >= 3, not on one line.
    points_N
        The same points in the sensor frame N, m, (n, 3).

    Returns
    -------
    T_R_N : ndarray
        The sensor frame in R, (4, 4).
    rms : float
        Root mean square of the distances that remain, m.

    Raises
    ------
    InputError
        If the arrays have other shapes, or numbers that are not finite.
    InsufficientDataError
        If there are fewer than three points, or the points are (nearly) on one line.
    """
    points_R, points_N = np.asarray(points_R, dtype=float), np.asarray(points_N, dtype=float)
    if points_R.ndim != 2 or points_R.shape[1:] != (3,) or points_R.shape != points_N.shape:
        raise InputError(
            f'registration: {points_R.shape} points of the robot and {points_N.shape} of the '
            'sensor; both must be (n, 3)'
        )
    if not (np.all(np.isfinite(points_R)) and np.all(np.isfinite(points_N))):
        raise InputError('registration: a point has a coordinate that is not a finite number')
    if len(points_R) < MINIMUM_POINTS:
        raise InsufficientDataError(
            f'registration: {len(points_R)} {"point does" if len(points_R) == 1 else "points do"} '
            'not fix a frame; measure at least '
            f'{MINIMUM_POINTS} that are not on one line'
        )
    _require_width(points_R, 'robot')
    _require_width(points_N, 'sensor')

    center_R, center_N = points_R.mean(axis=0), points_N.mean(axis=0)
    left, _, right = np.linalg.svd((points_R - center_R).T @ (points_N - center_N))
    handed = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    rotation = left @ handed @ right
    T_R_N = transform(rotation, center_R - rotation @ center_N)
    distances = np.linalg.norm(apply(T_R_N, points_N) - points_R, axis=1)
    return T_R_N, float(np.sqrt(np.mean(distances**2)))


def register_ransac(
    points_R: ArrayLike, points_N: ArrayLike, allowed_m: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Registration by the points that agree, without single points that are not of the marker.

    A frame is computed from every three of the first 20 points (`TRIED_POINTS`); the frame with
    most agreeing points is refined by all of these.

    Parameters
    ----------
    points_R, points_N
        As of `register_points`.
    allowed_m
        Largest distance of an agreeing point from its position by the other points, m.

    Returns
    -------
    T_R_N : ndarray
        The sensor frame in R, (4, 4).
    agree : ndarray of bool
        Whether each point was used, (n,).

    Raises
    ------
    InputError, InsufficientDataError
        As `register_points`; and if no three points, or no majority of the points, agree.
    """
    points_R, points_N = np.asarray(points_R, dtype=float), np.asarray(points_N, dtype=float)
    # Raises where the shapes are wrong or all of the points lie on a line.
    register_points(points_R, points_N)
    best, best_key, closest = np.zeros(len(points_R), bool), (0, 0.0), np.inf
    for triple in combinations(range(min(len(points_R), TRIED_POINTS)), MINIMUM_POINTS):
        three = list(triple)
        try:
            T_R_N, rms = register_points(points_R[three], points_N[three])
        except InsufficientDataError:
            continue
        off = np.linalg.norm(apply(T_R_N, points_N) - points_R, axis=1)
        closest = min(closest, float(off[three].max()))
        agree = off <= allowed_m
        key = (int(agree.sum()), -rms)
        if agree[three].all() and key > best_key:
            best, best_key = agree, key
    if 2 * best_key[0] <= len(points_R):
        raise InsufficientDataError(
            f'registration: of {len(points_R)} points too few agree with the robot (the best '
            f'three are {1e3 * closest:.0f} mm off, allowed {1e3 * allowed_m:.0f} mm): a stray '
            'taken for the marker, or a marker that the cell has elsewhere; measure more'
        )
    return register_points(points_R[best], points_N[best])[0], best


def _require_width(points: FloatArray, frame_name: str) -> None:
    """Raise InsufficientDataError if points (n, 3) are on one line or in one place.

    That is a spread across their best line of at most 2 % of that along it (`MINIMUM_WIDTH`).
    """
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    length, width = spread[:2]
    if not width > MINIMUM_WIDTH * length:
        raise InsufficientDataError(
            f"registration: the {frame_name}'s {len(points)} points lie on a line (spread "
            f'{length * 1e3:.1f} mm along it, {width * 1e3:.2f} mm across); move one of them '
            'well off the line and measure again'
        )
