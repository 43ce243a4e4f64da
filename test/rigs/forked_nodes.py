# SPDX-License-Identifier: Apache-2.0
"""Processes of nodes, forked from one that has imported most of what nodes import.

A node takes two seconds of a processor to import its libraries, and a collection has eight. Here
one process imports those without threads, once for a run of tests, and nodes begin as its forks:
processes of their own, with arguments, environment, folder, streams and signals as `subprocess`
gives them, and children of the tests. That nodes begin by themselves as well is what the tests of
`remaster demo`, of the launch files and of the installed commands show.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import importlib
import inspect
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CORE = (
    'kinematics',
    'collection',
    'motion',
    'planning',
    'discovery',
    'sensors',
    'session',
    'session.bags',
    'session.cells',
    'session.records',
    'simulation',
)
_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
_MOST_BYTES = 1 << 20
_asking = threading.Lock()


class NodeProcess(subprocess.Popen):
    """`python -m MODULE …` of a module of `remaster_ros.nodes`, for less of a processor's time.

    Called as `subprocess.Popen` with ``[sys.executable, '-m', module, …]`` and the options stdin,
    stdout, stderr, text, env and cwd.
    """

    def _execute_child(self, *args: Any) -> None:
        given = inspect.signature(subprocess.Popen._execute_child).bind(self, *args).arguments
        streams = [given[name] for name in ('p2cread', 'c2pwrite', 'errwrite')]
        request = {
            'words': [str(word) for word in given['args'][2:]],
            'environment': dict(os.environ if given['env'] is None else given['env']),
            'folder': str(given['cwd'] or os.getcwd()),
        }
        server, _ = _server(os.getpid())
        given_streams = [stream if stream != -1 else at for at, stream in enumerate(streams)]
        with _asking:
            socket.send_fds(server, [json.dumps(request).encode()], given_streams)
            self.pid = int(server.recv(32))
        self._child_created = True
        self._close_pipe_fds(
            *(given[name] for name in ('p2cread', 'p2cwrite', 'c2pread', 'c2pwrite')),
            *(given[name] for name in ('errread', 'errwrite')),
        )


@functools.cache
def _server(_owner: int) -> tuple[socket.socket, subprocess.Popen[bytes]]:
    """Start the process that forks nodes; return a connection, whose end ends it.

    A process of its own has each process that starts nodes.
    """
    # A fork of it is a child of this process once it has no parent: it is waited for as any other.
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), 'prctl')
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MOST_BYTES)
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
    with theirs:
        process = subprocess.Popen(
            [sys.executable, __file__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            # A thread of a library does not survive a fork.
            env={**os.environ, 'PYTHONPATH': path, 'OMP_NUM_THREADS': '1'},
            # Ctrl-C on the terminal is for the tests, which end what they started.
            start_new_session=True,
        )
    return ours, process


def _serve(tests: socket.socket) -> list[str]:
    """Fork when asked to; return, in a fork, the module and the arguments of its node."""
    while True:
        message, streams, _, _ = socket.recv_fds(tests, _MOST_BYTES, 3)
        if not message:
            os._exit(0)
        born, bears = os.pipe()
        between = os.fork()
        if between:
            os.waitpid(between, 0)
            # Only now is it a child of the tests: one that is no child counts as ended.
            tests.send(os.read(born, 32))
            for number in (born, bears, *streams):
                os.close(number)
            continue
        parent = os.getpid()
        node = os.fork()
        if node:
            os.write(bears, str(node).encode())
            os._exit(0)
        # Not before its parent has ended, whose death it would be told of: a moment after that has
        # closed its files the kernel passes it on to the tests.
        while os.getppid() == parent:
            time.sleep(0.001)
        time.sleep(0.001)
        # Tests that are killed leave no node behind.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        for number in (born, bears):
            os.close(number)
        tests.close()
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
            os.close(stream)
        request = json.loads(message)
        os.chdir(request['folder'])
        os.environ.clear()
        os.environ.update(request['environment'])
        tempfile.tempdir = None  # Of this environment, when next asked for.
        return request['words']


def main() -> None:
    """Import, serve, and be a node."""
    tests = socket.socket(fileno=int(sys.argv[1]))
    # Not rclpy, whose import begins threads.
    for name in CORE:
        folder = ROOT.joinpath('remaster_ros', *name.split('.'))
        for path in sorted(folder.glob('[a-z]*.py')):
            importlib.import_module(f'remaster_ros.{name}.{path.stem}')
    assert len(os.listdir('/proc/self/task')) == 1, 'threads do not survive a fork'
    gc.freeze()
    module, *arguments = _serve(tests)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # As which `ps` and a debugger show it.
    ctypes.CDLL(None).prctl(_PR_SET_NAME, module.rpartition('.')[2].encode(), 0, 0, 0)
    at_once = bool(os.environ.get('PYTHONUNBUFFERED'))
    for number, name in ((1, 'stdout'), (2, 'stderr')):
        setattr(sys, name, open(number, 'w', buffering=1, closefd=False))  # noqa: SIM115
    sys.stdout.reconfigure(line_buffering=False, write_through=at_once)
    # With the folder it runs in, as of `python -m`.
    further = os.environ.get('PYTHONPATH', '').split(os.pathsep)
    sys.path[:1] = [os.getcwd(), *(path for path in further if path and path not in sys.path)]
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name='__main__', alter_sys=True)


if __name__ == '__main__':
    main()
