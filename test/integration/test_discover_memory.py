# SPDX-License-Identifier: Apache-2.0
"""What `remaster discover` holds in memory against the number of rows of a session."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import ROOT
from worlds.calibration_scenes import CHAIN, MARKERS, URDF, sensors

from remaster_ros.reports.discovery_json import read_discovery
from remaster_ros.session.records.reader import write_session
from remaster_ros.simulation.simulated_session import simulate_session

# The command with a search of few rows, so that what all rows take is what counts; then the
# largest resident memory of this process alone, which os.wait4 mixes up with its parent's.
COMMAND = """
import re, sys
from functools import partial
from pathlib import Path
from remaster_ros.cli.main import main
from remaster_ros.discovery import discover
from remaster_ros.discovery.thinning import draw_rows
discover.draw_rows = partial(draw_rows, most=1000)
status = main(['discover', sys.argv[1], '--out', sys.argv[2], '--quiet', '--seed', '1'])
print(re.search(r'VmHWM:\\s+(\\d+) kB', Path('/proc/self/status').read_text())[1])
raise SystemExit(status)
"""
FEW, MANY = 4_000, 24_000
# With the columns of all kinds of errors in memory for all rows at once it took 64.
MOST_MB_PER_THOUSAND_ROWS = 8.0
CURVE_RAD = 8e-4


def write(rows: int, folder: Path) -> None:
    """Write a session whose joint 2 errs along a curve: a cause of some fifty parameters."""
    rng = np.random.default_rng(rows)
    middle, half = 0.5 * (CHAIN.lower + CHAIN.upper), 0.35 * (CHAIN.upper - CHAIN.lower)
    q = middle + half * rng.uniform(-1.0, 1.0, (rows, len(CHAIN)))
    poses = np.array_split(q, rows // 5)
    session, _ = simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=poses[200:],
        validation_poses=poses[:200],
        sensors=sensors(rng, sigma_m=0.1e-3, pose_sigma_m=0.2e-3),
        markers={'sir': MARKERS['sir']},
    )
    reported = session.measurements.q.copy()
    angle = reported[:, 1]
    reported[:, 1] -= CURVE_RAD * (np.exp(-((angle - 0.3) ** 2) / 0.02) + np.cos(7.3 * angle))
    write_session(folder, replace(session, measurements=replace(session.measurements, q=reported)))


def peak_mb(rows: int, folder: Path) -> float:
    """Return the largest memory of the command on a session of so many rows, MB."""
    write(rows, folder / 'session')
    process = subprocess.run(
        [sys.executable, '-c', COMMAND, folder / 'session', folder / 'out'],
        capture_output=True,
        text=True,
        timeout=1200,
        env={**os.environ, 'PYTHONPATH': str(ROOT), 'OMP_NUM_THREADS': '1'},
        check=False,
    )
    assert process.returncode == 0, process.stderr
    found = read_discovery(folder / 'out' / 'discovery.json')
    assert ('joint_error_curve', (2,)) in [(e.name, tuple(e.joints)) for e in found.effects]
    assert found.rows_searched.searched <= 1100
    return float(process.stdout) / 1024


@pytest.mark.qualify
def test_memory_hardly_grows_with_the_rows(tmp_path):
    """100,000 rows fit into 2 GiB: a search of a gigabyte, and what each row adds."""
    few_mb, many_mb = (peak_mb(rows, tmp_path / str(rows)) for rows in (FEW, MANY))
    growth = 1e3 * (many_mb - few_mb) / (MANY - FEW)
    print(
        f'{few_mb:.0f} MB at {FEW} rows, {many_mb:.0f} at {MANY}: {growth:.1f} MB per 1,000 rows'
    )
    assert growth < MOST_MB_PER_THOUSAND_ROWS
