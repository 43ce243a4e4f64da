# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for the work of a batch, in a module that a worker imports in no time."""

import os
import signal
from pathlib import Path


def square(job):
    return {'status': 'done', 'square': job * job}


def dies_once(job):
    """Of a number and a file: kills the worker at 1, where the file is not there yet."""
    number, mark = job
    if number == 1 and not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return square(number)


def always_dies(job):
    if job == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return square(job)
