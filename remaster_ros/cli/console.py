# SPDX-License-Identifier: Apache-2.0
"""What the command prints: progress on a terminal, a few lines on stdout."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

# So long a stage has to run before it is told how long it still takes, s.
LEAST_S = 1.0


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Yield a function (stage, share done) that shows a bar where stderr is a terminal.

    It has the stage, the share of it that is done and the time that is left of it; a bar that runs
    to and fro where neither is known.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda stage, share: None
        return
    # Imported late: `remaster fit` in a script needs none of it.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn('{task.description:>12s}'),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn('{task.fields[left]}'),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task('', total=None, left='')
        begun = ('', time.monotonic())

        def update(stage: str, share: float) -> None:
            nonlocal begun
            if stage != begun[0]:
                begun = stage, time.monotonic()
            passed = time.monotonic() - begun[1]
            left = f'{100 * share:.0f} %' if share > 0.0 else ''
            # Of a stage that has only begun nothing can be told.
            if share > 0.0 and passed > LEAST_S:
                left += f', about {_duration(passed * (1.0 - share) / share)} left'
            total = 1.0 if share > 0.0 else None
            bar.update(task, description=stage, completed=share, total=total, left=left)

        yield update


def _duration(seconds: float) -> str:
    return f'{seconds:.0f} s' if seconds < 90.0 else f'{seconds / 60.0:.0f} min'


def tell(args: argparse.Namespace, content: Mapping[str, Any], *lines: str) -> None:
    """Print one JSON object with --json, else those lines that there are, unless --quiet."""
    if args.json:
        print(json.dumps(content))
    else:
        show(args.quiet, *lines)


def show(quiet: bool, *lines: str) -> None:
    """Print those lines that there are unless --quiet was given."""
    for line in filter(None, () if quiet else lines):
        print(line)
