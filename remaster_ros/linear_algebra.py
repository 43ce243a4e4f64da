# SPDX-License-Identifier: Apache-2.0
"""Linear algebra in one thread, whatever the machine has, and with a second way where one fails.

Products of matrices of some hundred parameters in several threads take many times as long as in
one: the threads wait for each other at full speed. A search for causes takes six times the
processor time on two idle cores and up to thirty times on two busy ones, beside nodes that move an
arm; and its last digits depend on the machine.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from remaster_ros.types import FloatArray

_Given = ParamSpec('_Given')
_Result = TypeVar('_Result')


def one_thread(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Decorate a function so that the BLAS library works in one thread while it runs.

    Of the whole process, so that other threads are limited meanwhile; afterwards the number is
    as before.
    """

    @wraps(function)
    def limited(*args: _Given.args, **given: _Given.kwargs) -> _Result:
        # Looked up anew at each call: a library that was loaded since has threads of its own.
        with contextlib.ExitStack() as stack:
            with _interrupts_later():
                stack.enter_context(threadpool_limits(limits=1, user_api='blas'))
            return function(*args, **given)

    return limited


def svd(matrix: FloatArray, *, full_matrices: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the singular value decomposition U, s, V', as `numpy.linalg.svd`.

    If LAPACK's divide and conquer does not converge, as for some finite matrices of hundreds
    of columns, its older QR iteration is taken. Raises LinAlgError or ValueError if that fails
    too.
    """
    try:
        left, singular, right = np.linalg.svd(matrix, full_matrices=full_matrices)
    except np.linalg.LinAlgError:
        left, singular, right = scipy.linalg.svd(
            matrix, full_matrices=full_matrices, lapack_driver='gesvd'
        )
    return left, singular, right


@contextlib.contextmanager
def _interrupts_later() -> Iterator[None]:
    """Context in which Ctrl-C is held back: its signal is raised again at the end of the block.

    In a callback of ctypes it would be lost. Nothing is changed outside of the main thread.
    """
    handler = signal.getsignal(signal.SIGINT)
    came: list[int] = []
    try:
        if callable(handler):
            signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    except ValueError:  # Not the main thread: Ctrl-C is not raised in it.
        handler = None
    if not callable(handler):
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)
