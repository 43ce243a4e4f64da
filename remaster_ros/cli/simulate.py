# SPDX-License-Identifier: Apache-2.0
"""A session from a known truth, planned and ordered as the planner node does it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from remaster_ros.cli.console import progress_bar, tell
from remaster_ros.cli.options import add_poses, names, number
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.files import undone_on_failure, write_atomically
from remaster_ros.session.records.reader import write_session
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.simulated_workcell import (
    choose_robot,
    choose_sensors,
    simulate_workcell,
)
from remaster_ros.simulation.truth import truth_to_dict

TRUTH_FILE = 'truth.json'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster simulate``."""
    parser.add_argument('out', metavar='OUT', type=Path, help='new session folder')
    parser.add_argument('--json', action='store_true', help='print the truth as one JSON object')
    parser.add_argument('--cell', default='demo', help='cell file, or a shipped one (demo)')
    parser.add_argument(
        '--robot',
        metavar='NAME|URDF',
        help="a shipped robot such as lwr4plus, or any URDF file (default: the cell's robot)",
    )
    parser.add_argument('--base-link', metavar='LINK', help='frame R (default: the root link)')
    parser.add_argument('--tip-link', metavar='LINK', help='frame T (default: the only end)')
    add_poses(parser)
    parser.add_argument(
        '--sensors', type=names, metavar='NAME,…', help="of the cell's sensors (default: all)"
    )
    parser.add_argument(
        '--noise-mm',
        type=number(unit='mm'),
        default=0.1,
        metavar='S',
        help='noise of every point, std per axis (default 0.1)',
    )
    parser.add_argument(
        '--pose-noise-mm',
        type=number(unit='mm'),
        default=0.2,
        metavar='S',
        help='error common to all solutions of a pose, std per axis (default 0.2)',
    )
    parser.add_argument(
        '--depth-noise-mm',
        type=number(unit='mm'),
        default=0.0,
        metavar='S',
        help='further noise along the line of sight, as of a camera: std at 1 m, growing with the '
        'square of the distance (default 0)',
    )
    parser.add_argument(
        '--orientation-noise-deg',
        type=number(unit='deg'),
        metavar='S',
        help='the sensors measure full poses, with this noise of every orientation, std per axis '
        '(default: positions alone)',
    )
    parser.add_argument(
        '--pose-orientation-noise-deg',
        type=number(unit='deg'),
        default=0.0,
        metavar='S',
        help='error of orientations common to all solutions of a pose, std per axis (default 0)',
    )
    parser.add_argument(
        '--on-tool',
        action='store_true',
        help='the sensors are on the tool, at their markers, and measure the pose of a board in '
        'their place of the cell',
    )
    parser.add_argument(
        '--outliers',
        type=number(high=1.0),
        default=0.0,
        metavar='SHARE',
        help='share of the observations that are 20 mm off (default 0)',
    )
    parser.add_argument(
        '--offset-std-deg',
        # A joint that is off by more has lost its mastering, or the URDF is another robot's.
        type=number(high=2.0, unit='deg'),
        default=0.3,
        metavar='S',
        help='the true zero-offsets are drawn with this std (default 0.3); a joint that slides '
        'has 4.36 mm for each degree',
    )
    parser.add_argument(
        '--effect',
        type=EffectSpec.parse,
        action='append',
        default=[],
        metavar='NAME[@JOINT][:MM]',
        help='hide something else in it, such as backlash@4:0.3, of that size in mm after '
        'offsets, registration and marker are fitted; may be repeated; `random` draws one',
    )


def run(args: argparse.Namespace) -> int:
    """Plan, draw a truth, write the session and the truth; return 0.

    Raises InputError for invalid options, InsufficientDataError if no pose can be planned.
    """
    cell = read_cell(args.cell)
    chain = choose_robot(cell, args.robot, args.base_link, args.tip_link)
    choose_sensors(cell, args.sensors)
    turn_deg = args.orientation_noise_deg
    with progress_bar(args.quiet or args.json) as progress:
        progress('planning', 0.0)
        made = simulate_workcell(
            cell,
            chain,
            np.random.default_rng(args.seed),
            poses=args.poses,
            validation_poses=args.validation,
            sigma_m=args.noise_mm * 1e-3,
            pose_sigma_m=args.pose_noise_mm * 1e-3,
            depth_sigma_m=args.depth_noise_mm * 1e-3,
            turn_sigma_rad=None if turn_deg is None else np.deg2rad(turn_deg),
            pose_turn_sigma_rad=np.deg2rad(args.pose_orientation_noise_deg),
            on_tool=args.on_tool,
            outlier_share=args.outliers,
            joint_offset_std=np.deg2rad(args.offset_std_deg),
            effects=args.effect,
            measuring=lambda: progress('measuring', 0.9),
        )
        truth = truth_to_dict(made.truth, chain, args.seed)
        with undone_on_failure():
            write_session(args.out, made.session)
            write_atomically(args.out / TRUTH_FILE, json.dumps(truth, indent=2) + '\n')
    written = f'written: {args.out}, {len(made.session.measurements)} observations'
    tell(args, truth, made.tour.describe(), written)
    return 0
