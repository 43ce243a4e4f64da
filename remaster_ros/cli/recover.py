# SPDX-License-Identifier: Apache-2.0
"""Finish the files of a session that a crash has left; print what was lost."""

from __future__ import annotations

import argparse
from pathlib import Path

from remaster_ros.cli.console import tell
from remaster_ros.session.recovery import recover_session

LOST = 3
"""Exit status of a recovery with losses."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster recover``."""
    parser.add_argument('session', metavar='SESSION', type=Path, help='folder of the session')
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.epilog = (
        f'Exit status: 0 nothing was lost, {LOST} what was being written was lost (and what), '
        '2 no such session, one that is being written, or a damaged one.'
    )


def run(args: argparse.Namespace) -> int:
    """Recover the session; return the exit status, `LOST` with losses, else 0.

    Raises InputError for no session, one that is being written, or a damaged one.
    """
    recovery = recover_session(args.session)
    for line in () if args.json else recovery.lost:
        print(f'lost: {line}')
    done = 'recovered' if recovery.finished else 'at rest, nothing to recover'
    content = {'session': str(args.session), **vars(recovery)}
    tell(args, content, f'{args.session}: {done}')
    return LOST if recovery.lost else 0
