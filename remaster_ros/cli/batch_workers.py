# SPDX-License-Identifier: Apache-2.0
"""Workers of a batch: processes of this computer, or those of a Dask scheduler."""

from __future__ import annotations

import ipaddress
import logging
import multiprocessing
import os
import threading
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from remaster_ros.errors import InputError
from remaster_ros.version import __version__

KILLED = 2
"""A session whose worker died so often is given up: the first time another one may have done it,
the second time it had the worker for itself."""


def work_off(
    jobs: Sequence[Any],
    work: Callable[[Any], dict[str, Any]],  # Of a module, which a worker can import
    make: Callable[[], Executor],  # Called again after one has broken
    ahead: int,  # So many jobs are handed out at a time
    finished: Callable[[Any, dict[str, Any]], None],  # Called in the order in which they end
) -> None:
    """Distribute jobs to workers until all have a row.

    ``work``: called in a worker; ``make``: creates the workers, again if they died; ``ahead``:
    jobs under way at a time; ``finished``: called with each job and its row, in the order in which
    they end. If a worker dies, all jobs under way are repeated one at a time; a job whose worker
    died `KILLED` times has the row 'killed'. Another exception of `work` is raised.
    """
    waiting, deaths = list(reversed(jobs)), dict.fromkeys(map(id, jobs), 0)
    suspects: list[Any] = []
    under_way: dict[Future[dict[str, Any]], Any] = {}
    executor = make()
    try:
        while waiting or suspects or under_way:
            broken: list[Any] = []
            while (suspects and not under_way) or (
                waiting and not suspects and len(under_way) < ahead
            ):
                job = (suspects or waiting).pop()
                try:
                    under_way[executor.submit(work, job)] = job
                except BrokenProcessPool:
                    # A worker has died while it had nothing to do, or just now.
                    (suspects or waiting).append(job)
                    broken = list(under_way.values())
                    break
            if broken or not under_way:
                ended: set[Future[dict[str, Any]]] = set()
            else:
                ended, _ = wait(under_way, return_when=FIRST_COMPLETED)
            for future in ended:
                job = under_way.pop(future)
                try:
                    row = future.result()
                except Exception as error:
                    if not _died(error):
                        raise
                    broken.append(job)
                    continue
                finished(job, row)
            if ended and not broken:
                continue
            if isinstance(executor, ProcessPoolExecutor):
                # All of its workers have ended with it.
                broken = [*broken, *(job for job in under_way.values() if job not in broken)]
                under_way.clear()
                executor.shutdown(wait=False)
                executor = make()
            for job in broken:
                deaths[id(job)] += 1
                if deaths[id(job)] < KILLED:
                    suspects.append(job)
                else:
                    why = 'its worker was killed twice: is there enough memory?'
                    finished(job, {'status': 'killed', 'error': why})
    finally:
        for future in under_way:
            future.cancel()
        executor.shutdown(wait=False)


def _died(error: Exception) -> bool:
    """Whether an error means that a worker process has ended.

    BrokenProcessPool for one of this computer, KilledWorker for one of Dask.
    """
    return isinstance(error, BrokenProcessPool) or type(error).__name__ == 'KilledWorker'


def local_pool(workers: int) -> ProcessPoolExecutor:
    """Return the worker processes of this computer, spawned, each with one thread for BLAS.

    Sets the environment of this process too.
    """
    # What a worker starts with is set before; the latter two would go before the first.
    for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ[name] = '1'
    # Forked, a worker would have the parent's locks and threads.
    spawn = multiprocessing.get_context('spawn')
    return ProcessPoolExecutor(workers, mp_context=spawn, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End this worker with status 1 once its parent process has ended or was killed.

    Returns at once: a daemon thread waits for that. Only for workers of this computer, which
    were spawned, not for those of a Dask scheduler.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def scheduled(address: str, *, insecure: bool) -> Iterator[tuple[Executor, int]]:
    """Connect to a Dask scheduler; yield its executor and the number of workers.

    Raises InputError if it cannot be reached, is insecure, or has other versions.
    """
    refuse_open(address, insecure=insecure)
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--scheduler takes Dask: pip install 'remaster_ros[cluster]', or use --workers"
        ) from None
    # What it logs are tracebacks; what a person can do is said below.
    logging.getLogger('distributed').setLevel(logging.CRITICAL + 1)
    try:
        client = Client(address, timeout='10s')
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f'{address}: no scheduler answers ({error}); is it started?') from None
    try:
        workers = sum(client.nthreads().values())
        if not workers:
            raise InputError(f'{address}: the scheduler has no workers; start some first')
        _require_this_version(client, address)
        yield client.get_executor(pure=False), workers
    except CancelledError:
        raise InputError(
            f'{address}: the scheduler has ended; start it again and call this again: the rows '
            'that were done stay'
        ) from None
    finally:
        client.close()


def _require_this_version(client: Any, address: str) -> None:
    """Raise InputError if workers have another version of this package, or none."""
    try:
        versions = client.run(_version)
    except Exception as error:
        raise InputError(
            f'{address}: a worker cannot work with remaster_ros {__version__} ({error}); install '
            'it there'
        ) from None
    for worker, version in versions.items():
        if version != __version__:
            raise InputError(
                f'{worker}: has remaster_ros {version}, here is {__version__}; install the same'
            )


def _version() -> str:
    """Return the version of this package; run on each worker of a scheduler."""
    return __version__


def refuse_open(address: str, *, insecure: bool) -> None:
    """Raise InputError for plain TCP to another computer, whose peer decides what is executed.

    Loopback addresses, ``tls://`` and `insecure` pass.
    """
    parts = urllib.parse.urlsplit(address if '://' in address else f'tcp://{address}')
    host = parts.hostname or ''
    try:
        is_here = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_here = host == 'localhost'
    if parts.scheme != 'tls' and not is_here and not insecure:
        raise InputError(
            f"{address}: is another computer without TLS, and a scheduler runs anybody's code; "
            'give tls://…, a tunnel to 127.0.0.1, or --insecure where the network is yours alone'
        )
