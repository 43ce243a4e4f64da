"""Causes that come together: families of cells, their prior probability, grouping by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray

# A member of a family that the others explain to this share of its size is another name for them.
FAMILY_ABSORBED = 1e-3
# So many cells of one family are a family.
WHOLE = 3

FAMILIES: tuple[tuple[str, ...], ...] = tuple(
    tuple(name for name, effect in EFFECTS.items() if effect.family == family)
    for family in dict.fromkeys(effect.family for effect in EFFECTS.values() if effect.family)
)
"""Names of the effects of each family."""
FAMILY_OF = {name: family for family in FAMILIES for name in family}


def relatives(cells: Sequence[Cell], cell: Cell) -> int:
    """Return how many of the cells are of a cell's family; 1 where it has none."""
    family = FAMILY_OF.get(cell.name, ())
    return max(1, sum(other.name in family for other in cells))


def family_log_prior(cells: Sequence[Cell], catalogue: Sequence[Cell]) -> float:
    """Return the log prior probability of a set: cell by cell, or by whole families.

    Cells of a family come together more often than each by its own chance: given the family, each
    of its members is in or out.
    """
    alone: dict[tuple[str, ...], float] = {}
    for cell in cells:
        family = FAMILY_OF.get(cell.name, ())
        alone[family] = alone.get(family, 0.0) - math.log(cell.drawn_from)
    return sum(
        max(log_prior, -_members(tuple(catalogue), family) * math.log(2.0))
        if family
        else log_prior
        for family, log_prior in alone.items()
    )


@lru_cache(maxsize=2 * len(FAMILIES))
def _members(catalogue: tuple[Cell, ...], family: tuple[str, ...]) -> int:
    return len({(cell.name, cell.joints) for cell in catalogue if cell.name in family})


def evidence_without(
    solution: Solution, index: int, rows: int, catalogue: Sequence[Cell]
) -> float:
    """Return `Solution.evidence_without` with the prior of the smaller set."""
    smaller = (*solution.cells[:index], *solution.cells[index + 1 :])
    priors = [family_log_prior(cells, catalogue) for cells in (smaller, solution.cells)]
    return solution.evidence_without(index, rows) + priors[0] - priors[1]


def grouped(cells: Sequence[Cell]) -> list[tuple[Cell, ...]]:
    """Return the cells of each cause together, in the order of their first."""
    groups: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        key: tuple[str, ...] = (cell.name, cell.driver, cell.form, cell.subject)
        cause_per = EFFECTS[cell.name].cause_per
        if cause_per != 'effect':
            key += (str(cell.joints), cell.label if cause_per == 'variant' else '')
        groups.setdefault(key, []).append(cell)
    return [tuple(group) for group in groups.values()]


def visible(data: Residuals, given: Sequence[Cell], cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells that add something to base, given and earlier ones, in order."""
    if all(cell.penalty is not None for cell in cells):
        return list(cells)
    fixed = [cell for cell in given if cell.penalty is None]
    start = np.concatenate((data.base, data.columns(fixed)), axis=2)
    known, _ = np.linalg.qr(_unit(start.reshape(3 * len(data), -1)))
    kept = []
    for cell in cells:
        if cell.penalty is not None:
            kept.append(cell)
            continue
        block = _unit(data.columns([cell]).reshape(3 * len(data), -1))
        left = block - known @ (known.T @ block)
        left -= known @ (known.T @ left)
        if np.linalg.svd(left, compute_uv=False)[-1] < FAMILY_ABSORBED:
            continue
        kept.append(cell)
        known = np.concatenate((known, np.linalg.qr(left)[0]), axis=1)
    return kept


def _unit(columns: FloatArray) -> FloatArray:
    norm = np.linalg.norm(columns, axis=0)
    return columns / np.where(norm > 0.0, norm, 1.0)
