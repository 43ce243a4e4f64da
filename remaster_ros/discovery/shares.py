"""How much of the gain each cause has, whatever the order in which they are added.

What a cause takes away depends on what is there already: the length of a link and the error curves
of two joints imitate each other, and the first of them takes what they have in common. Added the
largest first, two causes of about one size changed places from search to search, and their shares
with them. So each has the mean over all orders, its Shapley value (Shapley 1953; of a regression,
Lindeman, Merenda & Gold 1980, Introduction to Bivariate and Multivariate Analysis, section 4.9).
Noise and smoothness stay those of all causes together.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray, FloatArray, IntArray

# All orders of so many causes, 120, and half as many drawn ones of more, each also backwards.
ALL_ORDERS = 5
DRAWN_ORDERS = 30
# Of a matrix with ones on its diagonal.
ROUNDING = 1e-12


def shares(data: Residuals, groups: Sequence[tuple[Cell, ...]], solution: Solution) -> list[float]:
    """Return how much of the mean-square error each cause takes away.

    On held-out rows where there are any. Together they make 1; all are 0 where nothing is gained.

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
    taken = np.zeros(len(groups))
    orders = list(_orders(len(groups)))
    for order in orders:
        left = [parts.left(frozenset(order[:count])) for count in range(len(order) + 1)]
        taken[list(order)] -= np.diff(left)
    total = taken.sum()
    return (taken / total if total > 0.0 else 0.0 * taken).tolist()


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    if count <= ALL_ORDERS:
        yield from itertools.permutations(range(count))
        return
    # A fixed seed: the same causes have the same shares.
    rng = np.random.default_rng(0)
    for _ in range(DRAWN_ORDERS):
        order = tuple(rng.permutation(count).tolist())
        yield order
        yield order[::-1]


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
    known: dict[frozenset[int], float] = field(default_factory=dict)

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

    def left(self, causes: frozenset[int]) -> float:
        """Return the sum of squares that the fit of some causes leaves, m²."""
        if causes not in self.known:
            chosen = np.concatenate((self.base, *(self.where[index] for index in sorted(causes))))
            H, pull = self.H[np.ix_(chosen, chosen)], self.pull[chosen]
            # In units of each parameter's own: those of rad and of m/s differ by ten decades.
            unit = np.diag(H) ** -0.5
            scaled = H * np.outer(unit, unit) + ROUNDING * np.eye(len(H))
            step = unit * cho_solve(cho_factor(scaled), unit * pull)
            fit = np.append(-step, 1.0)
            chosen = np.append(chosen, len(self.gram) - 1)
            self.known[causes] = float(fit @ self.gram[np.ix_(chosen, chosen)] @ fit)
        return self.known[causes]
