# SPDX-License-Identifier: Apache-2.0
"""The offsets in three forms: re-mastering, an offset layer, or a corrected URDF.

The true joint angle is the reported one plus the offset. Each form corrects all of it, so only one
may be in use at a time.

An offset that the data do not determine is in none of the three: its mean is a choice of the fit
(0, or a consequence of the marker's nominal position), and applied it would move the arm for no
reason. Each file lists the joints that are left out, and why.
"""

from __future__ import annotations

import hashlib
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from remaster_ros.compensation.arm_model import Geometry
from remaster_ros.compensation.mastering import MasteringStep, mastering
from remaster_ros.kinematics.pad_angles import pad_in_words
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_rpy, rotation_vector_to_matrix
from remaster_ros.session.strict_yaml import dump_yaml
from remaster_ros.types import BoolArray, Controller, FloatArray

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

APPLY_FOLDER = 'apply'
REMASTER_FILE = 'remaster.txt'
LAYER_FILE = 'offset_layer.yaml'
URDF_FILE = 'robot_calibrated.urdf'
MODEL_FILE = 'robot_model.urdf'

_PROLOG = re.compile(r'(?:\s*(?:<\?.*?\?>|<!--.*?-->))*\s*', re.DOTALL)
_LIMITS = {
    'limit': {'lower', 'upper'},
    'safety_controller': {'soft_lower_limit', 'soft_upper_limit'},
}
_PLAIN = """\
1. Re-master on the pad: drive each joint to the angle in the last column, as the
   robot reports it now, and set that place as the joint's new zero."""
_PAD = """\
1. Re-master on the pad, in the numbers of the pad, line by line: drive the joint until
   the pad shows the angle under "drive to", and set it, in that place, so that the pad
   shows the angle under "set to". Any other place does as well: add the same angle to both."""


@dataclass(frozen=True, eq=False)
class ZeroOffsets:
    """Zero-offsets of k joints, with what is needed to write them for a controller."""

    # The nominal robot: text of its URDF, and its joints
    urdf: str
    chain: SerialChain
    # Offsets and standard deviations, rad, m for prismatic joints, (k,)
    joint_offsets: FloatArray
    std: FloatArray
    identifiable: BoolArray  # Whether the data determine each, (k,); the others are not applied
    why: Sequence[str]  # Reason for each offset that is not identifiable, '' for the others
    # How the pad counts the joints; None if as the URDF, in degrees
    controller: Controller | None = None
    check_first: Sequence[str] = ()  # Checks before anything is loaded, a line each

    @classmethod
    def of(cls, result: FitResult, std: FloatArray | None = None) -> ZeroOffsets:
        """Zero-offsets of a fit; ``std``, (k,), rad or m, replaces its standard deviations."""
        return cls(
            result.session.urdf,
            result.chain,
            result.joint_offsets,
            result.joint_offsets_std if std is None else std,
            result.identifiable,
            result.why,
            result.session.controller,
            check_first(result),
        )

    @property
    def applied(self) -> FloatArray:
        """Offsets that are applied, rad or m, (k,): 0 for joints that are not identifiable."""
        return np.where(self.identifiable, self.joint_offsets, 0.0)

    @property
    def left_out(self) -> dict[str, str]:
        """Reason for each joint whose offset is not applied, by its name."""
        unknown = np.flatnonzero(~self.identifiable).tolist()
        return {self.chain.joint_names[i]: self.why[i] for i in unknown}


def exports(
    result: FitResult, remarks: Sequence[str] = (), std: FloatArray | None = None
) -> dict[str, str]:
    """Files of the folder ``apply`` with the zero-offsets: name -> text.

    Parameters
    ----------
    result
        The fit.
    remarks
        Effects that are not corrected, a line each, for the user.
    std
        Standard deviations of the offsets, rad or m, (k,), to replace those of a nominal geometry.
    """
    offsets = ZeroOffsets.of(result, std)
    notes = written_notes(offsets, remarks)
    return {
        REMASTER_FILE: remaster_text(offsets, remarks),
        LAYER_FILE: layer_text(offsets, remarks),
        URDF_FILE: calibrated_urdf(offsets.urdf, offsets.chain, offsets.applied, notes),
    }


