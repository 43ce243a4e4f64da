"""What the command prints: progress on a terminal, a few lines on stdout."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Yield a function (stage, share done) that shows a bar where stderr is a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda stage, share: None
        return
    # Imported late: `remaster fit` in a script needs none of it.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn('{task.description:>12s}'), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task('', total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


def show(quiet: bool, text: str) -> None:
    """Print unless --quiet was given."""
    if not quiet:
        print(text)
