# SPDX-License-Identifier: Apache-2.0
"""What a collection would do, and what its fit is expected to state, before anything moves."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.cli.console import progress_bar, show
from remaster_ros.cli.options import add_poses, integer, number
from remaster_ros.compensation.check_visits import CHECK_POSES, chosen_visits
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.planning.candidates import PlanningScene
from remaster_ros.planning.collection_plan import (
    CollectionPlan,
    plan_collection,
    session_time_s,
)
from remaster_ros.planning.moving_design import (
    LONGEST_MOVING_S,
    MOVING_S,
    SHORTEST_MOVING_S,
    check_sensors,
)
from remaster_ros.planning.tour_order import REGISTRATION
from remaster_ros.planning.tour_planner import REGISTRATION_CANDIDATES, TourPlanner
from remaster_ros.planning.travel_time import DWELL_S, SETTLE_S, SPEED_SHARE, TravelTime
from remaster_ros.reports.found_causes import read_causes
from remaster_ros.reports.plan_json import minutes_text, plan_text, plan_to_dict
from remaster_ros.reports.plan_page import check_plan_page, plan_page, write_plan_page
from remaster_ros.reports.robot_scene import robot_scene
from remaster_ros.session.cells.workcell import Workcell, read_cell
from remaster_ros.session.files import write_atomically
from remaster_ros.types import FloatArray

# Start configurations that are tried, from zero outwards.
TRIED_STARTS = 200


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster plan``; their defaults are those of the nodes."""
    parser.add_argument('cell', metavar='CELL', help='cell file, or a shipped one (demo)')
    add_poses(parser)
    parser.add_argument(
        '--reference-every',
        type=integer(0),
        default=25,
        metavar='N',
        help='configurations between two visits to the references (default 25; 0 for none)',
    )
    parser.add_argument(
        '--speed-share',
        type=number(0.01, 1.0),
        default=SPEED_SHARE,
        metavar='S',
        help=f"share of the joints' velocity limits that is used (default {SPEED_SHARE:g})",
    )
    parser.add_argument(
        '--cartesian-speed-limit',
        type=number(0.0, 10.0, 'm/s'),
        default=0.25,
        metavar='V',
        help='largest speed of the fastest point, m/s (default 0.25; 0 for no such limit)',
    )
    parser.add_argument(
        '--settle',
        type=number(0.0, 60.0, 's'),
        default=SETTLE_S,
        metavar='S',
        help=f'standstill before a reading, s (default {SETTLE_S:g})',
    )
    parser.add_argument(
        '--dwell',
        type=number(0.0, 60.0, 's'),
        default=DWELL_S,
        metavar='S',
        help=f'how long a reading takes, s (default {DWELL_S:g})',
    )
    parser.add_argument(
        '--out',
        metavar='PAGE',
        type=Path,
        help='write a page that plays the plan in 3-D, such as plan.html',
    )
    parser.add_argument(
        '--separate',
        metavar='FILE',
        help='discovery.json: add configurations that separate its causes from their look-alikes',
    )
    parser.add_argument(
        '--check',
        metavar='TABLE',
        type=Path,
        help='choose the eight configurations of `remaster check` among those planned, and write '
        'their joints as a table, such as check.csv',
    )
    parser.add_argument(
        '--moving',
        metavar='SECONDS',
        type=number(SHORTEST_MOVING_S, LONGEST_MOVING_S, 's'),
        nargs='?',
        const=MOVING_S,
        default=0.0,
        help='measure while the arm moves, along curves of so many seconds in all (default '
        f'{MOVING_S:g}), with poses at standstill as proof; for a camera that sees four markers',
    )
    parser.add_argument(
        '--json', action='store_true', help='print one JSON object and nothing else'
    )


def run(args: argparse.Namespace) -> int:
    """Plan, and print the plan; with --out and --check write page and table. Return 0.

    Raises InputError: an invalid file or option; InsufficientDataError: too few poses can be
    reached.
    """
    if args.out is not None:
        check_plan_page(args.out)
    cell = read_cell(args.cell)
    scene = cell.planning_scene(cell.chain())
    with progress_bar(args.quiet or args.json) as progress:
        progress('planning', 0.0)
        plan = planned(cell, scene, args, lambda share: progress('planning', share))
        if args.out is not None:
            progress('drawing', 0.0)
            name = Path(cell.file).stem
            write_plan_page(args.out, plan_page(plan, robot_scene(cell, scene), name))
    check = None if args.check is None else _check(cell, scene, plan, args)
    if args.json:
        content = plan_to_dict(plan)
        print(json.dumps(content if check is None else {**content, 'check': check[0]}, indent=2))
        return 0
    show(args.quiet, plan_text(plan, cell.design_settings()))
    if check is not None:
        show(args.quiet, check[1])
    if args.out is not None:
        show(args.quiet, f'written: {args.out}; open it in a browser to see every way')
    return 0


