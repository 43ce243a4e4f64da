# SPDX-License-Identifier: Apache-2.0
"""Run `remaster` as a user does: in a process of its own, or as one would, within this process."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from remaster_ros.cli.main import main

ROOT = Path(__file__).parents[2]


class Printed(NamedTuple):
    """What a verb has printed."""

    stdout: str
    stderr: str


def remaster(*args: object, status: int = 0, **options: object) -> Printed:
    """Run a verb as `run`, that must end with this status; return what it printed."""
    process = run(*args, **options)  # type: ignore[arg-type]
    assert process.returncode == status, process.stderr
    return Printed(process.stdout, process.stderr)


def run(
    *args: object,
    environment: dict[str, str] | None = None,
    through: Sequence[str] = (),
    real: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run a verb in the current folder; return what it printed and its status.

    A process of its own takes a second to load its libraries, so most are called in this one: with
    streams and a logging of their own.

    Parameters
    ----------
    environment
        Variables on top of this process's; it is a process of its own then.
    through
        A command that ends by becoming the command line it is given; so here.
    real
        Whether it is a process of its own in any case.
    """
    words = [str(arg) for arg in args]
    # They may become the process of a node.
    is_node = words[:1] == ['demo'] or (words[:1] == ['replay'] and '--out' not in words)
    if real or environment or through or is_node:
        done = _in_its_own_process(words, environment, through)
    else:
        done = _in_this_process(words)
    print('remaster', *args, '->', done.returncode, done.stderr)
    return done


def _in_its_own_process(
    words: list[str], environment: dict[str, str] | None, through: Sequence[str]
) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
    return subprocess.run(
        [*through, sys.executable, '-m', 'remaster_ros.cli.main', *words],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, 'PYTHONPATH': path, **(environment or {})},
        check=False,
    )


def _in_this_process(words: list[str]) -> subprocess.CompletedProcess[str]:
    out, err, root = io.StringIO(), io.StringIO(), logging.getLogger()
    handlers, level = root.handlers[:], root.level
    root.handlers.clear()
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            # As Python warns by itself: on stderr, where a test that wants one line sees it.
            warnings.catch_warnings(),
        ):
            warnings.resetwarnings()
            for kind in (DeprecationWarning, ImportWarning, ResourceWarning):
                warnings.simplefilter('ignore', kind)
            try:
                status = main(words)
            except SystemExit as ended:
                status = ended.code if isinstance(ended.code, int) else 2
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def refusal(*args: object, status: int = 2, **options: object) -> str:
    """Run a verb that must end with this status and exactly one line on stderr; return it."""
    stdout, stderr = remaster(*args, status=status, **options)
    assert stdout == ''
    assert stderr.count('\n') == 1, stderr
    assert stderr.startswith('error: ')
    return stderr
