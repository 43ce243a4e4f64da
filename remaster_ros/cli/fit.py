# SPDX-License-Identifier: Apache-2.0
"""Fit the zero-offsets of a session: fit.json, figures and report.html."""

from __future__ import annotations

import argparse
import json
import logging
import time
from pathlib import Path

from remaster_ros.cli.console import progress_bar, tell
from remaster_ros.cli.options import add_sessions, integer, number

# Imports are in the functions that need them: SciPy and others take a second to load, and neither
# `remaster fit --help` nor a mistyped option needs them.
log = logging.getLogger('remaster_ros')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster fit``."""
    add_sessions(parser)
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='output folder')
    parser.add_argument('--json', action='store_true', help='print fit.json in place of a summary')
    parser.add_argument(
        '--sampler',
        choices=('fast', 'paper'),
        default='fast',
        help="'fast' (default), or 'paper': the source paper's own chain, with its faults",
    )
    parser.add_argument(
        '--chains', type=integer(2), default=4, metavar='N', help='number of chains (default 4)'
    )
    parser.add_argument(
        '--draws',
        type=integer(100),
        metavar='N',
        help='draws of each chain (default: what the precision takes); with the paper sampler its '
        'steps (default 200000)',
    )
    parser.add_argument(
        '--precision',
        type=number(0.002, 0.1),
        default=0.02,
        metavar='P',
        help='sample until every mean is known to P standard deviations of its parameter '
        '(0.002 to 0.1, default 0.02); of no effect with --draws',
    )
    parser.add_argument(
        '--prior',
        type=Path,
        metavar='FILE',
        help='YAML file of what is known before: offsets, markers, base frames',
    )


def run(args: argparse.Namespace) -> int:
    """Fit, write the results, and print a short summary; return 0.

    Raises InputError: a session, the priors or the folder cannot be used; InsufficientDataError:
    the data do not allow a fit. What is implausible is logged as a warning.
    """
    import numpy as np

    from remaster_ros.calibration.fit import fit_session
    from remaster_ros.cli.sessions import read_together
    from remaster_ros.reports.fit_json import FIT_FILE, read_fit
    from remaster_ros.reports.result_folder import prepare_folder, save_fit
    from remaster_ros.reports.result_lines import fit_lines
    from remaster_ros.session.files import undone_on_failure
    from remaster_ros.session.records.priors_file import read_priors

    session, named = read_together(args.session)
    priors = read_priors(args.prior) if args.prior is not None else None
    with undone_on_failure(), progress_bar(args.quiet or args.json) as progress:
        # Before the fit: an hour of sampling must not end at a folder that cannot be written.
        prepare_folder(args.out, FIT_FILE)
        result = fit_session(
            session,
            rng=np.random.default_rng(args.seed),
            sampler=args.sampler,
            chains=args.chains,
            draws=args.draws,
            precision=args.precision,
            progress=progress,
            clock=time.perf_counter,
            priors=priors,
        )
        progress('writing', 0.0)
        report = save_fit(result, args.out, figures=not args.no_figures)
    for line in result.implausible:
        log.warning('%s', line)
    path = args.out / FIT_FILE
    lines = (*named, *fit_lines(read_fit(path)), f'written: {report}')
    tell(args, json.loads(path.read_bytes()), *lines)
    return 0
