# SPDX-License-Identifier: Apache-2.0
"""Cells for the judgement of paths: three robots, low poses, held values, long tools, boxes.

Meshes are made of cylinders and boxes. Each cell is written as a user would write it: a URDF, mesh
files, a cell file. The model under test reads those; the judge gets the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from judges.paths import BulletJudge, FclJudge, Judge, Part

from remaster_ros.kinematics.transforms import matrix_from_rpy, transform
from remaster_ros.session.cells.workcell import Workcell, config_path, read_cell
from remaster_ros.types import FloatArray

# Where each arm's wrist reaches with the tool level.
RADIUS = {'lwr': [0.2, 0.5], 'iiwa': [0.4, 0.7], 'six': [0.3, 0.65]}
NORMAL, LOW = [0.4, 0.8], [0.1, 0.6]
MARKERS = {'sir': [0.1, 0.0, 0.0], 'smr': [-0.1, 0.0, 0.0]}
LONG_TOOL = {'probe': {'radius_m': 0.02, 'length_m': 0.25, 'center_m': [0.0, 0.0, 0.125]}}
BOXES = {
    'table': {'center_m': [0.62, 0.0, 0.1], 'size_m': [0.4, 0.9, 0.2], 'yaw_deg': 10.0},
    'post': {'center_m': [-0.35, 0.45, 0.5], 'size_m': [0.08, 0.08, 1.0], 'yaw_deg': 30.0},
}


@dataclass(frozen=True)
class CellSpec:
    """What makes a cell: the robot's name, heights of poses, values of joint 3, tool, boxes."""

    name: str
    robot: str
    height: list[float] = field(default_factory=lambda: NORMAL)
    held: tuple[float, ...] = (0.0,)
    tool: dict[str, dict[str, object]] = field(default_factory=dict)
    boxes: dict[str, dict[str, object]] = field(default_factory=dict)


THREE = (-60.0, 0.0, 60.0)
SPECS = (
    CellSpec('LWR 4+', 'lwr'),
    CellSpec('LWR 4+, low', 'lwr', LOW),
    CellSpec('LWR 4+, low, 3 held values', 'lwr', LOW, THREE),
    CellSpec('LWR 4+, 250 mm tool', 'lwr', NORMAL, tool=LONG_TOOL),
    CellSpec('LWR 4+, low, 250 mm tool, boxes', 'lwr', LOW, tool=LONG_TOOL, boxes=BOXES),
    CellSpec('iiwa', 'iiwa'),
    CellSpec('iiwa, low, 3 held values', 'iiwa', LOW, THREE),
    CellSpec('iiwa, low, 250 mm tool', 'iiwa', LOW, tool=LONG_TOOL),
    CellSpec('iiwa, low, boxes', 'iiwa', LOW, boxes=BOXES),
    CellSpec('6R', 'six'),
    CellSpec('6R, low, 250 mm tool', 'six', LOW, tool=LONG_TOOL),
    CellSpec('6R, low, boxes', 'six', LOW, boxes=BOXES),
)


def _cylinder(radius: float, start: FloatArray, end: FloatArray) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, segment=np.array([start, end]), sections=24)


