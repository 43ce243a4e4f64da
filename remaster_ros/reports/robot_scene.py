# SPDX-License-Identifier: Apache-2.0
"""An arm and its surroundings as surfaces, for 3-D pictures.

Only plain arrays, in base_link or in moving frames: a page or a viewer that draws them needs
neither kinematics nor files. A link is drawn with the meshes of its URDF if all can be read, else
with its shape in the collision checks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.bodies import Body, Shape, triangles
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.kinematics.urdf_geometry import Visual, chain_visuals
from remaster_ros.planning.candidates import LineOfSight, PlanningScene
from remaster_ros.session.cells.meshes import MeshPart, find_mesh, read_mesh_parts
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.types import FloatArray, IntArray

Color = tuple[float, float, float]
MeshParts = Callable[[str], Sequence[MeshPart]]

MOST_TRIANGLES = 2500
"""Largest number of triangles of a surface; an arm has some twenty surfaces."""
_EQUAL_M = 1e-5
_FINEST_M, _COARSEST_M = 5e-4, 0.05


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, with a name and a role, that move together with one link of the arm."""

    name: str  # Name for people
    link: int  # 0 for a fixed surface, i for one that moves with joint i
    role: str  # link, tool, marker or obstacle
    vertices: FloatArray  # In the frame of `RobotScene.transforms` for that link, m, (n, 3)
    # Vertex indices of each triangle, (m, 3), counter-clockwise seen from outside
    faces: IntArray
    # Red, green and blue, 0 to 1; None if the robot description gives none
    color: Color | None = None


@dataclass(frozen=True, eq=False)
class RobotScene:
    """Arm, tool and surroundings as surfaces for a 3-D picture."""

    chain: SerialChain  # The arm
    surfaces: Sequence[Surface]
    sights: Sequence[LineOfSight]  # Position of each sensor, and the marker that it follows
    floor_z: float | None  # Height of the floor, m; None without a floor
    notes: Sequence[str]  # Parts not drawn as in the robot description, and the remedy

    def transforms(self, q: FloatArray) -> FloatArray:
        """Return the poses of the links, T_R_link, (..., k + 1, 4, 4); the first is the base's.

        ``q``: joint positions, rad or m, (..., k). That of the base is the identity.
        """
        frames = self.chain.frames(q)
        base = np.broadcast_to(np.eye(4), (*frames.shape[:-3], 1, 4, 4))
        return np.concatenate((base, frames), axis=-3)

    def with_sensors(self, T_R_N: Mapping[str, FloatArray]) -> RobotScene:
        """Return a copy with sensors at their measured poses T_R_N, (4, 4) each.

        Sensors that are not in ``T_R_N`` stay; names that are not in the scene are ignored.
        """
        sights = [
            replace(sight, sensor_R=T_R_N[sight.sensor][:3, 3]) if sight.sensor in T_R_N else sight
            for sight in self.sights
        ]
        return replace(self, sights=sights)


def robot_scene(cell: Workcell, scene: PlanningScene) -> RobotScene:
    """Make the scene of a cell: arm, tool, obstacles and sensors as surfaces.

    Parameters
    ----------
    cell
        The cell.
    scene
        Its planning scene: bodies of the collision checks, and sensors.
    """
    chain, folder = scene.model.chain, Path(cell.file).parent
    urdf, mesh_path = folder / cell.robot.urdf, [folder / path for path in cell.mesh_path]
    parts = cache(lambda name: read_mesh_parts(find_mesh(name, urdf, mesh_path)))
    visuals = chain_visuals(cell.urdf_text, chain)
    surfaces, notes = arm_surfaces(visuals, scene.model.bodies, parts)
    return RobotScene(chain, surfaces, scene.sights, scene.model.floor_z, notes)


def arm_surfaces(
    visuals: Sequence[Visual], bodies: Sequence[Body], mesh_parts: MeshParts
) -> tuple[list[Surface], list[str]]:
    """Return surfaces of an arm and its surroundings, and notes on geometry that cannot be read.

    Links are drawn by their ``visuals``; a link of which any is missing or cannot be read, by its
    bodies. Of ``bodies``, those of the collision checks, tool, markers and obstacles are drawn,
    too. ``mesh_parts``: function that reads a mesh by its name; InputError for a missing one.
    """
    surfaces: list[Surface] = []
    missing: dict[str, None] = {}
    seen: set[int] = set()
    without: set[int] = set()
    for visual in visuals:
        drawn = _drawn(visual, mesh_parts)
        if drawn:
            seen.add(visual.link)
            surfaces += drawn
        else:
            without.add(visual.link)
            missing[visual.mesh or f'the geometry of {visual.link_name}'] = None
    # A link of which a part is missing would look as if it had a gap to go through.
    surfaces = [surface for surface in surfaces if surface.link not in without]
    for body in bodies:
        if body.role != 'link' or body.link not in seen - without:
            role = 'marker' if body.name.startswith('marker ') else body.role
            points, faces = _hull(body.shape)
            placed = apply(body.T_link_body, points)
            surfaces.append(Surface(body.name, body.link, role, placed, faces))
    return surfaces, _notes(list(missing))


