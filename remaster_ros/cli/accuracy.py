# SPDX-License-Identifier: Apache-2.0
"""The three metrics of a fit's zero-offsets on any session of the same robot."""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.evaluate_offsets import OffsetsJudgement, accuracy_with_offsets
from remaster_ros.calibration.orientation_accuracy import METRICS as ORIENTATION
from remaster_ros.cli.console import progress_bar, tell
from remaster_ros.cli.sessions import read_to_fit
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.fit_json import joint_offsets_of, read_fit, require_own
from remaster_ros.reports.schemas import Fit
from remaster_ros.reports.sentences import METRICS
from remaster_ros.session.files import make_folder, undone_on_failure, write_atomically
from remaster_ros.types import FloatArray, Session
from remaster_ros.version import __version__

FORMAT = 'remaster-accuracy/1'
DESCRIPTION = (
    "Mean error and 95 % interval with all offsets at zero ('before') and with those of the fit "
    "('after'). In both cases registrations and markers are fitted to this session's optimization "
    'rows (to all rows where it has none) and applied to its validation rows. The theoretical '
    "error draws the offsets with the fit's standard deviations, as if independent; joints that "
    'the fit could not identify do not count: the registration or the marker takes them up. It is '
    "compared in the sensor's frame and, as the source paper does, in the robot base, at the "
    'visited and at 1,000 random configurations.'
)
SIDES = ('before', 'after')
WIDTH = 2 + max(map(len, METRICS.values()))

log = logging.getLogger('remaster_ros')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster accuracy``."""
    parser.description = DESCRIPTION
    parser.add_argument('session', metavar='SESSION', type=Path, help='session folder')
    parser.add_argument(
        '--offsets', metavar='FIT', type=Path, required=True, help='fit.json with the offsets'
    )
    parser.add_argument('--out', metavar='FILE', type=Path, help='write the metrics as JSON')
    parser.add_argument('--json', action='store_true', help='print them as JSON')


def run(args: argparse.Namespace) -> int:
    """Evaluate offsets on a session, print a table, write JSON with --out; return 0.

    Raises InputError: a file is invalid, of another arm, or --out is another program's.
    """
    session = read_to_fit(args.session)
    fit = read_fit(args.offsets)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    offsets, std = joint_offsets_of(fit, chain)
    warn_of_another_urdf(fit, session, args.offsets)
    if args.out is not None and args.out.exists():
        require_own(args.out, FORMAT)
    with progress_bar(args.quiet or args.json) as progress:
        progress('fitting', 0.0)
        judged = accuracy_with_offsets(session, offsets, std, np.random.default_rng(args.seed))
    warn_of_harm(judged, args.offsets)
    content = {
        'format': FORMAT,
        'version': __version__,
        'session': str(args.session),
        'offsets': str(args.offsets),
        **shown_offsets(chain, offsets),
        'accuracy': judged.accuracy,
        'left_out': [{'observation': row, 'why': why} for row, why in judged.left_out],
    }
    if args.out is not None:
        with undone_on_failure():
            make_folder(args.out.parent)
            write_atomically(args.out, json.dumps(content, indent=2) + '\n')
    tell(args, content, table(judged), '' if args.out is None else f'written: {args.out}')
    return 0


def shown_offsets(chain: SerialChain, offsets: FloatArray) -> dict[str, dict[str, float]]:
    """Return the offsets by joint name, in degrees and, for prismatic joints, in mm.

    ``joint_offsets_deg`` (empty if all joints slide), and ``joint_offsets_mm`` if any does.
    """
    by_unit: dict[str, dict[str, float]] = {'joint_offsets_deg': {}}
    shown = (chain.shown_scale * offsets).tolist()
    for name, unit, value in zip(chain.joint_names, chain.shown_units, shown, strict=True):
        by_unit.setdefault(f'joint_offsets_{unit}', {})[name] = value
    return by_unit


def warn_of_another_urdf(fit: Fit, session: Session, path: Path) -> None:
    """Log a warning if the offsets were fitted with another URDF, by its SHA-256.

    ``path``: of the offsets, for the message. Nothing if the fit states no robot.
    """
    if fit.robot and fit.robot.urdf_sha256 != session.urdf_sha256:
        log.warning(
            "%s: fitted with another URDF than this session's; the joints have the same names, "
            'but the geometry may differ',
            path,
        )


def warn_of_harm(judged: OffsetsJudgement, path: Path) -> None:
    """Log a warning for each split whose mean error is larger with the offsets than without.

    The error is that after registration; ``path``: of the offsets, for the message.
    """
    for split, metrics in judged.accuracy.items():
        errors = {} if metrics is None else metrics['post_registration']
        if errors is None or errors.get('after') is None:
            continue
        before, after = (errors[side]['mean_mm'] for side in SIDES)
        if after > before:
            log.warning(
                '%s: with these offsets the mean error of the %s rows is %.3f mm, without them '
                '%.3f mm: they are those of another arm, the arm was mastered anew since, or it '
                'uses them already',
                path,
                split,
                after,
                before,
            )


def table(judged: OffsetsJudgement) -> str:
    """Return the three metrics before and after as text, one per line for each split.

    Then the observations that were left out, each with the reason.
    """
    lines = [f'{"mean error [95 % interval], mm":{WIDTH + 2}s} {"before":28s} after']
    for split, metrics in judged.accuracy.items():
        if metrics is None:
            lines.append(f'{split}: no such rows')
            continue
        lines.append(split)
        for key, name in METRICS.items():
            if key in ORIENTATION and key not in metrics:
                continue
            values = metrics[key]
            if values['after'] is None:
                lines.append(f'  {name:{WIDTH}s} {values["why"]}')
                continue
            before, after = (interval(values[side]) for side in SIDES)
            lines.append(f'  {name:{WIDTH}s} {before:28s} {after}')
            if values.get('after_offsets_only'):
                before, after = (interval(values[f'{side}_offsets_only']) for side in SIDES)
                lines.append(f'  {"… without the noise":{WIDTH}s} {before:28s} {after}')
    for observation, why in judged.left_out:
        lines.append(f'left out: observation {observation}: {why}')
    return '\n'.join(lines)


def interval(metric: dict[str, Any]) -> str:
    """Return mean and interval of a metric as text: '0.123 [0.100, 0.150]', in mm.

    A metric of orientations is in degrees, and ends in 'deg'.
    """
    if 'mean_deg' in metric:
        low, high = metric['interval95_deg']
        return f'{metric["mean_deg"]:.4f} [{low:.4f}, {high:.4f}] deg'
    low, high = metric['interval95_mm']
    return f'{metric["mean_mm"]:.3f} [{low:.3f}, {high:.3f}]'