def _merged(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


def _six_urdf(folder: Path) -> tuple[str, list[Part]]:
    """Return an arm of the UR5's lengths with offset joints, its links meshes in STL files."""
    # Joint: origin and rpy in the parent link, limits (deg); the links' outlines follow.
    joints = (
        ((0, 0, 0.089), (0, 0, 0), 175),
        ((0, 0.136, 0), (0, np.pi / 2, 0), 175),
        ((0, -0.1197, 0.425), (0, 0, 0), 160),
        ((0, 0, 0.392), (0, np.pi / 2, 0), 175),
        ((0, 0.12, 0), (0, 0, 0), 175),
        ((0, 0, 0.0947), (0, 0, 0), 175),
    )
    axes = ('0 0 1', '0 1 0', '0 1 0', '0 1 0', '0 0 1', '0 1 0')
    o = np.zeros(3)
    outlines = {
        'base_link': [_cylinder(0.075, o, np.array([0, 0, 0.04]))],
        'link_1': [
            _cylinder(0.06, np.array([0, 0, -0.045]), np.array([0, 0, 0.055])),
            _cylinder(0.055, o, np.array([0, 0.07, 0])),
        ],
        'link_2': [
            _cylinder(0.058, np.array([0, -0.06, 0]), np.array([0, 0.06, 0])),
            _cylinder(0.05, o, np.array([0, 0, 0.425])),
            _cylinder(0.052, np.array([0, -0.055, 0.425]), np.array([0, 0.055, 0.425])),
        ],
        'link_3': [
            _cylinder(0.045, np.array([0, -0.055, 0]), np.array([0, 0.05, 0])),
            _cylinder(0.04, o, np.array([0, 0, 0.392])),
            _cylinder(0.04, np.array([0, -0.035, 0.392]), np.array([0, 0.035, 0.392])),
        ],
        'link_4': [_cylinder(0.038, np.array([0, 0.045, 0]), np.array([0, 0.155, 0]))],
        'link_5': [_cylinder(0.038, np.array([0, 0, 0.045]), np.array([0, 0, 0.13]))],
        'link_6': [_cylinder(0.036, np.array([0, 0.045, 0]), np.array([0, 0.0823, 0]))],
    }
    parts, elements = [], []
    for name, meshes in outlines.items():
        mesh = _merged(meshes)
        mesh.export(folder / f'{name}.stl')
        parts.append(Part(name, name, np.array(mesh.vertices), np.array(mesh.faces)))
        elements.append(
            f'<link name="{name}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" '
            'iyy="1" iyz="0" izz="1"/></inertial><collision><geometry>'
            f'<mesh filename="package://six_description/{name}.stl"/></geometry></collision></link>'
        )
    parent = 'base_link'
    for i, ((xyz, rpy, limit), axis) in enumerate(zip(joints, axes), start=1):
        bound = np.deg2rad(limit)
        elements.append(
            f'<joint name="joint_{i}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{i}"/><origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>'
            f'<axis xyz="{axis}"/><limit lower="{-bound}" upper="{bound}" velocity="3.14" '
            'effort="100"/></joint>'
        )
        parent = f'link_{i}'
    elements.append(
        '<link name="tool"/><joint name="tool_joint" type="fixed"><parent link="link_6"/>'
        f'<child link="tool"/><origin xyz="0 0.0923 0" rpy="{-np.pi / 2} 0 0"/></joint>'
    )
    return '<robot name="six">' + ''.join(elements) + '</robot>', parts


def _iiwa_urdf(folder: Path, spec: CellSpec) -> str:
    """Return PyBullet's iiwa with a tool frame; meshes by their full names."""
    bullet = pytest.importorskip('pybullet_data', reason='needs the judge: pip install pybullet')
    source = Path(bullet.getDataPath()) / 'kuka_iiwa'
    text = (source / 'model.urdf').read_text(encoding='utf-8')
    text = text[text.index('<robot') :].replace('"meshes/', f'"file://{source}/meshes/')
    tool = (
        '<link name="tool"/><joint name="tool_joint" type="fixed"><parent link="lbr_iiwa_link_7"/>'
        '<child link="tool"/><origin xyz="0 0 0.095"/></joint>'
    )
    return text.replace('</robot>', tool + '</robot>')


def _bullet_urdf(text: str, spec: CellSpec, marker_radius: float, link_radius: float) -> str:
    """Return the same for PyBullet: real file names, the tool's parts as collision geometry."""
    shapes = []
    for part in spec.tool.values():
        shapes.append(
            f'<collision><origin xyz="{_text(part["center_m"])}"/><geometry><cylinder '
            f'radius="{part["radius_m"]}" length="{part["length_m"]}"/></geometry></collision>'
        )
    for place in MARKERS.values():
        shapes.append(
            f'<collision><origin xyz="{_text(place)}"/><geometry>'
            f'<sphere radius="{marker_radius}"/></geometry></collision>'
        )
    inertial = (
        '<inertial><mass value="0.1"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" '
        'izz="1e-3"/></inertial>'
    )
    return text.replace('file://', '').replace(
        '<link name="tool"/>', f'<link name="tool">{inertial}{"".join(shapes)}</link>'
    )


def _lwr_parts(cell: Workcell) -> list[Part]:
    """Return cylinders of 60 mm along the links: the arm as it may be, in capsules of 75 mm.

    The forearm ends before the wrist and the flange is slender, as on the arm itself, whose wrist
    turns by 120 degrees without touching the forearm.
    """
    chain = cell.chain()
    names = ['base_link', *(f'link_{i}' for i in range(1, 8))]
    parts = []
    for link, name in enumerate(names):
        end = chain.T_fixed[link][:3, 3]
        share, radius = {5: (0.5, 0.06), 7: (1.0, 0.04)}.get(link, (1.0, 0.06))
        mesh = _cylinder(radius, np.zeros(3), share * end)
        parts.append(Part(name, name, np.array(mesh.vertices), np.array(mesh.faces)))
    return parts


def _tool_parts(spec: CellSpec, marker_radius: float) -> list[Part]:
    meshes = {
        f'marker {name}': trimesh.creation.icosphere(
            subdivisions=2, radius=marker_radius
        ).apply_translation(place)
        for name, place in MARKERS.items()
    }
    for name, part in spec.tool.items():
        mesh = trimesh.creation.cylinder(part['radius_m'], part['length_m'], sections=24)
        meshes[name] = mesh.apply_translation(part['center_m'])
    return [Part(n, 'tool', np.array(m.vertices), np.array(m.faces)) for n, m in meshes.items()]


def _box_parts(spec: CellSpec) -> list[Part]:
    parts = []
    for name, box in spec.boxes.items():
        T = transform(
            matrix_from_rpy(np.deg2rad([0, 0, box['yaw_deg']])), np.array(box['center_m'])
        )
        mesh = trimesh.creation.box(box['size_m'], transform=T)
        parts.append(Part(name, '', np.array(mesh.vertices), np.array(mesh.faces)))
    return parts


def make_cell(spec: CellSpec, folder: Path) -> tuple[Workcell, Judge]:
    """Write a cell into a folder, read it as the planner does, and return it with its judge."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = {'urdf': 'robot.urdf', 'base_link': 'base_link', 'tip_link': 'tool'}
    parts: list[Part] = []
    meshes = folder / 'six_description'
    if spec.robot == 'lwr':
        text = config_path('robots/lwr4plus.urdf').read_text(encoding='utf-8')
    elif spec.robot == 'six':
        meshes.mkdir(exist_ok=True)
        text, parts = _six_urdf(meshes)
    else:
        text = _iiwa_urdf(folder, spec)
        robot['base_link'] = 'lbr_iiwa_link_0'
    (folder / 'robot.urdf').write_text(text, encoding='utf-8')
    joint_3 = {'lwr': 'joint_3', 'iiwa': 'lbr_iiwa_joint_3', 'six': ''}[spec.robot]
    demo = yaml.safe_load(config_path('cells/demo.yaml').read_text(encoding='utf-8'))
    demo |= {
        'robot': robot,
        'held_joint': joint_3,
        'held_values_deg': list(spec.held) if joint_3 else [],
        'markers': MARKERS,
        'tool': spec.tool,
        'obstacles': spec.boxes,
    }
    demo['poses'] |= {'height_m': spec.height, 'radius_m': RADIUS[spec.robot]}
    path = folder / 'cell.yaml'
    path.write_text(yaml.safe_dump(demo), encoding='utf-8')
    cell = read_cell(path)
    chain = cell.chain()
    if spec.robot == 'iiwa':
        bullet = folder / 'bullet.urdf'
        bullet.write_text(_bullet_urdf(text, spec, cell.marker_radius_m, cell.link_radius_m))
        boxes = [
            (b['center_m'], b['size_m'], np.deg2rad(b['yaw_deg'])) for b in spec.boxes.values()
        ]
        return cell, BulletJudge(bullet, chain.joint_names, boxes)
    if spec.robot == 'lwr':
        parts = _lwr_parts(cell)
    parts = [*parts, *_tool_parts(spec, cell.marker_radius_m), *_box_parts(spec)]
    return cell, FclJudge(text, chain.joint_names, parts)


def _text(numbers: object) -> str:
    return ' '.join(f'{float(number):.12g}' for number in numbers)  # type: ignore[attr-defined]
