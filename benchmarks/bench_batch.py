"""What handing out sessions costs, and whether the rows depend on who works.

`python benchmarks/bench_batch.py [TASKS] [SESSIONS] [SCHEDULER]`: stand-in tasks of 10 ms on one
and two processes, against `executor.map` on the same ones, with one worker killed on the way; then
sessions, whose rows are compared; the same by a Dask scheduler, where its address is given.
"""

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

from remaster_ros.cli import batch
from remaster_ros.cli.main import main as remaster
from remaster_ros.session.journal import read_journal

TASK_S = 0.01


def task(number):
    """Compute for 10 ms of processor time."""
    end, value = time.process_time() + TASK_S, number
    while time.process_time() < end:
        value = (1103515245 * value + 12345) % 2**31
    return {'status': 'done', 'square': number**2}


def ready():
    return os.getpid()


def timed(tasks, executor, workers, kill=False):
    """Return the tasks' rows, and how much longer they take than by `executor.map`, as a share."""
    for future in [executor.submit(ready) for _ in range(4 * workers)]:
        future.result()
    begin = time.perf_counter()
    list(executor.map(task, range(tasks)))
    plain = time.perf_counter() - begin
    if kill:
        victim = multiprocessing.active_children()[0].pid
        threading.Timer(0.3 * tasks * TASK_S / workers, os.kill, (victim, signal.SIGKILL)).start()
    done = {}
    makers = iter([executor])
    begin = time.perf_counter()
    batch.work_off(
        list(range(tasks)),
        task,
        lambda: next(makers, None) or batch._pool(workers),
        batch.AHEAD * workers,
        lambda job, row: done.update({job: row}),
    )
    return done, (time.perf_counter() - begin) / plain - 1.0


def rows(folder):
    return sorted(
        json.dumps({k: v for k, v in row.items() if k not in ('crc32',)}, sort_keys=True)
        for row in read_journal(folder / batch.ROWS).records
    )


def main(tasks=10000, sessions=6, scheduler=''):
    print('| stand-in tasks of 10 ms | overhead | rows right |\n|---|---|---|')
    right = {number: {'status': 'done', 'square': number**2} for number in range(tasks)}
    for workers, kill in ((1, False), (2, False), (2, True)):
        done, over = timed(tasks, batch._pool(workers), workers, kill)
        what = f'{workers} process{"es" * (workers > 1)}{", one killed" * kill}'
        print(f'| {what} | {100 * over:.1f} % | {done == right} |', flush=True)
    if scheduler:
        with batch._scheduler(scheduler, insecure=False) as (executor, workers):
            done, over = timed(tasks, executor, workers)
            print(f'| scheduler, {workers} workers | {100 * over:.1f} % | {done == right} |')
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        made = [str(folder / f's{seed}') for seed in range(sessions)]
        for seed, out in enumerate(made):
            given = ['--poses', '20', '--validation', '10', '--seed', str(seed), '--quiet']
            remaster(['simulate', out, *given])
        found = {}
        ways = {'1': ['--workers', '1'], '2': ['--workers', '2']}
        if scheduler:
            ways['dask'] = ['--scheduler', scheduler]
        for name, way in ways.items():
            remaster(['batch', *made, '--out', str(folder / name), *way, '--quiet'])
            found[name] = rows(folder / name)
        print(
            f'\n{sessions} sessions: equal rows by {", ".join(ways)}: '
            f'{all(one == found["1"] for one in found.values())}'
        )


if __name__ == '__main__':
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
