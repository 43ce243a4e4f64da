"""A set of cells fitted to the residuals."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Solution:
    """A set of cells fitted to the residuals.

    Attributes
    ----------
    cells
        The set.
    parameters, covariance
        Of all the cells in order, SI, (m,) and (m, m).
    base, base_covariance
        Of the offsets model's columns, (p,); and of everything together, (p + m, p + m).
    noise
        Re-estimated.
    smoothness
        Precision factor of each penalised cell, in order of the cells (NaN for the others).
    ridge
        Prior precision of each unpenalised parameter (0 for the others), (m,).
    unpenalised_covariance
        Of the columns of the offsets model and the unpenalised parameters, in order, were the
        penalised ones known, (p + u, p + u).
    log_evidence
        With the prior probability of the cells.
    drawn
        Further precision of the prior on the parameters, because not all searches found them
        (`combined_searches`), (m, m); None where there is none.
    prior_mean
        What the prior on the parameters is about, (m,); None for 0.
    """

    cells: tuple[Cell, ...]
    parameters: FloatArray
    covariance: FloatArray
    base: FloatArray
    full_covariance: FloatArray
    noise: Noise
    smoothness: FloatArray
    ridge: FloatArray
    unpenalised_covariance: FloatArray
    log_evidence: float
    drawn: FloatArray | None = None
    prior_mean: FloatArray | None = None

    def slices(self) -> list[slice]:
        """Return where each cell's parameters are."""
        edges = np.cumsum([0, *(cell.size for cell in self.cells)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]

    def reordered(self, order: IntArray) -> Solution:
        """Return the same with the cells in another order, the unpenalised ones in the same."""
        if np.all(np.diff(order) > 0):
            return self
        where = self.slices()
        m = [np.arange(len(self.parameters))[where[index]] for index in order]
        chosen = np.concatenate([np.zeros(0, dtype=int), *m])
        every = np.concatenate((np.arange(len(self.base)), len(self.base) + chosen))
        full_covariance = self.full_covariance[np.ix_(every, every)]
        return replace(
            self,
            cells=tuple(self.cells[index] for index in order),
            parameters=self.parameters[chosen],
            covariance=full_covariance[len(self.base) :, len(self.base) :],
            full_covariance=full_covariance,
            smoothness=self.smoothness[order],
            ridge=self.ridge[chosen],
        )

    def evidence_without(self, index: int, rows: int) -> float:
        """Return the log evidence without one cell, with noise and smoothness as they are.

        Exact, from the covariance C alone: the square that is left rises by b_i' C_ii⁻¹ b_i, the
        determinant of what is estimated falls by that of C_ii. Log evidence of the columns: the
        prior probability of the cells is that of the larger set.

        Parameters
        ----------
        index
            Of the cell.
        rows
            Number of rows n that were fitted.
        """
        cell, p, where = self.cells[index], len(self.base), self.slices()[index]
        own = self.covariance[where, where]
        worth = 0.5 * self.parameters[where] @ np.linalg.solve(own, self.parameters[where])
        determinant = np.linalg.slogdet(own)[1]
        if cell.penalty is not None:
            prior = self.smoothness[index] * cell.roughness + self.ridge[where.start]
            price = 0.5 * (determinant + np.sum(np.log(prior)))
        else:
            among = self._among_unpenalised(index)
            alone = np.linalg.slogdet(self.unpenalised_covariance[among, among])[1]
            # Half log N in place of the determinant that the unpenalised ones have by themselves.
            price = 0.5 * (determinant - alone - cell.size * np.log(3.0 * rows - p))
        return float(self.log_evidence - worth - price)

    def less(self, index: int, rows: int) -> Solution:
        """Return the fit without one cell, with its `evidence_without`."""
        p, where = len(self.base), self.slices()[index]
        every = np.concatenate((self.base, self.parameters))
        out = slice(p + where.start, p + where.stop)
        covariance, pull = _conditioned(self.full_covariance, out)
        unpenalised = self.unpenalised_covariance
        if self.cells[index].penalty is None:
            unpenalised, _ = _conditioned(unpenalised, self._among_unpenalised(index))
        every = np.delete(every, out) - pull @ every[out]
        return replace(
            self,
            cells=(*self.cells[:index], *self.cells[index + 1 :]),
            parameters=every[p:],
            covariance=covariance[p:, p:],
            base=every[:p],
            full_covariance=covariance,
            smoothness=np.delete(self.smoothness, index),
            ridge=np.delete(self.ridge, where),
            unpenalised_covariance=unpenalised,
            log_evidence=self.evidence_without(index, rows),
        )

    def _among_unpenalised(self, index: int) -> slice:
        """Return where an unpenalised cell is in `unpenalised_covariance`."""
        before = sum(other.size for other in self.cells[:index] if other.penalty is None)
        first = len(self.base) + before
        return slice(first, first + self.cells[index].size)

    def unphysical(self) -> set[int]:
        """Return the indices of the cells with a parameter of the sign that physics excludes."""
        return {
            index
            for index, (cell, where) in enumerate(zip(self.cells, self.slices(), strict=True))
            if np.any(cell.sign * self.parameters[where] < 0.0)
        }

    def prior_precision(self) -> FloatArray:
        """Return the precision of the Gaussian prior on the parameters, (m, m)."""
        precision = np.diag(self.ridge)
        if self.drawn is not None:
            precision += self.drawn
        for cell, factor, where in zip(self.cells, self.smoothness, self.slices(), strict=True):
            if cell.penalty is not None:
                precision[where, where] += factor * cell.penalty
        return precision


def _conditioned(covariance: FloatArray, out: slice) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of the others were some known, and their regression on these."""
    size, first, last = len(covariance), out.start, out.stop
    own, across = covariance[out, out], np.delete(covariance[out], out, axis=1)
    pull: FloatArray = np.linalg.solve(own, across).T.astype(float, copy=False)
    conditioned: FloatArray = pull @ -across
    # In four parts: nothing is copied twice.
    for to, of in ((slice(first), slice(first)), (slice(first, None), slice(last, size))):
        conditioned[to, :first] += covariance[of, :first]
        conditioned[to, first:] += covariance[of, last:]
    return conditioned, pull
