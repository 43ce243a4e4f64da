# SPDX-License-Identifier: Apache-2.0
"""Convex bodies for collision checks: boxes, cylinders, spheres, capsules and hulls of points.

Each shape is centred near the origin of its frame. A body is a shape fixed to one link of the arm,
or to the base. Meshes are read in `session.meshes` and come here as arrays of points.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import apply, transform
from remaster_ros.types import FloatArray, IntArray

# Sides of the prism that encloses a cylinder; with 32 it is 0.5 % of the radius wider.
_SIDES = 32
# Most points of an outline; more are replaced by the corners of their bounding box.
_MOST_POINTS = 60
# Corners of a cube of edge length 2 about the origin, (8, 3).
_CUBE = np.array(list(product((-1.0, 1.0), repeat=3)))
_GOLDEN = (1 + 5**0.5) / 2
_RECTANGLE = _CUBE[:4] * (0.0, 1 / _GOLDEN, _GOLDEN)
# Corners of a regular dodecahedron that encloses the unit sphere, (20, 3): those of a cube and of
# three rectangles.
_AROUND_A_BALL = np.concatenate(
    [_CUBE, *(np.roll(_RECTANGLE, turn, axis=1) for turn in range(3))]
) / (3**0.5 * 0.7946544722917661)


@dataclass(frozen=True, eq=False)
class Shape:
    """Convex shape: the hull of `points`, grown by a disc across z and by a ball."""

    kind: str  # ``box``, ``cylinder``, ``sphere``, ``capsule`` or ``hull``
    points: FloatArray  # m, (n, 3)
    disc: float = 0.0  # Radius of the disc across z that is swept over the points (a cylinder), m
    ball: float = 0.0  # Radius of the ball that is swept over the points (sphere, capsule), m

    @cached_property
    def outline(self) -> FloatArray:
        """Points whose hull contains the shape, m, (n, 3)."""
        points = self.points
        if self.disc > 0.0:
            angle = np.arange(_SIDES) * (2 * np.pi / _SIDES)
            radius = self.disc / np.cos(np.pi / _SIDES)
            ring = radius * np.column_stack((np.cos(angle), np.sin(angle), 0 * angle))
            points = (points[:, None] + ring).reshape(-1, 3)
        if self.ball > 0.0:
            points = (points[:, None] + self.ball * _AROUND_A_BALL).reshape(-1, 3)
        return points

    @cached_property
    def capsule(self) -> tuple[FloatArray, FloatArray, float]:
        """Ends (m, (3,) each) and radius (m) of a capsule that encloses the shape, in its frame.

        The ends are those of the capsule's axis, equal for a sphere. Of a box or hull it is the
        capsule of least volume along six axes: x, y, z and the principal axes of the points.
        """
        if self.kind in ('sphere', 'capsule', 'cylinder'):
            return self.points[0], self.points[-1], self.ball + self.disc
        best = (np.zeros(3), np.zeros(3), np.inf, np.inf)
        middle = (self.points.min(axis=0) + self.points.max(axis=0)) / 2
        principal = np.linalg.svd(self.points - self.points.mean(axis=0))[2]
        for axis in (*np.eye(3), *principal):
            along = (self.points - middle) @ axis
            across = self.points - middle - along[:, None] * axis
            # The axis of the capsule goes through the middle of the extent across it.
            centre = middle + (across.min(axis=0) + across.max(axis=0)) / 2
            centre = centre - ((centre - middle) @ axis) * axis
            off = self.points - centre
            wide = np.linalg.norm(off - (off @ axis)[:, None] * axis, axis=1)
            radius = float(wide.max())
            # The round ends cover points near the axis: the segment can be shorter.
            reach = np.sqrt(np.maximum(radius**2 - wide**2, 0.0))
            low, high = float(np.min(along + reach)), float(np.max(along - reach))
            if high < low:
                low = high = (low + high) / 2
            volume = np.pi * radius**2 * (high - low) + 4 / 3 * np.pi * radius**3
            if volume < best[3]:
                best = (centre + low * axis, centre + high * axis, radius, volume)
        # Wider by the rounding error: the points lie on the surface.
        return best[0], best[1], best[2] + 1e-9

    @property
    def is_its_capsule(self) -> bool:
        """Whether `capsule` is the shape itself, not an enclosure of it."""
        return self.kind in ('sphere', 'capsule')


def box(size_m: ArrayLike) -> Shape:
    """Return a box with these edge lengths along x, y, z, m, (3,), centred at the origin.

    Raises InputError, as the other shapes do, if a size is not positive and finite.
    """
    size = _positive('box', size_m, 3)
    return Shape('box', _CUBE * size / 2)


def cylinder(radius_m: float, length_m: float) -> Shape:
    """Return a cylinder along z, centred at the origin.

    Sizes in m. Raises InputError if one is not positive and finite.
    """
    radius, length = _positive('cylinder', (radius_m, length_m), 2)
    return Shape('cylinder', np.array([[0, 0, -length / 2], [0, 0, length / 2]]), disc=radius)


def sphere(radius_m: float) -> Shape:
    """Return a sphere centred at the origin.

    Raises InputError if the radius, m, is not positive and finite.
    """
    (radius,) = _positive('sphere', (radius_m,), 1)
    return Shape('sphere', np.zeros((1, 3)), ball=radius)


def capsule(start: ArrayLike, end: ArrayLike, radius_m: float) -> Shape:
    """Return a capsule: all points within a radius of the segment from start to end, m, (3,).

    Raises InputError if the radius is not positive and finite; start and end may be equal.
    """
    (radius,) = _positive('capsule', (radius_m,), 1)
    return Shape('capsule', np.array([start, end], dtype=float), ball=radius)


def hull(points: ArrayLike) -> Shape:
    """Return the convex hull of points (the vertices of a mesh), m, (n, 3).

    Raises InputError if points are not finite, or all lie in one plane.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (3,) or not np.all(np.isfinite(points)):
        raise InputError(f'collision: a mesh of shape {points.shape}, or not finite; give (n, 3)')
    try:
        corners = points[np.sort(ConvexHull(points).vertices)]
    except (QhullError, ValueError):
        raise InputError(
            f'collision: the {len(points)} points of a mesh all lie in one plane; a body needs '
            'a volume'
        ) from None
    return Shape('hull', corners)