def written_notes(offsets: ZeroOffsets, remarks: Sequence[str] = ()) -> list[str]:
    """Comment lines for an exported file: remarks, warnings of the result, joints left out.

    If the robot's pad counts joints otherwise than the URDF, a line tells this with the
    formulas.
    """
    words = [] if offsets.controller is None else pad_in_words(offsets.controller)
    return [
        *remarks,
        *(
            (
                'in the joints and angles of the robot description (URDF), as the ROS driver has '
                f'them, not in those of the pad: {", ".join(words)}',
            )
            if words
            else ()
        ),
        *offsets.check_first,
        *(
            f'left out, not identifiable: {joint}: {" ".join(why.split())}'
            for joint, why in offsets.left_out.items()
        ),
    ]


def check_first(result: FitResult) -> list[str]:
    """'CHECK FIRST: ' line for each implausible value of the result; [] if there is none."""
    return [f'CHECK FIRST: {line}' for line in result.implausible]


def remaster_text(
    offsets: ZeroOffsets, remarks: Sequence[str] = (), *, is_single_file: bool = False
) -> str:
    """Instructions for re-mastering on the robot's pad (teach pendant), in the pad's numbers.

    ``remarks``: further paragraphs; ``is_single_file``: the text does not refer to the other
    files of a fit.
    """
    groups = mastering(
        offsets.controller,
        offsets.chain,
        offsets.joint_offsets,
        offsets.std,
        offsets.identifiable,
    )
    steps = [step for group in groups for step in group]
    plain = len(groups) == len(steps) and all(step.is_plain for step in steps)
    urdf_sha256 = hashlib.sha256(offsets.urdf.encode()).hexdigest()
    slides, way = [], _PLAIN if plain else _PAD
    if offsets.chain.slides.any():
        slides = [
            'The true joint position is the reported one plus the offset; of joints that slide',
            'all is in mm.',
        ]
        way = way.replace('the angle', 'the value').replace('the same angle', 'the same amount')
    ways = [
        'The true joint angle is the reported one plus the offset. Use ONE of three ways,',
        'never two at once:',
        '',
        *way.splitlines(),
        f'2. An offset layer between planner and controller: {LAYER_FILE}.',
        f'3. A corrected robot model for planner and controller: {URDF_FILE}.',
    ]
    where, which = 'Left out of all three', ', and ways 2 and 3, are'
    if is_single_file:
        ways = [
            'The true joint angle is the reported one plus the offset. Use no other form of',
            'this correction beside it.',
            '',
            *(line[3:] for line in way.splitlines()),
        ]
        where, which = 'Left out', ' are'
    left_out, pad = [], []
    if offsets.left_out:
        but = '' if all(step.determined for step in steps) else ', but for the table above'
        left_out = [
            f'{where}, as the data do not determine their offsets. Leave',
            f'these joints as they are{but}:',
            *(f'  {joint}: {why}' for joint, why in offsets.left_out.items()),
        ]
    if offsets.controller is not None and (words := pad_in_words(offsets.controller)):
        pad = [
            'How the angles of the robot description (URDF) come from those on the pad, as',
            'told when the session was made:',
            *(f'  {line}' for line in words),
            f'The offsets above{which} in the numbers of the description.',
        ]
    table = _plain_rows(steps) if plain else _pad_rows(groups)
    paragraphs = (
        [
            f'Joint zero-offsets of robot {offsets.chain.name!r}',
            f'(URDF with SHA-256 {urdf_sha256})',
        ],
        offsets.check_first,
        slides,
        ways,
        [line for remark in remarks for line in textwrap.wrap(remark, 88)],
        table if steps else ['  No joint: these data determine no offset.'],
        left_out,
        pad,
        [
            'Afterwards measure ten new poses and run "remaster verify": it shows whether the',
            'offsets act, and that they do not act twice.',
        ],
    )
    return '\n\n'.join('\n'.join(lines) for lines in paragraphs if lines) + '\n'


def _plain_rows(steps: Sequence[MasteringStep]) -> list[str]:
    """Lines of the table of mastering steps for a pad that counts the joints as the URDF does.

    ``steps``: all `MasteringStep.is_plain`. Joints that turn, in degrees, come first, then
    prismatic ones, in mm.
    """
    rows = []
    for unit in ('deg', 'mm'):
        steps_of_unit = [step for step in steps if step.unit == unit]
        if not steps_of_unit:
            continue
        rows.append(
            f'  {"joint":<20} {f"offset, {unit}":>12} {f"std, {unit}":>10} '
            f'{f"drive to, {unit}":>16}'
        )
        rows += [
            f'  {step.joint:<20} {step.offset:>+12.4f} {step.std:>10.4f} {step.drive_to:>+16.4f}'
            for step in steps_of_unit
        ]
    return rows


