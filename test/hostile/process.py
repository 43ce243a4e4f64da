# SPDX-License-Identifier: Apache-2.0
"""The bridge as a process of its own: start it, pause it, kill it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rigs.forked_nodes import NodeProcess

ROOT = Path(__file__).resolve().parents[2]


class BridgeProcess:
    """A bridge that can be started again and again.

    Parameters
    ----------
    environment
        Its environment: the DDS domain, the path, ROS_HOME.
    parameters
        Its parameters.
    log
        Its output is appended there.
    """

    def __init__(self, environment: dict[str, str], parameters: dict[str, Any], log: Path) -> None:
        self.environment, self.parameters, self.log = environment, parameters, log
        self.process: subprocess.Popen[bytes] | None = None
        self.started_s = -np.inf

    def start(self) -> None:
        """Start the bridge."""
        command = [sys.executable, '-m', 'remaster_ros.nodes.robot_bridge', '--ros-args']
        for name, value in self.parameters.items():
            command += ['-p', f'{name}:={value}']
        self.started_s = time.monotonic()
        with self.log.open('ab') as log:
            self.process = NodeProcess(
                command, env=self.environment, stdout=log, stderr=log, cwd=ROOT
            )

    def signal(self, number: int) -> None:
        """Send the bridge a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self) -> None:
        """Kill the bridge."""
        self.signal(signal.SIGKILL)
        assert self.process is not None
        self.process.wait()

    def end(self) -> None:
        """End the bridge as Ctrl-C does, if it runs."""
        if self.process is None or self.process.poll() is not None:
            return
        self.signal(signal.SIGCONT)
        self.signal(signal.SIGINT)
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.kill()


def environment(domain: int, home: Path) -> dict[str, str]:
    """Return the environment of a bridge with a DDS domain and a ROS_HOME of its own."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
    return {
        **os.environ,
        'PYTHONPATH': path,
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_HOME': str(home),
        'PYTHONUNBUFFERED': '1',
    }
