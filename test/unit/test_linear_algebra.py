# SPDX-License-Identifier: Apache-2.0
"""What estimates works in one thread of linear algebra, also where nothing else has said so."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from worlds.calibration_scenes import scene

from remaster_ros import linear_algebra
from remaster_ros.calibration.fit import fit_session
from remaster_ros.discovery.discover import discover_session
from remaster_ros.linear_algebra import one_thread, svd


@pytest.fixture
def two_threads() -> Iterator[None]:
    """As a program finds them that did not ask for one: as many as the machine has."""
    with threadpool_limits(limits=2, user_api='blas'):
        yield


def threads() -> set[int]:
    return {
        library['num_threads'] for library in threadpool_info() if library['user_api'] == 'blas'
    }


@pytest.mark.parametrize('work', [fit_session, discover_session])
def test_fits_and_searches_take_one_thread_and_leave_the_others_as_they_were(two_threads, work):
    session, _ = scene(3, poses=12, validation=4)
    seen: set[int] = set()
    work(session, rng=np.random.default_rng(1), progress=lambda *_: seen.update(threads()))
    assert seen == {1}
    assert threads() == {2}


def test_also_after_an_error(two_threads):
    @one_thread
    def failing() -> None:
        assert threads() == {1}
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        failing()
    assert threads() == {2}


def test_a_library_that_was_loaded_later_counts():
    """SciPy has one of its own, which nothing has loaded when the decorator is made."""
    code = (
        'import json, numpy\n'
        'from threadpoolctl import threadpool_info\n'
        'from remaster_ros.linear_algebra import one_thread\n'
        'limited = one_thread(lambda: [one["num_threads"] for one in threadpool_info()])\n'
        'before = len(threadpool_info())\n'
        'import scipy.linalg\n'
        'print(json.dumps([before, limited()]))\n'
    )
    environment = {**os.environ, 'OMP_NUM_THREADS': '2'}
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, env=environment
    )
    before, counts = json.loads(done.stdout)
    assert len(counts) >= before
    assert set(counts) == {1}


def test_an_interrupt_while_the_libraries_are_looked_up_is_not_lost(monkeypatch):
    """What is raised in a callback of ctypes is printed and forgotten: Ctrl-C did nothing."""
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))

    def interrupted(**limits):
        callback()
        return threadpool_limits(**limits)

    monkeypatch.setattr(linear_algebra, 'threadpool_limits', interrupted)
    worked = []
    with pytest.raises(KeyboardInterrupt):
        linear_algebra.one_thread(worked.append)(1)
    assert worked == []
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_decomposition_that_does_not_converge_is_made_otherwise(monkeypatch):
    matrix = np.random.default_rng(3).standard_normal((7, 4))
    expected = np.linalg.svd(matrix, full_matrices=True)

    def fails(*args, **given):
        raise np.linalg.LinAlgError('SVD did not converge')

    monkeypatch.setattr(np.linalg, 'svd', fails)
    left, singular, right = svd(matrix, full_matrices=True)
    np.testing.assert_allclose(singular, expected[1], rtol=1e-12)
    np.testing.assert_allclose((left[:, :4] * singular) @ right, matrix, atol=1e-12)