def _pad_rows(groups: Sequence[Sequence[MasteringStep]]) -> list[str]:
    """Lines of the table of steps in the pad's names and units, with remarks below.

    ``groups``: joints that are coupled stand in one group.
    """
    steps = [step for group in groups for step in group]
    wide = max(len('on the pad'), *(len(step.pad_name) for step in steps))
    long = max(len('in the URDF'), *(len(step.joint) for step in steps))
    # The units stand with the numbers where they are not all degrees.
    mixed = any(step.slides for step in steps)
    heads = ('offset', 'std') if mixed else ('offset, deg', 'std, deg')
    rows = [
        f'  {"on the pad":<{wide}}  {"in the URDF":<{long}}  {heads[0]:>11}  {heads[1]:>8}'
        f'  {"drive to":>16}  {"set to":>16}'
    ]
    for group in groups:
        if len(group) > 1:
            names = [step.pad_name for step in group]
            rows += [
                f'  Coupled: drive {" and ".join(names)} to their angles first. Then, without a '
                'move between,',
                f'  set {", then ".join(names)}: also where setting one changes what the pad '
                'shows of the next.',
            ]
        for step in group:
            unit = '' if not mixed else ' mm' if step.slides else ' deg'
            offset = f'{step.offset:+.4f}{unit}' if step.determined else 'unknown'
            std = f'{step.std:.4f}{unit}' if step.determined else '-'
            places = [f'{step.shown(v)} {step.unit}' for v in (step.drive_to, step.set_to)]
            rows.append(
                f'  {step.pad_name:<{wide}}  {step.joint:<{long}}  {offset:>11}  {std:>8}'
                f'  {places[0]:>16}  {places[1]:>16}'
            )
            if step.unit not in ('deg', 'mm'):
                degrees = [f'{step.in_degrees(v):+.4f}' for v in (step.drive_to, step.set_to)]
                rows.append(f'    ({step.pad_name} in degrees: {degrees[0]}, set to {degrees[1]})')
            if not step.determined:
                rows.append(
                    f'    ({step.joint} keeps its zero in the URDF; what the pad shows goes with '
                    'the joint that it is coupled to)'
                )
    zero_steps = [step for step in steps if step.set_to != 0.0 and step.zero_in_reach]
    if zero_steps:
        rows += [
            '  Where the controller sets nothing but 0, drive instead to',
            *(f'    {step.pad_name}: {step.to_set_zero} {step.unit}' for step in zero_steps),
        ]
    rows += [
        f'  {step.pad_name}: its zero is beyond its limits; a controller that sets nothing but 0 '
        'cannot take its offset: use way 2 or 3.'
        for step in steps
        if step.set_to != 0.0 and not step.zero_in_reach
    ]
    return rows


def layer_text(offsets: ZeroOffsets, remarks: Sequence[str] = ()) -> str:
    """Text of a ROS 2 parameter file with the offsets, rad or m, for an offset layer.

    A layer is a node between planner and controller. Only identifiable offsets; the names of
    the others are listed. ``remarks``: comments, a line each.
    """
    slides = bool(offsets.chain.slides.any())
    head = (
        f'# Joint zero-offsets, rad{", m of joints that slide" if slides else ""}. '
        'A layer between planner and controller:\n'
        '#   command to the controller = planned angle - offset\n'
        '#   angle to the planner      = reported angle + offset\n'
        "# Shift the joint limits as well: the controller's limits apply to its own angles.\n"
    )  # fmt: skip
    head += ''.join(f'# {note}\n' for note in written_notes(offsets, remarks))
    known = np.flatnonzero(offsets.identifiable)
    lists: dict[str, list[str] | list[float]] = {
        'joint_names': [offsets.chain.joint_names[i] for i in known],
        'joint_offsets': offsets.joint_offsets[known].tolist(),
        'joint_offsets_std': offsets.std[known].tolist(),
        'left_out': list(offsets.left_out),
    }
    parameters = {
        'robot': offsets.chain.name,
        'urdf_sha256': hashlib.sha256(offsets.urdf.encode()).hexdigest(),
        # ROS has no type for an empty list.
        **{key: values for key, values in lists.items() if values},
    }
    return head + dump_yaml({'/**': {'ros__parameters': parameters}})


