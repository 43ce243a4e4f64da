# SPDX-License-Identifier: Apache-2.0
"""Has an arm changed since its correction was measured?"""

from __future__ import annotations

import argparse
import logging
import math
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.gauge_words import counted, listed
from remaster_ros.cli.console import tell
from remaster_ros.cli.options import number
from remaster_ros.cli.sessions import refuse_moving
from remaster_ros.cli.verify import require_same_arm
from remaster_ros.compensation.checking import (
    SMALLEST_M,
    CheckResult,
    JointCheck,
    Measured,
    Trend,
    judge,
)
from remaster_ros.compensation.file import Compensation, read_compensation
from remaster_ros.compensation.iso9283 import IsoFigures, iso_figures
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.check_page import write_check_page
from remaster_ros.session.records.journal import Journal, format_record
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import Session

FORMAT = 'remaster-check/1'
HISTORY = 'remaster-check-history/1'

log = logging.getLogger('remaster_ros')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster check``."""
    parser.add_argument(
        'session',
        metavar='SESSION',
        type=Path,
        help='session folder of the check: the same eight poses each time, those that '
        '`remaster plan --check` chooses',
    )
    parser.add_argument(
        '--baseline',
        metavar='COMPENSATION',
        type=Path,
        required=True,
        help='apply/compensation.json, by which the arm was right',
    )
    parser.add_argument(
        '--history',
        metavar='FILE',
        type=Path,
        required=True,
        help='all checks of this arm so far, such as arm7.jsonl; this one is added to it',
    )
    parser.add_argument(
        '--smallest-mm',
        type=number(0.001, 100.0, 'mm'),
        default=1e3 * SMALLEST_M,
        metavar='MM',
        help=f'change at the tool that matters (default {1e3 * SMALLEST_M:g})',
    )
    parser.add_argument(
        '--out', metavar='PAGE', type=Path, help='write a page with the trend, such as check.html'
    )
    parser.add_argument('--json', action='store_true', help='print what was found as JSON')


def run(args: argparse.Namespace) -> int:
    """Judge a session against the baseline, add it to the history, print the result; return 0.

    A session that cannot be judged is not added. If the session is the newest check of the
    history already, it is judged again, and not added a second time. Raises InputError for a
    session that is an older check, of another arm, or measured moving, and for an invalid
    file.
    """
    session, baseline = read_session(args.session), read_compensation(args.baseline)
    refuse_moving(session, args.session, 'check')
    require_same_arm(session, baseline, args.session)
    measured, chain = measured_of(session), baseline.model.chain
    iso = iso_figures(baseline.model, measured, session.measurements.wanted)
    _require_history(args.history)
    history = Journal(args.history)
    try:
        if history.lost:
            log.warning('%s', history.lost)
        checks, names = _before(history, args.history, baseline)
        known = [record.get('session_sha256') for record in history.records]
        sha256 = session.observations_sha256
        if sha256 in known:
            if known.index(sha256) + 1 < len(known):
                raise InputError(
                    f'{args.session}: is in {args.history} already, as check '
                    f'{known.index(sha256) + 1} of {len(known)}; give the newest check'
                )
        else:
            try:
                measured = (
                    measured.as_before(checks[0], chain) if checks else measured.merged(chain)
                )
            except InputError as error:
                raise InputError(f'{args.session}: {error}') from None
            checks, names = [*checks, measured], [*names, args.session.name]
            # Before it is written: what cannot be judged is no check.
            judge(baseline.model, checks, 1e-3 * args.smallest_mm)
            history.append(_record(measured, args.session.name, sha256, baseline))
    finally:
        history.close()
    found = judge(baseline.model, checks, 1e-3 * args.smallest_mm)
    content = content_of(found, chain, names, args.smallest_mm, iso)
    if args.out is not None:
        write_check_page(args.out, content, found.series_m, names)
    tell(args, content, _text(content), '' if args.out is None else f'written: {args.out}')
    return 0


def measured_of(session: Session) -> Measured:
    """Return the readings of a session as a check; its time NaN if the session states none."""
    m = session.measurements
    return Measured(
        m.q,
        tuple(session.sensor_names[i] for i in m.sensor.tolist()),
        tuple(session.marker_names[i] for i in m.marker.tolist()),
        m.position,
        _seconds(session.created),
    )


def _seconds(created: str) -> float:
    """Return the Unix time, s, of an ISO 8601 text, UTC if it states no zone; NaN of ''.

    Raises ValueError for another text.
    """
    if not created:
        return float('nan')
    moment = datetime.fromisoformat(created)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _record(measured: Measured, name: str, sha256: str, baseline: Compensation) -> dict[str, Any]:
    """Return a check as a record for the history.

    It has baseline, arm, session, readings, and the time if known, else None. ``name``: of the
    session; ``sha256``: of its observations.
    """
    return {
        'format': HISTORY,
        'baseline_sha256': baseline.sha256,
        'robot': baseline.content.robot.name,
        'joints': list(baseline.model.chain.joint_names),
        'session': name,
        'session_sha256': sha256,
        'q_rad': measured.q.tolist(),
        'sensor': list(measured.sensor),
        'marker': list(measured.marker),
        'position_m': measured.position.tolist(),
        'when_s': measured.when_s if math.isfinite(measured.when_s) else None,
    }


def _require_history(path: Path) -> None:
    """Raise InputError if a file exists and does not begin as a history of checks.

    To be called before it is opened as a journal, which drops what is no whole line. An empty
    file passes, and one whose first line is cut off.
    """
    start = format_record({'format': HISTORY})[: len(f'{{"format":"{HISTORY}"')]
    try:
        if path.exists() and not path.is_file():
            raise InputError(f'{path}: not a regular file; name a file for the history')
        with path.open('rb') as file:
            found = file.read(len(start))
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}; name a file for the history') from None
    # The first line may itself be torn: cut off, or zeros that the file system had reserved.
    if not start.startswith(found.rstrip(b'\0')):
        raise InputError(
            f'{path}, line 1: is no check of an arm; name another file for the history'
        )


def _before(
    history: Journal, path: Path, baseline: Compensation
) -> tuple[list[Measured], list[str]]:
    """Return the checks in a history and the names of their sessions, oldest first.

    ``path``: of the history, for the errors.

    Raises InputError, with the line, for a record of another arm or baseline, or a damaged
    one.
    """
    checks, names = [], []
    for line, record in enumerate(history.records, 1):
        where = f'{path}, line {line}'
        if record.get('format') != HISTORY:
            raise InputError(f'{where}: is no check of an arm; name another file for the history')
        if record.get('joints') != list(baseline.model.chain.joint_names):
            raise InputError(f'{where}: is of another arm; each arm has a history of its own')
        if record.get('baseline_sha256') != baseline.sha256:
            raise InputError(
                f'{where}: was compared with another baseline; a new correction begins a new '
                'history'
            )
        try:
            q, position = np.array(record['q_rad'], float), np.array(record['position_m'], float)
            sensor, marker = tuple(record['sensor']), tuple(record['marker'])
            names.append(str(record['session']))
            # Of earlier versions without.
            when = record.get('when_s')
            when_s = float('nan' if when is None else when)
        except (KeyError, TypeError, ValueError):
            raise InputError(f'{where}: is not whole; take another copy of the file') from None
        rows, k = len(sensor), len(baseline.model.chain)
        sound = q.shape == (rows, k) and position.shape == (rows, 3) and len(marker) == rows
        known = set(sensor) <= set(baseline.model.T_R_N) and set(marker) <= set(
            baseline.model.markers
        )
        if not (sound and known and np.isfinite(q).all() and np.isfinite(position).all()):
            raise InputError(f'{where}: is not whole; take another copy of the file')
        checks.append(Measured(q, sensor, marker, position, when_s))
    return checks, names


def content_of(
    found: CheckResult,
    chain: SerialChain,
    names: list[str],
    smallest_mm: float,
    iso: IsoFigures,
) -> dict[str, Any]:
    """Return the verdict and its figures as printed by --json; null for an unknown number.

    ``names``: of the sessions, oldest first; ``iso``: figures of the newest. Lengths are in mm,
    angles in degrees, as the keys say; checks count from 1. ``smallest_mm``: change at the tool
    that matters.
    """

    def known(value: float, scale: float) -> float | None:
        return scale * float(value) if np.isfinite(value) else None

    degree = float(np.degrees(1.0))

    def own(check: JointCheck, unit: str) -> dict[str, Any]:
        if unit == 'mm':
            # What it does at the tool is its own change.
            return {'change_deg': None, 'std_deg': None, 'std_mm': known(check.std, 1e3)}
        return {'change_deg': known(check.change, degree), 'std_deg': known(check.std, degree)}

    return {
        'format': FORMAT,
        'verdict': found.verdict,
        'evidence': found.evidence,
        'joints': [
            {
                'joint': name,
                'unit': unit,
                **own(check, unit),
                'change_mm': known(check.change * check.lever_m, 1e3),
                'detectable_mm': known(check.detectable_m, 1e3),
                'evidence': check.evidence,
            }
            for name, check, unit in zip(
                chain.joint_names, found.joints, chain.shown_units, strict=True
            )
        ],
        'changed': [chain.joint_names[joint] for joint in found.changed],
        'tool_moved': found.tool_moved,
        'since': None if found.since is None else names[found.since],
        'since_check': None if found.since is None else found.since + 1,
        'moved_mm': 1e3 * found.moved_m,
        'check_again': found.again,
        'trend': None if found.trend is None else _trend(found, chain.joint_names, names),
        'next_check': _next_date(found),
        'next_in_checks': None if found.in_days else math.ceil(found.next_in),
        'checks': len(names),
        'noise': 1e3 * found.noise_m,
        'smallest_mm': smallest_mm,
        'iso9283': {
            'accuracy_mm': (1e3 * iso.accuracy_m).tolist(),
            'repeatability_mm': (1e3 * iso.repeatability_m).tolist(),
            'text': iso.text(),
        },
        'text': in_words(found, chain.joint_names, names, smallest_mm),
    }


def _trend(found: CheckResult, joint_names: tuple[str, ...], names: list[str]) -> dict[str, Any]:
    """Return the trend of the checks for JSON: kind, joints by name, size, and since when.

    Size and half width of its 95 % interval are in mm. `found.trend` may not be None.
    """
    trend = found.trend
    assert trend is not None
    return {
        'kind': trend.kind,
        'joints': [joint_names[joint] for joint in trend.joints],
        'tool': trend.tool,
        'size_mm': 1e3 * trend.size_m,
        'half_mm': 1e3 * trend.half_m if np.isfinite(trend.half_m) else None,
        'since': names[trend.since],
        'since_check': trend.since + 1,
        'days': trend.span if found.in_days else None,
    }


def _next_date(found: CheckResult) -> str | None:
    """Return the day of the next check, ISO 8601, UTC; None if the times are not known."""
    if not (found.in_days and math.isfinite(found.when_s)):
        return None
    last = datetime.fromtimestamp(found.when_s, UTC)
    return (last + timedelta(days=found.next_in)).date().isoformat()


def _next_in_words(found: CheckResult) -> str:
    """Sentence on the next check: its date if `_next_date` has one.

    Without a date, after how many times the usual interval between checks (`next_in`, rounded
    up); if that is 1, to go on with the usual checks.
    """
    if (date := _next_date(found)) is not None:
        return f'Next check on {date}.'
    if (more := math.ceil(found.next_in)) > 1:
        return f'Next check after {more} times the usual while.'
    return 'Go on with the usual checks.'


def _span(found: CheckResult, trend: Trend) -> str:
    """Return the duration of a trend in words: 'in 3 days', below 2 days in hours.

    In checks if their times are not known.
    """
    if not found.in_days:
        return f'in {counted(max(1, round(trend.span)), "check")}'
    if trend.span < 2.0:
        return f'in {24.0 * trend.span:.0f} hours'
    return f'in {trend.span:.0f} days'


def _trend_in_words(
    found: CheckResult, joint_names: tuple[str, ...], names: list[str], smallest_mm: float
) -> str:
    """Return sentences on the trend (a change that is certain, without an alarm) and what to do.

    `found.trend` may not be None; ``names``: of the sessions of all checks; ``smallest_mm``:
    change at the tool that matters.
    """
    trend = found.trend
    assert trend is not None
    who = ' or '.join(
        [*(joint_names[joint] for joint in trend.joints), *(['the marker'] if trend.tool else [])]
    )
    size, half = 1e3 * trend.size_m, 1e3 * trend.half_m
    small = size + half <= smallest_mm
    if trend.kind == 'drift':
        matters = f'{smallest_mm:g} mm would matter' if small else 'which may matter'
        return (
            f'Drifting: {who}, {size:.2f} mm at the tool {_span(found, trend)}; {matters}. '
            f'{_next_in_words(found)}'
        )
    about = (
        f'less than what matters ({smallest_mm:g} mm)'
        if small
        else f'about what matters ({smallest_mm:g} mm): correct the arm anew if that is too much; '
        'checks at once do not tell more'
    )
    return (
        f'{who} has changed by {size:.2f} ± {half:.2f} mm at the tool since check '
        f'{trend.since + 1} ({names[trend.since]}), {about}. {_next_in_words(found)}'
    )


def in_words(
    found: CheckResult,
    joint_names: tuple[str, ...],
    names: list[str],
    smallest_mm: float = 1e3 * SMALLEST_M,
) -> str:
    """Return sentences on the verdict and on the next step.

    ``joint_names``: in the chain's order; ``names``: of the sessions of all checks, oldest
    first; ``smallest_mm``: change at the tool that matters.
    """
    if found.trend is not None:
        return _trend_in_words(found, joint_names, names, smallest_mm)
    unseen = [n for n, check in zip(joint_names, found.joints) if np.isnan(check.detectable_m)]
    same = f', or the zero of {" or ".join(unseen)}, which looks the same' if unseen else ''
    if found.verdict == 'changed':
        alike = [joint_names[joint] for joint in found.changed]
        who = ' or '.join(alike)
        several = ': these look alike in the poses of the check' if len(alike) > 1 else ''
        size = 1e3 * abs(found.joints[found.changed[0]].change)
        size *= found.joints[found.changed[0]].lever_m
        how = 'Has drifted' if found.drifts else 'Changed'
        return (
            f'{how} since check {_named(found, names)}: {who}{several}; {size:.2f} mm at the '
            'tool. Look at it (a collision, a loose bolt, a new zero), then measure and correct '
            'the arm again.'
        )
    if found.verdict == 'unclear' and found.tool_moved:
        who = ' or '.join(joint_names[joint] for joint in found.changed)
        return (
            f'Something has changed since check {_named(found, names)}: {who} or the marker on '
            'the tool, which look alike in the poses of the check. Look at the marker first: '
            'where it sits as it did, the arm has changed.'
        )
    if found.verdict == 'setup_moved' and found.tool_moved:
        return (
            f'The marker on the tool moved since check {_named(found, names)}, not the arm: '
            'fasten it, and begin a new history.'
        )
    if found.verdict == 'setup_moved':
        return (
            f'The sensor or the base moved by {1e3 * found.moved_m:.2f} mm{same}. No other joint '
            'has changed: the check is good for them.'
        )
    if found.verdict == 'unclear' and len(names) == 1:
        return (
            'The first check is further from the correction than both are uncertain by: check '
            'again at once. If it stays so: is it this arm, this marker, and is the correction '
            'in use as it was when it was measured?'
        )
    if found.verdict == 'unclear' and not found.again:
        return (
            'Something may have changed, and checks at once do not decide it. A change that '
            f'matters is named as soon as it is certain. {_next_in_words(found)}'
        )
    if found.verdict == 'unclear':
        return 'Something may have changed: check again at once.'
    beyond = [
        name
        for name, check in zip(joint_names, found.joints, strict=True)
        if len(names) > 1 and abs(check.change) * check.lever_m > check.detectable_m
    ]
    if beyond:
        return (
            f'No change is certain yet, but {listed(beyond)} '
            f'{"is" if len(beyond) == 1 else "are"} further from the checks before than what '
            'would be seen: check again.'
        )
    return 'No joint has changed by more than a check can see.'


def _named(found: CheckResult, names: list[str]) -> str:
    """Return the check since which the arm has changed: '3 (NAME)', number from 1 and session.

    The first check if that is not known (`found.since` None).
    """
    since = found.since or 0
    return f'{since + 1} ({names[since]})'


def _text(content: dict[str, Any]) -> str:
    """Text that ``remaster check`` prints: verdict, a line per joint, evidence and noise.

    ``content``: as returned by `content_of`.
    """
    drifts = content['trend'] is not None and content['trend']['kind'] == 'drift'
    # The sentence of a drift begins with the word.
    lines = [content['text'] if drifts else f'{content["verdict"]}: {content["text"]}']
    if not content['changed']:
        lines.append('each joint as if it alone had changed:')
    for check in content['joints']:
        if check['detectable_mm'] is None:
            lines.append(f'  {check["joint"]}: looks like a sensor that was moved; not checked')
            continue
        unit, digits = check['unit'], 3 if check['unit'] == 'mm' else 4
        std = check[f'std_{unit}']
        change = f'{check[f"change_{unit}"]:+.{digits}f}'
        change += f'{"" if std is None else f" ± {std:.{digits}f}"} {unit}'
        lines.append(
            f'  {check["joint"]}: {change}, {check["change_mm"]:+.3f} mm at the tool; '
            f'{check["detectable_mm"]:.2f} mm would be seen'
        )
    lines.append(
        f'check {content["checks"]}; evidence {content["evidence"]:.2g} (an alarm at 100); noise '
        f'of a reading {content["noise"]:.3f} mm'
    )
    if content['iso9283']['accuracy_mm']:
        lines.append(content['iso9283']['text'])
    return '\n'.join(lines)
