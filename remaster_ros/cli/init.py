# SPDX-License-Identifier: Apache-2.0
"""Write a workcell file for a robot, with what is proposed and why."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from remaster_ros.cli.console import progress_bar, show, tell
from remaster_ros.cli.options import CANDIDATES, add_description, names, number, xacro_arguments
from remaster_ros.cli.plan import free_start
from remaster_ros.errors import InputError, InsufficientDataError, did_you_mean
from remaster_ros.kinematics.arm_ends import likely_base, likely_tips, moving_before
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS, InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.kinematics.urdf_geometry import chain_bodies, mesh_names
from remaster_ros.planning.candidates import Plan, PlanningScene, candidate_poses, reachable_poses
from remaster_ros.planning.cell_proposal import (
    facing_angle_deg,
    link_radius,
    marker_height,
    propose_held_joint,
    ranges_around,
    reach_of,
    widest_ranges,
)
from remaster_ros.planning.collection_plan import FITTED, count_with_free_path, rough_collection
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.reports.plan_json import outlook_text, outlook_to_dict
from remaster_ros.session.cells.cell_template import SENSORS, CellProposal, cell_text, rail_advice
from remaster_ros.session.cells.meshes import find_mesh, mesh_reader
from remaster_ros.session.cells.packages import package_of
from remaster_ros.session.cells.robot_description import is_xacro, read_description
from remaster_ros.session.cells.workcell import LINK_RADIUS_M, Workcell, parse_cell
from remaster_ros.session.files import (
    URDF_LIMIT,
    make_folder,
    read_limited,
    undone_on_failure,
    write_atomically,
)

# Tool poses for the comparison of held joints; candidate poses for the ranges.
COMPARED = 80
TRIED = 200
# Least number of usable poses that determine ranges.
FEWEST = 12
# Poses to fit: places of sensor and marker and six offsets are 15 unknowns, for which five poses
# give as many readings; ten leave as many to tell how well they agree.
FEWEST_FITTED = 10
# Distance of the proposed sensor from the workspace, m.
SENSOR_BEHIND_M = 1.2
REMEDY = 'give another name with --out'
# Parameters that the user has to set before the arm moves; no description has them.
ASKED = (
    'does the robot publish that its own safety stops it (std_msgs/Bool)? set '
    'emergency_stop_topic of robot_bridge in your copy of real.yaml to that topic, or to none: '
    'then a person goes on after every interruption; robot_bridge does not start without it'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster init``."""
    parser.add_argument('robot', metavar='FILE', type=Path, help='robot.urdf or robot.urdf.xacro')
    parser.add_argument(
        'arguments', metavar='NAME:=VALUE', nargs='*', help='arguments of a xacro file'
    )
    parser.add_argument(
        '--out', metavar='CELL', type=Path, default=Path('cell.yaml'), help='default: cell.yaml'
    )
    parser.add_argument('--base-link', metavar='LINK', help='frame R (default: the likely one)')
    parser.add_argument('--tip-link', metavar='LINK', help='frame T (default: the likely one)')
    add_description(parser)
    parser.add_argument(
        '--sensors',
        metavar='NAME,…',
        type=names,
        default=('tracker',),
        help=f'of {", ".join(SENSORS)} (default: tracker)',
    )
    parser.add_argument(
        '--sensor-at',
        metavar=('X', 'Y', 'Z'),
        type=number(-200.0, 200.0, 'm'),
        nargs=3,
        help='where it stands in the base link, m, roughly (default: in front of the arm)',
    )
    parser.add_argument('--no-floor', action='store_true', help='the arm hangs, or stands high')
    parser.add_argument(
        '--no-plan', action='store_true', help='write the cell file, and do not plan in it'
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def run(args: argparse.Namespace) -> int:
    """Propose a cell for the robot, write the cell file, and plan in it; return 0.

    Raises InputError for an invalid robot, an unknown sensor or a file that is there already;
    InsufficientDataError if fewer than `FEWEST_FITTED` poses are usable: then the file remains.
    """
    for sensor in args.sensors:
        if sensor not in SENSORS:
            meant = did_you_mean(sensor, SENSORS)
            raise InputError(f'--sensors: {sensor!r} is none of {", ".join(SENSORS)}{meant}')
    if args.out.exists():
        raise InputError(f'{args.out}: already there, and not overwritten; {REMEDY}')
    rng = np.random.default_rng(args.seed)
    with undone_on_failure(), progress_bar(args.quiet or args.json) as progress:
        progress('reading', 0.0)
        description = read_description(
            args.robot, xacro_arguments(args.arguments), args.package_path, trusted=args.trust
        )
        urdf = _urdf_file(args.robot, args.out, description)
        make_folder(args.out.parent)
        if urdf != args.robot:
            write_atomically(urdf, description)
        progress('trying', 0.1)
        widest = _propose(args, description, urdf, rng)
        progress('planning', 0.4)
        proposal, tried = _narrowed(widest, _cell(widest, args.out), rng)
        write_atomically(args.out, cell_text(proposal))
        progress('planning', 0.7)
        cell, missing = _cell(proposal, args.out), bool(proposal.missing_meshes)
        planned: dict[str, Any] = {}
        text = ''
        if args.no_plan:
            scene = cell.planning_scene(cell.chain(), without_meshes=missing)
            tour = Tour(scene.model.chain, {FITTED: tried}, model=scene.model)
            reached, of = _reached(scene, tour, args.seed)
        else:
            planned, text, (reached, of) = _plan(cell, missing, args.seed)
    written = f'written: {args.out}; look at its lines marked CHECK\n{ASKED}'
    tell(args, _as_json(args.out, proposal) | planned, _as_text(proposal), text, written)
    if reached < FEWEST_FITTED:
        # The file remains, so that the user can correct it.
        found = f'{reached} poses can be planned in this cell'
        if reached < of:
            found = f'a free way leads to {reached} of the {of} poses that were tried in this cell'
        geometry = ', or give what slides its collision geometry in the URDF'
        raise InsufficientDataError(
            f'{args.out}: {found}, and a calibration needs {FEWEST_FITTED}; correct its lines '
            'marked CHECK (place of the sensor, markers, floor, thickness of links)'
            f'{geometry * bool(proposal.chain.slides.any())}, and see whether they suffice: '
            f'remaster plan {quote(str(args.out))}'
        )
    page = f'every way, in 3-D: remaster plan {quote(str(args.out))} --out plan.html'
    show(args.quiet or args.json, page)
    return 0


def _urdf_file(robot: Path, out: Path, text: str) -> Path:
    """Return the path of the URDF that the cell will name; nothing is written.

    The given file, or, of a xacro, the file for its expansion in the folder of the cell file.
    ``robot``: given path; ``out``: path of the cell file; ``text``: the URDF.

    Raises InputError if that file exists with other content.
    """
    if not is_xacro(robot):
        return robot
    name = robot.name.removesuffix('.xacro').removesuffix('.urdf')
    urdf = out.parent / f'{name}.urdf'
    if urdf.exists() and (
        not urdf.is_file() or read_limited(urdf, URDF_LIMIT, 'it was there') != text.encode()
    ):
        raise InputError(
            f'{urdf}: already there with other content; move it, or name '
            'another folder with --out, such as new/cell.yaml'
        )
    return urdf


def _propose(
    args: argparse.Namespace, text: str, urdf: Path, rng: np.random.Generator
) -> CellProposal:
    """Return the proposed cell; InputError if poses cannot be planned for the robot.

    ``text``: URDF; ``urdf``: path that the cell will name.
    """
    try:
        model = parse_urdf(text)
        base = likely_base(model) if args.base_link is None else args.base_link
        tips = likely_tips(model, base)
        tip = tips[0] if args.tip_link is None else args.tip_link
        carrying = moving_before(model, base)
        chain = SerialChain.from_urdf(text, base, tip)
        reach = reach_of(chain, rng)
        place = args.sensor_at or [
            reach.reach_m + SENSOR_BEHIND_M,
            0.0,
            0.5 * (max(reach.low_m, 0.0) + reach.high_m),
        ]
        floor = None if args.no_floor else 0.0
        ranges = widest_ranges(reach, floor)
        at = np.array(place)
        angles = {
            name: facing_angle_deg(chain, at, SENSORS[name].max_angle_deg, rng)
            for name in args.sensors
        }
        facing = candidate_poses(COMPARED, ranges, at, rng)
        if len(chain) < FREE_JOINTS:
            angle = np.radians(angles[args.sensors[0]])
            facing = reachable_poses(chain, facing, ranges, at, angle, rng)
        held_joint = propose_held_joint(chain, facing)
    except InputError as error:
        raise InputError(f'{args.robot}: {error}') from None
    thickness = link_radius(reach, LINK_RADIUS_M)
    folders, missing = _meshes(text, args.robot, args.package_path)
    read_mesh = mesh_reader(urdf, [Path(folder) for folder in folders])
    bodies = chain_bodies(text, chain, lambda name: None if name in missing else read_mesh(name))
    return CellProposal(
        source=args.robot.name,
        urdf=os.path.relpath(urdf, args.out.parent),
        chain=chain,
        tips=tips,
        before=carrying,
        held=held_joint,
        reach=reach,
        ranges=ranges,
        kept='',
        marker_z=marker_height(chain, bodies, thickness),
        link_radius=thickness,
        sensor_R=place,
        sensors=args.sensors,
        max_angle_deg=angles,
        mesh_path=folders,
        missing_meshes=missing,
        floor_z=floor,
    )


def _meshes(text: str, robot: Path, package_path: list[Path]) -> tuple[list[str], list[str]]:
    """Return folders in which the collision meshes are found, and names of the missing ones.

    ``text``: URDF; ``robot``: its path, from which relative names count; ``package_path``:
    further folders of packages.
    """
    folders: dict[str, None] = {}
    missing = []
    for name in mesh_names(text):
        try:
            path = find_mesh(name, robot, package_path).resolve()
        except InputError:
            missing.append(name)
            continue
        package, _, relative_path = name.removeprefix('package://').partition('/')
        if name.startswith('package://'):
            folder = Path(str(path).removesuffix(relative_path))
            # The folder that holds the package, or the package where it has another name.
            folders[str(folder.parent if folder.name == package else folder)] = None
        elif not Path(name.removeprefix('file://')).is_absolute():
            folders[str(path).removesuffix(name).rstrip('/')] = None
        elif package_of(path) is None:
            # What is named by its whole path is read beside the description, not beside the cell.
            folders[str(path.parent)] = None
    return list(folders), missing


def _cell(proposal: CellProposal, out: Path) -> Workcell:
    """Return the cell of a proposal, parsed from its text."""
    return parse_cell(cell_text(proposal).encode(), out)


def _narrowed(
    p: CellProposal, cell: Workcell, rng: np.random.Generator
) -> tuple[CellProposal, Plan]:
    """Return the proposal with ranges around the usable poses, and these poses.

    Of `TRIED` candidates; if fewer than `FEWEST` are usable, the ranges stay as they are. The
    proposal's text `kept` says which of the two.
    """
    scene = cell.planning_scene(p.chain, without_meshes=bool(p.missing_meshes))
    plan = scene.plan(TRIED, scene.rough_R, rng)
    lost = ', '.join(f'{count} {why}' for why, count in plan.dropped.items())
    found = f'Of {TRIED} poses everywhere around the arm {len(plan.poses)} can be visited ({lost})'
    if len(plan.poses) < FEWEST:
        kept = f'{found}: too few to propose ranges.'
        return replace(p, kept=kept), plan
    places = np.array([pose.T_R_T[:3, 3] for pose in plan.poses])
    kept = f'{found}; these ranges are around them.'
    return replace(p, ranges=ranges_around(places), kept=kept), plan


def _reached(scene: PlanningScene, tour: Tour, seed: int) -> tuple[int, int]:
    """Return the number of poses to fit with a free path, and of those tried.

    The count ends at `FEWEST_FITTED`. ``tour``: of the poses; ``seed``: of the configuration
    that the paths start from, as in `free_start`.
    """
    return count_with_free_path(tour, scene.model, free_start(scene.model, seed), FEWEST_FITTED)


def _plan(
    cell: Workcell, without_meshes: bool, seed: int
) -> tuple[dict[str, Any], str, tuple[int, int]]:
    """Plan in the new cell; return the plan for JSON, as text, and counts of poses.

    Planned as by the nodes, with only as many paths as show whether there are any. The counts
    are those of poses to fit with a free path, and of those tried. If no pose is left to fit,
    the plan is None, with the reason, and the counts are 0.
    """
    chain = cell.chain()
    scene = cell.planning_scene(chain, without_meshes=without_meshes)
    counts = {'optimization': CANDIDATES, 'validation': CANDIDATES}
    try:
        tour, expected = rough_collection(
            TourPlanner(scene, counts, seed, design=cell.design_settings())
        )
    except InsufficientDataError as error:
        return (
            {'plan': None, 'why': str(error)},
            f'nothing can be measured like this: {error}',
            (0, 0),
        )
    text = f'planned from {sum(counts.values())} candidate poses:\n{outlook_text(tour, expected)}'
    return {'plan': outlook_to_dict(tour, expected)}, text, _reached(scene, tour, seed)


def _as_text(p: CellProposal) -> str:
    """Return the proposal as text: arm, held joint, kinematics, ranges, missing meshes."""
    chain, held_joint = p.chain, p.held
    lines = [
        f'{chain.name}: {len(chain)} joints between {chain.base_link} and {chain.tip_link}'
        + (f' (or {", ".join(p.tips[1:4])})' if len(p.tips) > 1 else ''),
        *([rail_advice(p.before, chain.base_link)] if p.before else []),
        f'reach {p.reach.reach_m:.2f} m; the sensor is taken to be at '
        f'{", ".join(f"{value:.1f}" for value in p.sensor_R)} m',
    ]
    if held_joint.joint is not None:
        values = ', '.join(
            chain.shown_offset(held_joint.joint, v, 0) for v in held_joint.values_held
        )
        lines.append(
            f'{chain.joint_names[held_joint.joint]} is held at {values}, which gives the most '
            f'joint solutions of a pose: {held_joint.solutions:.1f} on average'
        )
    lines += [held_joint.kinematics.in_words(), p.kept]
    if p.missing_meshes:
        lines.append(
            f'warning: {len(p.missing_meshes)} meshes were not found, such as '
            f'{p.missing_meshes[0]}; nothing is planned without them: give the folder of the '
            'package with --package-path, or as mesh_path in the cell file'
        )
    return '\n'.join(lines)


def _as_json(out: Path, p: CellProposal) -> dict[str, Any]:
    """Return the proposal for --json, as plain data."""
    held_joint = p.held
    return {
        'cell': str(out),
        'base_link': p.chain.base_link,
        'tip_link': p.chain.tip_link,
        'not_of_the_arm': list(p.before),
        'other_tips': [tip for tip in p.tips if tip != p.chain.tip_link],
        'held_joint': None if held_joint.joint is None else p.chain.joint_names[held_joint.joint],
        'solutions': held_joint.solutions,
        'inverse_kinematics': _kinematics_as_json(held_joint.kinematics),
        'missing_meshes': list(p.missing_meshes),
        'asks': {'emergency_stop_topic': ASKED},
    }


def _kinematics_as_json(kinematics: InverseKinematics) -> dict[str, Any]:
    """Return the method of the inverse kinematics for --json.

    Its distance from the nearest closed form is in mm and deg, None without such a form.
    """
    off = kinematics.difference
    return {
        'way': kinematics.method,
        'closed_form_off_mm': None if off is None else 1e3 * off[0],
        'closed_form_off_deg': None if off is None else float(np.degrees(off[1])),
        'in_words': kinematics.in_words(),
    }
