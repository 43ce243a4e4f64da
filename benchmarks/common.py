# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks share: the folder of the tests' helpers, and printing."""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
# Hidden worlds, judges and studies are the tests' own; import this module before them.
sys.path.insert(0, str(ROOT / 'test'))

Item = TypeVar('Item')


def machine() -> str:
    """Return one line with the machine and versions that the figures come from."""
    threads = os.environ.get('OMP_NUM_THREADS', 'not set')
    return (
        f'{os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()}, '
        f'NumPy {np.__version__}, OMP_NUM_THREADS {threads}'
    )


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = ['| ' + ' | '.join(header) + ' |', '|' + '---|' * len(header)]
    lines += ['| ' + ' | '.join(map(str, row)) + ' |' for row in rows]
    return '\n'.join(lines)


def known(path: Path) -> dict[str, dict[str, Any]]:
    """Read the lines of a results file by their name; one torn by an interruption is left out."""
    lines = {}
    if path.exists():
        for text in path.read_text(encoding='utf-8').splitlines():
            try:
                line = json.loads(text)
            except json.JSONDecodeError:
                continue
            lines[line['name']] = line
    return lines


def resumed(
    path: Path,
    todo: Mapping[str, Item],
    work: Callable[[tuple[str, Item]], dict[str, Any]],
    jobs: int,
) -> Iterator[dict[str, Any]]:
    """Do the work in so many processes; append each line to the results file, and give it."""
    # One thread per process, as the processes fill the cores; they start with what stands here.
    for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ[name] = '1'
    # Ended from outside it ends its processes too.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    fresh = multiprocessing.get_context('spawn')
    with fresh.Pool(jobs) as pool, path.open('a', encoding='utf-8') as file:
        for line in pool.imap_unordered(work, todo.items()):
            file.write(json.dumps(line) + '\n')
            file.flush()
            yield line


def progress(text: str) -> None:
    """Write a line that the next one replaces, on a terminal only."""
    if sys.stderr.isatty():
        print(f'\r\x1b[K{text}', end='', file=sys.stderr, flush=True)
