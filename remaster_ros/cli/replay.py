"""Publish a recorded session again (as ``ros2 bag play`` does)."""

from __future__ import annotations

import argparse
from typing import NoReturn

from remaster_ros.cli.demo import run_node
from remaster_ros.cli.options import number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster replay``."""
    parser.add_argument('bag', metavar='BAG', help='folder of the bag, or of the session with one')
    parser.add_argument(
        '--rate',
        type=number(0.01, 100.0),
        default=1.0,
        help='how many times as fast as recorded (0.01 to 100; default 1)',
    )
    parser.add_argument('--no-clock', action='store_true', help='do not publish /clock')
    parser.add_argument(
        '--wait-for', metavar='TOPIC', default='', help='wait for the first subscriber of TOPIC'
    )
    parser.add_argument(
        '--with-commands',
        action='store_true',
        help='publish also the commands to the controller; refused where a controller subscribes',
    )


def run(args: argparse.Namespace) -> NoReturn:
    """Become the replay node's process."""
    run_node(
        'replay',
        {
            'bag': args.bag,
            'rate': args.rate,
            'publish_clock': not args.no_clock,
            'wait_for': args.wait_for,
            'with_commands': args.with_commands,
        },
    )
