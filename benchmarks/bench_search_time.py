"""What does a search of 350 rows of a real arm take, beside another checkout of this project?

Of the rows to fit of `ur10_iso_cubes` 350 are drawn at random; the others are left out. Each draw
is searched in a process of its own by this tree and by the other one in turns, so that both see
the same machine: its speed changes by a half within hours. Times are CPU seconds of
`discover_session`.

    python benchmarks/bench_search_time.py [--other FOLDER] [--draws 3] [--turns 2] [--rows 350]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT, machine, table

SESSION = ROOT.parent / 'shared' / 'data' / 'ur10_iso_cubes'


def one(rows: int, draw: int) -> dict[str, Any]:
    """Search one draw; return what it took and found."""
    from remaster_ros.discovery.discover import discover_session
    from remaster_ros.session.reader import read_session

    session = read_session(SESSION)
    held_out = session.measurements.is_validation
    kept = np.random.default_rng(draw).choice(np.flatnonzero(~held_out), rows, replace=False)
    session = session.select(held_out | np.isin(np.arange(len(held_out)), kept))
    started = time.process_time()
    found = discover_session(session, rng=np.random.default_rng(draw))
    return {
        'seconds': time.process_time() - started,
        'parameters': len(found.solution.parameters),
        'causes': len(found.groups),
        'held_out_mm': 1e3 * (found.gain.held_out_rms_after_m or float('nan')),
    }


def in_its_process(tree: Path, rows: int, draw: int) -> dict[str, Any]:
    """Run `one` with the package of a checkout."""
    environment = {**os.environ, 'PYTHONPATH': str(tree), 'OMP_NUM_THREADS': '1'}
    command = [sys.executable, __file__, '--rows', str(rows), '--one', str(draw)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    line: dict[str, Any] = json.loads(done.stdout)
    return line


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--other', type=Path, help='another checkout, to compare with')
    parser.add_argument('--rows', type=int, default=350)
    parser.add_argument('--draws', type=int, default=3)
    parser.add_argument('--turns', type=int, default=2)
    parser.add_argument('--one', type=int, help='only this draw, by the package that is found')
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(one(args.rows, args.one)))
        return
    if not SESSION.is_dir():
        sys.exit(f'{SESSION} is not here: this benchmark is of measurements of others')
    trees = [ROOT, *([args.other.resolve()] if args.other else [])]
    lines = []
    for draw in range(args.draws):
        # The least of the turns: other work on the machine only adds.
        taken: dict[Path, list[dict[str, Any]]] = {tree: [] for tree in trees}
        for _ in range(args.turns):
            for tree in trees:
                taken[tree].append(in_its_process(tree, args.rows, draw))
        best = [min(runs, key=lambda run: run['seconds']) for runs in taken.values()]
        ratio = f'{best[0]["seconds"] / best[1]["seconds"]:.2f}' if args.other else ''
        for tree, run in zip(trees, best, strict=True):
            lines.append(
                (
                    draw,
                    'this' if tree is ROOT else 'other',
                    f'{run["seconds"]:.1f}',
                    ratio if tree is ROOT else '',
                    run['causes'],
                    run['parameters'],
                    f'{run["held_out_mm"]:.3f}',
                )
            )
    print(machine())
    print(table(('draw', 'tree', 'CPU s', 'ratio', 'causes', 'parameters', 'held out, mm'), lines))


if __name__ == '__main__':
    main()
