# SPDX-License-Identifier: Apache-2.0
"""Cost of `remaster discover` on large sessions of an arm in which everything errs a little.

A six-axis arm with curves and waves in all joints, couplings, backlash, settling, lengths and
tilts, measured by a tracker at random configurations, five to a pose. Each size is a process of
its own: CPU seconds, peak memory, and which of the hidden kinds are named.

    OMP_NUM_THREADS=1 python benchmarks/bench_large_session.py [--sizes 2000 20000]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from common import machine, table
from worlds.hidden_arm import six_joint_arm

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.reader import write_session
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor

WANTED = {2_000: (40.0, 1.0), 20_000: (30.0, 1.0)}  # CPU s, GiB
SOLUTIONS = 5
JOINTS = range(1, 7)
HIDDEN = (
    *(f'joint_error_curve@{joint}:0.1' for joint in JOINTS),
    *(f'gear_periodic@{joint}:0.04' for joint in JOINTS),
    *('joint_coupling@2:0.08', 'joint_coupling@4:0.06', 'joint_coupling@5:0.06'),
    *(f'backlash@{joint}:0.06' for joint in (1, 3, 4)),
    *(f'settling@{joint}:0.06' for joint in (1, 2, 3, 5)),
    *(f'link_length@{joint}:0.2' for joint in (2, 3, 4)),
    *(f'joint_axis_tilt@{joint}:0.2' for joint in (3, 4, 5)),
)
NOISE_M = (0.03e-3, 0.02e-3)


def simulate(rows: int, folder: Path) -> None:
    """Write a session of so many rows, and a tenth of it held out."""
    rng = np.random.default_rng(rows)
    urdf = six_joint_arm()
    chain = SerialChain.from_urdf(urdf)
    middle, half = 0.5 * (chain.lower + chain.upper), 0.4 * (chain.upper - chain.lower)
    q = middle + half * rng.uniform(-1.0, 1.0, (rows + rows // 10, len(chain)))
    sensor_frame = np.eye(4)
    sensor_frame[:3, 3] = (2.0, 0.5, 1.0)
    session, _ = simulate_session(
        chain,
        urdf,
        rng,
        poses=np.array_split(q[:rows], rows // SOLUTIONS),
        validation_poses=np.array_split(q[rows:], rows // 10 // SOLUTIONS),
        sensors={'tracker': SimulatedSensor('ball', sensor_frame, *NOISE_M)},
        markers={'ball': np.array([0.06, 0.03, 0.08])},
        effects=[EffectSpec.parse(text) for text in HIDDEN],
    )
    write_session(folder, session)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--sizes', type=int, nargs='+', default=[*WANTED])
    parser.add_argument('--keep', type=Path, help='folder for the sessions and what is found')
    args = parser.parse_args()
    print(machine())
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        for size in args.sizes:
            session, out = folder / f'session-{size}', folder / f'found-{size}'
            if not session.exists():
                simulate(size, session)
            command = [sys.executable, '-m', 'remaster_ros.cli.main', 'discover', str(session)]
            process = subprocess.Popen([*command, '--out', str(out), '--no-figures', '--quiet'])
            _, status, used = os.wait4(process.pid, 0)
            if status:
                sys.exit(f'discover ended with {os.waitstatus_to_exitcode(status)}')
            found = json.loads((out / 'discovery.json').read_text(encoding='utf-8'))
            rows.append([size, *_row(found, used, WANTED.get(size))])
            print('  '.join(map(str, rows[-1])), file=sys.stderr, flush=True)
    print(table(('rows', 'CPU s', 'peak GiB', 'held out, mm RMS', 'causes'), rows))


def _row(
    found: dict, used: resource.struct_rusage, wanted: tuple[float, float] | None
) -> list[str]:
    cpu, peak = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024**2
    limits = ('', '') if wanted is None else (f' (wanted {wanted[0]:g})', f' ({wanted[1]:g})')
    gain = found['gain']
    before, after = 1e3 * gain['held_out_rms_before_m'], 1e3 * gain['held_out_rms_after_m']
    kinds: dict[str, list[int]] = {}
    for effect in found['effects']:
        kinds.setdefault(effect['name'], []).extend(effect['joints'])
    named = '; '.join(f'{name} {sorted(joints)}' for name, joints in sorted(kinds.items()))
    return [
        f'{cpu:.0f}{limits[0]}',
        f'{peak:.2f}{limits[1]}',
        f'{before:.3f} → {after:.3f}',
        named,
    ]


if __name__ == '__main__':
    main()
