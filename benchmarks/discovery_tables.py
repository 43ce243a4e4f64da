# SPDX-License-Identifier: Apache-2.0
"""The tables of bench_discovery.py, from the lines of its results file."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from common import table
from judges.hidden_effects import CURVE_SHARE
from scipy.optimize import minimize
from worlds.hidden_third import HARM

from remaster_ros.simulation.hidden_effects import NAMED

BINS = (0.5, 1.0, 2.0, 4.0, 8.0)
# Held-out error may lie this far above the noise, in this share of single-effect sessions.
EXCESS, WITHIN_EXCESS = 1.05, 0.95
CLAIMS = 0.02
OUTCOMES = ('right', 'unexplained', 'elsewhere', 'partly', 'none', 'wrong')


def report(lines: Iterable[dict[str, Any]]) -> None:
    """Print all tables for the lines so far."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in lines:
        groups[line['name'].partition('-')[0]].append(line)
    for group, members in groups.items():
        failed = [line for line in members if 'error' in line]
        for line in failed[:5]:
            print(f'  failed: {line["name"]}: {line["error"]}')
        groups[group] = [line for line in members if 'error' not in line]
        times = [line['seconds'] for line in groups[group]]
        if times:
            print(
                f'{group}: {len(times)} sessions, {len(failed)} failed; {np.median(times):.1f} s '
                f'(median), {max(times):.1f} s (most) of CPU each'
            )
    for group in ('null', 'few'):
        if groups[group]:
            report_null(groups[group])
    if groups['single']:
        report_single(groups['single'])
        report_held_out(groups['single'])
    for group in ('pair', 'unnamed', 'triple'):
        if groups[group]:
            report_named(group, groups[group])
    report_outcomes([line for members in groups.values() for line in members])


def report_null(lines: list[dict[str, Any]]) -> None:
    claims = [line for line in lines if line['named']]
    rows = [line['rows'] for line in lines]
    print(
        f'\nNothing hidden, {min(rows)} to {max(rows)} observations: '
        f'{len(claims)} claims in {len(lines)} sessions '
        f'({_percent(len(claims), len(lines))}; the limit is {CLAIMS:.0%})'
    )
    for key in ('noise', 'outliers', 'robot', 'sensors'):
        shares = []
        for value in sorted({line[key] for line in lines}, key=str):
            mine = [line for line in lines if line[key] == value]
            shares.append(f'{value} {sum(bool(m["named"]) for m in mine)}/{len(mine)}')
        print(f'  {key}: ' + ', '.join(shares))
    for line in claims:
        print(f'  claimed in {line["name"]}: {"; ".join(line["named"])}')
    undetermined = sum(line['verdict'] == 'undetermined' for line in lines)
    print(f'  "undetermined" without a claim counts as none: {undetermined} such verdicts')


def report_single(lines: list[dict[str, Any]]) -> None:
    print(
        '\nPower: share named right (nothing else named) by size, a multiple of the size at which '
        'the best\npossible test finds it in 90 %; and the size at which 90 % are named right.'
    )
    edges = [f'{a:g}-{b:g}' for a, b in pairwise(BINS)]
    print(
        f'{"effect":22}' + ''.join(f'{e:>9}' for e in edges) + '   best mm   times   90 % at mm'
        '   size in 3 std'
    )
    for kind in NAMED:
        mine = [line for line in lines if line['kinds'] == [kind]]
        if not mine:
            continue
        cells = []
        for low, high in pairwise(BINS):
            part = [m['named_right'] for m in mine if low <= m['multiple'] < high]
            cells.append(f'{sum(part)}/{len(part)}' if part else '')
        times = multiple_for(mine)
        best = float(np.median([m['best_mm'][0] for m in mine]))
        sizes = [m['size_right'] for m in mine if m['size_right'] is not None]
        where = f'{times:7.1f} {times * best:10.2f}' if times else '    > 8          '
        print(
            f'{kind:22}'
            + ''.join(f'{c:>9}' for c in cells)
            + f'{best:10.3f} {where}   {sum(sizes)}/{len(sizes)}'
        )
    z = [
        value
        for line in lines
        for key, value in line['deviations'].items()
        if key != 'curve' and line['size_right'] is not None
    ]
    if z:
        beyond = sum(abs(value) > 3 for value in z)
        print(
            f'sizes: {len(z)} parameters, RMS of (found - true) / std '
            f'{np.sqrt(np.mean(np.square(z))):.2f}, {beyond} beyond 3 std; curves agree to '
            f'{CURVE_SHARE:.0%} of their RMS'
        )


