"""Find what the offsets leave: discovery.json, figures and report.html."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from remaster_ros.cli.console import progress_bar, show
from remaster_ros.discovery.confirmation import (
    Confirmation,
    confirm,
    in_words,
    require_same_cell,
)
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.reports.discovery_json import save_discovery
from remaster_ros.reports.fit_json import prepare_folder
from remaster_ros.session.reader import read_session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster discover``."""
    parser.add_argument('session', metavar='SESSION', type=Path, help='session folder')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='output folder')
    parser.add_argument(
        '--confirm',
        metavar='OTHER',
        type=Path,
        help='another session of the same arm: do the causes, frozen, predict it?',
    )


def run(args: argparse.Namespace) -> int:
    """Search, extend, measure the gain, write, and print a summary of a few lines."""
    session = read_session(args.session)
    other = None if args.confirm is None else read_session(args.confirm)
    if other is not None:
        # Not after the long search.
        require_same_cell(session, other)
    prepare_folder(args.out)
    with progress_bar(args.quiet) as progress:
        found = discover_session(
            session,
            rng=np.random.default_rng(args.seed),
            progress=progress,
            clock=time.perf_counter,
        )
        confirmation = None
        if other is not None:
            progress('confirming', 0.0)
            confirmation = confirm(found, other)
        progress('writing', 0.0)
        report = save_discovery(found, args.out, confirmation, figures=not args.no_figures)
    show(args.quiet, summary(found, confirmation))
    show(args.quiet, f'written: {report}')
    return 0


def summary(found: Discovery, confirmation: Confirmation | None = None) -> str:
    """Return verdict, causes and gain in a few lines."""
    lines = [f'verdict: {found.verdict}']
    for effect in found.effects:
        joints = f' {list(effect.joints)}' if effect.joints else ''
        share = '' if effect.share is None else f', {100 * effect.share:.0f} % of the gain'
        lines.append(f'{effect.name}{joints}: {1e3 * effect.size_m:.3f} mm{share}; {effect.cause}')
        for alike in effect.confusable_with:
            where = f' {list(alike.joints)}' if alike.joints else ''
            lines.append(f'    could be {alike.name}{where}; to distinguish: {alike.separate_by}')
    lines += [f'unexplained: {left.next}' for left in found.unexplained]
    if found.verdict == 'none':
        lines.append('nothing beyond the zero-offsets and the noise was found')
    gain = found.gain
    if gain.held_out_rms_before_m is not None and gain.held_out_rms_after_m is not None:
        lines.append(
            f'held out: {1e3 * gain.held_out_rms_before_m:.3f} mm RMS before, '
            f'{1e3 * gain.held_out_rms_after_m:.3f} mm after; '
            f'the noise alone is {1e3 * gain.noise_floor_m:.3f} mm'
        )
    if found.thinning is not None:
        part = found.thinning
        lines.append(
            f'searched: {part.searched} of {part.rows} rows; the others fall from '
            f'{1e3 * part.others_rms_before_m:.3f} to {1e3 * part.others_rms_after_m:.3f} mm RMS '
            'with the causes as found, frozen'
        )
    lines += [f'not testable: {name}: {why}' for name, why in found.untestable.items()]
    if confirmation is not None:
        lines.append(
            f'other session: {1e3 * confirmation.rms_before_m:.3f} mm RMS with frozen offsets, '
            f'{1e3 * confirmation.rms_after_m:.3f} mm with the frozen causes; '
            f'{100 * confirmation.carried_over:.0f} % of the gain carries over'
        )
        lines += in_words(found, confirmation)
    return '\n'.join(lines)
