"""A set of cells fitted to the residuals."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

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
    log_evidence
        With the prior probability of the cells.
    """

    cells: tuple[Cell, ...]
    parameters: FloatArray
    covariance: FloatArray
    base: FloatArray
    full_covariance: FloatArray
    noise: Noise
    smoothness: FloatArray
    ridge: FloatArray
    log_evidence: float

    def slices(self) -> list[slice]:
        """Return where each cell's parameters are."""
        edges = np.cumsum([0, *(cell.size for cell in self.cells)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]

    def reordered(self, order: IntArray) -> Solution:
        """Return the same with the cells in another order."""
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

    def less(self, index: int, rows: int) -> Solution:
        """Return the fit without one cell, with noise and smoothness as they are.

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
        cell, p = self.cells[index], len(self.base)
        covariance, every = self.full_covariance, np.concatenate((self.base, self.parameters))
        out = p + np.arange(len(self.parameters))[self.slices()[index]]
        kept = np.delete(np.arange(len(every)), out)
        pull = np.linalg.solve(covariance[np.ix_(out, out)], covariance[np.ix_(out, kept)]).T
        values = every[out]
        worth = 0.5 * values @ np.linalg.solve(covariance[np.ix_(out, out)], values)
        price = 0.5 * np.linalg.slogdet(covariance[np.ix_(out, out)])[1]
        if cell.penalty is not None:
            ridge = self.ridge[out[0] - p]
            price += 0.5 * np.sum(np.log(self.smoothness[index] * cell.roughness + ridge))
        else:
            # Half log N in place of the determinant that the unpenalised ones have by themselves.
            price -= 0.5 * np.linalg.slogdet(self._unpenalised_covariance(out))[1]
            price -= 0.5 * cell.size * np.log(3.0 * rows - p)
        every = every[kept] - pull @ values
        covariance = covariance[np.ix_(kept, kept)] - pull @ covariance[np.ix_(out, kept)]
        return replace(
            self,
            cells=(*self.cells[:index], *self.cells[index + 1 :]),
            parameters=every[p:],
            covariance=covariance[p:, p:],
            base=every[:p],
            full_covariance=covariance,
            smoothness=np.delete(self.smoothness, index),
            ridge=np.delete(self.ridge, out - p),
            log_evidence=float(self.log_evidence - worth - price),
        )

    def _unpenalised_covariance(self, chosen: IntArray) -> FloatArray:
        """Return the covariance of some parameters if all penalised ones were known."""
        covariance = self.full_covariance
        own = covariance[np.ix_(chosen, chosen)]
        penalised = [
            np.arange(len(self.base) + where.start, len(self.base) + where.stop)
            for cell, where in zip(self.cells, self.slices(), strict=True)
            if cell.penalty is not None
        ]
        if not penalised:
            return own
        known = np.concatenate(penalised)
        across = covariance[np.ix_(known, chosen)]
        root = cho_factor(covariance[np.ix_(known, known)], lower=True)
        alone: FloatArray = own - across.T @ cho_solve(root, across)
        return alone

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
        for cell, factor, where in zip(self.cells, self.smoothness, self.slices(), strict=True):
            if cell.penalty is not None:
                precision[where, where] += factor * cell.penalty
        return precision
