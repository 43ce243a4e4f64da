"""Simulated power cuts in the life of a session: what is lost, and does recovery settle?

The real writer's operations (writes, syncs, renames, new names) are recorded; then a crash is
played after each of them, where of everything not synced any part may be there, be missing, be
cut or be zeros (test/crash_states.py). After each: the session is read as it is, recovered, at
times with a crash in the recovery too, recovered again, gone on with and completed, and held to
what its writer had acknowledged (test/session_crashes.py).

A life that is done is written down, so that the next run goes on where this one stopped.

    python benchmarks/bench_crash_states.py [--states 12000] [--processes N] [--out FILE]
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

from session_crashes import check, live, yaml_read_once

MEMORY = '/dev/shm' if os.path.isdir('/dev/shm') else None


def one_life(seed: int) -> tuple[int, int, Counter[str], list[str]]:
    """Crash the life of this seed at every boundary, four times each."""
    logging.disable(logging.CRITICAL)
    found: Counter[str] = Counter()
    failures = []
    with tempfile.TemporaryDirectory(dir=MEMORY) as name, yaml_read_once():
        root = Path(name)
        (root / 'life').mkdir()
        life = live(root / 'life', seed, configurations=6 + seed % 10)
        for cut in range(len(life.operations) + 1):
            for repeat in range(4):
                (root / 'crash').mkdir()
                try:
                    chooser = random.Random(f'{seed} {cut} {repeat}')
                    found[check(life, cut, chooser, root / 'crash')] += 1
                except Exception:
                    what = traceback.format_exc(limit=-1)
                    failures.append(f'seed {seed} cut {cut} repeat {repeat}: {what}')
                shutil.rmtree(root / 'crash')
    return seed, len(life.operations), found, failures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--states', type=int, default=12_000, help='at least so many states')
    parser.add_argument('--processes', type=int, default=os.cpu_count())
    parser.add_argument('--out', type=Path, default=Path('crash_states.jsonl'))
    args = parser.parse_args()
    known = (
        {life[0]: life for life in map(json.loads, args.out.read_text().splitlines())}
        if args.out.exists()
        else {}
    )
    total: Counter[str] = Counter()
    failures: list[str] = []
    began = time.monotonic()
    print('  seed  operations  states so far  nothing yet  whole  dropped  failures')
    with args.out.open('a') as file, ProcessPoolExecutor(args.processes) as pool:
        # A life has some hundred operations.
        seeds = range(args.states // 350 + 1)
        fresh = pool.map(one_life, [seed for seed in seeds if seed not in known])
        for seed in seeds:
            life = known.get(seed) or next(fresh)
            if seed not in known:
                file.write(json.dumps(life) + '\n')
                file.flush()
            _, operations, found, failed = life
            total.update(found)
            failures += failed
            print(
                f'{seed:6d} {operations:11d} {total.total() + len(failures):14d} '
                f'{total["nothing"]:12d} {total["whole"]:6d} {total["dropped"]:8d} '
                f'{len(failures):9d}',
                flush=True,
            )
    states = total.total() + len(failures)
    for failure in failures[:5]:
        print(failure)
    print(
        f'{states} crash states in {time.monotonic() - began:.0f} s: '
        f'{len(failures)} lost or changed something acknowledged, or did not settle; '
        f'{total["dropped"]} dropped what was being written, and reported it'
    )
    return 1 if failures or states < args.states else 0


if __name__ == '__main__':
    sys.exit(main())