def multiple_for(lines: list[dict[str, Any]], share: float = 0.9) -> float | None:
    """Fit a logistic curve over the logarithm of the size; return where it reaches the share."""
    x = np.log2([line['multiple'] for line in lines])
    right = np.array([line['named_right'] for line in lines], dtype=float)

    def cost(p: np.ndarray) -> float:
        eta = np.exp(p[1]) * (x - p[0])
        likelihood = np.sum(np.logaddexp(0.0, eta) - right * eta)
        # Weak priors: half way is near twice the best test's size, a slope of about 2.
        return float(likelihood + 0.5 * ((p[0] - 1.0) / 2.0) ** 2 + 0.5 * (p[1] - 0.7) ** 2)

    middle, slope = minimize(cost, np.array([1.0, 0.7])).x
    at = middle + np.log(share / (1.0 - share)) / np.exp(slope)
    return float(2.0**at) if at <= np.log2(BINS[-1]) else None


def report_held_out(lines: list[dict[str, Any]]) -> None:
    ratios = np.array([line['after_mm'] / line['floor_mm'] for line in lines])
    within = int(np.sum(ratios <= EXCESS))
    print(
        f'\nHeld-out error after / noise of the same rows: within {EXCESS - 1:.0%} in {within} of '
        f'{len(ratios)} ({_percent(within, len(ratios))}; at least {WITHIN_EXCESS:.0%} wanted); '
        f'median {np.median(ratios):.3f}, largest {ratios.max():.3f}'
    )


def report_named(group: str, lines: list[dict[str, Any]]) -> None:
    right = sum(line['named_right'] for line in lines)
    first = sum(line['first_right'] for line in lines)
    sizes = [line['size_right'] for line in lines if line['size_right'] is not None]
    print(
        f'\n{group}: exactly right {right} of {len(lines)} ({_percent(right, len(lines))}); the '
        f'first named is one hidden {first}; sizes within 3 std {sum(sizes)} of {len(sizes)}'
    )
    for line in lines:
        if not line['named_right'] and line['multiple'] >= 2.0:
            named = '; '.join(line['named']) or 'nothing'
            print(f'  {line["name"]}: hidden {"; ".join(line["hidden"])}; named {named}')


def report_outcomes(lines: list[dict[str, Any]]) -> None:
    """Print what came of every kind of session, and where what was returned did harm."""
    kinds: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in lines:
        group, *kind, _ = line['name'].split('-')
        if group in ('plane', 'region'):
            kind = ['one effect' if line['kinds'] else 'nothing hidden']
        elif group in ('single', 'pair', 'triple', 'unnamed'):
            kind = ['from 2 x' if line['multiple'] >= 2.0 else 'below 2 x']
        kinds[' '.join((group, *kind))].append(line)
    print(
        '\nOutcomes. unexplained: said to be unexplained, at the right place, and no wrong name; '
        'elsewhere: at another\nplace; partly: some of several are named, nothing else; wrong: '
        'something named that is not there; harm:\nerror on a third set of poses more than 5 % '
        'above that of the offsets, both without noise; by how much\nat most; measured: harm '
        'where the third set has noise like the rows held out.\n'
    )
    header = ('sessions', 'n', *OUTCOMES, 'harm', 'largest', 'measured', 'named')
    rows = []
    for kind, members in kinds.items():
        counts = Counter(line['outcome'] for line in members)
        ratios = [line['third_mm'] / line['third_offsets_mm'] for line in members]
        names = Counter(
            cause.split()[0]
            for line in members
            if line['outcome'] != 'right'
            for cause in line['named']
        )
        rows.append(
            (
                kind,
                len(members),
                *(counts[outcome] for outcome in OUTCOMES),
                sum(line['harm'] for line in members),
                f'{max(ratios):.2f}',
                sum(_harm_as_measured(line) for line in members),
                ', '.join(f'{name} {n}' for name, n in names.most_common(4)),
            )
        )
    print(table(header, rows))


def _harm_as_measured(line: dict[str, Any]) -> bool:
    # Gross errors among the held-out rows would hide any harm.
    noise = 0.0 if line['outliers'] else line['floor_mm']
    return bool(
        np.hypot(line['third_mm'], noise) > HARM * np.hypot(line['third_offsets_mm'], noise)
    )


def _percent(part: int, total: int) -> str:
    return f'{100.0 * part / total:.1f} %'