def _positive(kind: str, values: ArrayLike, count: int) -> FloatArray:
    """Return sizes as an array (count,); raise InputError if one is not positive and finite.

    InputError as well for another number of sizes; ``kind``: the shape's name, for it.
    """
    array = np.asarray(values, dtype=float)
    if array.shape != (count,) or not np.all((array > 0.0) & (array < np.inf)):
        raise InputError(
            f'collision: a {kind} with sizes {array.tolist()}; {count} positive m are needed'
        )
    return array


@dataclass(frozen=True, eq=False)
class Body:
    """Convex body for collision checks: a shape fixed to a link of the arm, or to the base."""

    name: str
    link: int  # 0 for the base, i for the link after joint i (1-based)
    shape: Shape
    # Pose of the shape in its link's frame, (4, 4)
    T_link_body: FloatArray = field(default_factory=lambda: np.eye(4))
    role: str = 'link'  # ``link``, ``tool`` (tool and markers) or ``obstacle``

    @cached_property
    def outline(self) -> FloatArray:
        """Points whose hull contains the body, in the frame of its link, m, (n, 3)."""
        return apply(self.T_link_body, self.shape.outline)

    @cached_property
    def capsule(self) -> tuple[FloatArray, FloatArray, float]:
        """Ends (m, (3,) each) and radius (m) of a capsule around the body, in its link's frame."""
        a, b, radius = self.shape.capsule
        return apply(self.T_link_body, a), apply(self.T_link_body, b), radius


def obstacle(
    name: str, center_m: ArrayLike, size_m: ArrayLike, rotation: ArrayLike | None = None
) -> Body:
    """Return a box that stands in the base frame; `rotation` is (3, 3), None for no rotation.

    ``center_m, size_m``: m, (3,). Raises InputError as `box`.
    """
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
    return Body(name, 0, box(size_m), transform(turn, np.asarray(center_m, float)), 'obstacle')


def triangles(points: FloatArray) -> IntArray:
    """Return the outward triangles of the convex hull of points (n, 3), as indices (m, 3).

    Counterclockwise seen from outside. Raises scipy's QhullError if the points lie in one plane.
    """
    convex = ConvexHull(points)
    faces = convex.simplices.astype(np.int64)
    a, b, c = (points[faces[:, i]] for i in range(3))
    inwards = np.sum(np.cross(b - a, c - a) * convex.equations[:, :3], axis=1) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return faces


def enclosing_points(points: FloatArray) -> FloatArray:
    """Return at most `_MOST_POINTS` points whose hull contains the points (n, 3).

    The vertices of their convex hull; the 8 corners of their bounding box if there are more
    vertices than that. Up to 8 points are returned as they are; of points in one plane, all
    count as vertices.
    """
    if len(points) > 8:
        with suppress(QhullError):  # all in one plane: kept as they are
            points = points[np.sort(ConvexHull(points).vertices)]
    if len(points) <= _MOST_POINTS:
        return points
    low, high = points.min(axis=0), points.max(axis=0)
    return low + (_CUBE + 1.0) / 2 * (high - low)
