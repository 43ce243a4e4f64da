# SPDX-License-Identifier: Apache-2.0
"""The same work for many items, in several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from multiprocessing import get_context
from typing import TypeVar

Item = TypeVar('Item')
Outcome = TypeVar('Outcome')


def in_parallel(
    work: Callable[[Item], Outcome], items: Iterable[Item], workers: int
) -> Iterator[Outcome]:
    """Yield the results as they come, from that many processes (from this one with 1)."""
    if workers <= 1:
        yield from map(work, items)
        return
    with get_context('spawn').Pool(workers) as pool:
        yield from pool.imap_unordered(work, items)
