"""Fit the zero-offsets of a session: fit.json, figures and report.html."""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING

from remaster_ros.cli.console import progress_bar, show, show_file
from remaster_ros.cli.options import add_sessions, integer, number

# What fits and draws is imported where it does so: SciPy and the rest take a second to load, and
# neither `remaster fit --help` nor a mistyped option needs them.
if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

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
    """Fit, write, and print a summary of a few lines."""
    import numpy as np

    from remaster_ros.calibration.fit import fit_session
    from remaster_ros.cli.sessions import read_together
    from remaster_ros.reports.fit_json import FIT_FILE
    from remaster_ros.reports.result_folder import prepare_folder, save_fit
    from remaster_ros.session.files import undone_on_failure
    from remaster_ros.session.session_yaml import read_priors

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
    if args.json:
        show_file(args.out / FIT_FILE)
    else:
        for line in (*named, summary(result)):
            show(args.quiet, line)
        show(args.quiet, f'written: {report}')
    return 0


def geometry_lines(result: FitResult) -> list[str]:
    """Return what lengths and tilts off their drawing do to the offsets, and the model of them."""
    import numpy as np

    from remaster_ros.compensation.export import MODEL_FILE
    from remaster_ros.reports.fit_json import geometry_of

    geometry = geometry_of(result)
    if geometry is None or not result.identifiable.any():
        return []
    known = np.flatnonzero(result.identifiable)
    moved = {int(joint): geometry.largest_imitation(int(joint)) for joint in known}
    joint = max(moved, key=lambda index: moved[index][1])
    member, most = moved[joint]
    what = 'link' if member.name == 'link_length' else 'the axis of joint'
    lines = [
        'the standard deviations are for an arm as drawn: '
        f'{1e3 * geometry.tolerance_m:.1f} mm at {what} {member.joints[0]} is '
        f'{np.degrees(most):.3f} deg at {result.joint_names[joint]}'
    ]
    if geometry.is_better:
        lines.append(
            f'with all lengths and tilts (apply/{MODEL_FILE}) the mean error on held-out poses is '
            f'{1e3 * geometry.held_out_m:.3f} mm, with the offsets alone '
            f'{1e3 * geometry.drawing_held_out_m:.3f} mm'
        )
    return lines


def summary(result: FitResult) -> str:
    """Return offsets, errors and verdict in a few lines."""
    import numpy as np

    from remaster_ros.reports.sentences import verdict

    lines = []
    for joint, mean, std, slides, seen, why in zip(
        result.joint_names,
        result.joint_offsets,
        result.joint_offsets_std,
        result.chain.slides,
        result.identifiable,
        result.why,
    ):
        if not seen:
            value = f'   not identifiable: {why}'
        elif slides:
            value = f'{1e3 * mean:+9.4f} ± {1e3 * std:.4f} mm'
        else:
            value = f'{np.rad2deg(mean):+9.4f} ± {np.rad2deg(std):.4f} deg'
        lines.append(f'{joint:12s} {value}')
    for split, metrics in result.accuracy.items():
        if metrics is None:
            lines.append(f'{split}: no such rows')
            continue
        for metric in ('relative', 'post_registration'):
            sides = metrics[metric]
            if sides['before'] and sides['after']:
                before, after = sides['before']['mean_mm'], sides['after']['mean_mm']
                lines.append(f'{split}, {metric}: {before:.3f} mm before, {after:.3f} mm after')
            turned = metrics.get(f'{metric}_orientation', {})
            if turned.get('after'):
                before, after = turned['before']['mean_deg'], turned['after']['mean_deg']
                lines.append(f'… orientation: {before:.4f} deg before, {after:.4f} deg after')
    judged = verdict(result)
    lines += [judged.headline, *judged.points]
    lines += geometry_lines(result)
    if result.chain.slides.any():
        lines.append(
            'of an arm with a joint that slides neither lengths and tilts off their drawing nor '
            'other causes are looked for, and there is no compensation.json'
        )
    if not result.session.timed:
        lines.append('the session has no times: nothing that changes with time can be seen')
    if result.left_out:
        rows = ', '.join(str(observation) for observation, _ in result.left_out)
        lines.append(f'left out as gross errors: observation {rows}')
    return '\n'.join(lines)
