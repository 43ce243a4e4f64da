"""What the benchmarks share: the folder of the tests' helpers, and printing."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
# Hidden worlds, judges and studies are the tests' own; import this module before them.
sys.path.insert(0, str(ROOT / 'test'))


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


def progress(text: str) -> None:
    """Write a line that the next one replaces, on a terminal only."""
    if sys.stderr.isatty():
        print(f'\r\x1b[K{text}', end='', file=sys.stderr, flush=True)
