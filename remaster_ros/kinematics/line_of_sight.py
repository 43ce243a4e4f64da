# SPDX-License-Identifier: Apache-2.0
"""Occlusion of a marker by the arm itself, with a capsule around each link.

A link is the set of points within ``radius`` of the segment from its joint to the next one, which
any URDF defines; meshes are not needed. Collisions are checked in `collision`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import BoolArray, FloatArray


@dataclass(frozen=True)
class LinkCapsules:
    """The links of an arm as capsules, each from the origin of a joint to that of the next one.

    The first capsule begins at the base frame. The link after the last joint carries the marker
    and is left out: whether it hides the marker is decided by the marker's viewing angle.
    """

    chain: SerialChain
    # Radius of the links, m. 75 mm encloses the links of arms of the LWR's and iiwa's size about
    # as their collision models do (70 mm in CentroEPiaggio's).
    radius: float = 0.075

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < np.inf:
            raise InputError(
                f'line of sight: the link radius is {self.radius} m; it must be positive'
            )

    def hides(self, q: ArrayLike, marker_T: ArrayLike, sensor_R: ArrayLike) -> BoolArray:
        """Return whether a link stands between a marker and a sensor, (...).

        ``q``: joint angles, rad, (..., k); ``marker_T``: marker in the tool frame, m, (3,);
        ``sensor_R``: the sensor's origin in R, m, (3,).
        """
        ends = self.chain.frames(q)[..., :3, 3]
        starts = np.zeros_like(ends)
        starts[..., 1:, :] = ends[..., :-1, :]
        marker = self.chain.positions(q, marker_T)[..., None, :]
        distances = segment_distance(starts, ends, marker, sensor_R)
        return np.any(distances < self.radius, axis=-1)


def segment_distance(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike) -> FloatArray:
    """Return the shortest distances between segments a–b and c–d, (...); either may be a point.

    ``a, b, c, d``: end points, (..., 3), broadcast against each other.
    """
    a, b, c, d = (np.asarray(point, dtype=float) for point in (a, b, c, d))
    along_1, along_2, gap = b - a, d - c, a - c
    length_1, length_2 = _dot(along_1, along_1), _dot(along_2, along_2)
    across, gap_1, gap_2 = _dot(along_1, along_2), _dot(along_1, gap), _dot(along_2, gap)
    # Nearest points of the two lines, as shares s and t of the segments (of parallel lines any
    # does); t and s are computed again after the other was clipped to its segment.
    s = _share(across * gap_2 - gap_1 * length_2, length_1 * length_2 - across**2)
    t = _share(across * s + gap_2, length_2)
    s = _share(across * t - gap_1, length_1)
    nearest = gap + s[..., None] * along_1 - t[..., None] * along_2
    return np.linalg.norm(nearest, axis=-1)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the dot product along the last axis."""
    return np.sum(a * b, axis=-1)


def _share(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Return numerator / denominator clipped to [0, 1]; 0 if the denominator is 1e-15 or less."""
    safe = np.where(denominator > 1e-15, denominator, 1.0)
    return np.clip(np.where(denominator > 1e-15, numerator / safe, 0.0), 0.0, 1.0)
