"""What handing out sessions costs, and whether the rows depend on who works.

`python benchmarks/bench_batch.py [TASKS] [SESSIONS] [SCHEDULER]`: stand-in tasks of 10 ms on one
and two processes, with a worker killed every five seconds on the way; then sessions as
`remaster simulate` makes them, by one process, by two of which one is killed every 20 s, and by a
Dask scheduler where its address is given. The rows and all files of results are compared.

The overhead is the time that workers spend in no task, as a share of the time in tasks, each by
the clock: what else runs on the computer makes both longer alike.
"""

import hashlib
import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

from remaster_ros.cli import batch
from remaster_ros.cli.main import main as remaster
from remaster_ros.session.journal import read_journal

TASK_S = 0.01
STEP = 20


def task(number):
    """Compute for 10 ms of processor time; the row says how long that took by the clock."""
    begin, end, value = time.perf_counter(), time.thread_time() + TASK_S, number
    while time.thread_time() < end:
        value = (1103515245 * value + 12345) % 2**31
    return {'square': number**2, 'took_s': time.perf_counter() - begin}


def ready():
    return os.getpid()


@contextmanager
def killing(every_s):
    """Kill one of this process's workers every so often; yields the list of those killed."""
    killed, stop, draw = [], threading.Event(), random.Random(0)

    def kill():
        while not stop.wait(every_s):
            if workers := multiprocessing.active_children():
                killed.append(draw.choice(workers).pid)
                os.kill(killed[-1], signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    if every_s:
        thread.start()
    yield killed
    stop.set()


def timed(tasks, executor, workers, kill_s=0.0):
    """Print a line on so many tasks of an executor whose workers have started."""
    for future in [executor.submit(ready) for _ in range(8 * workers)]:
        future.result()
    done, makers = {}, iter([executor])
    begin = time.perf_counter()
    with killing(kill_s) as killed:
        batch.work_off(
            list(range(tasks)),
            task,
            lambda: next(makers, None) or batch._pool(workers),
            batch.AHEAD * workers,
            lambda job, row: done.update({job: row}),
        )
    wall = time.perf_counter() - begin
    over = workers * wall / sum(row['took_s'] for row in done.values()) - 1.0
    right = [done[number]['square'] for number in range(tasks)] == [n**2 for n in range(tasks)]
    print(
        f'{len(killed)} | {1e3 * wall * workers / tasks:.2f} | {100 * over:.1f} % | {right} |',
        flush=True,
    )


def rows(folder):
    """Return the last row of each session."""
    return {row['session']: row for row in read_journal(folder / batch.ROWS).records}


def results(folder):
    """Return the rows, and a sum of each file of results, whatever the folder's place."""
    sums = {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.glob('*/**/*')
        if path.is_file()
    }
    return json.dumps(rows(folder), sort_keys=True), sums


def by(folder, sessions, *way, kill_s=0.0):
    """Run the verb until no row is left to be done again, and say how long it took."""
    given, begin = [*sessions, '--out', str(folder), *way, '--quiet'], time.perf_counter()
    with killing(kill_s) as killed:
        remaster(['batch', *given])
    calls = 1
    while any(row['status'] == 'killed' for row in rows(folder).values()):
        remaster(['batch', *given])
        calls += 1
    took = time.perf_counter() - begin
    print(f'{" ".join(way)}: {took:.0f} s, {len(killed)} killed, {calls} calls', flush=True)
    return results(folder)


def main(tasks=10000, sessions=6, scheduler=''):
    if tasks:
        print('| by | killed | ms a task | overhead | rows right |\n|---|---|---|---|---|')
        for workers, kill_s in ((1, 0.0), (2, 0.0), (2, 5.0)):
            print(f'| processes: {workers} | ', end='')
            timed(tasks, batch._pool(workers), workers, kill_s)
        if scheduler:
            with batch._scheduler(scheduler, insecure=False) as (executor, workers):
                print(f"| scheduler's workers: {workers} | ", end='')
                timed(tasks, executor, workers)
    if not sessions:
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        made = [str(folder / f's{seed}') for seed in range(sessions)]
        for seed, out in enumerate(made):
            remaster(['simulate', out, '--seed', str(seed), '--quiet'])
        ways = {'one': ['--workers', '1'], 'two': ['--workers', '2']}
        if scheduler:
            ways['dask'] = ['--scheduler', scheduler]
        # In steps, each of which does what is new, so that there is an answer early.
        for upto in range(STEP, sessions + STEP, STEP):
            found = [
                by(folder / name, made[:upto], *way, kill_s=20.0 * (name == 'two'))
                for name, way in ways.items()
            ]
            done = sum(row['status'] == 'done' for row in rows(folder / 'one').values())
            print(
                f'{len(made[:upto])} sessions ({done} done), {len(found[0][1])} files: '
                f'equal rows {all(one[0] == found[0][0] for one in found)}, '
                f'equal files {all(one[1] == found[0][1] for one in found)}',
                flush=True,
            )


if __name__ == '__main__':
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
