"""Show a collection under way on a local web page."""

from __future__ import annotations

import argparse
from typing import NoReturn

from remaster_ros.cli.demo import run_node
from remaster_ros.cli.options import integer


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


def run(args: argparse.Namespace) -> NoReturn:
    """Become the process of the node that serves the page."""
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
