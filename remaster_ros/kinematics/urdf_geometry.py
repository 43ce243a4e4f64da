# SPDX-License-Identifier: Apache-2.0
"""The geometry of a URDF: which shapes hang on which joint of the arm, and where.

Collision geometry is read strictly, as it decides what the arm may do; visual geometry is for
pictures, where an element that cannot be read is one that is missing.
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
"""Takes a mesh's file name as the URDF writes it; returns its vertices, m, (n, 3).

None leaves that shape out."""


@dataclass(frozen=True, eq=False)
class LinkShape:
    """One ``<collision>`` element: its link, its place in the link's frame, its shape."""

    link: str
    T_link_shape: FloatArray
    shape: Shape


@dataclass(frozen=True, eq=False)
class Visual:
    """One ``<visual>`` element of a link of the arm."""

    link_name: str  # The URDF's link
    link: int  # 0 for what stands still, i for what moves with joint i
    # Its place in the frame after that joint (in the base for 0), (4, 4)
    T_link_visual: FloatArray
    shape: Shape | None  # A box, cylinder or sphere; None for a mesh
    # The mesh's file name as the URDF writes it; '' for none, with no shape either where the
    # element cannot be read
    mesh: str
    scale: FloatArray  # Of the mesh, (3,)
    # Red, green and blue, 0 to 1; None where the URDF gives none
    color: tuple[float, float, float] | None


def link_shapes(text: str, read_mesh: MeshReader) -> list[LinkShape]:
    """Read all collision elements of URDF text (that `parse_urdf` accepts).

    ``text``: contents of the URDF file; ``read_mesh``: called for each mesh; what it returns is
    taken as its convex hull, scaled.
    Raises InputError: a geometry that is missing, unknown or has no volume, or what `read_mesh`
    raises.
    """
    found = []
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
                found.append(LinkShape(name, origin_of(element, where), shape))
    return found


def mesh_names(text: str) -> list[str]:
    """Return the file names of the meshes of all collision elements, as they are written."""
    names: list[str] = []
    link_shapes(text, names.append)
    return list(dict.fromkeys(names))


def _shape(element: ElementTree.Element, where: str, read_mesh: MeshReader) -> Shape | None:
    if element.tag == 'box':
        return box(numbers(attribute(element, 'size', where), 3, f'the size of {where}'))
    if element.tag == 'sphere':
        return sphere(*numbers(attribute(element, 'radius', where), 1, f'the radius of {where}'))
    if element.tag in ('cylinder', 'capsule'):
        radius = numbers(attribute(element, 'radius', where), 1, f'the radius of {where}')
        length = numbers(attribute(element, 'length', where), 1, f'the length of {where}')
        core = cylinder(radius[0], length[0])
        # The few programs that write capsules mean the length without the round ends.
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
    """Return the URDF's collision geometry as bodies on the links of the arm.

    What is fastened rigidly to a link moves with it. Joints off the arm (a gripper's fingers)
    count as fixed at zero, as for the masses.

    Parameters
    ----------
    text
        The URDF that the chain was read from.
    chain
        The arm.
    read_mesh
        See `link_shapes`.
    """
    carrier = _carriers(text, chain)
    bodies = []
    for found in link_shapes(text, read_mesh):
        link, T = carrier(found.link)
        bodies.append(Body(found.link, link, found.shape, T @ found.T_link_shape))
    return bodies


def _carriers(text: str, chain: SerialChain) -> Callable[[str], tuple[int, FloatArray]]:
    """Return what gives, for a link's name, the joint that it moves with and T_joint_link.

    The joint is 0 for what stands still, whose place is then in the base.
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
        # Where no joint of the arm carries it, this is its place in the root's frame.
        return index.get(name, 0), T if name in index else inverse(T_root_base) @ T

    return carrier


def chain_visuals(text: str, chain: SerialChain) -> list[Visual]:
    """Return the visual elements of URDF text (that `parse_urdf` accepts), for pictures.

    Parameters
    ----------
    text
        The URDF that the chain was read from.
    chain
        The arm.
    """
    carrier, robot = _carriers(text, chain), ElementTree.fromstring(text)
    colors = {element.get('name', ''): _color(element) for element in robot.findall('material')}
    found = []
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
            found.append(Visual(name, number, T @ T_visual, shape, mesh, scale, color))
    return found


def _color(material: ElementTree.Element) -> tuple[float, float, float] | None:
    """Return red, green and blue of a ``<material>``; None where it has no colour that is one."""
    element = material.find('color')
    with suppress(InputError):
        if element is not None:
            rgba = numbers(element.get('rgba', ''), 4, 'a colour')
            red, green, blue = np.clip(rgba[:3], 0.0, 1.0).tolist()
            return red, green, blue
    return None
