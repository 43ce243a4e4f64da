"""Does the arm hit itself or the floor, or hide a marker? Capsules around the links answer.

A link is the set of points within ``radius`` of the straight line from its joint to the next one,
which any URDF gives; meshes are not needed. That is a plan's first filter, not a safety device:
the operator still watches the first run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InputError
from remaster_ros.core.types import BoolArray, FloatArray

# Joints from the third on move their origin up and down; what carries them cannot reach the floor.
FIRST_MOVING_POINT = 3


@dataclass(frozen=True)
class ArmCapsules:
    """The arm as capsules: segment i runs from the origin of joint i to that of joint i + 1.

    Segment 0 starts at the base frame, the last one ends at the tool frame.

    Attributes
    ----------
    chain
        The arm.
    radius
        Radius of the links, m. 75 mm encloses the links of arms of the LWR's and iiwa's size
        about as their collision models do (70 mm in CentroEPiaggio's).
    floor_z
        Height of the floor in R, m; None where there is none to hit (an arm that hangs).
    """

    chain: SerialChain
    radius: float = 0.075
    floor_z: float | None = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < np.inf:
            raise InputError(f'collision: the link radius is {self.radius} m; it must be positive')

    def points(self, q: ArrayLike) -> FloatArray:
        """Return the ends of the segments in R for q (..., k): m, (..., k + 2, 3)."""
        frames = self.chain.frames(q)
        tip = frames[..., -1, :, :] @ self.chain.T_fixed[-1]
        points = np.zeros((*frames.shape[:-3], len(self.chain) + 2, 3))
        points[..., 1:-1, :] = frames[..., :3, 3]
        points[..., -1, :] = tip[..., :3, 3]
        return points

    def self_collision(self, q: ArrayLike) -> BoolArray:
        """Tell whether links touch that a joint does not let touch anyway, (...) for q (..., k).

        Neighbours share a joint; links with little more than a joint between them (less than two
        radii of arm) overlap as capsules in every position. Both are left out: their joints'
        limits keep them apart.
        """
        points = self.points(q)
        lengths = np.linalg.norm(np.diff(self.points(np.zeros(len(self.chain))), axis=0), axis=1)
        starts = np.concatenate(([0.0], np.cumsum(lengths)))
        first, second = np.triu_indices(len(lengths), k=2)
        apart = starts[second] - starts[first + 1] >= 2 * self.radius
        first, second = first[apart], second[apart]
        distances = segment_distance(
            points[..., first, :],
            points[..., first + 1, :],
            points[..., second, :],
            points[..., second + 1, :],
        )
        return np.any(distances < 2 * self.radius, axis=-1)

    def hits_floor(self, q: ArrayLike) -> BoolArray:
        """Tell whether a link reaches below the floor, (...) for q (..., k)."""
        heights = self.points(q)[..., FIRST_MOVING_POINT:, 2]
        if self.floor_z is None:
            return np.zeros(heights.shape[:-1], dtype=bool)
        return np.any(heights < self.floor_z + self.radius, axis=-1)

    def hides(self, q: ArrayLike, marker_T: ArrayLike, sensor_R: ArrayLike) -> BoolArray:
        """Tell whether a link stands between a marker and a sensor.

        The last segment carries the marker and is left out: which way the marker faces decides
        there.

        Parameters
        ----------
        q
            Joint angles, rad, (..., k).
        marker_T
            Marker in the tool frame, m, (3,).
        sensor_R
            The sensor's origin in R, m, (3,).

        Returns
        -------
        ndarray
            (...).
        """
        points = self.points(q)[..., :-1, :]
        marker = self.chain.positions(q, marker_T)[..., None, :]
        distances = segment_distance(
            points[..., :-1, :], points[..., 1:, :], marker, np.asarray(sensor_R, dtype=float)
        )
        return np.any(distances < self.radius, axis=-1)


def segment_distance(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike) -> FloatArray:
    """Return the shortest distances between segments a–b and c–d, points among them.

    Parameters
    ----------
    a, b, c, d
        End points, (..., 3), broadcast against each other.

    Returns
    -------
    ndarray
        (...).
    """
    a, b, c, d = (np.asarray(point, dtype=float) for point in (a, b, c, d))
    along_1, along_2, gap = b - a, d - c, a - c
    length_1, length_2 = _dot(along_1, along_1), _dot(along_2, along_2)
    across, gap_1, gap_2 = _dot(along_1, along_2), _dot(along_1, gap), _dot(along_2, gap)
    # The nearest points of the two lines, as shares s and t of the segments (parallel lines have
    # many: any does), then t and s again where the other was cut off at an end.
    s = _share(across * gap_2 - gap_1 * length_2, length_1 * length_2 - across**2)
    t = _share(across * s + gap_2, length_2)
    s = _share(across * t - gap_1, length_1)
    nearest = gap + s[..., None] * along_1 - t[..., None] * along_2
    return np.linalg.norm(nearest, axis=-1)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.sum(a * b, axis=-1)


def _share(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Divide and cut to [0, 1]; 0 where there is nothing to divide by."""
    safe = np.where(denominator > 1e-15, denominator, 1.0)
    return np.clip(np.where(denominator > 1e-15, numerator / safe, 0.0), 0.0, 1.0)