def _notes(missing: Sequence[str]) -> list[str]:
    """Return a note on geometry that cannot be read, in a list; [] if there is none.

    ``missing``: names of it.
    """
    if not missing:
        return []
    more = f' and {len(missing) - 1} more' if len(missing) > 1 else ''
    return [
        f'{missing[0]}{more} cannot be read, so that these links are drawn as the collision '
        'checks have them; mesh_path of the cell file names the folder of the meshes'
    ]


def _drawn(visual: Visual, mesh_parts: MeshParts) -> list[Surface]:
    """Surfaces of a visual element, in its link's frame; [] if its mesh cannot be read."""
    if visual.shape is not None:
        points, faces = _hull(visual.shape)
        parts = [MeshPart(points, faces, None)]
    elif not visual.mesh:
        return []
    else:
        try:
            parts = list(mesh_parts(visual.mesh))
        except InputError:
            return []
    surfaces = []
    for part in parts:
        points, faces = coarser(part.vertices * visual.scale, part.faces)
        if np.prod(visual.scale) < 0.0:
            faces = faces[:, ::-1]
        if len(faces):
            placed = apply(visual.T_link_visual, points)
            color = visual.color or part.color
            surfaces.append(Surface(visual.link_name, visual.link, 'link', placed, faces, color))
    return surfaces


def coarser(
    vertices: FloatArray, faces: IntArray, most: int = MOST_TRIANGLES
) -> tuple[FloatArray, IntArray]:
    """Return a mesh with at most `most` triangles, in which vertices near each other are merged.

    Vertices of one cell of a grid become their mean, and triangles that lose a corner are
    dropped (J. Rossignac and P. Borrel, "Multi-resolution 3D approximations for rendering
    complex scenes", 1993); the grid widens until few enough remain. Equal vertices are always
    merged.

    Parameters
    ----------
    vertices, faces
        m, (n, 3), and vertex indices, (m, 3).
    most
        Largest number of triangles; exceeded only if cells of 5 cm leave more.
    """
    points, remaining = _clustered(vertices, faces, _EQUAL_M)
    cell = _FINEST_M
    while len(remaining) > most and cell < _COARSEST_M:
        points, remaining = _clustered(vertices, faces, cell)
        # The number of triangles falls with the square of the cell, where it falls.
        cell *= max(1.1, 0.95 * float(np.sqrt(len(remaining) / most)))
    return points, remaining


def _clustered(vertices: FloatArray, faces: IntArray, cell: float) -> tuple[FloatArray, IntArray]:
    """Return a mesh with the vertices of each cell of a cubic grid merged to their mean.

    ``cell``: edge of a cell, m. Triangles that lose a corner, and repeated ones, are dropped.
    """
    steps = np.round((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    _, index = np.unique(_numbered(steps), return_inverse=True)
    counts = np.bincount(index)
    points = np.stack([np.bincount(index, column) / counts for column in vertices.T], axis=1)
    corners = index[faces]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    # Of triangles on the same corners one is enough.
    _, first = np.unique(_numbered(np.sort(corners, axis=1)), return_index=True)
    return _used(points, corners[np.sort(first)])


def _numbered(rows: IntArray) -> IntArray:
    """Return a number for each row of three whole numbers, equal only for equal rows, (n,).

    ``rows``: 0 or more, (n, 3). The numbers are not consecutive.
    """
    size = rows.max(axis=0, initial=0) + 1
    return (rows[:, 0] * size[1] + rows[:, 1]) * size[2] + rows[:, 2]


def _used(points: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the points that triangles use, and the triangles with the new indices.

    (p, 3) and (m, 3).
    """
    used, renumbered = np.unique(faces, return_inverse=True)
    return points[used], renumbered.reshape(-1, 3).astype(np.int64)


def _hull(shape: Shape) -> tuple[FloatArray, IntArray]:
    """Return the surface of a convex shape in its own frame: vertices and triangles.

    Vertices: m, (n, 3); triangles: vertex indices, counter-clockwise seen from outside, (m,
    3).
    """
    points = shape.outline
    if shape.ball > 0.0:
        # Its outline encloses it with few points; this is the shape itself, rounder.
        core = Shape(shape.kind, shape.points, shape.disc).outline
        points = (core[:, None] + shape.ball * _ball()).reshape(-1, 3)
    return _used(points, triangles(points))


@cache
def _ball() -> FloatArray:
    """200 points spread evenly over the unit sphere, (200, 3), along a spiral."""
    count = 200
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.arange(count) * np.pi * (3.0 - 5.0**0.5)
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack((radius * np.cos(turn), radius * np.sin(turn), z))
