# SPDX-License-Identifier: Apache-2.0
"""Progress shows on a terminal and nowhere else."""

import os
import pty
import subprocess
import sys

import pytest

SCRIPT = """
import sys
import time
from remaster_ros.cli.console import progress_bar, show
quiet = 'quiet' in sys.argv
with progress_bar(quiet) as progress:
    progress('sampling', 0.25)
    time.sleep(1.1)
    progress('sampling', 0.5)
show(quiet, 'the result')
print('rich' in sys.modules)
"""


def on_a_terminal(*args: str) -> tuple[str, str]:
    """Run the script with stderr on a terminal; return stdout and what the terminal got."""
    leader, follower = pty.openpty()
    environment = {**os.environ, 'TERM': 'xterm', 'COLUMNS': '80'}
    process = subprocess.run(
        [sys.executable, '-c', SCRIPT, *args],
        stdout=subprocess.PIPE,
        stderr=follower,
        env=environment,
        check=True,
    )
    os.close(follower)
    shown = b''
    try:
        while chunk := os.read(leader, 65536):
            shown += chunk
    except OSError:
        pass  # Linux's way to say that the other end is closed
    os.close(leader)
    return process.stdout.decode(), shown.decode()


def test_a_terminal_shows_the_stage():
    out, shown = on_a_terminal()
    assert out == 'the result\nTrue\n'
    assert 'sampling' in shown
    assert '50 %, about 1 s left' in shown


def test_quiet_shows_and_prints_nothing():
    assert on_a_terminal('quiet') == ('False\n', '')


@pytest.mark.parametrize('stderr', [subprocess.PIPE, subprocess.STDOUT])
def test_a_pipe_gets_no_bar(stderr):
    process = subprocess.run(
        [sys.executable, '-c', SCRIPT], stdout=subprocess.PIPE, stderr=stderr, check=True
    )
    assert process.stdout == b'the result\nFalse\n'
    assert not process.stderr
