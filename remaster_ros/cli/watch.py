# SPDX-License-Identifier: Apache-2.0
"""Show a collection under way on a local web page."""

from __future__ import annotations

import argparse
from pathlib import Path

from remaster_ros.cli.console import show
from remaster_ros.cli.demo import run_node
from remaster_ros.cli.options import integer
from remaster_ros.errors import InputError
from remaster_ros.session.cells.rviz_config import rviz_config
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.files import write_atomically


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster watch``."""
    parser.add_argument(
        'cell', nargs='?', default='demo', help='cell file of the arm (default: demo)'
    )
    parser.add_argument(
        '--fit', default='fit', metavar='DIR', help="the optimizer's folder (default: fit)"
    )
    parser.add_argument(
        '--address',
        default='127.0.0.1',
        help='IP address to listen on; one that other computers reach needs a certificate',
    )
    parser.add_argument(
        '--port', type=integer(0), default=0, help='port to listen on (default: any free one)'
    )
    parser.add_argument(
        '--name',
        action='append',
        default=[],
        help='a name of this computer by which browsers may ask; may be repeated',
    )
    parser.add_argument('--certificate', default='', metavar='PEM', help='for https')
    parser.add_argument('--key', default='', metavar='PEM', help='of the certificate')
    parser.add_argument(
        '--rviz',
        metavar='FILE',
        type=Path,
        help="write a configuration of RViz with the cell's own sensors, and end (needs no ROS)",
    )


def run(args: argparse.Namespace) -> int:
    """Replace this process by the node that serves the page, or write an RViz configuration.

    Raises InputError if the file of the RViz configuration exists.
    """
    if args.rviz is not None:
        if args.rviz.exists():
            raise InputError(f'{args.rviz}: already there, and not overwritten; give another name')
        write_atomically(args.rviz, rviz_config(read_cell(args.cell)))
        show(args.quiet, f'written: {args.rviz}; show it: rviz2 -d {args.rviz}')
        return 0
    run_node(
        'watch',
        {
            'cell': args.cell,
            'fit': args.fit,
            'address': args.address,
            'port': args.port,
            'names': ','.join(args.name),
            'certificate': args.certificate,
            'key': args.key,
        },
    )
