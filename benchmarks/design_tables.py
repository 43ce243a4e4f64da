"""Tables of designed poses beside the Latin hypercube."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from common import table
from scipy.stats import binomtest


def table_of(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table of an arm."""
    header = (
        'row', 'configurations', 'poses', 'nearest, s', 'fastest, s',
        '… at 0.25 m/s: configurations', 'nearest, s', 'fastest, s', 'expected RMS std, deg',
        'RMS error of the fits, deg', '95 % intervals that hold it', 'choice, s',
    )  # fmt: skip
    rows = []
    for line in lines:
        free, slow = line['limits']
        std, error = (f'{value:.5f}' for value in (free['joint_rms_deg'], line['rms_error_deg']))
        held, choice_s = share_held(line['held'], line['intervals']), f'{line["choice_s"]:.1f}'
        count, *times = cost(free)
        rows.append(
            (line['row'], count, free['poses'], *times, *cost(slow), std, error, held, choice_s)
        )
    return table(header, rows)


def side_by_side(
    lines: dict[tuple[str, int], list[dict[str, Any]]], limits: Sequence[float]
) -> str:
    """Return what the design saves, arm by arm and seed by seed."""
    header = (
        'arm', 'seed', 'limit, m/s', 'Latin hypercube: configurations', 'nearest, s', 'fastest, s',
        'A-optimal: configurations', 'nearest, s', 'fastest, s', 'configurations, 1/…',
        'time, nearest to fastest, 1/…', 'both nearest, 1/…', 'both fastest, 1/…',
    )  # fmt: skip
    rows = []
    for place, limit in enumerate(limits):
        for (robot, seed), pair in lines.items():
            latin, best = (line['limits'][place] for line in pair)
            count, near, fast = 'configurations', 'nearest_s', 'fastest_s'
            shares = ((count, count), (near, fast), (near, near), (fast, fast))
            saved = [f'{latin[before] / best[after]:.1f}' for before, after in shares]
            name = 'none' if np.isinf(limit) else f'{limit:g}'
            rows.append((robot, seed, name, *cost(latin), *cost(best), *saved))
    return table(header, rows)


def cost(found: dict[str, Any]) -> tuple[str, ...]:
    """Return configurations, and time in both orders."""
    times = [
        f'{found[f"{order}_s"]:.0f}' + f' ({lost} without a way)' * bool(lost)
        for order in ('nearest', 'fastest')
        for lost in [found[f'{order}_lost']]
    ]
    return (str(found['configurations']), *times)


def share_held(held: int, intervals: int) -> str:
    return f'{held} of {intervals} (p {binomtest(held, intervals, 0.95).pvalue:.2f})'
