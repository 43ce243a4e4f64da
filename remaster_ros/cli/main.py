"""The ``remaster`` command: run the verb, turn errors into one line and an exit status."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence

from remaster_ros import __version__
from remaster_ros.cli import accuracy, demo, fit, replay, simulate
from remaster_ros.core.errors import InsufficientDataError, RemasterError

VERBS = (demo, simulate, fit, accuracy, replay)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser with every verb."""
    parser = argparse.ArgumentParser(
        prog='remaster',
        description='Remaster a robot arm in place: joint zero-offsets with honest uncertainty.',
        epilog='Exit status: 0 done, 1 the data allow no answer, 2 wrong usage or bad input.',
    )
    parser.add_argument('--version', action='version', version=f'remaster {__version__}')
    verbs = parser.add_subparsers(dest='verb', required=True, metavar='VERB')
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument('--seed', type=_seed, default=0, help='seed of all randomness (default 0)')
    common.add_argument('--quiet', action='store_true', help='print nothing but errors')
    common.add_argument('--no-figures', action='store_true', help='write no figures, no report')
    for verb in VERBS:
        name = verb.__name__.rpartition('.')[2]
        help_text = (verb.__doc__ or '').strip().splitlines()[0]
        sub = verbs.add_parser(name, parents=[common], help=help_text, description=help_text)
        verb.add_arguments(sub)
        sub.set_defaults(run=verb.run)
    return parser


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'{value} is negative; a seed is 0 or more')
    return value


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    args = build_parser().parse_args(argv)
    logging.basicConfig(
        format='%(levelname)s: %(message)s',
        level=logging.ERROR if args.quiet else logging.WARNING,
    )
    try:
        return args.run(args)
    except RemasterError as error:
        print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
        return 1 if isinstance(error, InsufficientDataError) else 2
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has gone (`remaster fit … | head`).
        sys.stderr.close()
        return 1


if __name__ == '__main__':
    sys.exit(main())
