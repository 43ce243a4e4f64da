# SPDX-License-Identifier: Apache-2.0
"""Are the intervals right? Sessions with random truths: coverage, rank statistics, efficiency.

Every session has the paper's size (36 poses, 173 configurations), one of three choices of sensors
(mocap, tracker, both) and one of three kinds of noise:

    independent  per point only
    common       a part common to all solutions of a pose, 2 to 6 times the part per point
    prior        the ratio of the two parts drawn from the fit's own prior, half-Cauchy

The size of the noise is drawn log-uniformly from 0.02 to 0.5 mm, the offsets from N(0, 0.3 deg),
the markers from their prior, all anew for each session. Printed are, over all sessions,

*Coverage* of the central 95 % intervals. The common part under independent noise is left out: its
truth is exactly 0, where no central interval reaches.

*Ranks* of the truth among the draws (simulation-based calibration, Talts et al. 2018), with the
p-value of a chi-square test in 20 bins. Ranks are uniform only for truths from the prior. The
priors of offsets, registrations and log sigma are flat, so there is nothing to draw from; but flat
priors are those of the shifts and the scale that leave the model as it is (to first order in
offsets of a fraction of a degree), and then ranks are uniform for *any* truth. Markers and the
ratio of the noises have proper priors and are drawn from them; so sessions of kind `prior` decide.

*Efficiency*: RMS of (posterior mean - truth) over the Cramér-Rao bound of the session: inverse
Fisher information of all parameters and the markers' prior at the truth, with the noise known.

Compared are parameters in coordinates that the data can see (joint 1 turned into the
registrations, the last joint into the markers).

    OMP_NUM_THREADS=1 python benchmarks/bench_calibration.py [--sessions 1000] [--record FILE]

With --record a run goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import machine, progress, table
from judges.calibration_study import NOISES, RANKS, Outcome, one_session
from rigs.parallel import in_parallel
from scipy.stats import binom, chi2, kstest

BINS = 20


def report(outcomes: Sequence[Outcome]) -> str:
    """Return the tables."""
    parts = [_coverage(outcomes), _ranks(outcomes), _efficiency(outcomes)]
    return '\n\n'.join(parts)


def kind_of(name: str) -> str:
    """Return which group a parameter belongs to."""
    group = name.split('.')[0]
    if group == 'noise':
        return name.split('.')[-1]
    return group if group in ('registration', 'marker') else 'offset'


def _coverage(outcomes: Sequence[Outcome]) -> str:
    rows = []
    by_name: dict[str, list[bool]] = {}
    for outcome in outcomes:
        for name, is_inside in outcome.inside.items():
            by_name.setdefault(name, []).append(is_inside)
    for kind in dict.fromkeys(map(kind_of, by_name)):
        names = [name for name in by_name if kind_of(name) == kind]
        shares = [float(np.mean(by_name[name])) for name in names]
        counts = [len(by_name[name]) for name in names]
        together = float(np.average(shares, weights=counts))
        fewest = min(counts)
        low, high = binom.interval(0.99, fewest, 0.95) if fewest else (0, 0)
        rows.append(
            (
                kind,
                len(names),
                f'{fewest}',
                f'{100 * together:.1f}',
                f'{100 * min(shares):.1f} to {100 * max(shares):.1f}',
                f'{100 * low / fewest:.1f} to {100 * high / fewest:.1f}',
            )
        )
    header = (
        'parameters',
        'how many',
        'sessions each, at least',
        'all together, %',
        'from worst to best, %',
        'of one at 95 %: 99 % of chance lies in',
    )
    return f'Coverage of central 95 % intervals\n\n{table(header, rows)}'


def _ranks(outcomes: Sequence[Outcome]) -> str:
    rows = []
    for title, chosen in (
        ('all', outcomes),
        ('prior only', [o for o in outcomes if o.noise == 'prior']),
    ):
        ranks: dict[str, list[int]] = {}
        for outcome in chosen:
            for name, rank in outcome.rank.items():
                if title == 'all' and 'pose_sigma' in name:
                    continue
                ranks.setdefault(name, []).append(rank)
        p_values = {name: _uniform(values) for name, values in ranks.items()}
        if not p_values:
            continue
        worst = min(p_values, key=lambda name: p_values[name][0])
        p = np.array([chi for chi, _ in p_values.values()])
        rows.append(
            (
                title,
                len(p),
                len(chosen),
                f'{p.min():.4f} ({worst})',
                f'{min(1.0, len(p) * p.min()):.2f}',
                f'{np.sum(p < 0.05)} ({0.05 * len(p):.1f} expected)',
                f'{min(ks for _, ks in p_values.values()):.4f}',
            )
        )
    header = (
        'sessions',
        'parameters',
        'how many',
        'smallest chi-square p',
        'times the number of tests',
        'p below 0.05',
        'smallest KS p',
    )
    note = 'pose_sigma has a proper prior: its ranks are uniform in sessions of kind `prior` only.'
    return f'Ranks ({BINS} bins)\n\n{table(header, rows)}\n\n{note}'


def _uniform(ranks: Sequence[int]) -> tuple[float, float]:
    """Return p-values that ranks 0 … RANKS are uniform, by chi-square and Kolmogorov-Smirnov."""
    values = np.asarray(ranks)
    found = np.bincount(values * BINS // (RANKS + 1), minlength=BINS)
    expected = len(values) / BINS
    statistic = float(np.sum((found - expected) ** 2) / expected)
    # The middle of each rank's step: a continuous stand-in, for a test of continuous values.
    return float(chi2.sf(statistic, BINS - 1)), float(
        kstest((values + 0.5) / (RANKS + 1), 'uniform').pvalue
    )


def _efficiency(outcomes: Sequence[Outcome]) -> str:
    rows = []
    for title, chosen in (
        ('all', outcomes),
        *((noise, [o for o in outcomes if o.noise == noise]) for noise in NOISES),
    ):
        errors = np.array([outcome.error for outcome in chosen])
        if len(errors) == 0:
            continue
        squares = np.mean(errors**2, axis=1)
        ratio = float(np.sqrt(squares.mean()))
        spread = float(squares.std() / np.sqrt(len(squares)) / (2.0 * ratio))
        by_joint = ' '.join(f'{value:.3f}' for value in np.sqrt(np.mean(errors**2, axis=0)))
        rows.append((title, len(errors), f'{ratio:.3f}', f'{spread:.3f}', by_joint))
    header = ('noise', 'sessions', 'RMS error / bound', 'std of that by chance', 'joint by joint')
    return f'Standard error of the offsets over the Cramér-Rao bound\n\n{table(header, rows)}'


def read_record(path: Path | None) -> list[Outcome]:
    """Return the outcomes of an earlier run; a last line cut short is left out."""
    if path is None or not path.is_file():
        return []
    found = []
    for line in path.read_text(encoding='utf-8').splitlines():
        try:
            found.append(Outcome(**json.loads(line)))
        except (ValueError, TypeError):
            continue
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--sessions', type=int, default=90, help='how many (default 90)')
    parser.add_argument('--record', type=Path, help='JSON lines of what is done; goes on from it')
    parser.add_argument('--workers', type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    outcomes = [o for o in read_record(args.record) if o.seed < args.sessions]
    seeds = sorted(set(range(args.sessions)) - {outcome.seed for outcome in outcomes})
    print(f'{machine()}; {args.sessions} sessions, {len(outcomes)} of them from {args.record}')
    started = time.perf_counter()
    file = args.record.open('a', encoding='utf-8') if args.record else None
    for outcome in in_parallel(one_session, seeds, args.workers):
        outcomes.append(outcome)
        if file is not None:
            file.write(json.dumps(outcome._asdict()) + '\n')
            file.flush()
        progress(f'{len(outcomes)} of {args.sessions}')
        if len(outcomes) % 250 == 0 and len(outcomes) < args.sessions:
            print(f'-- after {len(outcomes)} sessions\n{report(outcomes)}\n', flush=True)
    progress('')
    print(report(outcomes))
    print(f'\n{len(seeds)} sessions in {time.perf_counter() - started:.0f} s')


if __name__ == '__main__':
    main()
