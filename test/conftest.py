# SPDX-License-Identifier: Apache-2.0
"""For every test: missing packages are named in one line, and a signal ends what was started."""

from __future__ import annotations

import gc
import signal

import pytest
from hypothesis import HealthCheck, settings

from remaster_ros.requirements import missing_packages

if _missing := missing_packages():
    pytest.exit(_missing, returncode=2)

# How long an example takes says how busy the machine is, not whether the example is right.
settings.register_profile('busy', deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile('busy')

# What a shell starts in the background, as tools/run-tests does, ignores SIGINT, and so would the
# nodes of its tests. Either signal ends a run as Ctrl-C does: with the processes that it started.
for _number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(_number, signal.default_int_handler)


def pytest_collection_finish():
    """Let the collector of garbage leave alone what stays to the end: all tests and libraries."""
    gc.collect()
    gc.freeze()
