# SPDX-License-Identifier: Apache-2.0
"""Find what the offsets leave: discovery.json, figures and report.html."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from remaster_ros.cli.console import progress_bar, tell
from remaster_ros.cli.options import add_sessions
from remaster_ros.cli.sessions import read_together, refuse_moving
from remaster_ros.discovery.confirmation import (
    confirm,
    require_other_session,
)
from remaster_ros.discovery.decision import Named, decisions
from remaster_ros.discovery.discover import discover_session
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.discovery_json import read_discovery
from remaster_ros.reports.fit_json import DISCOVERY_FILE
from remaster_ros.reports.found_causes import earlier_pairs
from remaster_ros.reports.result_folder import prepare_folder, save_discovery
from remaster_ros.reports.result_lines import discovery_lines
from remaster_ros.session.files import undone_on_failure
from remaster_ros.session.records.reader import read_session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster discover``."""
    add_sessions(parser)
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='output folder')
    parser.add_argument(
        '--json', action='store_true', help='print discovery.json in place of a summary'
    )
    parser.add_argument(
        '--confirm',
        metavar='OTHER',
        type=Path,
        help='another session of the same arm: do the causes hold there?',
    )
    parser.add_argument(
        '--decide',
        metavar='FILE',
        type=Path,
        help='discovery.json of before more was measured (plan --separate): which of its causes '
        'and their look-alikes is it?',
    )


def run(args: argparse.Namespace) -> int:
    """Search for causes, write the results, and print a short summary; return 0.

    An error of the session of --confirm is raised after everything else was written. Raises
    InputError: a file is invalid, or the sessions are the same; InsufficientDataError: the data do
    not allow a search.
    """
    session, named = read_together(args.session)
    other = None if args.confirm is None else read_session(args.confirm)
    if other is not None:
        assert args.confirm is not None
        refuse_moving(session, args.session[0], 'discover --confirm')
        refuse_moving(other, args.confirm, 'discover --confirm')
        # Before the long search.
        require_other_session(session, other)
    pairs: tuple[tuple[Named, Named], ...] = ()
    if args.decide is not None:
        chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
        pairs = earlier_pairs(args.decide, chain.joint_names)
    with undone_on_failure(), progress_bar(args.quiet or args.json) as progress:
        prepare_folder(args.out, DISCOVERY_FILE)
        found = discover_session(
            session,
            rng=np.random.default_rng(args.seed),
            progress=progress,
            clock=time.perf_counter,
        )
        confirmation, refusal = None, None
        if other is not None:
            progress('confirming', 0.0)
            try:
                confirmation = confirm(found, other, np.random.default_rng(args.seed))
            except InsufficientDataError as error:
                # The result of the first session remains, whatever the other one is.
                refusal = InsufficientDataError(f'the other session: {error}')
        progress('writing', 0.0)
        report = save_discovery(
            found,
            args.out,
            confirmation,
            figures=not args.no_figures,
            decided=decisions(found, pairs),
        )
    path = args.out / DISCOVERY_FILE
    lines = [*named, *discovery_lines(read_discovery(path))]
    if session.measurements.orientation is not None:
        lines.append(
            'the measured orientations are not used: causes are searched in the positions alone; '
            '"remaster fit" fits both'
        )
    tell(args, json.loads(path.read_bytes()), *lines, f'written: {report}')
    if refusal is not None:
        raise refusal
    return 0
