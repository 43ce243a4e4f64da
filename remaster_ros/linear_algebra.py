"""Linear algebra in one thread, whatever the machine has.

Products of matrices of some hundred parameters in several threads take many times as long as in
one: the threads wait for each other at full speed. A search for causes takes six times the
processor time on two idle cores and up to thirty times on two busy ones, beside nodes that move an
arm; and its last digits depend on the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

_Given = ParamSpec('_Given')
_Result = TypeVar('_Result')


def one_thread(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Decorate what estimates or designs: it works in one thread, others as before.

    The limit is of the whole process while the function works.
    """

    @wraps(function)
    def limited(*args: _Given.args, **given: _Given.kwargs) -> _Result:
        # Looked up anew at each call: a library that was loaded since has threads of its own.
        with threadpool_limits(limits=1, user_api='blas'):
            return function(*args, **given)

    return limited
