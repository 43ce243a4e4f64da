# SPDX-License-Identifier: Apache-2.0
"""Publish a recorded session again (as ``ros2 bag play`` does), or write its rows again."""

from __future__ import annotations

import argparse
from pathlib import Path

from remaster_ros.cli.console import progress_bar, show
from remaster_ros.cli.demo import run_node
from remaster_ros.cli.options import number
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.files import undone_on_failure

SHOWN = 5
"""Most differing rows that are listed; the others are counted."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster replay``."""
    parser.add_argument('bag', metavar='BAG', help='folder of the bag, or of the session with one')
    offline = parser.add_argument_group('without ROS')
    offline.add_argument(
        '--out',
        metavar='SESSION',
        type=Path,
        help='write the session of the bag into this new folder, and compare its rows with those '
        'of the session that holds the bag: exit status 1 where they differ',
    )
    offline.add_argument(
        '--cell',
        metavar='CELL',
        help='cell file to pair by, in place of the one that the recorder wrote into the bag',
    )
    ros = parser.add_argument_group('with ROS')
    ros.add_argument(
        '--rate',
        type=number(0.01, 100.0),
        help='how many times as fast as recorded, at most: it waits for the recorder (0.01 to '
        '100; default 1)',
    )
    ros.add_argument('--no-clock', action='store_true', help='do not publish /clock')
    ros.add_argument(
        '--wait-for', metavar='TOPIC', default='', help='wait for the first subscriber of TOPIC'
    )
    ros.add_argument(
        '--with-commands',
        action='store_true',
        help='publish also the commands to the controller; refused where a controller subscribes',
    )


def run(args: argparse.Namespace) -> int:
    """Write the session of the bag, or replace this process by the replay node.

    Raises InputError for contradictory options.
    """
    if args.out is not None:
        return _write(args)
    if args.cell is not None:
        raise InputError('--cell is of use with --out alone: a replay over ROS needs no cell file')
    run_node(
        'replay',
        {
            'bag': args.bag,
            'rate': 1.0 if args.rate is None else args.rate,
            'publish_clock': not args.no_clock,
            'wait_for': args.wait_for,
            'with_commands': args.with_commands,
        },
    )


def _write(args: argparse.Namespace) -> int:
    """Write the session of the bag, and compare its rows with the recorded ones; return 0.

    Raises InputError for an invalid bag or options for a replay over ROS,
    InsufficientDataError if rows differ or the end of the bag is torn; the session is written
    then.
    """
    given = {
        '--rate': args.rate is not None,
        '--no-clock': args.no_clock,
        '--wait-for': bool(args.wait_for),
        '--with-commands': args.with_commands,
    }
    if useless := [name for name, is_given in given.items() if is_given]:
        raise InputError(
            f'{useless[0]} is for a replay over ROS; with --out nothing is published: leave it out'
        )
    # Imported here: a replay over ROS needs none of it.
    from remaster_ros.session.bag_replay import (
        bag_folder,
        differences,
        record_from_bag,
        session_beside,
    )
    from remaster_ros.session.cells.workcell import read_cell

    folder = bag_folder(Path(args.bag))
    bag = BagReader(folder)
    cell = None if args.cell is None else read_cell(args.cell)
    with undone_on_failure(), progress_bar(args.quiet) as progress:
        done = record_from_bag(bag, args.out, cell, lambda share: progress('pairing', share))
    show(args.quiet, f'written: {args.out}, {done.observations} observations')
    recorded = session_beside(folder)
    if recorded is None:
        show(args.quiet, 'no session holds this bag: there is nothing to compare the rows with')
    else:
        lines = differences(recorded, args.out)
        if lines:
            more = f'; and {len(lines) - SHOWN} more' if len(lines) > SHOWN else ''
            raise InsufficientDataError(
                f'{len(lines)} rows of {args.out} are not those of {recorded}: '
                f'{"; ".join(lines[:SHOWN])}{more}'
            )
        show(args.quiet, f'all rows are those of {recorded}')
    if done.torn_bytes:
        raise InsufficientDataError(
            f'{folder}: the last {done.torn_bytes} bytes are no whole message (its writer was '
            'killed); what came before is written'
        )
    return 0
