# SPDX-License-Identifier: Apache-2.0
"""Distances between convex shapes, by coal."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from remaster_ros.kinematics.bodies import Shape, triangles
from remaster_ros.kinematics.transforms import transform, with_z_along
from remaster_ros.types import FloatArray


class ConvexDistances:
    """Distances between shapes fixed to moving frames.

    ``shapes``: each with its pose in its frame, (4, 4).
    """

    def __init__(self, shapes: Sequence[tuple[Shape, FloatArray]]) -> None:
        self._shapes = tuple(shapes)

    @cached_property
    def _coal(self) -> Any:
        """The module coal, or hppfcl (its name before version 3), given coal's names.

        Raises ImportError if neither is installed.
        """
        # Imported here: commands that move nothing need not load it.
        try:
            import coal
        except ImportError:
            # The last version that supports NumPy 1.
            import hppfcl as coal

            coal.Transform3s, coal.StdVec_Vec3s = coal.Transform3f, coal.StdVec_Vec3f
        return coal

    @cached_property
    def _objects(self) -> list[tuple[Any, FloatArray]]:
        """Coal's object of each shape, and its pose in the frame that carries it, (4, 4)."""
        return [self._object(shape, T) for shape, T in self._shapes]

    @cached_property
    def _request(self) -> Any:
        """Coal's request for signed distances, whichever version of coal is installed."""
        request = self._coal.DistanceRequest()
        if hasattr(request, 'enable_signed_distance'):  # the older one always does
            request.enable_signed_distance = True
        return request

    def distance(self, i: int, T_i: FloatArray, j: int, T_j: FloatArray) -> float:
        """Return the distance of shapes i and j, m, negative if they overlap.

        ``T_i``, ``T_j``: poses of their frames, (4, 4).
        """
        coal = self._coal
        (first, T_1_shape), (second, T_2_shape) = self._objects[i], self._objects[j]
        T_1, T_2 = T_i @ T_1_shape, T_j @ T_2_shape
        return float(
            coal.distance(
                first,
                coal.Transform3s(T_1[:3, :3], T_1[:3, 3]),
                second,
                coal.Transform3s(T_2[:3, :3], T_2[:3, 3]),
                self._request,
                coal.DistanceResult(),
            )
        )

    def _object(self, shape: Shape, T: FloatArray) -> tuple[Any, FloatArray]:
        """Return coal's object of a shape, and its pose in the frame that carries it, (4, 4).

        ``T``: pose of the shape in that frame, (4, 4).
        """
        coal = self._coal
        if shape.kind == 'box':
            return coal.Box(*(shape.points.max(axis=0) * 2).tolist()), T
        if shape.kind == 'sphere':
            return coal.Sphere(shape.ball), T
        if shape.kind == 'hull':
            corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
            for point in shape.points:
                corners.append(np.array(point))
            for a, b, c in triangles(shape.points).tolist():
                faces.append(coal.Triangle(a, b, c))
            return coal.Convex(corners, faces), T
        # Cylinders and capsules lie along z of their frame, about its origin.
        start, end = shape.points[0], shape.points[-1]
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-9:
            return coal.Sphere(shape.ball), T @ transform(np.eye(3), start)
        T_shape = T @ transform(with_z_along(along), (start + end) / 2)
        if shape.kind == 'capsule':
            return coal.Capsule(shape.ball, length), T_shape
        return coal.Cylinder(shape.disc, length), T_shape
