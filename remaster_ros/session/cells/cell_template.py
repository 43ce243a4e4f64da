# SPDX-License-Identifier: Apache-2.0
"""Text of a new cell file: every key with its meaning, and why its value is proposed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import PoseRanges
from remaster_ros.planning.cell_proposal import HeldJoint, Reach
from remaster_ros.session.cells.workcell import CellSensor
from remaster_ros.session.strict_yaml import load_yaml

_PLAIN = re.compile(r'[A-Za-z/.][\w./+-]*')


ANYWHERE = (0.0, 0.0, 0.0)
SENSORS = {
    'tracker': CellSensor(
        'smr',
        'laser_tracker/marker',
        ANYWHERE,
        single_shot=True,
        measure_service='laser_tracker/measure',
        max_angle_deg=25.0,
    ),
    'mocap': CellSensor('sir', 'optitrack/marker', ANYWHERE, max_angle_deg=60.0),
}
"""Sensors of a new cell; their positions are proposed."""


@dataclass(frozen=True)
class CellProposal:
    """Proposed values for a new cell file: arm, held joint, ranges of poses, sensors, meshes."""

    source: str
    urdf: str  # As the cell file is to name it
    chain: SerialChain
    tips: Sequence[str]  # Links that may be the tool frame, the proposed one first
    before: Sequence[str]  # Joints that carry the whole arm, such as a rail's
    held: HeldJoint
    reach: Reach
    ranges: PoseRanges
    kept: str  # What became of poses everywhere around the arm; '' before it is known
    marker_z: float  # Where the markers are along the tool's Z axis, m
    link_radius: float  # How thick links are, m
    sensor_R: Sequence[float]  # Rough place of the sensors in the base, m, (3,)
    sensors: Sequence[str]  # Names among `SENSORS`
    # Of each of them, between the tool's Z axis and the line to it
    max_angle_deg: Mapping[str, float]
    # Folders in which meshes were found, and the meshes that were not
    mesh_path: Sequence[str]
    missing_meshes: Sequence[str]
    floor_z: float | None


def rail_advice(before: Sequence[str], base_link: str) -> str:
    """Return a sentence that advises to leave joints before the arm, such as a rail, unmoved.

    ``before``: names of these joints, at least one; ``base_link``: link where the arm begins.
    """
    return (
        f'{", ".join(before)} carries the whole arm, and is no joint of it here: leave it where '
        f'it is until everything is measured; the result is of the arm from {base_link} on'
    )


def cell_text(p: CellProposal) -> str:
    """Return the YAML text of a cell file, with a comment on every key that needs a check."""
    chain, ranges = p.chain, p.ranges
    other_tips = ', '.join(tip for tip in p.tips if tip != chain.tip_link)
    limits = ', '.join(
        f'{name} {chain.shown_limits(joint)}{" mm" if chain.slides[joint] else ""}'
        for joint, name in enumerate(chain.joint_names)
    )
    azimuth = np.degrees(ranges.azimuth_rad)
    parts = [
        *_comment(
            f'A cell for {chain.name}, proposed by "remaster init {p.source}". Lines marked CHECK '
            'need your eyes: what they state cannot be read from a robot description. Lengths in '
            'metres; angles in degrees where the name has deg. Every key: config/cells/demo.yaml.'
        ),
        '',
        *_comment(
            'The markers are in the frame of tip_link; its Z axis faces the sensor.'
            + (f' Other links behind the last joint: {other_tips}.' if other_tips else '')
        ),
        *_comment(f'Joints between base_link and tip_link, limits in degrees: {limits}.'),
        *(_comment(rail_advice(p.before, chain.base_link) + '.') if p.before else []),
        'robot:',
        f'  urdf: {_value(p.urdf)}   # relative to this file',
        f'  base_link: {_value(chain.base_link)}',
        f'  tip_link: {_value(chain.tip_link)}',
        '',
        *_held_lines(p),
        '',
        *_comment(
            'CHECK: nominal marker positions in tip_link, and how well they are known per axis. '
            'Proposed: in front of the last link, clear of it.'
        ),
        'markers:',
        *(f'  {SENSORS[name].marker}: [0.0, 0.0, {p.marker_z:.2f}]' for name in p.sensors),
        'marker_std_m: 0.002',
        '',
        *_comment(
            'CHECK: where a sensor stands, in base_link; 0.3 m is good enough. It turns the tool '
            'to it for the first three poses, after which the place is measured. Proposed: in '
            f'front of the arm, which reaches {p.reach.reach_m:.2f} m.'
        ),
        'sensors:',
        *(line for name in p.sensors for line in _sensor_lines(name, p)),
        '',
        *_comment("The tool's Z axis points at this sensor."),
        f'aim_at: {p.sensors[0]}',
        '',
        *_comment(
            'CHECK that this space is free: ranges of the poses, about the Z axis of base_link. '
            + p.kept
        ),
        'poses:',
        f'  azimuth_deg: [{azimuth[0]:.1f}, {azimuth[1]:.1f}]',
        f'  radius_m: [{ranges.radius_m[0]:.2f}, {ranges.radius_m[1]:.2f}]',
        f'  height_m: [{ranges.height_m[0]:.2f}, {ranges.height_m[1]:.2f}]',
        '  roll_deg: [0.0, 360.0]',
        '',
        *_comment('CHECK: what the arm must not hit. Boxes in base_link, by name:'),
        '#   table: {center_m: [0.8, 0.0, 0.2], size_m: [0.5, 1.0, 0.4], yaw_deg: 15.0}',
        'obstacles: {}',
        *_comment(
            'CHECK: how thick links are for the line of sight, and for collisions where the robot '
            'description has no geometry. A marker nearer to the last joint counts as hidden.'
        ),
        f'link_radius_m: {p.link_radius:.3f}',
        *_comment('In base_link; null where there is none (an arm that hangs).'),
        f'floor_z_m: {_value(p.floor_z)}',
        *_comment('CHECK: parts of the tool that the robot description has not, in tip_link:'),
        '#   plate: {size_m: [0.2, 0.04, 0.01], center_m: [0.0, 0.0, 0.005]}',
        'tool: {}',
        '',
        *_mesh_lines(p),
        '',
        *_comment(
            'The nodes draw their plan on a page, and the arm waits until somebody has looked at '
            'it and called /remaster/confirm. false: /remaster/collect alone moves it.'
        ),
        'confirm: true',
        '',
    ]
    return '\n'.join(parts)


def _held_lines(p: CellProposal) -> list[str]:
    """Return the YAML lines of the held joint: its name and values, with the reason as comment.

    ``held_joint: ''`` if none is held.
    """
    held_joint, chain = p.held, p.chain
    if held_joint.joint is None:
        text = (
            f'no joint is held. A pose has {held_joint.solutions:.1f} joint solutions on average.'
        )
        how = held_joint.kinematics.in_words()
        count = {3: 'Three', 4: 'Four', 5: 'Five'}.get(len(chain), 'Six')
        return [*_comment(f'{count} joints: {text} {how}'), "held_joint: ''"]
    tried = ', '.join(
        f'{name} {count:.1f}' if isinstance(count, float) else f'{name} none ({count})'
        for name, count in held_joint.tried.items()
    )
    values = (
        f'held_values_deg: [{", ".join(f"{np.degrees(v):.1f}" for v in held_joint.values_held)}]'
    )
    if chain.slides[held_joint.joint]:
        values = (
            f'held_values_m: [{", ".join(f"{value:.3f}" for value in held_joint.values_held)}]'
        )
    return [
        *_comment(
            'Seven joints leave one free: this one is held, which gives poses the most joint '
            f'solutions. Tried, solutions of a pose on average: {tried}. Several values give more '
            'poses, and determine the offset of this joint better. '
            + held_joint.kinematics.in_words()
        ),
        f'held_joint: {_value(chain.joint_names[held_joint.joint])}',
        values,
    ]


def _sensor_lines(name: str, p: CellProposal) -> list[str]:
    """Return the YAML lines of a sensor, with its proposed rough position and viewing angle.

    ``name``: of the sensor, a key of `SENSORS`; ``p``: has the proposals.
    """
    sensor, place, angle = SENSORS[name], p.sensor_R, p.max_angle_deg[name]
    why = 'a retroreflector' if sensor.single_shot else 'a sphere is seen from far round'
    if angle > sensor.max_angle_deg:
        why = 'CHECK: the arm cannot turn its tool to the sensor; it is to see the marker so'
    service = [f'    measure_service: {sensor.measure_service}'] if sensor.measure_service else []
    return [
        f'  {name}:',
        f'    marker: {sensor.marker}',
        f'    topic: {sensor.topic}',
        f'    single_shot: {_value(sensor.single_shot)}',
        *service,
        f'    rough_position_m: [{", ".join(f"{value:.1f}" for value in place)}]',
        f'    max_angle_deg: {angle}   # {why}',
    ]


def _mesh_lines(p: CellProposal) -> list[str]:
    """Return the YAML lines of the mesh path, with the missing meshes as comments."""
    lines = _comment('Folders in which the meshes are that the robot description names.')
    if p.missing_meshes:
        lines += _comment(
            'CHECK: these were not found; give the folder of their package here (--package-path):'
        )
        lines += [f'#   {name}' for name in p.missing_meshes]
    if not p.mesh_path:
        return [*lines, 'mesh_path: []']
    return [*lines, 'mesh_path:', *(f'  - {_value(folder)}' for folder in p.mesh_path)]


def _comment(text: str) -> list[str]:
    """Return a text as comment lines of at most 99 columns."""
    return [f'# {line}' for line in wrap(text, 97, break_long_words=False)]


def _value(value: str | float | bool | None) -> str:
    """Return a value as YAML: plain text if it is read back as that text, else as JSON."""
    if isinstance(value, str) and _PLAIN.fullmatch(value) and load_yaml(value) == value:
        return value
    return json.dumps(value)
