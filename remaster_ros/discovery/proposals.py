"""What may join a set of cells next: one cell, or a family as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.families import FAMILIES
from remaster_ros.discovery.screening import Screening
from remaster_ros.discovery.selection import Proposal
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray

# Family-wise error of one round.
SIGNIFICANCE = 0.01
SHORTLIST = 8
# A fit gains at most about so many times what the screening shows, and so much more: structure
# hides in the noise common to a pose and shows when that is fitted again, members of a family help
# each other.
SHOWN, FURTHER, FURTHER_STRUCTURE, FURTHER_FAMILY = 2.0, 20.0, 100.0, 50.0
# Members of a family of which none raises the evidence alone have to raise it by this together.
TOGETHER = 10.0

Fit = Callable[[Sequence[Cell], Solution], Solution | None]
Grown = Callable[[Solution, tuple[str, ...]], Solution | None]


def propose(
    solution: Solution, screening: Screening, catalogue: Catalogue, fit: Fit, grown: Grown
) -> Iterator[Proposal]:
    """Give sets one step on that raise the evidence, the best first.

    What the screening shows to gain far less than another is fitted once that has failed.

    Parameters
    ----------
    solution
        The set so far.
    screening
        Of the catalogue beside it.
    catalogue
        All cells that are tried.
    fit
        Fits a set of cells; None where it cannot be fitted.
    grown
        Adds to a solution all of a family that raises the evidence; None for nothing.
    """
    score, structure = screening.score, catalogue.structure

    def with_one(index: int) -> Proposal | None:
        candidate = fit((*solution.cells, catalogue.cells[index]), solution)
        if candidate is None or candidate.unphysical():
            return None
        gain = candidate.log_evidence - solution.log_evidence
        shown = max(score[index], gain) if structure[index] else score[index]
        p_value = screening.p_value(shown)
        return Proposal(candidate, p_value) if gain > 0.0 and p_value <= SIGNIFICANCE else None

    further = np.where(structure, FURTHER_STRUCTURE, FURTHER)
    # Cells to try, each with the most that it may gain. One alone has the p-value that is screened
    # however well it fits, but for structure.
    tried = np.flatnonzero(structure & np.isfinite(score)).tolist()
    tried += [
        index
        for index in np.argsort(-score)[:SHORTLIST].tolist()
        if not structure[index] and screening.p_value(score[index]) <= SIGNIFICANCE
    ]
    waiting: list[tuple[float, Callable[[], Proposal | None]]] = [
        (SHOWN * max(0.0, score[index]) + further[index], partial(with_one, index))
        for index in tried
    ]
    for family in FAMILIES:
        most = SHOWN * _together(catalogue, score, family) + FURTHER_FAMILY
        one = partial(_with_family, solution, screening, catalogue, grown, family)
        waiting.append((most, one))
    waiting.sort(key=lambda option: option[0])
    found: list[Proposal] = []
    while True:
        best = max(found, key=lambda one: one.solution.log_evidence, default=None)
        gain = best.solution.log_evidence - solution.log_evidence if best else -np.inf
        if waiting and waiting[-1][0] > gain:
            _, fitted = waiting.pop()
            found += [] if (proposal := fitted()) is None else [proposal]
        elif best is not None:
            found.remove(best)
            yield best
        else:
            return


def _together(catalogue: Catalogue, score: FloatArray, family: tuple[str, ...]) -> float:
    """Return what the screening shows the members of a family to gain, each by itself.

    Each is in or out of a family that is there, whatever other cells are tried.
    """
    return sum(
        max(0.0, float(score[index]) + np.log(0.5 * cell.drawn_from))
        for index, cell in enumerate(catalogue.cells)
        if cell.name in family and EFFECTS[cell.name].in_family(cell)
    )


def _with_family(
    solution: Solution,
    screening: Screening,
    catalogue: Catalogue,
    grown: Grown,
    family: tuple[str, ...],
) -> Proposal | None:
    """Return the set with a family; None where that is no proposal."""
    candidate = grown(solution, family)
    if candidate is None:
        return None
    gain = candidate.log_evidence - solution.log_evidence
    p_value = screening.p_value(gain)
    # What is left of a family is judged anew.
    whole = len(candidate.cells) > len(solution.cells) + 1
    if gain <= 0.0 or not (whole or p_value <= SIGNIFICANCE):
        return None
    mine = [cell.name in family for cell in catalogue.cells]
    if gain > TOGETHER or np.any(screening.score[mine] > 0.0):
        return Proposal(candidate, p_value)
    return None
