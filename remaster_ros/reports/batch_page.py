"""Many sessions on one page: which differ from the others, and which joints change along them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.compensation.checking import ALARM, change
from remaster_ros.reports.pages import page
from remaster_ros.session.files import write_atomically

MAD_STD = 1.4826
"""Standard deviations of a normal variable in a median of absolute deviations."""
DIFFERS = 5.0
"""So many standard deviations from the median of the sessions one differs: of ten joints in a
thousand sessions, none does by chance."""
FEW = 5
"""Sessions that a median and its scatter take."""


def summary_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what is to be said over all rows.

    Parameters
    ----------
    rows
        Of rows.jsonl, in the order of the sessions given.

    Returns
    -------
    dict
        ``counts`` by status; ``joints``: one of each joint of each kind of arm; ``lines``.
    """
    counts: dict[str, int] = defaultdict(int)
    arms: dict[tuple[str, tuple[str, ...]], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        counts[row['status']] += 1
        if row['status'] == 'done':
            names = tuple(one['joint'] for one in row['fit']['joints'])
            arms[row['fit']['robot'], names].append(row)
    joints = [
        _joint(robot, name, index, mine)
        for (robot, names), mine in arms.items()
        for index, name in enumerate(names)
    ]
    lines = [', '.join(f'{count} {status}' for status, count in counts.items())]
    for one in joints:
        if one['differs']:
            lines.append(
                f'{one["robot"]}, {one["joint"]}: {", ".join(one["differs"])} differ from the '
                f'median {one["median_deg"]:+.4f} deg'
            )
        if one['since']:
            lines.append(
                f'{one["robot"]}, {one["joint"]}: changed by {one["change_deg"]:+.4f} deg along '
                f'the sessions, since {one["since"]}'
            )
    for row in rows:
        check = row.get('check', {})
        if check.get('verdict') in ('changed', 'unclear', 'setup_moved'):
            lines.append(f'{Path(row["session"]).name}: {check["text"]}')
        if row['status'] != 'done':
            lines.append(f'{Path(row["session"]).name}: {row["error"]}')
    return {'counts': dict(counts), 'joints': joints, 'lines': lines}


def _joint(robot: str, name: str, index: int, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    known = [row for row in rows if row['fit']['joints'][index]['mean_deg'] is not None]
    mean = np.array([row['fit']['joints'][index]['mean_deg'] for row in known])
    std = np.array([row['fit']['joints'][index]['std_deg'] for row in known])
    names = [Path(row['session']).name for row in known]
    found: dict[str, Any] = {
        'robot': robot, 'joint': name, 'sessions': len(known), 'median_deg': None,
        'spread_deg': None, 'differs': [], 'since': '', 'change_deg': None,
    }  # fmt: skip
    if not len(mean):
        return found
    median = float(np.median(mean))
    spread = MAD_STD * float(np.median(np.abs(mean - median)))
    found |= {'median_deg': median, 'spread_deg': spread}
    if len(mean) < FEW:
        return found
    off = np.abs(mean - median) / np.hypot(spread, std)
    found['differs'] = [names[i] for i in np.flatnonzero(off > DIFFERS)]
    # Along the sessions in the order given, as for checks; one that differs alone is no change.
    along = change(mean)
    if along.evidence >= ALARM and abs(along.size) > along.half:
        found |= {'since': names[along.at], 'change_deg': along.size}
    return found


def write_batch_page(
    path: Path, rows: Sequence[Mapping[str, Any]], over_all: Mapping[str, Any]
) -> None:
    """Write the page; `InputError` where it cannot be written."""
    shown = [
        {
            'name': Path(row['session']).name,
            'folder': row['session'],
            'status': row['status'],
            'fit': row.get('fit'),
            'discovery': row.get('discovery'),
            'check': row.get('check'),
            'error': row.get('error', ''),
        }
        for row in rows
    ]
    write_atomically(path, page('batch.html.jinja', rows=shown, over_all=over_all))
