"""Structure without a name, taken for what many named causes do together.

A smooth field over the sensor's volume, or a free form of one link, can explain more in one step
than the next named cause does alone. Once it is there, those causes gain nothing beside it, though
all of them together explain the data better. Whether they do is tried here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.families import FAMILIES, WHOLE
from remaster_ros.discovery.solution import Solution

# Families join one after another: this often at most.
JOINS = 6
# Together families gain about the sum of what each does by itself. Where that, so many times, and
# so much more does not make up for the structure, the others are not tried beside the best.
AT_MOST, FURTHER = 2.0, 10.0


def named_instead(
    solution: Solution,
    fit: Callable[[Sequence[Cell], Solution], Solution | None],
    grown: Callable[[Solution, tuple[str, ...]], Solution | None],
    least: float,
) -> Solution:
    """Return the better one: a solution, or families of causes in place of what has no name.

    Parameters
    ----------
    solution
        What the search found.
    fit
        Fits a set of cells.
    grown
        Adds to a solution all of a family that raises the evidence; None for nothing.
    least
        By how much the log evidence has to rise.
    """
    named = [cell for cell in solution.cells if has_a_name(cell)]
    if not named or len(named) == len(solution.cells):
        return solution
    better = fit(named, solution)
    for _ in range(JOINS):
        if better is None:
            return solution
        joined = [one for family in FAMILIES if (one := grown(better, family)) is not None]
        gains = [max(0.0, one.log_evidence - better.log_evidence) for one in joined]
        if solution.log_evidence - better.log_evidence > AT_MOST * sum(gains) + FURTHER:
            return solution
        best = max(joined, key=lambda one: one.log_evidence, default=better)
        if best.log_evidence <= better.log_evidence + least:
            break
        better = best
    if better is not None and better.log_evidence > solution.log_evidence + least:
        return better
    return solution


def regrown(
    solution: Solution,
    with_all: Callable[[Solution, tuple[str, ...]], Solution | None],
    prune: Callable[[Solution], Solution],
) -> Solution:
    """Return the best solution with a whole family anew, and one other family beside it.

    Members of two families imitate each other, lengths of links the compliance of a joint: which
    of them a family had when it joined was chosen without what was found since, and what is
    missing gains nothing beside the wrong ones.

    Parameters
    ----------
    solution
        What the search found; where it has no whole family of few parameters, nothing is tried.
    with_all
        Adds to a solution all members of these effects; None for nothing.
    prune
        Drops what does not raise the evidence.
    """
    whole = tuple(
        name
        for family in FAMILIES
        if sum(cell.name in family and cell.penalty is None for cell in solution.cells) >= WHOLE
        for name in family
    )
    best = solution
    for family in FAMILIES if whole else ():
        larger = with_all(solution, tuple(dict.fromkeys((*whole, *family))))
        if larger is not None:
            best = max(best, prune(larger), key=lambda one: one.log_evidence)
    return best


def has_a_name(cell: Cell) -> bool:
    """Return whether a cell is one that a technician can act on, of a size that is known."""
    effect = EFFECTS[cell.name]
    return effect.is_cause and effect.plausible is not None
