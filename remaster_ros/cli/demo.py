# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline on fake hardware: real nodes, real DDS, real sockets."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import NoReturn

from remaster_ros.cli.options import integer, number
from remaster_ros.errors import InputError
from remaster_ros.planning.moving_design import LONGEST_MOVING_S, MOVING_S, SHORTEST_MOVING_S

WITHOUT_ROS = (
    "needs ROS 2 Jazzy: source /opt/ros/jazzy/setup.bash, or pip install '.[jazzy]' for the wheels"
)


DESIGNED_FROM, HELD_OUT_FROM = 30, 9
"""Candidates to fit and to validate of an optimal design: three to six of the latter remain, each
in all its solutions, which keeps the demo to about two minutes."""
WITH_CAUSES = 14
"""Candidates of each split of a demo that looks for causes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster demo``."""
    parser.add_argument('--out', metavar='DIR', help='new folder (default: remaster_demo_N)')
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        '--candidates',
        type=integer(1),
        metavar='N',
        help='visit every pose of a Latin hypercube that can be reached, of N candidates for '
        'optimization and N for validation, with one marker for each sensor (default: three '
        f'markers, and the poses that tell the most; with --hide {WITH_CAUSES} candidates)',
    )
    size.add_argument(
        '--full',
        dest='candidates',
        action='store_const',
        const=60,
        help="the paper's collection: one marker for each sensor, 60 candidate poses each",
    )
    parser.add_argument(
        '--hide',
        action='append',
        default=[],
        metavar='NAME[@JOINT][:MM]',
        help='let something else be wrong with the arm or a sensor, such as backlash@4:0.3 (mm at '
        'the tool), and look for it; `random` draws one; may be repeated',
    )
    parser.add_argument(
        '--apply',
        action='store_true',
        help='let the bridge correct by what was found, visit other poses, and see whether the '
        'tool comes to where it is wanted; a minute more',
    )
    parser.add_argument(
        '--dynamics',
        nargs='?',
        type=number(0.1, 10.0),
        const=1.0,
        default=0.0,
        metavar='SCALE',
        help='let the arm lag, wind up, yield and swing while it moves, with sizes of real '
        'machines (times SCALE), reports at 125 Hz and frames at 120 Hz, so that `remaster import '
        '--moving` can read the bag of the session; takes as long as a real arm',
    )
    parser.add_argument(
        '--moving',
        nargs='?',
        type=number(SHORTEST_MOVING_S, LONGEST_MOVING_S, 's'),
        const=MOVING_S,
        default=0.0,
        metavar='SECONDS',
        help=f'measure while the arm moves, for so long (default {MOVING_S:g} s), and prove it on '
        'poses at standstill; the arm has dynamics (--dynamics, by default 1)',
    )
    parser.add_argument(
        '--rate',
        type=number(1.0, 20.0),
        help='world time over wall time (1 to 20; default 10, with --dynamics 1)',
    )
    parser.add_argument(
        '--watch', action='store_true', help='show it on the live page, until Ctrl-C'
    )


def run(args: argparse.Namespace) -> NoReturn:
    """Replace this process by that of the demo; does not return.

    Raises InputError if rclpy is not installed.
    """
    out = Path(args.out) if args.out else free_folder()
    if args.moving and (args.hide or args.apply or args.candidates):
        raise InputError('--moving goes without --hide, --apply, --candidates and --full')
    dynamics = args.dynamics or float(args.moving > 0.0)
    become(
        'demo',
        ['remaster_ros.demo'],
        {
            'out': str(out),
            'seed': args.seed,
            **_collection(args.candidates, bool(args.hide)),
            **({'cell': 'moving', 'moving_s': args.moving} if args.moving else {}),
            'rate': args.rate or (1.0 if dynamics else 10.0),
            'dynamics': dynamics,
            'figures': not args.no_figures,
            'quiet': args.quiet,
            'hide': ','.join(args.hide),
            'apply': args.apply,
            'watch': args.watch,
        },
    )


def _collection(candidates: int | None, hidden: bool) -> dict[str, object]:
    """Return the parameters of the demo's collection: cell and numbers of candidates.

    ``candidates``: number of candidate poses given by the user, None for none; ``hidden``:
    whether causes are looked for. Without both the cell is 'quick', with an optimal design
    that has the fewest poses that a search for causes needs; else it is 'demo', with that
    number of candidates, or by default with enough to visit more poses.
    """
    if candidates is None and not hidden:
        return {
            'cell': 'quick',
            'candidates': DESIGNED_FROM,
            'held_out_candidates': HELD_OUT_FROM,
            'reference_every': 50,
        }
    return {'cell': 'demo', 'candidates': candidates or WITH_CAUSES}


def free_folder() -> Path:
    """Return the first of remaster_demo_1, remaster_demo_2, … that does not exist."""
    number = 1
    while Path(f'remaster_demo_{number}').exists():
        number += 1
    return Path(f'remaster_demo_{number}')


def run_node(name: str, parameters: dict[str, object]) -> NoReturn:
    """Replace this process by the node `name` with these parameters; does not return."""
    become(name, ['remaster_ros.nodes', name], parameters)


def become(verb: str, module: list[str], parameters: dict[str, object]) -> NoReturn:
    """Replace this process by ``python -m MODULE`` with ROS parameters; does not return.

    Raises InputError, which names the verb, if rclpy is not installed.
    """
    if importlib.util.find_spec('rclpy') is None:
        raise InputError(f'remaster {verb} {WITHOUT_ROS}')
    command = [sys.executable, '-m', *module, '--ros-args']
    for key, value in parameters.items():
        # JSON is YAML; text in double quotes stays text whatever it looks like.
        command += ['-p', f'{key}:={json.dumps(value)}']
    sys.stdout.flush()
    os.execv(sys.executable, command)
