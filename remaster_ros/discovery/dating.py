"""The moment of a step: dated as finely as the rows allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.solution import Solution


def refine_moments(
    solution: Solution,
    tried: Sequence[Cell],
    context: Context,
    fit: Callable[[Sequence[Cell], Solution], Solution | None],
) -> Solution:
    """Move what happened at one moment to the best moment and variant nearby.

    Parameters
    ----------
    solution
        The set found.
    tried
        All cells of the search: a better moment lies between those tried before and after.
    context
        Of the rows worked on.
    fit
        Fits a set, with a start.
    """
    for cell in solution.cells:
        if np.isnan(cell.moment) or (between := EFFECTS[cell.name].between) is None:
            continue
        moments = np.unique([other.moment for other in tried if other.name == cell.name])
        low = np.max(moments[moments < cell.moment], initial=-np.inf)
        high = np.min(moments[moments > cell.moment], initial=np.inf)
        rest = tuple(other for other in solution.cells if other is not cell)
        nearby = [
            other
            for other in between(context, float(low), float(high))
            if (other.place, other.joints, other.subject)
            == (cell.place, cell.joints, cell.subject)
        ]
        # All rows worked on may lie before or after what was tried on either side: then it stays.
        fits = [
            moved
            for other in nearby or [cell]
            if (moved := fit((*rest, other), solution)) is not None
        ]
        solution = _dated(fits) if fits else solution
    return solution


def _dated(fits: Sequence[Solution]) -> Solution:
    """Return the best of fits that differ in the moment of their last cell, with its std."""
    evidence = np.array([fit.log_evidence for fit in fits])
    best = fits[int(np.argmax(evidence))]
    weight = np.exp(evidence - evidence.max())
    moment = np.array([fit.cells[-1].moment for fit in fits])
    spread = np.sqrt(np.average((moment - best.cells[-1].moment) ** 2, weights=weight))
    dated = replace(best.cells[-1], moment_std=float(spread))
    return replace(best, cells=(*best.cells[:-1], dated))
