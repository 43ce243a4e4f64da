"""A set of cells fitted to the residuals."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.types import FloatArray


@dataclass(frozen=True, eq=False)
class Covariances:
    """Covariances of a fit, computed when asked for: most fits are compared by evidence alone."""

    # Returns the covariance of everything together, (p + m, p + m), and that of the columns of the
    # offsets model and the unpenalised parameters, were the penalised ones known, (p + u, p + u)
    compute: Callable[[], tuple[FloatArray, FloatArray]]

    @cached_property
    def both(self) -> tuple[FloatArray, FloatArray]:
        """What `compute` returns."""
        return self.compute()


@dataclass(frozen=True, eq=False)
class Solution:
    """A set of cells fitted to the residuals."""

    cells: tuple[Cell, ...]  # The set; of a fit those with a penalty are last
    parameters: FloatArray  # Of all the cells in order, SI, (m,)
    base: FloatArray  # Of the offsets model's columns, (p,)
    noise: Noise  # Re-estimated
    # Precision factor of each penalised cell, in order of the cells (NaN for the others)
    smoothness: FloatArray
    ridge: FloatArray  # Prior precision of each unpenalised parameter (0 for the others), (m,)
    covariances: Covariances  # Of base and parameters, in this order
    log_evidence: float  # With the prior probability of the cells

    @property
    def full_covariance(self) -> FloatArray:
        """Covariance of base and parameters together, (p + m, p + m)."""
        return self.covariances.both[0]

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the parameters, (m, m)."""
        return self.full_covariance[len(self.base) :, len(self.base) :]

    def slices(self) -> list[slice]:
        """Return where each cell's parameters are."""
        edges = np.cumsum([0, *(cell.size for cell in self.cells)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]

    def factors(self) -> dict[object, float]:
        """Return the precision factor of each penalised cell, by the cell's key."""
        return {
            cell.key: float(factor)
            for cell, factor in zip(self.cells, self.smoothness, strict=True)
            if np.isfinite(factor)
        }

    def weight_precisions(self) -> dict[Cell, float]:
        """Return the prior precision that all weights of a cell have; of those of a kind alone."""
        first = [where.start for where in self.slices()]
        return dict(zip(self.cells, self.smoothness + self.ridge[first], strict=True))

    def evidence_without(self, index: int, rows: int) -> float:
        """Return the log evidence without one cell, with noise and smoothness as they are.

        Exact, from the covariance C alone: the square that is left rises by b_i' C_ii⁻¹ b_i, the
        determinant of what is estimated falls by that of C_ii. Log evidence of the columns: the
        prior probability of the cells is that of the larger set.
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
            alone = np.linalg.slogdet(self.covariances.both[1][among, among])[1]
            # Half log N in place of the determinant that the unpenalised ones have by themselves.
            price = 0.5 * (determinant - alone - cell.size * np.log(3.0 * rows - p))
        return float(self.log_evidence - worth - price)

    def less(self, index: int, log_evidence: float) -> Solution:
        """Return the fit without one cell, with noise and smoothness as they are."""
        p, where = len(self.base), self.slices()[index]
        out = slice(p + where.start, p + where.stop)
        pull = _regression(self.full_covariance, out)
        every = np.concatenate((self.base, self.parameters))
        every = np.delete(every, out) - pull @ every[out]
        among = self._among_unpenalised(index) if self.cells[index].penalty is None else None
        return replace(
            self,
            cells=(*self.cells[:index], *self.cells[index + 1 :]),
            parameters=every[p:],
            base=every[:p],
            smoothness=np.delete(self.smoothness, index),
            ridge=np.delete(self.ridge, where),
            covariances=Covariances(partial(_without, self.covariances, out, among)),
            log_evidence=log_evidence,
        )

    def _among_unpenalised(self, index: int) -> slice:
        """Return where an unpenalised cell is among the unpenalised ones."""
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
        for cell, factor, where in zip(self.cells, self.smoothness, self.slices(), strict=True):
            if cell.penalty is not None:
                precision[where, where] += factor * cell.penalty
        return precision


def _without(
    before: Covariances, out: slice, among: slice | None
) -> tuple[FloatArray, FloatArray]:
    """Return covariances were the parameters of a cell known: where it is in both of them."""
    full, unpenalised = before.both
    if among is not None:
        unpenalised = _conditioned(unpenalised, among)
    return _conditioned(full, out), unpenalised


def _regression(covariance: FloatArray, out: slice) -> FloatArray:
    """Return the regression of the other parameters on some."""
    across = np.delete(covariance[out], out, axis=1)
    return np.asarray(np.linalg.solve(covariance[out, out], across).T)


def _conditioned(covariance: FloatArray, out: slice) -> FloatArray:
    """Return the covariance of the others were some parameters known."""
    size, first, last = len(covariance), out.start, out.stop
    across = np.delete(covariance[out], out, axis=1)
    conditioned: FloatArray = _regression(covariance, out) @ -across
    # In four parts: nothing is copied twice.
    for to, of in ((slice(first), slice(first)), (slice(first, None), slice(last, size))):
        conditioned[to, :first] += covariance[of, :first]
        conditioned[to, first:] += covariance[of, last:]
    return conditioned