def _travel(cell: Workcell, scene: PlanningScene, args: argparse.Namespace) -> TravelTime:
    """Return the model of the time that motion and measuring take, by the command's options.

    ``args``: share of joint speeds, largest speed of a point (0 for none), settling and dwell.
    Accelerations are those of the cell.
    """
    return TravelTime.of(
        scene.model,
        args.speed_share,
        args.cartesian_speed_limit or np.inf,
        cell.acceleration_limits(scene.model.chain),
        args.settle,
        args.dwell,
    )


def _check(
    cell: Workcell, scene: PlanningScene, plan: CollectionPlan, args: argparse.Namespace
) -> tuple[dict[str, Any], str]:
    """Choose the configurations of a check among the plan's, and write them as a table.

    Returns the smallest changes that the check detects, for JSON and as text. Raises
    InsufficientDataError if fewer than `CHECK_POSES` are planned.
    """
    chain = scene.model.chain
    q = np.unique([visit.q for visit in plan.visits], axis=0)
    if len(q) < CHECK_POSES:
        raise InsufficientDataError(
            f'{len(q)} configurations are planned, and a check takes {CHECK_POSES}; plan more'
        )
    travel = _travel(cell, scene, args)
    visits = chosen_visits(cell, chain, q, travel, np.random.default_rng(args.seed))
    write_atomically(args.check, visits.table())
    seconds = visits.seconds(travel)
    found = {
        'configurations': len(visits.q),
        'seconds': seconds,
        'noise_mm': 1e3 * visits.noise_m,
        'detectable_mm': {
            name: None if np.isnan(size) else 1e3 * float(size)
            for name, size in zip(chain.joint_names, visits.detectable_m, strict=True)
        },
    }
    lines = [
        f'check: {len(visits.q)} configurations, some {seconds:.0f} s by straight lines; written: '
        f'{args.check}. The ways between them are not planned: let /remaster/check or your own '
        'planner find them, and measure these configurations in each check',
        visits.too_long(seconds),
        'smallest change that one check finds, at a noise of '
        f'{1e3 * visits.noise_m:.2g} mm per axis:',
        *(f'  {line}' for line in visits.expected()),
    ]
    return found, '\n'.join(filter(None, lines))


def planned(
    cell: Workcell,
    scene: PlanningScene,
    args: argparse.Namespace,
    progress: Callable[[float], None] = lambda share: None,
) -> CollectionPlan:
    """Return the collection as the nodes plan it, with sensors at their rough positions.

    ``args``: options of ``remaster plan``; ``progress``: called with the share done, 0 to 1.
    Raises InputError if motion cannot be measured (--moving); else as `plan_collection` and
    `read_causes`.
    """
    travel = _travel(cell, scene, args)
    if args.moving:
        _check_moving(cell, scene, args, travel)
    causes = read_causes(args.separate, scene.model.chain.joint_names) if args.separate else ()
    counts = {
        'optimization': args.poses,
        'validation': args.validation,
        REGISTRATION: REGISTRATION_CANDIDATES,
    }
    planner = TourPlanner(
        scene,
        counts,
        args.seed,
        args.reference_every,
        cell.design_settings(),
        travel,
        causes,
        args.moving,
    )
    start = free_start(scene.model, args.seed)
    return plan_collection(planner, planner.rough_places, start, progress)


def _check_moving(
    cell: Workcell, scene: PlanningScene, args: argparse.Namespace, travel: TravelTime
) -> None:
    """Raise InputError if this cell or --separate does not allow measuring in motion.

    If it is the cell, the error also says how long the collection would take with stops
    instead.
    """
    if args.separate:
        raise InputError(
            '--separate adds configurations at standstill, and --moving has none to fit; leave '
            'one of them out'
        )
    try:
        check_sensors(scene, cell.design_settings().sensors)
    except InputError as error:
        counts = {
            'optimization': args.poses,
            'validation': args.validation,
            REGISTRATION: REGISTRATION_CANDIDATES,
        }
        planner = TourPlanner(
            scene, counts, args.seed, args.reference_every, cell.design_settings(), travel
        )
        tour = planner.collection(planner.rough_places)
        seconds = session_time_s(planner, tour, free_start(scene.model, args.seed))
        raise InputError(f'{error}: some {minutes_text(seconds)}') from None


def free_start(model: CollisionModel, seed: int) -> FloatArray:
    """Return a configuration to start from, (k,): zero if free, else a free one near to it.

    At zero some arms lie stretched out along the floor (a UR does), without a free path. Zero also
    if no tried configuration is free. Free is with `RESERVE_M` more than the clearance.
    `TRIED_STARTS` configurations are tried, drawn by ``seed`` ever further from zero, and cut to
    the joint limits.
    """
    chain = model.chain
    spread = np.linspace(0.0, np.pi, TRIED_STARTS)[:, None]
    tried = spread * np.random.default_rng(seed).uniform(-1.0, 1.0, (TRIED_STARTS, len(chain)))
    tried = np.clip(tried, chain.lower, chain.upper)
    free = np.flatnonzero(model.reasons(tried, RESERVE_M) == '')
    return tried[free[0] if len(free) else 0]
