# SPDX-License-Identifier: Apache-2.0
"""Cost against the number of configurations, and the whole command `remaster fit`.

Each size is fitted in a process of its own (one sensor, about five solutions a pose, a common part
in the noise): seconds of wall and of CPU of `fit_session`, and the largest memory of the process,
interpreter and simulated session included. The poses of the larger sessions are random
configurations in groups of five that share their pose-common error; nothing is planned for them.

Then `remaster fit SESSION --out DIR` on 173 + 156 configurations, two sensors, with figures and
without: CPU seconds of the process, start-up included, the best of three.

    OMP_NUM_THREADS=1 python benchmarks/bench_scaling.py [--sizes 50 173 1000 10000 100000]
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import machine, table
from worlds.paper_experiment import CELL, CHAIN, MARKER_OF, MARKERS, experiment, sensor_frames

from remaster_ros.calibration.fit import fit_session
from remaster_ros.session.records.reader import write_session
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor

NOISE_M = (0.1e-3, 0.2e-3)
SOLUTIONS = 5
WANTED_SECONDS, WANTED_GIB, WANTED_COMMAND = 60.0, 2.0, 2.5


def one_size(n: int) -> dict[str, float]:
    """Fit a session of n configurations; return what it cost."""
    rng = np.random.default_rng(n)
    middle, half = 0.5 * (CHAIN.lower + CHAIN.upper), 0.35 * (CHAIN.upper - CHAIN.lower)
    q = middle + half * rng.uniform(-1.0, 1.0, (n, len(CHAIN)))
    session, truth = simulate_session(
        CHAIN,
        CELL.urdf_text,
        rng,
        poses=np.array_split(q, -(-n // SOLUTIONS)),
        sensors={'mocap': SimulatedSensor(MARKER_OF['mocap'], sensor_frames()['mocap'], *NOISE_M)},
        markers={MARKER_OF['mocap']: MARKERS[MARKER_OF['mocap']]},
        marker_std_m=CELL.marker_std_m,
    )
    wall, cpu = time.perf_counter(), time.process_time()
    result = fit_session(session, rng=rng)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    inner = slice(1, len(CHAIN) - 1)
    error = (result.joint_offsets - truth.joint_offsets)[inner] / result.joint_offsets_std[inner]
    return {
        'wall': wall,
        'cpu': cpu,
        'gib': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2,
        'error': float(np.sqrt(np.mean(error**2))),
        'effective': result.sampler.ess_min,
        'r_hat': result.sampler.r_hat_max,
    }


def whole_command(*options: str) -> list[float]:
    """Return CPU seconds of `remaster fit` with those options, three times."""
    noises = {'mocap': NOISE_M, 'tracker': (0.05e-3, 0.2e-3)}
    session, _ = experiment(np.random.default_rng(0), noises)
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        write_session(Path(folder) / 'session', session)
        command = [sys.executable, '-m', 'remaster_ros.cli.main', 'fit', f'{folder}/session']
        for _ in range(3):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([*command, '--out', f'{folder}/fit', '--quiet', *options], check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--sizes', type=int, nargs='+', default=[50, 173, 1000, 10_000])
    parser.add_argument('--one', type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(one_size(args.one)))
        return
    print(machine())
    header = ('n', 'wall s', 'CPU s', 'peak GiB', 'RMS error / std', 'effective, least', 'R-hat')
    rows = []
    for n in args.sizes:
        answer = subprocess.run(
            [sys.executable, __file__, '--one', str(n)], check=True, capture_output=True, text=True
        )
        cost = json.loads(answer.stdout.splitlines()[-1])
        rows.append(
            (
                n,
                f'{cost["wall"]:.2f}',
                f'{cost["cpu"]:.2f}',
                f'{cost["gib"]:.2f}',
                f'{cost["error"]:.2f}',
                f'{cost["effective"]:.0f}',
                f'{cost["r_hat"]:.3f}',
            )
        )
        print('  '.join(map(str, rows[-1])), file=sys.stderr, flush=True)
    print(table(header, rows))
    print(f'wanted at 100,000: {WANTED_SECONDS:.0f} s, {WANTED_GIB:g} GiB')
    for options in ((), ('--no-figures',)):
        seconds = whole_command(*options)
        print(
            f'`{" ".join(("remaster fit", *options))}`, 173 + 156 configurations, two sensors: '
            f'{min(seconds):.2f} s of CPU (all: {", ".join(f"{value:.2f}" for value in seconds)}; '
            f'wanted {WANTED_COMMAND:g})'
        )


if __name__ == '__main__':
    main()
