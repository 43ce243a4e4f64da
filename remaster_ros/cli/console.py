# SPDX-License-Identifier: Apache-2.0
"""Output of the command: progress on a terminal, a few lines on stdout."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

# Time after which the remaining time of a stage is shown, s.
LEAST_S = 1.0


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Context: yield a function (stage, share done) that shows a progress bar on stderr.

    The bar shows the stage, its share done and the remaining time; it moves to and fro if the
    share is 0 (unknown). The share is at most 1. Without a terminal, or if ``quiet``, the
    function does nothing.
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
        TextColumn('{task.fields[remaining]}'),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task('', total=None, remaining='')
        begun = ('', time.monotonic())

        def update(stage: str, share: float) -> None:
            nonlocal begun
            if stage != begun[0]:
                begun = stage, time.monotonic()
            passed = time.monotonic() - begun[1]
            remaining = f'{100 * share:.0f} %' if share > 0.0 else ''
            # The remaining time of a new stage is unknown.
            if share > 0.0 and passed > LEAST_S:
                remaining += f', about {_duration(passed * (1.0 - share) / share)} left'
            total = 1.0 if share > 0.0 else None
            bar.update(task, description=stage, completed=share, total=total, remaining=remaining)

        yield update


def _duration(seconds: float) -> str:
    """Return a time as text: seconds below 90 s, then minutes."""
    return f'{seconds:.0f} s' if seconds < 90.0 else f'{seconds / 60.0:.0f} min'


def tell(args: argparse.Namespace, content: Mapping[str, Any], *lines: str) -> None:
    """Print one JSON object with --json; else the non-empty lines, unless --quiet.

    ``content``: the object, which is printed even with --quiet; ``lines``: text for people.
    """
    if args.json:
        print(json.dumps(content))
    else:
        show(args.quiet, *lines)


def show(quiet: bool, *lines: str) -> None:
    """Print the non-empty lines, unless --quiet."""
    for line in filter(None, () if quiet else lines):
        print(line)
