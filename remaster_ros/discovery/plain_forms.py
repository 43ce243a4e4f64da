"""A free form, and the named shapes of few parameters that are special cases of it.

An error curve of a joint can follow its encoder's eccentricity as well as that does itself, and a
wandering sensor one that drifts. So no measurement decides against the free form; the plainer of
two that explain as much is the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.screening import scores_in_place
from remaster_ros.discovery.solution import Solution

AS_WELL = 3.0
"""Log evidence by which a free form has to be better: odds of twenty to one."""
SCREENING_ERROR = 5.0
"""The screening keeps the noise fixed, which costs it this much of the evidence."""


def is_special_case(cell: Cell, other: Cell) -> bool:
    """Return whether a cell is one of the shapes that another, a free form, can have."""
    free = other.curve is not None or not EFFECTS[other.name].is_cause
    wheres = {(one.place, one.driver, one.joints, one.subject) for one in (cell, other)}
    return free and other.penalty is not None and cell.penalty is None and len(wheres) == 1


def plainest(
    solution: Solution,
    data: Residuals,
    catalogue: Catalogue,
    fit: Callable[[Sequence[Cell], Solution], Solution | None],
) -> Solution:
    """Return a solution with named shapes in place of free forms that are not better.

    Only for those that are causes: structure that was located stays, as it is no claim.

    Parameters
    ----------
    solution
        What a search found.
    data, catalogue
        The residuals, and all cells that were tried.
    fit
        Fits a set of cells.
    """
    for form in solution.cells:
        rest = [cell for cell in solution.cells if cell is not form]
        plain = [
            cell
            for cell in catalogue.cells
            if EFFECTS[form.name].is_cause
            and is_special_case(cell, form)
            and not EFFECTS[cell.name].costly
        ]
        if not plain:
            continue
        # Most often none comes near it: fits would cost ten times as much as to see that.
        own, *others = scores_in_place(data, catalogue, solution, form, plain)
        named = [
            found
            for cell, gained in zip(plain, others, strict=True)
            if gained > own - AS_WELL - SCREENING_ERROR
            if (found := fit((*rest, cell), solution)) is not None and not found.unphysical()
        ]
        best = max(named, key=lambda found: found.log_evidence, default=None)
        if best is not None and best.log_evidence > solution.log_evidence - AS_WELL:
            solution = best
    return solution
