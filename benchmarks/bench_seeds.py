"""How often the truth lies outside the claim: `remaster simulate` + `remaster fit`, 20 seeds.

Real commands, the paper's size (60 candidate poses each). An offset is missed where it lies more
than 3 posterior standard deviations from the truth: 0.27 % of the identifiable joints, if
posteriors are Gaussian and right.

    python benchmarks/bench_seeds.py [--seeds N] [--sensors mocap,tracker mocap tracker …]
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

LIMIT = 3.0
MISS_PROBABILITY = math.erfc(LIMIT / math.sqrt(2.0))
OUTSIDE_95 = 0.05


class Outcome(NamedTuple):
    """One seed: deviations in std by joint, 95 % intervals that miss, rows fitted, the gain."""

    z: dict[str, float]
    outside_95: int
    observations: int
    mean_mm: tuple[float, float]
    converged: bool
    seconds: tuple[float, float]


def remaster(*args: object) -> float:
    """Run a command; return its wall time, s."""
    command = [sys.executable, '-m', 'remaster_ros.cli.main', *map(str, args), '--quiet']
    started = time.perf_counter()
    subprocess.run(command, check=True)
    return time.perf_counter() - started


def one_seed(seed: int, sensors: str, folder: Path) -> Outcome:
    session, fit = folder / 'session', folder / 'fit'
    simulating = remaster('simulate', session, '--seed', seed, '--sensors', sensors)
    fitting = remaster('fit', session, '--out', fit, '--seed', seed, '--no-figures')
    result = json.loads((fit / 'fit.json').read_text(encoding='utf-8'))
    truth = json.loads((session / 'truth.json').read_text(encoding='utf-8'))
    true = {row['joint']: row['offset_deg'] for row in truth['joint_offsets']}
    found = [row for row in result['joint_offsets'] if row['identifiable']]
    intervals = [(row['interval95_deg'], true[row['joint']]) for row in found]
    metric = result['accuracy']['validation']['post_registration']
    return Outcome(
        {row['joint']: (row['mean_deg'] - true[row['joint']]) / row['std_deg'] for row in found},
        sum(not low < value < high for (low, high), value in intervals),
        result['session']['optimization']['observations'],
        (metric['before']['mean_mm'], metric['after']['mean_mm']),
        result['sampler']['converged'],
        (simulating, fitting),
    )


def some_misses(count: int, probability: float) -> float:
    """Return the probability of at least one miss among that many."""
    return 1.0 - (1.0 - probability) ** count


def report(sensors: str, outcomes: list[Outcome]) -> tuple[int, int]:
    """Print the sums of one choice of sensors; return intervals and misses."""
    z = [value for outcome in outcomes for value in outcome.z.values()]
    misses = sum(abs(value) > LIMIT for value in z)
    outside = sum(outcome.outside_95 for outcome in outcomes)
    spread = math.sqrt(sum(value**2 for value in z) / len(z))
    print(
        f'{sensors}: {len(z)} identifiable offsets\n'
        f'  beyond {LIMIT:g} std: {MISS_PROBABILITY * len(z):.2f} expected, {misses} found\n'
        f'  outside their 95 % interval: {OUTSIDE_95 * len(z):.1f} expected, {outside} found\n'
        f'  RMS of deviation / std: 1 expected, {spread:.2f} found\n'
        f'  converged: {sum(outcome.converged for outcome in outcomes)} of {len(outcomes)} fits\n'
    )
    return len(z), misses


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--seeds', type=int, default=20, help='how many (default 20)')
    parser.add_argument(
        '--sensors',
        nargs='+',
        default=['mocap,tracker', 'mocap', 'tracker'],
        help="choices of the cell's sensors (default: both, and each alone)",
    )
    args = parser.parse_args()
    totals = []
    for sensors in args.sensors:
        print(f'seed  rows  before   after mm  sim. s  fit s  deviation / std, {sensors}')
        outcomes = []
        for seed in range(args.seeds):
            with tempfile.TemporaryDirectory() as folder:
                outcome = one_seed(seed, sensors, Path(folder))
            outcomes.append(outcome)
            before, after = outcome.mean_mm
            simulating, fitting = outcome.seconds
            z = ' '.join(f'{joint} {value:+5.2f}' for joint, value in outcome.z.items())
            print(
                f'{seed:4d} {outcome.observations:5d} {before:7.3f} {after:7.3f}    '
                f'{simulating:6.1f} {fitting:6.1f}  {z}',
                flush=True,
            )
        totals.append(report(sensors, outcomes))
    count, misses = (sum(column) for column in zip(*totals))
    print(
        f'all: {count} offsets, {100 * MISS_PROBABILITY:.2f} % each: '
        f'{MISS_PROBABILITY * count:.2f} misses expected, {misses} found '
        f'(at least one: probability {some_misses(count, MISS_PROBABILITY):.2f})'
    )


if __name__ == '__main__':
    main()
