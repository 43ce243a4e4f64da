# SPDX-License-Identifier: Apache-2.0
"""Page of many sessions: those that differ from the others, and joints that change along them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from remaster_ros.compensation.checking import ALARM, change
from remaster_ros.reports.fit_judgement import without_search
from remaster_ros.reports.pages import page
from remaster_ros.session.files import write_atomically
from remaster_ros.types import FloatArray

MAD_STD = 1.4826
"""Factor from a median absolute deviation to the standard deviation of a normal variable."""
OWN_STD = 5.0
"""Least distance from the median, in its own standard deviations, of a session that differs: of
ten joints in a thousand sessions, none exceeds it by chance."""
FALSE = 0.01
"""Probability that any of a kind of arm is reported to differ if all are alike."""
FEW = 5
"""Least number of sessions from which one can be found to differ."""


def summary_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the summary of many sessions for the page and the terminal.

    Parameters
    ----------
    rows
        Rows of rows.jsonl, in the order of the sessions given.

    Returns
    -------
    dict
        ``counts``: number of rows by status; ``joints``: a row for each joint of each kind of arm;
        ``lines``: text on sessions that differ, changes, checks and errors.
    """
    counts: dict[str, int] = defaultdict(int)
    arms: dict[tuple[str, tuple[str, ...]], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        counts[row['status']] += 1
        if row['status'] == 'done':
            names = tuple(joint['joint'] for joint in row['fit']['joints'])
            arms[row['fit']['robot'], names].append(row)
    joints = [
        _joint(robot, name, index, selection, FALSE / len(names))
        for (robot, names), selection in arms.items()
        for index, name in enumerate(names)
    ]
    lines = [', '.join(f'{count} {status}' for status, count in counts.items())]
    for joint in joints:
        if joint['differs']:
            lines.append(
                f'{joint["robot"]}, {joint["joint"]}: {", ".join(joint["differs"])} differ from '
                f'the median {_shown(joint, "median")}'
            )
        if joint['since']:
            lines.append(
                f'{joint["robot"]}, {joint["joint"]}: changed by {_shown(joint, "change")} along '
                f'the sessions, since {joint["since"]}'
            )
    for row in rows:
        check = row.get('check', {})
        if check.get('verdict') in ('changed', 'unclear', 'setup_moved'):
            lines.append(f'{Path(row["session"]).name}: {check["text"]}')
        if row['status'] != 'done':
            lines.append(f'{Path(row["session"]).name}: {row["error"]}')
    return {'counts': dict(counts), 'joints': joints, 'lines': lines}


def differing(values: FloatArray, level: float) -> list[int]:
    """Indices of the values (n,) that do not belong to the normal distribution of the others.

    ``level``: probability that any is named if none differs; checked by simulation for 5 to 200
    values. By the generalised extreme Studentised deviate test: values are taken out one by one,
    up to a third of them, so that several do not hide each other (B. Rosner, "Percentage points
    for a generalized ESD many-outlier procedure", Technometrics 25, 1983, equation 2.5). [] for
    fewer than 4 values.
    """
    remaining = list(range(len(values)))
    removed: list[int] = []
    differ = 0
    for _ in range((len(values) - 1) // 3):
        n = len(remaining)
        deviation = np.abs(values[remaining] - np.mean(values[remaining]))
        worst = int(np.argmax(deviation))
        t = float(stdtrit(n - 2.0, 1.0 - level / (2.0 * n)))
        limit = (n - 1.0) * t / np.sqrt((n - 2.0 + t**2) * n)
        beyond = deviation[worst] > limit * np.std(values[remaining], ddof=1)
        removed.append(remaining.pop(worst))
        if beyond:
            differ = len(removed)
    return sorted(removed[:differ])


def _shown(joint: Mapping[str, Any], key: str) -> str:
    """Return a joint's value with sign and unit: '+0.0123 deg'.

    ``joint``: a row of `_joint`, in which the value is not None; ``key``: name of the value
    without its unit, such as 'median'.
    """
    return f'{joint[key + "_" + joint["unit"]]:+.4f} {joint["unit"]}'


def _joint(
    robot: str, name: str, index: int, rows: Sequence[Mapping[str, Any]], level: float
) -> dict[str, Any]:
    """Row of a joint for the page, on its zero-offset in the sessions of one kind of arm.

    Median and spread of the offset, sessions that differ, lasting change; keys of values end in
    the unit, 'deg' or 'mm'. Unknown values are None, under '_deg' for any unit; lists and texts
    are empty then. With fewer than `FEW` offsets only median and spread are known. ``index``:
    of the joint in each row, from 0; ``rows``: done sessions; ``level``: probability that any
    session is named if none differs.
    """
    unit = rows[0]['fit']['joints'][index].get('unit', 'deg')
    known = [row for row in rows if row['fit']['joints'][index].get(f'mean_{unit}') is not None]
    mean = np.array([row['fit']['joints'][index][f'mean_{unit}'] for row in known])
    std = np.array([row['fit']['joints'][index][f'std_{unit}'] for row in known])
    names = [Path(row['session']).name for row in known]
    found: dict[str, Any] = {
        'robot': robot, 'joint': name, 'sessions': len(known), 'median_deg': None,
        'spread_deg': None, 'differs': [], 'since': '', 'change_deg': None, 'unit': unit,
    }  # fmt: skip
    if not len(mean):
        return found
    median = float(np.median(mean))
    spread = MAD_STD * float(np.median(np.abs(mean - median)))
    found |= {f'median_{unit}': median, f'spread_{unit}': spread}
    if len(mean) < FEW:
        return found
    sure = np.abs(mean - median) > OWN_STD * std
    found['differs'] = [names[i] for i in differing(mean, level) if sure[i]]
    # Along the sessions in the order given, as for checks; one that differs alone is no change.
    along = change(mean)
    if along.evidence >= ALARM and abs(along.size) > along.half:
        found |= {'since': names[along.at], f'change_{unit}': along.size}
    return found


def _fit_shown(row: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the fit of a row, without the advice to search for causes if that was done.

    A copy then; None if the row has no fit.
    """
    fit = row.get('fit')
    if not fit or 'discovery' not in row:
        return fit
    return {**fit, 'headline': without_search(fit['headline'])}


def write_batch_page(
    path: Path, rows: Sequence[Mapping[str, Any]], over_all: Mapping[str, Any]
) -> None:
    """Write the page of many sessions; an existing file is replaced.

    ``rows``: rows of rows.jsonl; ``over_all``: result of `summary_of`. Raises DiskError if the
    file cannot be written.
    """
    shown = [
        {
            'name': Path(row['session']).name,
            'folder': row['session'],
            'status': row['status'],
            'fit': _fit_shown(row),
            'discovery': row.get('discovery'),
            'check': row.get('check'),
            'error': row.get('error', ''),
        }
        for row in rows
    ]
    write_atomically(path, page('batch.html.jinja', rows=shown, over_all=over_all))
