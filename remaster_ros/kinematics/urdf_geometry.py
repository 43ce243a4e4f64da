# SPDX-License-Identifier: Apache-2.0
"""The geometry of a URDF: shapes, the joint that moves each, and their poses.

Collision geometry is read strictly, as it decides where the arm may go; visual geometry is for
pictures, and an element that cannot be read is skipped.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.bodies import Body, Shape, box, capsule, cylinder, hull, sphere
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.kinematics.urdf import attribute, numbers, origin_of, parse_urdf
from remaster_ros.types import FloatArray

MeshReader = Callable[[str], FloatArray | None]
"""From a mesh's file name, as the URDF writes it, to its vertices, m, (n, 3).

None leaves that shape out."""


@dataclass(frozen=True, eq=False)
class LinkShape:
    """Shape and pose of one <collision> element of a link."""

    link: str  # The URDF's link
    T_link_shape: FloatArray  # Pose of the shape in the link's frame, (4, 4)
    shape: Shape


@dataclass(frozen=True, eq=False)
class Visual:
    """Shape or mesh, pose and colour of one ``<visual>`` element of a link of the arm."""

    link_name: str  # The URDF's link
    link: int  # 0 for the base, i for the link after joint i
    # Pose in the frame after that joint (in the base frame for 0), (4, 4)
    T_link_visual: FloatArray
    shape: Shape | None  # A box, cylinder or sphere; None for a mesh
    # The mesh's file name as the URDF writes it; '' for none. Without shape and mesh the element
    # could not be read
    mesh: str
    scale: FloatArray  # Of the mesh, (3,)
    # Red, green and blue, 0 to 1; None if the URDF gives none
    color: tuple[float, float, float] | None


def link_shapes(text: str, read_mesh: MeshReader) -> list[LinkShape]:
    """Read all collision elements of URDF text (which `parse_urdf` accepts).

    ``read_mesh``: called with the file name of each mesh; the shape is the convex hull of the
    returned vertices, scaled. If it returns None, the element is left out. Raises InputError
    if a geometry is missing, unknown or has no volume, or `read_mesh` raises it.
    """
    shapes = []
    for link in ElementTree.fromstring(text).findall('link'):
        name = link.get('name', '')
        for element in link.findall('collision'):
            where = f"the collision geometry of link '{name}'"
            geometry = element.find('geometry')
            if geometry is None or not len(geometry):
                raise InputError(f'URDF: {where} is empty; write a box, cylinder, sphere or mesh')
            try:
                shape = _shape(geometry[0], where, read_mesh)
            except InputError as error:
                place = '' if where in str(error) else f'URDF: {where}: '
                raise InputError(f'{place}{error}') from None
            if shape is not None:
                shapes.append(LinkShape(name, origin_of(element, where), shape))
    return shapes


def mesh_names(text: str) -> list[str]:
    """Return the file names of all collision meshes, as written, without repeats, in file order.

    Raises InputError as `link_shapes`.
    """
    names: list[str] = []
    link_shapes(text, names.append)
    return list(dict.fromkeys(names))


def _shape(element: ElementTree.Element, where: str, read_mesh: MeshReader) -> Shape | None:
    """Read a geometry element; None if `read_mesh` leaves its mesh out.

    ``where``: for messages. Raises InputError for an unknown element, or sizes that are malformed
    or not positive.
    """
    if element.tag == 'box':
        return box(numbers(attribute(element, 'size', where), 3, f'the size of {where}'))
    if element.tag == 'sphere':
        return sphere(*numbers(attribute(element, 'radius', where), 1, f'the radius of {where}'))
    if element.tag in ('cylinder', 'capsule'):
        radius = numbers(attribute(element, 'radius', where), 1, f'the radius of {where}')
        length = numbers(attribute(element, 'length', where), 1, f'the length of {where}')
        core = cylinder(radius[0], length[0])
        # Programs that write capsules mean the length without the round ends.
        low, high = core.points
        return core if element.tag == 'cylinder' else capsule(low, high, core.disc)
    if element.tag == 'mesh':
        vertices = read_mesh(attribute(element, 'filename', where))
        if vertices is None:
            return None
        scale = numbers(element.get('scale', '1 1 1'), 3, f'the scale of {where}')
        return hull(np.asarray(vertices, dtype=float) * scale)
    raise InputError(
        f'URDF: {where} is a <{element.tag}>; a box, cylinder, sphere or mesh is needed'
    )


def chain_bodies(text: str, chain: SerialChain, read_mesh: MeshReader) -> list[Body]:
    """Return the collision geometry of a URDF as bodies on the links of the arm.

    Bodies fixed rigidly to a link move with it. Joints off the arm (a gripper's fingers) count as
    fixed at zero, as for the masses. ``text``: the URDF that the chain was read from;
    ``read_mesh`` and errors as of `link_shapes`.
    """
    carrier = _carriers(text, chain)
    bodies = []
    for element in link_shapes(text, read_mesh):
        link, T = carrier(element.link)
        bodies.append(Body(element.link, link, element.shape, T @ element.T_link_shape))
    return bodies


def _carriers(text: str, chain: SerialChain) -> Callable[[str], tuple[int, FloatArray]]:
    """Return a function from a link's name to the number of the joint that moves it, and its pose.

    The pose is T_joint_link, in the frame after that joint. The number is 0 for links that stand
    still, whose pose is in the base frame.
    """
    model = parse_urdf(text)
    index = {
        joint.child: chain.joint_names.index(joint.name) + 1
        for joint in model.parent_joint.values()
        if joint.name in chain.joint_names
    }
    _, T_root_base = model.carrier(chain.base_link, index)

    def carrier(link: str) -> tuple[int, FloatArray]:
        name, T = model.carrier(link, index)
        # If no joint of the arm carries the link, T is its pose in the root's frame.
        return index.get(name, 0), T if name in index else inverse(T_root_base) @ T

    return carrier


def chain_visuals(text: str, chain: SerialChain) -> list[Visual]:
    """Return the visual elements of URDF text (which `parse_urdf` accepts), for pictures.

    ``text``: the URDF that the chain was read from. An element that cannot be read has neither
    shape nor mesh; no error is raised for it.
    """
    carrier, robot = _carriers(text, chain), ElementTree.fromstring(text)
    colors = {element.get('name', ''): _color(element) for element in robot.findall('material')}
    visuals = []
    for link in robot.findall('link'):
        name = link.get('name', '')
        number, T = carrier(name)
        for element in link.findall('visual'):
            where = f"the visual geometry of link '{name}'"
            shape, mesh, scale, T_visual = None, '', np.ones(3), np.eye(4)
            with suppress(InputError):
                T_visual = origin_of(element, where)
                geometry = element.find('geometry/')
                if geometry is not None and geometry.tag == 'mesh':
                    scale = numbers(geometry.get('scale', '1 1 1'), 3, where)
                    mesh = attribute(geometry, 'filename', where)
                elif geometry is not None:
                    shape = _shape(geometry, where, lambda name: None)
            material = element.find('material')
            color = None
            if material is not None:
                color = _color(material) or colors.get(material.get('name', ''))
            visuals.append(Visual(name, number, T @ T_visual, shape, mesh, scale, color))
    return visuals


def _color(material: ElementTree.Element) -> tuple[float, float, float] | None:
    """Return red, green and blue of a <material>, 0 to 1; None if it has no valid colour."""
    element = material.find('color')
    with suppress(InputError):
        if element is not None:
            rgba = numbers(element.get('rgba', ''), 4, 'a colour')
            red, green, blue = np.clip(rgba[:3], 0.0, 1.0).tolist()
            return red, green, blue
    return None