def calibrated_urdf(
    urdf: str,
    chain: SerialChain,
    joint_offsets: FloatArray,
    notes: Sequence[str] = (),
    geometry: Geometry | None = None,
) -> str:
    """URDF whose kinematics at reported angles is that of the nominal one at true angles.

    Each joint's origin is turned by its offset about its axis, or shifted along it for a prismatic
    joint, and its limits are shifted the other way, so that they still stop the arm in the same
    places. A joint that mimics one of them follows the true angle. Elements that name the joints
    elsewhere (``<transmission>``, ``<ros2_control>``, ``<gazebo>``) refer to reported angles and
    stay as they are.

    Parameters
    ----------
    urdf
        Text of the nominal robot from which `chain` was read.
    chain
        Its joints.
    joint_offsets
        rad, m for prismatic joints, (k,).
    notes
        Further comments in the file, such as the joints left out.
    geometry
        Changes of the joints' origins in addition to the offsets.
    """
    root = parsed_xml(urdf)
    # The robot's own children: a <transmission> or <ros2_control> has joints of the same names.
    joints = {joint.get('name'): joint for joint in root.findall('joint')}
    for i, (name, axis, offset) in enumerate(
        zip(chain.joint_names, chain.axes, joint_offsets, strict=True)
    ):
        shift, turn = np.zeros(3), np.zeros(3)
        if geometry is not None:
            shift, turn = geometry.shifts[i], geometry.turns[i]
        if offset == 0.0 and not np.any(shift) and not np.any(turn):
            continue
        joint = joints[name]
        origin = joint.find('origin')
        if origin is None:
            origin = ElementTree.Element('origin', xyz='0 0 0', rpy='0 0 0')
            joint.insert(0, origin)
        rpy = [float(angle) for angle in origin.get('rpy', '0 0 0').split()]
        drawn = matrix_from_rpy(rpy)
        turned = drawn @ rotation_vector_to_matrix(turn)
        along = np.zeros(3)
        if chain.slides[i]:
            along = turned @ (offset * axis)
        else:
            turned = turned @ rotation_vector_to_matrix(offset * axis)
        origin.set('rpy', ' '.join(repr(angle) for angle in rpy_of(turned)))
        if np.any(shift) or np.any(along):
            # From the link that the joint before moves, through fixed joints, to the parent link.
            to_parent = drawn @ chain.T_fixed[i][:3, :3].T
            xyz = [float(value) for value in origin.get('xyz', '0 0 0').split()]
            origin.set('xyz', ' '.join(repr(float(v)) for v in xyz + to_parent @ shift + along))
        for tag, keys in _LIMITS.items():
            for element in joint.findall(tag):
                for key in keys.intersection(element.keys()):
                    element.set(key, repr(float(element.attrib[key]) - float(offset)))
        for other in joints.values():
            for mimic in other.findall('mimic'):
                if mimic.get('joint') == name:
                    share = float(mimic.get('multiplier', '1')) * float(offset)
                    mimic.set('offset', repr(float(mimic.get('offset', '0')) + share))
    first = []
    if np.any(joint_offsets):
        first.append('joint origins and limits hold the calibrated zero-offsets')
    if geometry is not None and geometry.is_any:
        first.append('joint origins hold the lengths and tilts that were found')
    return xml_text(urdf, root, (*(first or ['nothing is changed']), *notes))


def parsed_xml(text: str) -> ElementTree.Element:
    """Root element of a description, with its comments; raises ElementTree.ParseError."""
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    return ElementTree.fromstring(text, parser)


def xml_text(before: str, root: ElementTree.Element, notes: Sequence[str]) -> str:
    """Text of a changed description, with notes as comments in it and the prolog of the original.

    ``before``: original text; ``root``: root element of the changed description, in which the
    comments become the first children; ``notes``: a comment each.
    """
    for text in reversed(notes):
        # Two hyphens would end the comment.
        note = ElementTree.Comment(f' {re.sub("-(?=-)", "- ", text).rstrip("-")} ')
        note.tail = '\n  '
        root.insert(0, note)
    # What stands before the root (who made the model, under which licence) is no part of the tree.
    prolog = _PROLOG.match(before)
    head = prolog.group() if prolog else ''
    return head + ElementTree.tostring(root, encoding='unicode') + '\n'


def rpy_of(rotation: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch, yaw of R = Rz(yaw) Ry(pitch) Rx(roll), exact at pitch ±90° too.

    The roll is taken after undoing the yaw, so that at pitch ±90°, where both act alike, an error
    of one is corrected by the other.
    """
    R = rotation
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return float(roll), float(pitch), float(yaw)
