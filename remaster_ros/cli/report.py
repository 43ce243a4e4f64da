# SPDX-License-Identifier: Apache-2.0
"""One page of session, fit and causes: what to do, what it brings, what remains."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.fit import fit_session
from remaster_ros.cli.console import progress_bar, tell
from remaster_ros.cli.sessions import read_to_fit
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.answer import Answer
from remaster_ros.reports.fit_json import FIT_FILE, REPORT_FILE
from remaster_ros.reports.plan_facts import PlanFacts, plan_facts, plan_to_dict
from remaster_ros.reports.report_inputs import parts, read_inputs
from remaster_ros.reports.result_folder import prepare_folder, save_fit
from remaster_ros.session.files import undone_on_failure
from remaster_ros.session.records.plan_journal import read_plan

FIT_FOLDER = 'fit'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster report``."""
    parser.add_argument('session', metavar='SESSION', type=Path, help='session folder')
    parser.add_argument(
        'results',
        metavar='FIT DISCOVERY',
        nargs='*',
        type=Path,
        help='what "remaster fit" and "remaster discover" wrote: folders, or fit.json and '
        'discovery.json; without a fit the session is fitted first',
    )
    parser.add_argument(
        '--out',
        metavar='DIR',
        type=Path,
        help="output folder (default: the session's name with -report, in the current folder)",
    )
    parser.add_argument('--pdf', action='store_true', help='write report.pdf as well')
    parser.add_argument('--json', action='store_true', help='print the answer as JSON')


def run(args: argparse.Namespace) -> int:
    """Read or fit, write the page, print a short answer; return 0.

    Without a fit the session is fitted into `FIT_FOLDER` of the output. Raises InputError: a file
    or the folder cannot be used; InsufficientDataError: the data do not allow a fit.
    """
    fit_path, found_path = parts(args.results)
    session = read_to_fit(args.session)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    plan = read_plan(args.session, chain)
    out = args.out or Path(f'{args.session.resolve().name}-report')
    # Matplotlib takes a second to import: after what may be refused at once.
    from remaster_ros.reports.report import require_ready, write_answer

    require_ready(out, args.pdf)
    with undone_on_failure(), progress_bar(args.quiet or args.json) as progress:
        if fit_path is None:
            fit_path = out / FIT_FOLDER / FIT_FILE
            prepare_folder(fit_path.parent, FIT_FILE)
            result = fit_session(
                session,
                rng=np.random.default_rng(args.seed),
                progress=progress,
                clock=time.perf_counter,
            )
            save_fit(result, fit_path.parent, figures=not args.no_figures)
        progress('writing', 0.0)
        inputs = read_inputs(session, fit_path, found_path, plan)
        found_folder = None if found_path is None else found_path.parent
        answer = write_answer(
            inputs, fit_path.parent, found_folder, out, not args.no_figures, args.pdf
        )
    remains = [f'remains: {row.sentence}' for row in answer.remains]
    lines = (answer.headline, *remains, f'written: {out / REPORT_FILE}')
    tell(args, as_dict(answer, out, plan_facts(inputs)), *lines)
    return 0


def as_dict(answer: Answer, out: Path, plan: PlanFacts | None) -> dict[str, Any]:
    """Return the JSON output: path of the report, answer, and plan (None without one)."""
    return {
        'report': str(out / REPORT_FILE),
        'mood': answer.mood,
        'headline': answer.headline,
        'action': answer.action,
        'held_out': answer.held_out,
        'not_counted': answer.not_counted,
        'stages': [
            {
                'title': stage.title,
                'mean_mm': stage.mean,
                'most_mm': stage.most,
                'largest_mm': stage.largest,
            }
            for stage in answer.stages
        ],
        'brings': answer.brings,
        'on_the_pad': [[vars(step) for step in group] for group in answer.on_the_pad],
        'noise_mm': {row.sensor: row.reading_mm for row in answer.noise},
        'remains': [row._asdict() for row in answer.remains],
        'plan': None if plan is None else plan_to_dict(plan),
    }
