"""Eight hours of simulated collection with both sensors: do memory, threads and files stay flat?

The demo's nodes and fakes, each a process of its own, collect in accelerated time; meanwhile the
resident memory, threads and open files of every one are read from /proc. Compared are the medians
of the first and of the last quarter after a warm-up of a tenth of the time. What grows by more
than `GROWTH_MB`, or by a thread or a file, ends the run with status 1. Every sample is written to
`--out`/samples.csv as it is taken.

Run: python benchmarks/bench_soak.py [--hours 8] [--rate 10] [--candidates 600] [--out soak]
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

GROWTH_MB = 8.0
EVERY_S = 5.0
PAGE = os.sysconf('SC_PAGE_SIZE')


class Sample(NamedTuple):
    """One look at one process."""

    hours: float
    node: str
    resident_mb: float
    threads: int
    files: int


def children(parent: int) -> dict[str, int]:
    """Return the node processes that a process has started, by name."""
    found = {}
    for folder in Path('/proc').iterdir():
        if not folder.name.isdigit():
            continue
        try:
            if int(folder.joinpath('stat').read_text().rpartition(')')[2].split()[1]) != parent:
                continue
            words = folder.joinpath('cmdline').read_bytes().decode(errors='replace').split('\0')
        except (OSError, ValueError):
            continue  # it has just ended
        if 'remaster_ros.nodes' in words:
            found[words[words.index('remaster_ros.nodes') + 1]] = int(folder.name)
    return found


def look(node: str, pid: int, hours: float) -> Sample | None:
    """Read a process; None where it has ended."""
    folder = Path('/proc') / str(pid)
    try:
        pages = int(folder.joinpath('statm').read_text().split()[1])
        threads = len(list(folder.joinpath('task').iterdir()))
        files = len(list(folder.joinpath('fd').iterdir()))
    except OSError:
        return None
    return Sample(hours, node, pages * PAGE / 1e6, threads, files)


def verdict(samples: list[Sample]) -> tuple[str, bool]:
    """Return a line on one node, and whether it is flat."""
    end = samples[-1].hours
    settled = [sample for sample in samples if sample.hours >= 0.1 * end]
    quarter = max(len(settled) // 4, 1)
    first, last = settled[:quarter], settled[-quarter:]

    def change(field: str) -> tuple[float, float]:
        ends = (statistics.median(getattr(s, field) for s in part) for part in (first, last))
        return tuple(ends)  # type: ignore[return-value]

    memory, threads, files = change('resident_mb'), change('threads'), change('files')
    flat = memory[1] - memory[0] <= GROWTH_MB and threads[1] <= threads[0] and files[1] <= files[0]
    line = (
        f'{samples[0].node:22} {memory[0]:7.1f} {memory[1]:7.1f} '
        f'{max(s.resident_mb for s in settled):7.1f} {threads[0]:6.0f} {threads[1]:4.0f} '
        f'{files[0]:6.0f} {files[1]:4.0f}  {"flat" if flat else "GROWS"}'
    )
    return line, flat


def main() -> int:
    """Run the collection and watch it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--hours', type=float, default=8.0, help='of world time')
    parser.add_argument('--rate', type=float, default=10.0, help='world time over wall time')
    parser.add_argument('--candidates', type=int, default=600, help='enough for the hours asked')
    parser.add_argument('--out', type=Path, default=Path('soak'))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, '-m', 'remaster_ros.nodes', 'demo', '--ros-args']
    for name, value in (
        ('out', f'"{args.out / "demo"}"'),
        ('candidates', args.candidates),
        ('rate', args.rate),
        ('figures', 'false'),
    ):
        command += ['-p', f'{name}:={value}']
    by_node: dict[str, list[Sample]] = defaultdict(list)
    begin = told = time.monotonic()
    with (
        (args.out / 'samples.csv').open('w', newline='') as file,
        subprocess.Popen(command, stdout=subprocess.DEVNULL) as demo,
    ):
        table = csv.writer(file)
        table.writerow(Sample._fields)
        while demo.poll() is None:
            hours = (time.monotonic() - begin) * args.rate / 3600
            for node, pid in children(demo.pid).items():
                sample = look(node, pid, hours)
                if sample is not None:
                    by_node[node].append(sample)
                    table.writerow(sample)
            file.flush()
            if time.monotonic() - told > 60.0:
                told = time.monotonic()
                memory = ', '.join(f'{n} {s[-1].resident_mb:.0f}' for n, s in by_node.items())
                print(f'{hours:5.2f} h: MB: {memory}', flush=True)
            if hours >= args.hours:
                demo.send_signal(signal.SIGINT)
                demo.wait(60.0)
                break
            time.sleep(EVERY_S)
    if demo.returncode not in (0, 130):
        print(f'the demo ended with status {demo.returncode}', file=sys.stderr)
    observations = args.out / 'demo' / 'session' / 'observations.csv'
    rows = len(observations.read_text().splitlines()) - 1 if observations.exists() else 0
    # What the last look saw may already have been ending.
    lines = [verdict(samples[:-1]) for samples in by_node.values() if len(samples) > 8]
    hours = max((samples[-1].hours for samples in by_node.values()), default=0.0)
    print(f'{hours:.2f} h of world time, {rows} observations')
    print('node                   MB: first  last quarter  largest; threads first, last; files')
    for line, _flat in lines:
        print(line)
    return int(not lines or not all(flat for _line, flat in lines))


if __name__ == '__main__':
    sys.exit(main())
