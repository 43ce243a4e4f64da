# SPDX-License-Identifier: Apache-2.0
"""Processes of nodes, with restarts, and free ports for the fake devices."""

from __future__ import annotations

import ctypes
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from remaster_ros.errors import DeviceError

_PR_SET_PDEATHSIG = 1

SHORT_LIFE_S = 2.0
"""Life of a process below which it counts as killed just after its start, s."""
SHORT_LIVES = 5
"""Most such restarts in a row."""


def _die_with_parent() -> None:
    """Ask Linux for SIGTERM when the parent dies, so that a killed demo leaves no processes."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class NodeProcesses:
    """Processes of nodes, each with its output in a file ``<name>.log``; killed ones restart."""

    def __init__(self, log_folder: Path, environment: Mapping[str, str]) -> None:
        self._log_folder = log_folder
        self._environment = {**os.environ, **environment}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._commands: dict[str, list[str]] = {}
        self._started_wall: dict[str, float] = {}
        self._short_lives: Counter[str] = Counter()

    def start(self, name: str, parameters_file: Path, parameters: Mapping[str, Any]) -> None:
        """Start the node `name`; ``parameters`` override those of the file. Returns at once."""
        command = [sys.executable, '-m', 'remaster_ros.nodes', name, '--ros-args']
        command += ['--params-file', str(parameters_file)]
        for key, value in parameters.items():
            # JSON is YAML; text in double quotes stays text whatever it looks like.
            command += ['-p', f'{key}:={json.dumps(value)}']
        self._commands[name] = command
        self._spawn(name)

    def _spawn(self, name: str) -> None:
        """Start the process of a node, or start it again."""
        self._started_wall[name] = time.monotonic()
        with (self._log_folder / f'{name}.log').open('ab') as log:
            self._running[name] = subprocess.Popen(
                self._commands[name],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=self._environment,
                start_new_session=True,  # Ctrl-C on the terminal reaches only the demo.
                preexec_fn=_die_with_parent,
            )

    def check(self) -> list[str]:
        """Restart processes that were killed by a signal; return the names of their nodes.

        Raises DeviceError, with the last line of its log, if a process has ended by itself, or
        is killed more than `SHORT_LIVES` times in a row within `SHORT_LIFE_S` of its start.
        """
        killed = []
        for name, process in list(self._running.items()):
            status = process.poll()
            if status is None:
                continue
            lived_s = time.monotonic() - self._started_wall[name]
            self._short_lives[name] = self._short_lives[name] + 1 if lived_s < SHORT_LIFE_S else 0
            if status < 0 and self._short_lives[name] <= SHORT_LIVES:
                self._spawn(name)
                killed.append(name)
            else:
                lines = (self._log_folder / f'{name}.log').read_text(errors='replace').split('\n')
                last = next((line for line in reversed(lines) if line.strip()), 'its log is empty')
                raise DeviceError(f'{name} ended with status {status}: {last.strip()}')
        return killed

    def pid(self, name: str) -> int:
        """Return the id of the present process of a node; KeyError if it was not started."""
        return self._running[name].pid

    def stop(self, names: Sequence[str] = (), grace_s: float = 20.0) -> list[str]:
        """End processes, all by default; return the names of those killed after `grace_s`.

        By SIGINT, then SIGKILL. Raises KeyError for a name that is not running.
        """
        ended = {name: self._running[name] for name in names or self._running}
        for process in ended.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + grace_s
        killed = []
        for name, process in ended.items():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                killed.append(name)
            del self._running[name]
        return killed


def free_ports(*kinds: int) -> list[int]:
    """Return an unused port on loopback for each kind of socket, all different.

    They lie above the ports that Linux assigns to sockets without one (32768 to 60999): nine
    processes open dozens of these before the returned ports are bound.
    """
    candidates = iter(random.SystemRandom().sample(range(61001, 65001), 1000))
    return [next(port for port in candidates if _is_free(kind, port)) for kind in kinds]


def _is_free(kind: int, port: int) -> bool:
    """Whether a socket of this kind can be bound to a port on 127.0.0.1."""
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind(('127.0.0.1', port))
        except OSError:
            return False
        return True
