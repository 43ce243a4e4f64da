"""Find what the offsets leave: discovery.json, figures and report.html."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from remaster_ros.calibration.predictions import Coverage
from remaster_ros.cli.console import progress_bar, show, show_file
from remaster_ros.cli.options import add_sessions
from remaster_ros.cli.sessions import read_together
from remaster_ros.discovery.confirmation import (
    Confirmation,
    confirm,
    require_other_session,
    rms_sigmas,
)
from remaster_ros.discovery.decision import Named, decisions
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.discovery.words import part_words, percent, sentence_case, shown
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.discovery_json import (
    earlier_pairs,
    held_out_coverage,
    load_words,
    predictions_of,
    read_discovery,
)
from remaster_ros.reports.fit_json import DISCOVERY_FILE
from remaster_ros.reports.result_folder import prepare_folder, save_discovery
from remaster_ros.reports.schemas import Discovered, Judgement, Loadable
from remaster_ros.session.files import undone_on_failure
from remaster_ros.session.reader import read_session

# Of a curve's hundred values the table has one line; discovery.json has them all.
MOST_PARAMETERS = 8


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
    """Search, extend, measure the gain, write, and print a summary of a few lines."""
    session, named = read_together(args.session)
    other = None if args.confirm is None else read_session(args.confirm)
    if other is not None:
        # Not after the long search.
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
                # What was found stays, whatever the other session is like.
                refusal = InsufficientDataError(f'the other session: {error}')
        progress('writing', 0.0)
        predictions = predictions_of(found)
        decided = decisions(found, pairs)
        report = save_discovery(
            found,
            args.out,
            confirmation,
            figures=not args.no_figures,
            predictions=predictions,
            decided=decided,
        )
    if args.json:
        show_file(args.out / DISCOVERY_FILE)
    else:
        content = msgspec.convert(read_discovery(args.out / DISCOVERY_FILE), Discovered)
        assert isinstance(content.judgement, Judgement)
        judged = content.judgement
        coverage = held_out_coverage(found, predictions)
        for line in named:
            show(args.quiet, line)
        show(args.quiet, summary(found, judged, confirmation, coverage, content.loadable or ()))
        if session.measurements.orientation is not None:
            show(
                args.quiet,
                'the measured orientations are not used: causes are searched in the '
                'positions alone; "remaster fit" fits both',
            )
        for one in decided:
            show(args.quiet, one.describe())
        show(args.quiet, f'written: {report}')
    if refusal is not None:
        raise refusal
    return 0


def summary(
    found: Discovery,
    judged: Judgement,
    confirmation: Confirmation | None = None,
    held_out: Coverage | None = None,
    to_load: Sequence[Loadable] = (),
) -> str:
    """Return verdict, causes, what can be loaded, and the coverage of held-out rows in lines."""
    lines = [f'verdict: {found.verdict}', judged.headline]
    for effect in found.effects:
        share = (
            ''
            if effect.share is None
            else f', without it {percent(effect.share)} of the gain is lost'
        )
        lines.append(f'{effect.title}: {1e3 * effect.size_m:.3f} mm{share}. {effect.cause}')
        if effect.remedy:
            lines.append(f'    to do: {effect.remedy}')
        for alike in effect.confusable_with:
            fewer = part_words(effect.name, effect.joints, alike.name, alike.joints)
            name = fewer or sentence_case(alike.title)
            lines.append(f'    could be {name}; to distinguish: {alike.separate_by}')
    lines += [f'unexplained: {left.next}' for left in found.unexplained]
    measured = any(effect.of_measurement for effect in found.effects)
    taken_out = ' (measuring errors taken out)' if measured else ''
    for row in to_load:
        what, to_do = load_words(row)
        mean = row.held_out_mean_mm
        error = '' if mean is None else f', mean error on held-out poses {mean:.3f} mm{taken_out}'
        lines.append(f'to load: {what}{error}: {to_do}')
    if held_out is not None and held_out.share is not None:
        lines.append(
            f'{held_out.inside} of {held_out.rows} held-out rows ({percent(held_out.share)}) lie '
            'in the regions predicted for them with 95 %'
        )
    if found.thinning is not None:
        part = found.thinning
        lines.append(
            f'searched: {part.searched} of {part.rows} rows; the others fall from '
            f'{1e3 * part.others_rms_before_m:.3f} to {1e3 * part.others_rms_after_m:.3f} mm RMS '
            'with the causes as found, frozen'
        )
    lines += [f'not testable: {name}: {why}' for name, why in found.untestable.items()]
    lines += judged.doubts
    lines += [f'other session: {line}' for line in judged.points]
    if confirmation is not None:
        lines += side_by_side(found, confirmation)
    return '\n'.join(lines)


def side_by_side(found: Discovery, confirmation: Confirmation) -> list[str]:
    """Return a table of the zero-offsets and the causes' parameters in both sessions."""
    tables = [('zero-offsets', confirmation.joint_offsets)]
    tables += [
        (effect.title, cause.parameters)
        for effect, cause in zip(found.effects, confirmation.effects, strict=False)
    ]
    width = max((len(row.name) for _, rows in tables for row in rows), default=0)
    lines = []
    for name, rows in tables:
        if len(rows) > MOST_PARAMETERS:
            lines.append(
                f'    {name}: {len(rows)} values, which differ by {rms_sigmas(rows):.1f} standard '
                'deviations on the average'
            )
            continue
        for row in rows:
            here = ' ± '.join(shown(row.value, row.std, row.unit)[:2])
            value, std, unit = shown(row.other_value, row.other_std, row.unit)
            sigmas = f'{row.sigmas:+.1f}'.replace('-', '−')
            there = f'{value} ± {std}'
            lines.append(f'    {row.name:{width}}  {here:>18}  {there:>18} {unit:7}  {sigmas} σ')
    return ['here and there, and the difference in standard deviations:', *lines] if lines else []
