# SPDX-License-Identifier: Apache-2.0
"""A strict reader of the links, joints, limits and masses in URDF text.

Meshes, materials and the like are ignored. Wrong text is refused with one line that names the
joint or link; nothing is guessed.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Container, Mapping
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import matrix_from_rpy, transform
from remaster_ros.types import FloatArray

_LARGEST = 1e6
"""Largest length (m), angle (rad) or mass (kg) accepted; far larger ones would overflow."""
_XACRO = (
    'URDF: this is xacro, from which a URDF is still to be made; let its name end in .xacro, and '
    'expand it: remaster init FILE (or ros2 run xacro xacro FILE > robot.urdf)'
)
MOST_LINKS, MOST_DEPTH = 2_000, 200
"""Most links of a description, and most in one chain: ten times those of the largest descriptions
seen (190 links of a cell with two arms and hands; 20 from a humanoid's root to its finger)."""
_NO_LIMIT = 1e300
"""Largest joint limit accepted: some programs write a huge one, such as 1e16, to mean none."""


@dataclass(frozen=True, eq=False)
class UrdfLink:
    """One link: its mass (kg; 0 without ``<inertial>``) and centre of mass (m, link frame)."""

    name: str
    mass: float
    center_of_mass: FloatArray


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint as written in the URDF."""

    name: str
    kind: str  # ``type`` of the URDF: revolute, continuous, fixed, prismatic, floating, planar
    parent: str
    child: str
    origin: FloatArray  # T_parent_joint, (4, 4)
    axis: FloatArray  # Unit vector in the joint frame, (3,); X for a fixed joint
    # Limits as written, rad and rad/s; None if absent
    lower: float | None
    upper: float | None
    velocity: float | None
    mimic: bool  # Whether the joint follows another one


@dataclass(frozen=True, eq=False)
class UrdfModel:
    """A robot as a tree: ``parent_joint`` maps each link but the root to its joint."""

    name: str
    root: str
    links: Mapping[str, UrdfLink]
    parent_joint: Mapping[str, UrdfJoint]

    @cached_property
    def child_joints(self) -> Mapping[str, list[UrdfJoint]]:
        """Joints that each link carries, in file order, by link name; [] for a leaf."""
        found: dict[str, list[UrdfJoint]] = {name: [] for name in self.links}
        for joint in self.parent_joint.values():
            found[joint.parent].append(joint)
        return found

    def leaves(self) -> list[str]:
        """Return the links without child links, in file order."""
        parents = {joint.parent for joint in self.parent_joint.values()}
        return [name for name in self.links if name not in parents]

    def carrier(self, link: str, moving: Container[str]) -> tuple[str, FloatArray]:
        """Return the first link in `moving` on the way from a link to the root, and a pose.

        The link itself counts; the root if there is no other. The pose is T_carrier_link (4, 4),
        that of the given link in the returned one, with all joints between the two at zero.
        """
        T = np.eye(4)
        while link not in moving and link in self.parent_joint:
            joint = self.parent_joint[link]
            link, T = joint.parent, joint.origin @ T
        return link, T


def parse_urdf(text: str) -> UrdfModel:
    """Read URDF text into a tree of links and joints.

    Raises
    ------
    InputError
        If the XML is malformed or declares a DOCTYPE or entities, it is xacro, a joint names a
        missing link, two links or joints share a name, a link has two parents, links form a loop
        or no single tree, a number is malformed, or there are too many links (`MOST_LINKS`), or
        too many in one chain (`MOST_DEPTH`).
    """
    # The keyword is case-sensitive in XML, so text without it cannot declare an entity.
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise InputError('URDF: it declares a DOCTYPE or entities; remove the declaration')
    try:
        robot = ElementTree.fromstring(text)
    # ValueError: the text has characters that no encoding can write.
    except (ElementTree.ParseError, ValueError) as error:
        if '<xacro:' in text:  # Its namespace is undeclared, so that the XML is malformed.
            raise InputError(_XACRO) from None
        raise InputError(f'URDF: not well-formed XML ({error})') from None
    # Expanded xacro may still declare the namespace, but has no elements of it.
    if any(_is_xacro(element) for element in robot.iter()):
        raise InputError(_XACRO)
    if robot.tag != 'robot':
        raise InputError(f'URDF: the outermost element is <{robot.tag}>, not <robot>')

    count = len(robot.findall('link'))
    if count > MOST_LINKS:
        raise InputError(
            f'URDF: {count} links, where {MOST_LINKS} at the most are read; leave out what is no '
            'part of the arm and its base'
        )
    links: dict[str, UrdfLink] = {}
    for element in robot.findall('link'):
        link = _link(element)
        if link.name in links:
            raise InputError(f"URDF: two links are named '{link.name}'")
        links[link.name] = link

    parent_joint: dict[str, UrdfJoint] = {}
    names: set[str] = set()
    for element in robot.findall('joint'):
        joint = _joint(element)
        for end in (joint.parent, joint.child):
            if end not in links:
                raise InputError(
                    f"URDF: joint '{joint.name}' names link '{end}', which is missing"
                )
        if joint.name in names:
            raise InputError(f"URDF: two joints are named '{joint.name}'")
        if joint.child in parent_joint:
            other = parent_joint[joint.child].name
            raise InputError(
                f"URDF: link '{joint.child}' hangs on two joints, '{other}' and '{joint.name}'"
            )
        names.add(joint.name)
        parent_joint[joint.child] = joint

    roots = [name for name in links if name not in parent_joint]
    if len(roots) != 1:
        found = ', '.join(roots) if roots else 'none, the links form a loop'
        raise InputError(f'URDF: a robot is a tree with one root link; found {found}')
    parents = {link: (joint.parent,) for link, joint in parent_joint.items()}
    try:
        TopologicalSorter(parents).prepare()
    except CycleError as error:
        link = min(error.args[1])
        raise InputError(f"URDF: link '{link}' is part of a loop; a robot is a tree") from None
    model = UrdfModel(robot.get('name', ''), roots[0], links, parent_joint)
    _refuse_deep(model)
    return model


def _refuse_deep(model: UrdfModel) -> None:
    """Raise InputError if there are more than `MOST_DEPTH` links in one chain."""
    level, depth = [model.root], 0
    while level := [joint.child for link in level for joint in model.child_joints[link]]:
        depth += 1
        if depth > MOST_DEPTH:
            raise InputError(
                f"URDF: link '{level[0]}' has more than {MOST_DEPTH} links between it and "
                f"'{model.root}', which no arm has; correct the description"
            )


def _is_xacro(element: ElementTree.Element) -> bool:
    """Return whether an element is in one of the namespaces of xacro."""
    # The tag of a comment is a function.
    tag = element.tag if isinstance(element.tag, str) else ''
    return tag.startswith('{') and tag.partition('}')[0].endswith('xacro')


def _link(element: ElementTree.Element) -> UrdfLink:
    """Read a <link> element; raise InputError if it is invalid."""
    name = attribute(element, 'name', 'a link')
    where = f"link '{name}'"
    inertial = element.find('inertial')
    if inertial is None:
        return UrdfLink(name, 0.0, np.zeros(3))
    mass_element = inertial.find('mass')
    if mass_element is None:
        raise InputError(f'URDF: {where} has <inertial> without <mass>')
    mass = _number(attribute(mass_element, 'value', where), f'the mass of {where}')
    if mass < 0.0:
        raise InputError(f'URDF: the mass of {where} is {mass} kg; it cannot be negative')
    return UrdfLink(name, mass, origin_of(inertial, where)[:3, 3])


def _joint(element: ElementTree.Element) -> UrdfJoint:
    """Read a <joint> element; raise InputError if it is invalid."""
    name = attribute(element, 'name', 'a joint')
    where = f"joint '{name}'"
    ends = {}
    for end in ('parent', 'child'):
        child = element.find(end)
        if child is None:
            raise InputError(f'URDF: {where} has no <{end}>')
        ends[end] = attribute(child, 'link', f'<{end}> of {where}')
    kind = attribute(element, 'type', where)
    limit = element.find('limit')
    lower, upper, velocity = (
        None if limit is None else _optional_number(limit, key, where)
        for key in ('lower', 'upper', 'velocity')
    )
    _check_unused_numbers(element, where)
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=ends['parent'],
        child=ends['child'],
        origin=origin_of(element, where),
        axis=_axis(element, kind, where),
        lower=lower,
        upper=upper,
        velocity=velocity,
        mimic=element.find('mimic') is not None,
    )


def _check_unused_numbers(element: ElementTree.Element, where: str) -> None:
    """Raise InputError for malformed numbers that only `compensation.export` reads.

    Those of mimic and safety_controller; ``where``: the joint in words.
    """
    for tag, keys in (
        ('mimic', ('multiplier', 'offset')),
        ('safety_controller', ('soft_lower_limit', 'soft_upper_limit')),
    ):
        for found in element.findall(tag):
            for key in keys:
                _optional_number(found, key, where)


def _axis(element: ElementTree.Element, kind: str, where: str) -> FloatArray:
    """Return the unit axis of a joint in its frame, (3,); X if it is not given, URDF's default.

    ``kind``: type of the joint; X for a fixed or floating one, whatever is given; ``where``:
    the joint in words, for the error.

    Raises InputError if its length is not between 1e-6 and 1e6, or it is malformed.
    """
    axis_element = element.find('axis')
    # CAD exporters write an axis of 0 0 0 for joints that do not move.
    if axis_element is None or kind in ('fixed', 'floating'):
        return np.array([1.0, 0.0, 0.0])
    axis = numbers(attribute(axis_element, 'xyz', where), 3, f'the axis of {where}')
    length = math.hypot(*axis)
    if not 1e-6 < length < 1e6:
        raise InputError(f'URDF: the axis of {where} has length {length:g}; give a unit vector')
    return axis / length


def origin_of(element: ElementTree.Element, where: str) -> FloatArray:
    """Return the transform of the <origin> of an element, (4, 4); the identity if it has none.

    ``where``: for messages. Raises InputError if xyz (m) or rpy (rad) is malformed.
    """
    origin = element.find('origin')
    if origin is None:
        return np.eye(4)
    xyz = numbers(origin.get('xyz', '0 0 0'), 3, f'the origin xyz of {where}')
    rpy = numbers(origin.get('rpy', '0 0 0'), 3, f'the origin rpy of {where}')
    return transform(matrix_from_rpy(rpy), xyz)


def attribute(element: ElementTree.Element, key: str, where: str) -> str:
    """Return a required attribute; raise InputError, which names `where`, if it is missing.

    An empty one is missing. ``where``: the element in words.
    """
    value = element.get(key, '')
    if not value:
        raise InputError(f"URDF: {where} has no attribute '{key}'")
    return value


def numbers(text: str, count: int, what: str) -> FloatArray:
    """Return the `count` numbers in a text, (count,); `what` names them in messages.

    Raises InputError if they are more or fewer, or one is not finite or above `_LARGEST`.
    """
    parts = text.split()
    if len(parts) != count:
        needed = 'three numbers are needed' if count == 3 else f'{count} is needed'
        raise InputError(f"URDF: {what} is '{text}'; {needed}")
    return np.array([_number(part, what) for part in parts])


def _optional_number(element: ElementTree.Element, key: str, where: str) -> float | None:
    """Return a number attribute, None if it is missing; InputError if it is malformed.

    ``where``: the element in words, for the error.
    """
    text = element.get(key)
    return None if text is None else _number(text, f'{key} of {where}', _NO_LIMIT)


def _number(text: str, what: str, largest: float = _LARGEST) -> float:
    """Return text as a finite number; raise InputError, which names `what`, if it is none.

    ``largest``: largest absolute value.
    """
    try:
        value = float(text)
    except ValueError:
        hint = ' (run xacro on the file first)' if '$' in text else ''
        raise InputError(f"URDF: {what} is '{text}', not a number{hint}") from None
    if not abs(value) <= largest:
        raise InputError(f"URDF: {what} is '{text}', not a finite number of at most {largest:g}")
    return value
