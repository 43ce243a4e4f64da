# SPDX-License-Identifier: Apache-2.0
"""Registrations as static transforms of tf2: a launch file and a message in YAML.

A sensor that stands is a child of the arm's base; a sensor on the tool is a child of the tool, and
the board that it sees a child of the base.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np
from msgspec import UNSET

from remaster_ros.compensation.file import Compensation
from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.types import FloatArray

TF = 'tf'
LAUNCH_FILE = 'static_transforms.launch.xml'
MESSAGE_FILE = 'static_transforms.yaml'
# Suffix of the frame of the board that a sensor on the tool sees.
BOARD = '_board'
# Names that a launch line and a YAML need no quotes for; tf2 refuses a leading slash.
FRAME = re.compile(r'[A-Za-z_][A-Za-z0-9_./-]*')
_HEAD = (
    'Made by remaster export, form tf. Right with the whole correction in use that it was',
    'exported of: the zero-offsets of the outer joints belong to these transforms.',
    'No other node may publish the same child frames.',
)


@dataclass(frozen=True)
class StaticTransform:
    """Pose of a child frame in its parent frame, with standard deviations per axis."""

    parent: str
    child: str
    translation_m: tuple[float, ...]
    rotation_xyzw: tuple[float, ...]
    std_m: tuple[float, ...]
    std_rad: tuple[float, ...]

    @property
    def arguments(self) -> str:
        """Command line of ``static_transform_publisher``."""
        names = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
        values = zip(names, (*self.translation_m, *self.rotation_xyzw), strict=True)
        numbers = ' '.join(f'--{name} {value:.9f}' for name, value in values)
        return f'{numbers} --frame-id {self.parent} --child-frame-id {self.child}'

    @property
    def words(self) -> str:
        """Line of text with the two frames and the standard deviations, mm and degrees."""
        mm = ' '.join(f'{1e3 * value:.3f}' for value in self.std_m)
        degrees = ' '.join(f'{value:.4f}' for value in np.degrees(self.std_rad))
        return f'{self.parent} -> {self.child}: std x y z {mm} mm, about x y z {degrees} deg'


def static_transforms(
    compensation: Compensation, frames: Mapping[str, str]
) -> list[StaticTransform]:
    """Transforms of every sensor of a correction; of one on the tool, also that of its target.

    Parameters
    ----------
    compensation
        Correction with the registrations.
    frames
        Sensor -> name of its frame in tf; the sensor's name if absent.

    Raises
    ------
    InputError
        No such sensor, a name that tf2 does not accept or that two frames have, a sensor on the
        tool whose rotation is unknown, or a file of an earlier version, in which it is not stated
        which sensors are on the tool.
    """
    content = compensation.content
    for sensor in frames:
        if sensor not in content.base_frame:
            known = ', '.join(content.base_frame)
            meant = did_you_mean(sensor, content.base_frame)
            raise InputError(f'--frame: {sensor!r} is not among the sensors ({known}){meant}')
    if content.on_tool is UNSET:
        raise InputError(
            f'{compensation.path}: made by an earlier version, it does not tell which sensors are '
            'on the tool; fit the session again and export the new file'
        )
    base, tip = content.robot.base_link, content.robot.tip_link
    model = compensation.model
    root = model.widening * model.root
    found = []
    for sensor, there in content.base_frame.items():
        child, mount = frames.get(sensor, sensor), content.on_tool.get(sensor)
        if mount is not None:
            if mount.rotation_xyzw is UNSET or mount.std_rad is UNSET:
                raise InputError(
                    f'{compensation.path}: how {sensor} is turned on the tool is not in this file '
                    '(discover, and a fit without orientations, use positions alone); export the '
                    'compensation.json of a remaster fit with orientations'
                )
            found.append(
                StaticTransform(
                    tip,
                    child,
                    content.tool[mount.marker].position_m,
                    mount.rotation_xyzw,
                    _std(root[:, model.marker(mount.marker)]),
                    tuple(model.widening * value for value in mount.std_rad),
                )
            )
            child = f'{child}{BOARD}'
        shift, turn = (root[:, where] for where in model.registration(sensor))
        # The file has shifts of the base frame at its own origin; the child's origin also moves
        # by the turns, at the lever of its distance.
        moved = shift + np.cross(turn, there.translation_m)
        found.append(
            StaticTransform(
                base, child, there.translation_m, there.rotation_xyzw, _std(moved), _std(turn)
            )
        )
    names = [base, tip, *(transform.child for transform in found)]
    for name in names:
        if not FRAME.fullmatch(name):
            raise InputError(
                f'{name!r} is no name for a frame of tf2 here (letters, digits and _ . / -): name '
                "the sensor's by --frame SENSOR=FRAME"
            )
    if twice := next((name for name in names[2:] if names.count(name) > 1), ''):
        raise InputError(f'two frames have the name {twice!r}; give another by --frame')
    return found


def _std(root: FloatArray) -> tuple[float, ...]:
    """Standard deviations (p,) of parameters with covariance U' U; U is (r, p)."""
    return tuple(np.linalg.norm(root, axis=0).tolist())


def transform_files(transforms: list[StaticTransform]) -> dict[str, str]:
    """Launch file and tf2_msgs/TFMessage (YAML) of static transforms, name -> text."""
    nodes = [
        f'  <node pkg="tf2_ros" exec="static_transform_publisher" '
        f'name={quoteattr(_node_name(transform.child))}\n'
        f'        args={quoteattr(transform.arguments)}/>'
        for transform in transforms
    ]
    comment = [f'  {line}' for line in (*_HEAD, *(transform.words for transform in transforms))]
    launch = ['<launch>', '  <!--', *comment, '  -->', *nodes, '</launch>', '']
    lines = [
        *(f'# {line}' for line in _HEAD),
        '# A tf2_msgs/TFMessage for /tf_static (durability transient_local).',
        'transforms:',
    ]
    for transform in transforms:
        x, y, z = transform.translation_m
        qx, qy, qz, qw = transform.rotation_xyzw
        lines += [
            f'# {transform.words}',
            f"- header: {{frame_id: '{transform.parent}'}}",
            f"  child_frame_id: '{transform.child}'",
            '  transform:',
            f'    translation: {{x: {x:.9f}, y: {y:.9f}, z: {z:.9f}}}',
            f'    rotation: {{x: {qx:.9f}, y: {qy:.9f}, z: {qz:.9f}, w: {qw:.9f}}}',
        ]
    return {LAUNCH_FILE: '\n'.join(launch), MESSAGE_FILE: '\n'.join([*lines, ''])}


def _node_name(frame: str) -> str:
    """Node name of a frame: characters other than letters and digits become '_'."""
    return 'static_transform_of_' + re.sub(r'[^A-Za-z0-9_]', '_', frame)
