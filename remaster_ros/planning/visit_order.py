"""The shortest way through all configurations of a tour, by travel time."""

from __future__ import annotations

import numpy as np

from remaster_ros.types import FloatArray

FEW = 2
"""So few places have one order."""
LONGEST_MOVED = 3
"""So many neighbours are moved to another place of the order together."""


def fastest_order(times: FloatArray) -> list[int]:
    """Order the visits of an open tour that begins at the first place.

    The nearest neighbour first, then 2-opt (a part of the order is reversed) and Or-opt (up to
    three neighbours are moved elsewhere) until neither makes it faster (D. S. Johnson and L. A.
    McGeoch, "The Traveling Salesman Problem: A Case Study in Local Optimization", 1997). A search
    from 100 perturbed orders shortens tours of 60 places by another 1 %, of 180 by 1.5 %.

    Parameters
    ----------
    times
        From each place to each, symmetric, s, (n, n); place 0 is where the arm stands.

    Returns
    -------
    list of int
        All places but the first, in order.
    """
    n = len(times)
    order = _nearest(times)
    # An open tour is a closed one through a place that is as near to all: the end costs nothing.
    padded = np.zeros((n + 1, n + 1))
    padded[:n, :n] = times
    order.append(n)
    while n > FEW and (_reverse(padded, order) or _move(padded, order)):
        pass
    return order[1:-1]


def _nearest(times: FloatArray) -> list[int]:
    order, left = [0], np.ones(len(times), bool)
    left[0] = False
    while left.any():
        order.append(int(np.argmin(np.where(left, times[order[-1]], np.inf))))
        left[order[-1]] = False
    return order


def _reverse(times: FloatArray, order: list[int]) -> bool:
    """Reverse the part whose reversal gains the most, if any does; both ends stay."""
    at = np.array(order)
    # Of the part from i to j: its entry from i - 1, and its exit to j + 1.
    entry, exit_ = times[at[:-2], at[1:-1]], times[at[1:-1], at[2:]]
    gain = (entry[:, None] + exit_[None]) - (
        times[np.ix_(at[:-2], at[1:-1])] + times[np.ix_(at[1:-1], at[2:])]
    )
    gain = np.triu(gain, 1)
    i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
    if gain[i, j] < 1e-9:
        return False
    order[i + 1 : j + 2] = order[i + 1 : j + 2][::-1]
    return True


def _move(times: FloatArray, order: list[int]) -> bool:
    """Move a part elsewhere, either way round, where that gains the most, if anywhere it does."""
    best, found = 1e-9, None
    for size in range(1, LONGEST_MOVED + 1):
        for i in range(1, len(order) - size):
            part, rest = order[i : i + size], np.array(order[:i] + order[i + size :])
            before, after = order[i - 1], order[i + size]
            saved = times[before, part[0]] + times[part[-1], after] - times[before, after]
            gap = times[rest[:-1], rest[1:]]
            for turned in (part, part[::-1]):
                cost = times[rest[:-1], turned[0]] + times[turned[-1], rest[1:]] - gap
                place = int(np.argmin(cost))
                if saved - cost[place] > best:
                    best, found = saved - cost[place], (rest.tolist(), place + 1, turned)
    if found is None:
        return False
    rest_, place, turned = found
    order[:] = [*rest_[:place], *turned, *rest_[place:]]
    return True
