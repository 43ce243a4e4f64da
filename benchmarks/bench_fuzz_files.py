"""Every reader of files, on tens of thousands of spoilt files: `InputError` or an answer.

A session is simulated, fitted and bagged by this package; then its session.yaml, observations.csv
and URDF, a cell file, its fit.json and the bag are spoilt (test/hostile_files.py) and read. Every
read is bounded in processor time. The first thing that is neither an answer nor an `InputError` of
one short line ends the reader's run, with the file's content, and gives status 1.

Run: python benchmarks/bench_fuzz_files.py [--times 20000] [--seed 0]
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import Pool
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test'))

from hostile_files import read_urdf, spoil_and_read  # noqa: E402

from remaster_ros.cli.main import main as remaster  # noqa: E402
from remaster_ros.reports.fit_json import joint_offsets_rad, read_fit  # noqa: E402
from remaster_ros.session.bag import BagReader  # noqa: E402
from remaster_ros.session.bag_writer import BagWriter  # noqa: E402
from remaster_ros.session.reader import read_session  # noqa: E402
from remaster_ros.session.workcell import read_cell  # noqa: E402

JOINTS = tuple(f'joint_{number}' for number in range(1, 8))
KINDS = ('session.yaml', 'observations.csv', 'session.urdf', 'robot.urdf', 'cell', 'fit', 'bag')


def make_valid(folder: Path) -> None:
    """Make one valid file of every kind."""
    options = ['--quiet', '--no-figures']
    for command in (
        ['simulate', str(folder / 'session'), '--poses', '6', *options],
        ['fit', str(folder / 'session'), '--out', str(folder / 'fit'), *options],
    ):
        if remaster(command):
            raise SystemExit(f'remaster {" ".join(command)} failed')
    shutil.copytree(ROOT / 'config' / 'robots', folder / 'robots')
    shutil.copytree(ROOT / 'config' / 'cells', folder / 'cells')
    with BagWriter(folder / 'bag') as bag:
        for number in range(50):
            bag.write('/joint_states', 'sensor_msgs/msg/JointState', bytes(200), number)
            bag.write('/optitrack/marker', 'geometry_msgs/msg/PointStamped', bytes(50), number)


def reader_of(kind: str, folder: Path) -> tuple[Path, Callable[[], object]]:
    """Return the file to spoil and what reads it."""
    session = folder / 'session'
    if kind in ('session.yaml', 'observations.csv'):
        return session / kind, lambda: read_session(session)
    if kind == 'session.urdf':
        return next(session.glob('*.urdf')), lambda: read_session(session)
    if kind == 'robot.urdf':
        path = folder / 'robots' / 'iiwa14.urdf'
        return path, lambda: read_urdf(path)
    if kind == 'cell':
        cell = folder / 'cells' / 'demo.yaml'
        return cell, lambda: read_cell(cell)
    if kind == 'fit':
        fit = folder / 'fit' / 'fit.json'
        return fit, lambda: joint_offsets_rad(read_fit(fit), JOINTS)
    bag = folder / 'bag'
    return next(bag.glob('*.mcap')), lambda: list(BagReader(bag))


def work(job: tuple[str, Path, int, int]) -> tuple[str, str, bool]:
    """Spoil and read one kind of file, in a copy of the folder."""
    kind, valid, times, seed = job
    logging.getLogger('remaster_ros').setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / 'copy'
        shutil.copytree(valid, folder)
        path, read = reader_of(kind, folder)
        begin = time.perf_counter()
        try:
            taken, refused = spoil_and_read(path, read, random.Random(f'{kind} {seed}'), times)
        except AssertionError as error:
            return kind, f'FAILED: {error}', False
        seconds = time.perf_counter() - begin
    return kind, f'{times} spoilt: {taken} read, {refused} refused, {seconds:.0f} s', True


def main() -> int:
    """Run every kind, on all cores."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--times', type=int, default=20_000, help='spoilt files of each kind')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--processes', type=int, default=os.cpu_count())
    args = parser.parse_args()
    good = True
    with tempfile.TemporaryDirectory() as temporary, Pool(args.processes) as pool:
        valid = Path(temporary)
        make_valid(valid)
        jobs = [(kind, valid, args.times, args.seed) for kind in KINDS]
        for kind, line, fine in pool.imap_unordered(work, jobs):
            print(f'{kind:17} {line}', flush=True)
            good = good and fine
    return int(not good)


if __name__ == '__main__':
    sys.exit(main())
