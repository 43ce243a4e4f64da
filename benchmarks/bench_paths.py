"""Do the planner's moves hit anything? Twelve cells, judged by what shares nothing with it.

Each cell is planned as the planner node does it, stop by stop; every move of the tours, from the
first on, is given to an independent judge (test/path_judges.py): sampled at 1 mm, with
bodies grown by half of that. Also printed: what is dropped and why, ways around, and the time of
planning 60 + 60 candidates with all their ways.

    python benchmarks/bench_paths.py [--tours N] [--cells WORD …] [--workers N]
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import machine, table
from parallel import in_parallel
from path_cells import SPECS, CellSpec, make_cell
from path_judges import collides
from planned_moves import tours

from remaster_ros.kinematics.body_pairs import FLOOR, OBSTACLE, SELF_COLLISION


class Tally(NamedTuple):
    """What became of the tours of a cell."""

    name: str
    moves: int
    around: int
    hits: int
    ends_hit: int
    straight_hits: int
    configurations: int
    dropped: Counter[str]
    no_path: int
    planning_s: list[float]
    ways_s: list[float]
    slowest_s: float
    samples: int


def judge_cell(job: tuple[CellSpec, int]) -> Tally:
    """Plan tours of a cell and have every move judged."""
    spec, count = job
    with tempfile.TemporaryDirectory() as folder:
        cell, judge = make_cell(spec, Path(folder))
        moves, dropped, no_path, planning, ways, slowest = tours(cell, range(count))
        hits = ends_hit = samples = straight_hits = 0
        for path in moves:
            hit, looked_at, _ = collides(judge, path)
            hits += hit
            samples += looked_at
            ends_hit += judge.distance(path[-1]) <= 0.0
            if len(path) > 2:
                straight_hits += collides(judge, path[[0, -1]])[0]
    return Tally(
        spec.name,
        len(moves),
        sum(len(path) > 2 for path in moves),
        hits,
        ends_hit,
        straight_hits,
        len(moves) + no_path,
        dropped,
        no_path,
        planning,
        ways,
        slowest,
        samples,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--tours', type=int, default=1, help='tours of 60 + 60 candidates a cell')
    parser.add_argument('--cells', nargs='*', default=[], help='only cells with these in the name')
    parser.add_argument('--workers', type=int, default=1)
    given = parser.parse_args()
    specs = [s for s in SPECS if all(word in s.name for word in given.cells)]
    print(machine())
    jobs = [(spec, given.tours) for spec in specs]
    rows = []
    total = Counter[str]()
    for tally in in_parallel(judge_cell, jobs, given.workers):
        lost = {reason: tally.dropped[reason] for reason in (SELF_COLLISION, FLOOR, OBSTACLE)}
        planning = np.array(tally.planning_s) + tally.ways_s
        rows.append(
            (
                tally.name,
                tally.moves,
                tally.around,
                tally.straight_hits,
                tally.hits,
                ' / '.join(str(n) for n in lost.values()),
                tally.no_path,
                f'{np.mean(tally.planning_s):.2f} + {np.mean(tally.ways_s):.2f}',
                f'{planning.max():.1f}',
                f'{tally.slowest_s:.2f}',
            )
        )
        print(rows[-1], flush=True)
        total.update(moves=tally.moves, hits=tally.hits, ends=tally.ends_hit)
        total.update(around=tally.around, no_path=tally.no_path, samples=tally.samples)
    header = (
        'cell',
        'moves',
        'around something',
        'their straight way hits',
        'in collision',
        'dropped: self / floor / obstacle',
        'no free path',
        'planning + ways, s',
        'most, s',
        'slowest stop, s',
    )
    print(table(header, rows))
    print(
        f'{total["moves"]} moves, {total["around"]} around something, {total["samples"]} samples: '
        f'{total["hits"]} in collision; {total["no_path"]} configurations without a free path'
    )


if __name__ == '__main__':
    main()
