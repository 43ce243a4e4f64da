# SPDX-License-Identifier: Apache-2.0
"""Against peers that install with pip: figaroh and pybotics on the same synthetic session.

A LWR 4+ of seven joints, one sensor, 36 poses with 173 configurations to fit, 32 with 156 held
out; 0.1 mm of noise per point and 0.2 mm common to the solutions of a pose (per axis); offsets of
0.3 degrees std, the marker 0.5 mm off. All fit offsets, sensor frame and marker. Printed: CPU
seconds of the fit (imports and files not counted), the mean error held out, the error of the
offsets of joints 2 to 6 (the others trade with the sensor and the marker), and, where standard
deviations are stated, the RMS of error / std (1 is right).

pybotics is given the arm's modified Denavit-Hartenberg parameters and calibrates by the function
its package has for that; figaroh reads the URDF, in which joints about -y (it has none) are
counted the other way. Each gets a virtual environment of its own under --envs (pybotics needs
NumPy 1, figaroh a package that builds only without isolation); made once, needs the network.

    OMP_NUM_THREADS=1 python benchmarks/bench_peers.py [--seeds 3] [--envs .venv-bench]
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import ROOT, machine, table
from paper_model import rigid_fit
from worlds.paper_experiment import CELL, CHAIN, experiment

from remaster_ros.calibration.fit import fit_session
from remaster_ros.types import FloatArray, Session

# Arguments of pip, step by step; every version is pinned in a file beside the peer's script.
PEERS = {
    'pybotics': [[]],
    'figaroh': [
        ['setuptools==79.0.1', 'wheel==0.45.1', 'numpy', 'cvxopt'],
        ['--no-build-isolation'],
    ],
}
SCRIPTS = Path(__file__).parent / 'peers'
NOISE_M = (0.1e-3, 0.2e-3)
JOINTS = slice(1, 6)


def modified_dh() -> list[list[float]]:
    """Return alpha, a, theta, d by joint: at zero the arm stands straight up, its axes meet.

    Joints turn about z or y of the base; the former carry all the length between the latter.
    """
    frames = CHAIN.frames(np.zeros(len(CHAIN)))
    axes, heights = CHAIN.axes_in_base(frames), frames[:, 2, 3]
    tip = float(CHAIN.positions(np.zeros(len(CHAIN)), np.zeros(3))[2])
    upright = np.abs(axes[:, 2]) > 0.5
    turns = np.where(upright, 0.0, -np.sign(axes[:, 1]) * np.pi / 2)
    elbows = np.concatenate(([0.0], heights[~upright], [tip]))
    lengths = np.zeros(len(CHAIN))
    lengths[upright] = np.diff(elbows)
    alphas = np.diff(np.concatenate(([0.0], turns)))
    return [[alpha, 0.0, 0.0, length] for alpha, length in zip(alphas.tolist(), lengths.tolist())]


def write_data(session: Session, folder: Path) -> None:
    """Write the session as the peers read it."""
    m = session.measurements
    (marker,) = session.markers.values()
    # figaroh takes no joint about -y: the same arm with these joints counted the other way.
    urdf = session.urdf.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 1 0"/>')
    signs = np.where(CHAIN.axes[:, 1] < -0.5, -1.0, 1.0)
    (folder / 'robot.urdf').write_text(urdf, encoding='utf-8')
    for split, rows in (('fit', ~m.is_validation), ('validation', m.is_validation)):
        nominal = CHAIN.positions(m.q, marker)
        T_N_R = rigid_fit(nominal[~m.is_validation], m.position[~m.is_validation])
        in_sensor = nominal[rows] @ T_N_R[:3, :3].T + T_N_R[:3, 3]
        np.savez(folder / split, q=m.q[rows], position=m.position[rows], nominal=in_sensor)
        with (folder / f'{split}.csv').open('w', newline='', encoding='utf-8') as file:
            writer = csv.writer(file)
            writer.writerow(['x1', 'y1', 'z1', *CHAIN.joint_names])
            writer.writerows(np.column_stack((m.position[rows], signs * m.q[rows])).tolist())
    given = {
        'robot': CHAIN.name,
        'tip_link': CHAIN.tip_link,
        'joints': list(CHAIN.joint_names),
        'signs': signs.tolist(),
        'modified_dh': modified_dh(),
        'marker_m': marker.tolist(),
        # The registration with offsets at zero: where a user would begin.
        'T_N_R': T_N_R.tolist(),
    }
    (folder / 'given.json').write_text(json.dumps(given), encoding='utf-8')


def peer_python(name: str, envs: Path) -> Path:
    """Return the interpreter of a peer's environment; make it where it is missing."""
    folder = envs / name
    python = folder / 'bin' / 'python'
    if not (folder / 'installed').is_file():
        subprocess.run([sys.executable, '-m', 'venv', '--clear', str(folder)], check=True)
        pins = str(SCRIPTS / f'{name}.txt')
        for step in PEERS[name][:-1]:
            command = [str(python), '-m', 'pip', 'install', '-q', '-c', pins, *step]
            subprocess.run(command, check=True)
        command = [str(python), '-m', 'pip', 'install', '-q', *PEERS[name][-1], '-r', pins]
        subprocess.run(command, check=True)
        (folder / 'installed').touch()
    return python


