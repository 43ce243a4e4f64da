# SPDX-License-Identifier: Apache-2.0
"""A demo whose arm is halted, at a terminal: a person goes on, and it comes to its end."""

import os
import pty
import subprocess
import sys
import threading

import pytest
from rigs.ros_rig import wait_until

from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.faults import inject

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

SEED = 10


class Terminal:
    """A program at a terminal of its own, and what it has printed."""

    def __init__(self, command, environment):
        self._end, far = pty.openpty()
        self.process = subprocess.Popen(
            command, stdin=far, stdout=far, stderr=far, env=environment, start_new_session=True
        )
        os.close(far)
        self.printed = ''
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        try:
            while data := os.read(self._end, 65536):
                self.printed += data.decode(errors='replace')
        except OSError:
            # The program has ended.
            return

    def press_enter(self):
        os.write(self._end, b'\n')


@pytest.mark.qualify
def test_a_person_at_the_terminal_goes_on_after_a_halt(ros_environment, tmp_path):
    out = tmp_path / 'out'
    terminal = Terminal(
        [sys.executable, '-m', 'remaster_ros.cli.main', 'demo', '--out', str(out)]
        + ['--seed', str(SEED), '--candidates', '5', '--no-figures'],
        {**ros_environment, 'TMPDIR': str(tmp_path), 'COLUMNS': '200'},
    )
    try:
        rows = out / 'session' / 'observations.csv'
        wait_until(
            lambda: rows.exists() and rows.read_text().count('\n') > 4, 300.0, 'the first rows'
        )
        (world,) = tmp_path.glob('remaster_world_*')
        inject(world, {'robot': {'off': 1}})
        wait_until(lambda: 'Enter goes on' in terminal.printed, 120.0, 'the offer')
        assert 'the arm is halted: no sign of robot' in terminal.printed
        inject(world, {})
        terminal.press_enter()
        assert terminal.process.wait(600.0) == 0, terminal.printed
    finally:
        terminal.process.terminate()
        terminal.process.wait(30.0)
    assert 'estimate' in terminal.printed
    assert read_session(out / 'session').exit_status == 'complete'
