"""Do two halves of one session agree within what each of them states?

Each set of `../shared/data` is split at random into two halves that share no pose; `discover` runs
on both. RMS of the differences over the stated standard deviations, of zero-offsets, and of all
link lengths and axis tilts. Below 1 the intervals are too wide, as they must be of what neither
half determines: there both have the prior.

    python benchmarks/bench_halves.py --sets panda_left --splits 10
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from common import ROOT, table

from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.session.reader import read_session

DATA = ROOT.parent / 'shared' / 'data'
KINDS = ('link_length', 'joint_axis_tilt')


def geometry(found: Discovery) -> dict[str, tuple[float, float]]:
    """Return lengths and tilts, those of names or of all kinds: name to value and std."""
    solution, known = found.solution, {}
    std = np.sqrt(np.diag(solution.covariance))
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        if cell.name in KINDS:
            pairs = zip(solution.parameters[where], std[where], strict=True)
            known |= dict(zip(cell.parameters, pairs, strict=True))
    return known


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    sets = [path.name for path in sorted(DATA.glob('*')) if (path / 'session.yaml').exists()]
    parser.add_argument('--sets', nargs='+', default=sets, choices=sets)
    parser.add_argument('--splits', type=int, default=10)
    args = parser.parse_args()
    rows = []
    for name in args.sets:
        session = read_session(Path(DATA / name))
        pose = session.measurements.pose
        offsets, shapes, alone = [], [], 0
        for seed in range(args.splits):
            order = np.random.default_rng(1000 + seed).permutation(np.unique(pose))
            halves = [
                discover_session(
                    session.select(np.isin(pose, part)), rng=np.random.default_rng(seed)
                )
                for part in np.array_split(order, 2)
            ]
            one, two = (half.fit for half in halves)
            std = np.hypot(one.joint_offsets_std, two.joint_offsets_std)
            seen = one.identifiable & two.identifiable
            offsets += ((one.joint_offsets - two.joint_offsets) / std)[seen].tolist()
            first, second = (geometry(half) for half in halves)
            alone += len(first.keys() ^ second.keys())
            for key in first.keys() & second.keys():
                (a, s), (b, t) = first[key], second[key]
                shapes.append((a - b) / np.hypot(s, t))
        rms = [f'{np.sqrt(np.mean(np.square(z))):.2f} of {len(z)}' for z in (offsets, shapes)]
        rows.append((name, args.splits, *rms, alone))
        print(rows[-1], flush=True)
    print(table(('set', 'splits', 'offsets', 'lengths and tilts', 'in one half only'), rows))


if __name__ == '__main__':
    main()
