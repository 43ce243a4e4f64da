# SPDX-License-Identifier: Apache-2.0
"""Do two halves of one session agree as well as their stated standard deviations say?

Each set beside this repository is split at random into halves that share no pose; both go through
`remaster discover`, and what either finds is compared: RMS of the differences over the stated
standard deviations, 1 where these are right. Each split is a line of the results file, so that the
benchmark can be stopped and goes on where it was.

    python benchmarks/bench_halves.py                       ten splits of four sets, on all cores
    python benchmarks/bench_halves.py --only panda_left --splits 1
"""

from __future__ import annotations

import argparse
import os
import re
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import ROOT, known, resumed, table

from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.discover import discover_session
from remaster_ros.session.reader import read_session

SETS = ('panda_left', 'meca500_repeats', 'ur10_two_solutions', 'ur10_iso_cubes')
# Lengths and tilts of joints, by the names of their parameters.
GEOMETRY = re.compile(r'(length|offset_[xyz]|tilt_[xyz])_\d+')


class Split(NamedTuple):
    """One of the splits of a set."""

    folder: str
    seed: int


def run(item: tuple[str, Split]) -> dict[str, Any]:
    """Discover both halves; return a line of the results file."""
    name, (folder, seed) = item
    session = read_session(folder)
    rng = np.random.default_rng(seed)
    poses = rng.permutation(np.unique(session.measurements.pose))
    started = time.process_time()
    halves = []
    for part in np.array_split(poses, 2):
        rows = np.flatnonzero(np.isin(session.measurements.pose, part))
        halves.append(discover_session(session.select(rows), rng=np.random.default_rng(seed)))
    one, other = (found.fit for found in halves)
    both = one.identifiable & other.identifiable
    std = np.hypot(one.joint_offsets_std, other.joint_offsets_std)
    offsets = ((one.joint_offsets - other.joint_offsets) / std)[both]
    mine, theirs = _geometry(one), _geometry(other)
    shared = [
        (mine[key][0] - theirs[key][0]) / float(np.hypot(mine[key][1], theirs[key][1]))
        for key in mine.keys() & theirs.keys()
    ]
    return {
        'name': name,
        'offsets': offsets.tolist(),
        'geometry': shared,
        'in_one_half_only': len(mine.keys() ^ theirs.keys()),
        'seconds': time.process_time() - started,
    }


def _geometry(fit: FitResult) -> dict[str, tuple[float, float]]:
    """Return value and standard deviation of the lengths and tilts of a fit."""
    return {
        name: (value, std)
        for name, value, std in zip(fit.theta_names, fit.theta, fit.theta_std, strict=True)
        if GEOMETRY.fullmatch(name)
    }


def _rms(values: list[float]) -> str:
    return f'{np.sqrt(np.mean(np.square(values))):.2f} of {len(values)}' if values else 'none'


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--data', type=Path, default=ROOT.parent / 'shared' / 'data')
    parser.add_argument('--results', type=Path, default=Path('bench_halves.jsonl'))
    parser.add_argument('--only', nargs='+', choices=SETS, default=list(SETS))
    parser.add_argument('--splits', type=int, default=10)
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    if not args.data.is_dir():
        print(f'no data beside this repository ({args.data})')
        return
    wanted = {
        f'{name}-{seed}': Split(str(args.data / name), seed)
        for name in args.only
        for seed in range(args.splits)
    }
    done = known(args.results)
    todo = {name: split for name, split in wanted.items() if name not in done}
    for line in resumed(args.results, todo, run, args.jobs):
        done[line['name']] = line
        print(line['name'], f'{line["seconds"]:.0f} s', flush=True)
    rows = []
    for name in args.only:
        lines = [done[f'{name}-{seed}'] for seed in range(args.splits)]
        together = {
            key: [value for line in lines for value in line[key]]
            for key in ('offsets', 'geometry')
        }
        alone = sum(line['in_one_half_only'] for line in lines)
        seconds = float(np.median([line['seconds'] for line in lines]))
        rows.append(
            [
                f'`{name}`, {args.splits}',
                _rms(together['offsets']),
                _rms(together['geometry']),
                alone,
                f'{seconds:.0f}',
            ]
        )
    header = ('set, splits', 'zero-offsets', 'lengths and tilts', 'in one half only', 'CPU s')
    print(table(header, rows))


if __name__ == '__main__':
    main()