def by_peer(name: str, python: Path, folder: Path) -> dict[str, Any]:
    """Run a peer's script in its environment; return what it prints."""
    script = SCRIPTS / f'fit_{name}.py'
    answer = subprocess.run(
        [str(python), '-W', 'ignore', str(script), str(folder)],
        check=False,
        capture_output=True,
        text=True,
    )
    if answer.returncode:
        raise SystemExit(f'{name}: {answer.stderr[-2000:]}')
    return json.loads(answer.stdout.splitlines()[-1])


def by_us(session: Session) -> dict[str, Any]:
    started = time.process_time()
    fit = fit_session(session, rng=np.random.default_rng(0))
    seconds = time.process_time() - started
    return {
        'seconds': seconds,
        'held_out_m': 1e-3 * fit.accuracy['validation']['post_registration']['after']['mean_mm'],
        'offsets': fit.joint_offsets.tolist(),
        'std': fit.joint_offsets_std.tolist(),
        'uncertainty': 'posterior, converged' if fit.sampler.converged else 'NOT converged',
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--envs', type=Path, default=ROOT / '.venv-bench')
    args = parser.parse_args()
    print(machine())
    pythons = {name: peer_python(name, args.envs) for name in PEERS}
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in ('remaster_ros', *PEERS)}
    truths: list[FloatArray] = []
    for seed in range(args.seeds):
        session, truth = experiment(np.random.default_rng([77, seed]), {'mocap': NOISE_M})
        truths.append(np.degrees(truth.joint_offsets[JOINTS]))
        found['remaster_ros'].append(by_us(session))
        with tempfile.TemporaryDirectory() as folder:
            write_data(session, Path(folder))
            for name, python in pythons.items():
                found[name].append(by_peer(name, python, Path(folder)))
    rows = []
    for name, answers in found.items():
        errors = np.array([np.degrees(a['offsets'])[JOINTS] for a in answers]) - truths
        ratio = '–'
        if answers[0]['std'] is not None:
            std = np.degrees(np.array([a['std'][JOINTS] for a in answers], dtype=float))
            ratio = f'{np.sqrt(np.mean((errors / std) ** 2)):.2f}'
        rows.append(
            (
                name,
                f'{np.median([a["seconds"] for a in answers]):.2f}',
                f'{1e3 * np.mean([a["held_out_m"] for a in answers]):.3f}',
                f'{np.sqrt(np.mean(errors**2)):.4f}',
                answers[0]['uncertainty'],
                ratio,
            )
        )
    header = (
        'program',
        'CPU s',
        'held out, mm',
        'RMS error of joints 2 to 6, deg',
        'uncertainty',
        'RMS error / std',
    )
    noise = 1e3 * np.hypot(*NOISE_M) * np.sqrt(8.0 / np.pi)
    print(table(header, rows))
    print(f'{args.seeds} session(s) of {CELL.robot.urdf}; the noise alone is {noise:.3f} mm long')


if __name__ == '__main__':
    main()
