"""Are look-alikes decided once the configurations that separate them are measured?

An arm of the hidden world (test/hidden_pairs.py) has one of a pair of look-alikes, of 2 to 8 times
the size at which the best possible test finds it at all. An ordinary session of it is searched;
the causes that the search finds and their look-alikes decide which configurations are measured
further (25 at most); everything is searched again. Printed is how often each search names exactly
the hidden cause, leaves it open, finds nothing, or names others.

    OMP_NUM_THREADS=1 python benchmarks/bench_separating.py --out separating.jsonl [--sessions 120]

Begun again with the same file it goes on where it was.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import known, machine, progress, resumed, table
from hidden_pairs import PAIRS, measured_further, pair_session, separating, verdict, visits_of

from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.planning.rival_causes import FoundCause


def words(found: Discovery) -> list[list[Any]]:
    """Return each cause and its look-alikes, with their log evidence."""
    return [
        [
            [one.name, one.joints, round(one.log_evidence_gain, 1)]
            for one in (e, *e.confusable_with)
        ]
        for e in found.effects
    ]


def one(task: tuple[str, int]) -> dict[str, Any]:
    """Search a session, and again with what separates."""
    name, number = task
    started = time.process_time()
    pair = pair_session(number)
    before = discover_session(pair.session, rng=np.random.default_rng(number))
    causes = [cause for e in before.effects if (cause := FoundCause.of(e)).look_alikes]
    outcome = verdict(before, pair, pair.world, pair.truth)
    line = {
        'name': name,
        'pair': pair.number,
        'true': pair.true,
        'multiple': pair.multiple,
        'rows': len(pair.session.measurements),
        'left': bool(causes),
        'before': outcome,
        'first': words(before),
        'added': 0,
        'after': outcome,
    }
    if causes:
        design = separating(pair, causes)
        line['apart'] = [[p.before, p.after] for p in design.pairs]
        if design.order:
            session, world, truth = measured_further(pair, visits_of(pair, design))
            after = discover_session(session, rng=np.random.default_rng(number))
            line |= {
                'added': len(design.order),
                'after': verdict(after, pair, world, truth),
                'second': words(after),
            }
    return {**line, 'seconds': time.process_time() - started}


def main() -> None:
    """Run what the file does not hold yet, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--out', type=Path, required=True, help='results so far, JSON lines')
    parser.add_argument('--sessions', type=int, default=120)
    parser.add_argument('--jobs', type=int, default=1)
    args = parser.parse_args()
    print(machine())
    todo = {f'session {number}': number for number in range(args.sessions)}
    done = known(args.out)
    left = {name: number for name, number in todo.items() if name not in done}
    for count, line in enumerate(resumed(args.out, left, one, args.jobs)):
        done[line['name']] = line
        progress(f'{count + 1} of {len(left)} sessions')
    report([done[name] for name in todo if name in done])


def report(lines: Sequence[dict[str, Any]]) -> None:
    """Print how often the searches were right, open, without an answer and wrong."""
    rows = []
    for number, pair in enumerate(PAIRS):
        words = ' / '.join(
            f'{name} {joints[0]}' if joints else name for name, joints in pair
        ).replace('_', ' ')
        rows.append([words, *_counts([s for s in lines if s['pair'] == number])])
    rows.append(['all', *_counts(lines)])
    left = [s for s in lines if s['left'] or s['before'] != 'right']
    rows.append(['of these not decided by the first search', *_counts(left)])
    header = ['pair', 'sessions', 'first search', 'with what separates', 'added at most']
    print('right, open, none, wrong:\n')
    print(table(header, rows))
    print(f'\n{np.mean([s["seconds"] for s in lines]):.1f} s of CPU each')


def _counts(mine: Sequence[dict[str, Any]]) -> list[object]:
    counts = [
        ' '.join(str(sum(s[key] == w for s in mine)) for w in ('right', 'open', 'none', 'wrong'))
        for key in ('before', 'after')
    ]
    return [len(mine), *counts, max((s['added'] for s in mine), default=0)]


if __name__ == '__main__':
    main()
