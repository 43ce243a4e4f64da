# SPDX-License-Identifier: Apache-2.0
"""Moments at which something begins or changes in mid-session.

A moment lies midway in the gap between two successive configurations. Nothing tells when in such
a gap it was: a row held out there is predicted by the mean over the gap.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Changes, Design
from remaster_ros.discovery.effects.context import Context
from remaster_ros.types import FloatArray

# Of the fitted configurations, before and after a moment: fewer do not tell it from gross errors.
LEAST_SHARE = 0.04
# Moments at which each effect may change that are tried; those near the best follow.
MOMENTS_OF_CHANGE = 12
# An effect changes in mid-session in one of so many sessions in which it is there.
RARITY_OF_CHANGE = 3


def gaps(context: Context, low: float = -np.inf, high: float = np.inf) -> FloatArray:
    """Return start and end of the gaps between successive configurations, s, (m, 2).

    Since the first row. Gaps with few fitted configurations on one side are left out
    (`LEAST_SHARE`), as those among readings that are all held out at the end. ``low, high``: only
    gaps that overlap this interval, s.
    """
    m = context.measurements
    _, row = np.unique(m.configuration, return_inverse=True)
    first, last = np.full(row.max() + 1, np.inf), np.full(row.max() + 1, -np.inf)
    np.minimum.at(first, row, context.elapsed_s)
    np.maximum.at(last, row, context.elapsed_s)
    order = np.argsort(first)
    first, last = first[order], np.maximum.accumulate(last[order])
    is_gap = first[1:] > last[:-1]
    is_fitted = np.bincount(row, ~m.is_validation) > 0.0
    before = np.cumsum(is_fitted[order])
    edge = max(2, int(LEAST_SHARE * before[-1]))
    inside = (before[:-1] >= edge) & (before[:-1] <= before[-1] - edge)
    found = np.column_stack([last[:-1], first[1:]])[is_gap & inside]
    return found[(found[:, 1] > low) & (found[:, 0] < high)]


def spread(found: FloatArray, count: int) -> FloatArray:
    """Return at most `count` of some gaps, (m, 2), evenly spread over their order.

    `found` itself if it is empty.
    """
    if len(found) == 0:
        return found
    chosen = np.linspace(0, len(found) - 1, min(count, len(found)))
    return found[chosen.round().astype(int)]


def after(context: Context, gap: FloatArray) -> FloatArray:
    """Probability that each row is after a moment uniform in a gap, (n, 1).

    ``gap``: start and end, start < end, s since the first row; here up to the fitted rows around
    it, as held-out rows do not tell when in between it was.
    """
    fitted_s = context.elapsed_s[~context.measurements.is_validation]
    start = np.max(fitted_s[fitted_s <= gap[0]], initial=-np.inf)
    end = np.min(fitted_s[fitted_s >= gap[1]], initial=np.inf)
    start, end = np.where(np.isfinite([start, end]), [start, end], gap)
    share: FloatArray = np.clip((context.elapsed_s - start) / (end - start), 0.0, 1.0)
    return share[:, None]


def switched(context: Context, candidate: Candidate, gap: FloatArray, ends: bool) -> Design:
    """Return the columns of a candidate, multiplied by the probability that it is present.

    It is present from a moment in a gap on, or up to the moment if ``ends``. ``gap``: start and
    end, s since the first row, between which the moment is uniform.
    """
    design = candidate.columns(context)
    share = 1.0 - after(context, gap) if ends else after(context, gap)
    values = design.values * (share if design.values.ndim == 2 else share[:, None])
    return Design(design.at, values)


def changed_at(candidate: Candidate, changes: Changes, gap: FloatArray) -> Iterator[Candidate]:
    """Yield two changes of a candidate in mid-session, as candidates.

    One that begins at a moment in a gap, and one that is present only up to the moment, each in
    addition to the candidate if the model has that. Of a candidate whose sign physics allows
    only one of, both have that sign: what becomes more begins, what becomes less ends.
    ``changes``: function that makes their columns; ``gap``: start and end, s since the first row.
    """
    begins = replace(
        candidate,
        parameters=tuple(f'{name}_change' for name in candidate.parameters),
        columns=partial(changes, candidate=candidate, gap=gap, ends=False),
        drawn_from=candidate.drawn_from * MOMENTS_OF_CHANGE * RARITY_OF_CHANGE,
        moment=float(gap.mean()),
        changes=candidate,
        model_change=None,
    )
    yield begins
    columns = partial(changes, candidate=candidate, gap=gap, ends=True)
    yield replace(begins, columns=columns, ends=True)


def changed(
    context: Context, candidates: Iterable[tuple[Candidate, Changes | None]]
) -> Iterator[Candidate]:
    """Yield candidates that begin, change or end at up to `MOMENTS_OF_CHANGE` moments.

    ``candidates``: each with the function for the columns of its change; those with None, or
    with a penalty, have no changes. Nothing is yielded if the session has no times.
    """
    moments = spread(gaps(context), MOMENTS_OF_CHANGE) if context.has_time else np.zeros((0, 2))
    for candidate, changes in candidates:
        if changes is not None and candidate.penalty is None:
            for gap in moments:
                yield from changed_at(candidate, changes, gap)
