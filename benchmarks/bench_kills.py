"""SIGKILL of random nodes at random moments of complete runs: is anything lost, twice or wrong?

Each run is `remaster demo` at the highest clock rate: real nodes, real DDS, real sockets; what is
killed is started again as a supervisor would. The session is held to what was ever on the disk,
to the plan, and to the opened truth; the fit to that of the undisturbed run of the same seed.
Each seed is run once undisturbed and some times with other kills. Results are kept a line per run,
and runs that are there already are not done again.

    python benchmarks/bench_kills.py [--kills 200] [--per-run 8] [--turns 5] [--out kills.jsonl]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

from kill_judge import judge, node_processes

NODES = (
    'pose_planner',
    'robot_bridge',
    'optitrack_markers',
    'laser_tracker_markers',
    'recorder',
    'optimizer',
)


class Run:
    """One demo, disturbed or not."""

    def __init__(self, out: Path, seed: int, candidates: int, rate: float) -> None:
        self.out, self.session = out, out / 'session'
        self.seen: set[str] = set()
        self.killed: list[str] = []
        command = [
            *(sys.executable, '-m', 'remaster_ros.cli.main', 'demo', '--no-figures'),
            *('--out', str(out), '--seed', str(seed)),
            *('--rate', str(rate)),
            *(('--candidates', str(candidates)) if candidates else ()),
        ]
        self.log = (out.parent / f'{out.name}.log').open('w')
        self.process = subprocess.Popen(command, stdout=self.log, stderr=subprocess.STDOUT)

    def look(self) -> None:
        """Note every whole row that is on the disk now."""
        path = self.session / 'observations.csv'
        if path.exists():
            text = path.read_text(errors='replace')
            self.seen.update(text[: text.rfind('\n') + 1].splitlines()[1:])

    def watch(self, chooser: random.Random, kills: int, mean_s: float, timeout_s: float) -> None:
        """Kill so many nodes at random moments; wait for the end."""
        began, due = time.monotonic(), None
        while self.process.poll() is None:
            if time.monotonic() - began > timeout_s:
                self.process.send_signal(signal.SIGINT)
                self.process.wait(30)
                break
            time.sleep(0.05)
            self.look()
            if due is None and (self.session / 'plan.jsonl').exists():
                due = time.monotonic() + chooser.expovariate(1.0 / mean_s)
            if due is not None and time.monotonic() > due and len(self.killed) < kills:
                name = chooser.choice(NODES)
                pid = node_processes(self.process.pid).get(name)
                if pid is not None:
                    os.kill(pid, signal.SIGKILL)
                    self.killed.append(name)
                due = time.monotonic() + chooser.expovariate(1.0 / mean_s)
        self.look()
        self.log.close()


def largest_z(a: dict[str, Any], b: dict[str, Any]) -> float:
    """Return the largest difference of two fits' offsets in standard deviations of it."""
    both = [(a[joint], b[joint]) for joint in a if joint in b]
    return max((abs(x[0] - y[0]) / np.hypot(x[1], y[1]) for x, y in both), default=np.nan)


def one(folder: Path, seed: int, turn: int, args: argparse.Namespace) -> dict[str, Any]:
    """Run a demo, undisturbed in turn 0."""
    run = Run(folder / f'seed_{seed}_turn_{turn}', seed, args.candidates, args.rate)
    began = time.monotonic()
    kills = args.per_run if turn else 0
    run.watch(random.Random(f'kills {seed} {turn}'), kills, args.mean_s, args.timeout_s)
    return {
        'seed': seed,
        'turn': turn,
        'candidates': args.candidates,
        'rate': args.rate,
        'load': os.getloadavg()[0],
        'seconds': round(time.monotonic() - began, 1),
        'status': run.process.returncode,
        'killed': run.killed,
        **judge(run.out, run.seen),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--kills', type=int, default=200, help='in all')
    parser.add_argument('--per-run', type=int, default=8, help='kills in a run, if it lasts')
    parser.add_argument('--turns', type=int, default=5, help='disturbed runs of each seed')
    parser.add_argument(
        '--candidates',
        type=int,
        default=10,
        help='of the Latin hypercube with one marker; 0: the demo with three markers',
    )
    parser.add_argument('--rate', type=float, default=20.0, help='world time over wall time')
    parser.add_argument('--mean-s', type=float, default=4.0, help='wall time between kills')
    parser.add_argument('--timeout-s', type=float, default=600.0, help='wall time of a run')
    parser.add_argument('--until', default='', help='HH:MM after which no run is begun')
    parser.add_argument('--out', type=Path, default=Path('kills.jsonl'))
    parser.add_argument('--keep', type=Path, help='keep the runs in this folder')
    args = parser.parse_args()
    done = (
        [json.loads(line) for line in args.out.read_text().splitlines()]
        if (args.out.exists())
        else []
    )
    known = {(run['seed'], run['turn']): run for run in done}
    print(
        ' seed turn  kills  rows  configurations  lost  twice  wrong  largest z  status  seconds'
    )
    failed = total = 0
    with tempfile.TemporaryDirectory() as name:
        folder = args.keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for seed, turn in ((s, t) for s in itertools.count(1) for t in range(args.turns + 1)):
            if total >= args.kills or (args.until and time.strftime('%H:%M') >= args.until):
                break
            if (seed, turn) not in known:
                known[seed, turn] = one(folder, seed, turn, args)
                with args.out.open('a') as file:
                    file.write(json.dumps(known[seed, turn]) + '\n')
            run, clean = known[seed, turn], known[seed, 0]
            z = largest_z(clean.get('offsets', {}), run.get('offsets', {}))
            total += len(run['killed'])
            good = not (run['status'] or run['lost'] or run['twice'] or run['wrong'])
            good = good and z < 4.0 and run['exit_status'] == 'complete'
            good = good and run['configurations'] == run['planned_configurations']
            failed += not good
            print(
                f'{seed:5d} {turn:4d} {len(run["killed"]):6d} {run["rows"]:5d} '
                f'{run["configurations"]:7d}/{run["planned_configurations"]:<7d} {run["lost"]:4d} '
                f'{run["twice"]:6d} {run["wrong"]:6d} {z:10.2f} {run["status"]:6d} '
                f'{run["seconds"]:8.1f}  {" ".join(run["killed"])}{"" if good else "  FAILED"}',
                flush=True,
            )
    print(f'{total} kills; {failed} runs with something lost, twice, wrong or incomplete')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
