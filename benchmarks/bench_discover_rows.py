"""What `remaster discover` costs against the number of rows of a session.

One sensor, five configurations a pose, a fifth of the poses for validation, random configurations;
joint 3 has an eccentric encoder (0.03 deg) and the sensor's scale is wrong by 50 ppm. Each size is
a process of its own, the command as a user calls it, figures and all: seconds by the clock and of
processor time, and the largest resident memory of the process.

    OMP_NUM_THREADS=1 python benchmarks/bench_discover_rows.py [--sizes 1000 10000 100000]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import machine, table
from paper_experiment import CELL, CHAIN, MARKER_OF, MARKERS, sensor_frames

from remaster_ros.session.reader import write_session
from remaster_ros.simulation.session_simulator import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor

NOISE_M = (0.1e-3, 0.2e-3)
SOLUTIONS = 5
JOINT, ECCENTRICITY_RAD, SCALE = 2, np.deg2rad(0.03), 50e-6
WANTED_GIB = 2.0


def write(n: int, folder: Path) -> None:
    """Write a session of n rows with both effects."""
    rng = np.random.default_rng(n)
    middle, half = 0.5 * (CHAIN.lower + CHAIN.upper), 0.35 * (CHAIN.upper - CHAIN.lower)
    q = middle + half * rng.uniform(-1.0, 1.0, (n, len(CHAIN)))
    poses = np.array_split(q, -(-n // SOLUTIONS))
    held_out = len(poses) // 5
    session, _ = simulate_session(
        CHAIN,
        CELL.urdf_text,
        rng,
        poses=poses[held_out:],
        validation_poses=poses[:held_out],
        sensors={'mocap': SimulatedSensor(MARKER_OF['mocap'], sensor_frames()['mocap'], *NOISE_M)},
        markers={MARKER_OF['mocap']: MARKERS[MARKER_OF['mocap']]},
        marker_std_m=CELL.marker_std_m,
    )
    m = session.measurements
    # The simulated angles are the true ones; the encoder reports them with its error.
    reported = m.q.copy()
    reported[:, JOINT] -= ECCENTRICITY_RAD * np.sin(m.q[:, JOINT])
    changed = replace(m, q=reported, position=(1.0 + SCALE) * m.position)
    write_session(folder, replace(session, measurements=changed))


def one_size(n: int, folder: Path) -> tuple[object, ...]:
    """Run the command on n rows; return a line of the table."""
    write(n, folder / 'session')
    command = [sys.executable, '-m', 'remaster_ros.cli.main', 'discover', folder / 'session']
    begin = time.perf_counter()
    process = subprocess.Popen([*command, '--out', folder / 'out', '--quiet'])
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    if status:
        raise SystemExit(f'remaster discover on {n} rows ended with {status}')
    found = json.loads((folder / 'out' / 'discovery.json').read_text())
    gain = found['gain']
    names = ', '.join(f'{e["name"]} {e["joints"] or ""}'.strip() for e in found['effects'])
    rows = found.get('rows_searched', {}).get('searched', 'all')
    return (
        f'{n:,}',
        rows,
        f'{seconds:.0f}',
        f'{usage.ru_utime + usage.ru_stime:.0f}',
        f'{usage.ru_maxrss / 1024**2:.2f}',
        f'{1e3 * gain["held_out_rms_before_m"]:.3f} → {1e3 * gain["held_out_rms_after_m"]:.3f}',
        names,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--sizes', type=int, nargs='+', default=[1000, 10_000, 100_000])
    args = parser.parse_args()
    print(machine())
    lines = []
    for n in args.sizes:
        with tempfile.TemporaryDirectory() as folder:
            lines.append(one_size(n, Path(folder)))
        print('  '.join(map(str, lines[-1])), file=sys.stderr, flush=True)
    header = ('rows', 'searched', 'wall s', 'CPU s', 'peak GiB', 'held out mm', 'found')
    print(table(header, lines))
    print(f'wanted at 100,000: {WANTED_GIB:g} GiB')


if __name__ == '__main__':
    main()
