"""Run `remaster` as a user does: a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parent.parent


def remaster(
    *args: object,
    environment: dict[str, str] | None = None,
    through: Sequence[str] = (),
) -> subprocess.CompletedProcess[str]:
    """Run a verb in the repository's folder; return what it printed and its status.

    Parameters
    ----------
    environment
        Variables on top of this process's.
    through
        A command that ends by becoming the command line it is given.
    """
    command = [*through, sys.executable, '-m', 'remaster_ros.cli.main', *map(str, args)]
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
    process = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, 'PYTHONPATH': path, **(environment or {})},
        check=False,
    )
    print('remaster', *args, '->', process.returncode, process.stderr)
    return process


def refusal(*args: object, status: int = 2, **options: object) -> str:
    """Run a verb that must end with this status and exactly one line on stderr; return it."""
    process = remaster(*args, **options)  # type: ignore[arg-type]
    assert process.returncode == status, process.stderr
    assert process.stdout == ''
    assert process.stderr.count('\n') == 1, process.stderr
    assert process.stderr.startswith('error: ')
    return process.stderr
