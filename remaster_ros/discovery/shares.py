"""How much of the gain is lost without each cause, everything else fitted again.

Two causes that imitate each other lose little each: the other takes its place. Together the shares
need not make 1. Noise and variances stay those of all causes together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Of a matrix with ones on its diagonal.
ROUNDING = 1e-12


def shares(data: Residuals, groups: Sequence[tuple[Cell, ...]], solution: Solution) -> list[float]:
    """Return the share of the gain in mean square that is lost without each cause.

    On held-out rows where there are any; negative where they are predicted better without it.
    All are 0 where nothing is gained.

    Parameters
    ----------
    data, solution
        What was searched, and found.
    groups
        The cells of each cause, all of the solution's.
    """
    rows = data.context.measurements.is_validation
    if not rows.any():
        rows = np.isin(np.arange(len(rows)), data.rows.source)
    parts = _Parts.of(data, groups, solution, rows)
    every = set(range(len(groups)))
    with_all = parts.left(every)
    gain = parts.left(set()) - with_all
    if gain <= 0.0:
        return [0.0] * len(groups)
    return [(parts.left(every - {index}) - with_all) / gain for index in every]


@dataclass(frozen=True, eq=False)
class _Parts:
    """What fits of some of the causes leave of some rows.

    Attributes
    ----------
    H, pull
        Of the equations of base and cells, (p + m, p + m) and (p + m,).
    gram
        Products of what they displace in the rows to judge, and of the errors there, m²,
        (p + m + 1, p + m + 1).
    base, where
        Places of the base columns, and those of each cause.
    """

    H: FloatArray
    pull: FloatArray
    gram: FloatArray
    base: IntArray
    where: list[IntArray]

    @classmethod
    def of(
        cls,
        data: Residuals,
        groups: Sequence[tuple[Cell, ...]],
        solution: Solution,
        rows: BoolArray,
    ) -> _Parts:
        """Assemble; rows are those to judge by, (all rows,)."""
        p, cells = data.base.shape[2], solution.cells
        joined = (data.base, data.columns(cells), data.errors[:, :, None])
        white = data.noise_model.whitened(np.concatenate(joined, axis=2), solution.noise)
        flat = white.reshape(3 * len(data), -1)
        H = flat.T @ flat
        pull = H[:-1, -1]
        H = H[:-1, :-1].copy()
        H[:p, :p] += data.base_precision
        H[p:, p:] += solution.prior_precision()
        gram = np.zeros((len(pull) + 1, len(pull) + 1))
        for block, context in data.context.blocks():
            mine = rows[block]
            columns = [cell.columns(context).displacement(context) for cell in cells]
            seen = (data.full_base[block], *columns, data.full_errors[block][:, :, None])
            flat = np.concatenate(seen, axis=2)[mine].reshape(-1, len(gram))
            gram += flat.T @ flat
        places = {
            cell: p + np.arange(where.start, where.stop)
            for cell, where in zip(cells, solution.slices(), strict=True)
        }
        where = [np.concatenate([places[cell] for cell in group]) for group in groups]
        return cls(H, pull, gram, np.arange(p), where)

    def left(self, causes: set[int]) -> float:
        """Return the sum of squares that the fit of some causes leaves, m²."""
        chosen = np.concatenate((self.base, *(self.where[index] for index in sorted(causes))))
        H, pull = self.H[np.ix_(chosen, chosen)], self.pull[chosen]
        # In units of each parameter's own: those of rad and of m/s differ by ten decades.
        unit = np.diag(H) ** -0.5
        scaled = H * np.outer(unit, unit) + ROUNDING * np.eye(len(H))
        step = unit * cho_solve(cho_factor(scaled), unit * pull)
        fit = np.append(-step, 1.0)
        chosen = np.append(chosen, len(self.gram) - 1)
        return float(fit @ self.gram[np.ix_(chosen, chosen)] @ fit)
