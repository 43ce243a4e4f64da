"""A free form, and the named shapes of few parameters that are special cases of it.

An error curve of a joint can follow its encoder's eccentricity as well as that does itself. So no
measurement decides against the curve; the plainer of two that explain as much is the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.solution import Solution

AS_WELL = 3.0
"""Log evidence by which a free form has to be better: odds of twenty to one."""


def is_special_case(cell: Cell, other: Cell) -> bool:
    """Return whether a cell is one of the shapes that another, a free form, can have."""
    where = (cell.place, cell.driver, cell.joints)
    free = other.curve is not None and other.penalty is not None
    return free and cell.penalty is None and where == (other.place, other.driver, other.joints)


def plainest(
    solution: Solution,
    cells: Sequence[Cell],
    fit: Callable[[Sequence[Cell], Solution], Solution | None],
) -> Solution:
    """Return a solution with named shapes in place of free forms that are not better.

    Parameters
    ----------
    solution
        What a search found.
    cells
        All that were tried.
    fit
        Fits a set of cells.
    """
    for form in solution.cells:
        rest = [cell for cell in solution.cells if cell is not form]
        named = [
            found
            for cell in cells
            if is_special_case(cell, form) and not EFFECTS[cell.name].costly
            if (found := fit((*rest, cell), solution)) is not None and not found.unphysical()
        ]
        best = max(named, key=lambda found: found.log_evidence, default=None)
        if best is not None and best.log_evidence > solution.log_evidence - AS_WELL:
            solution = best
    return solution
