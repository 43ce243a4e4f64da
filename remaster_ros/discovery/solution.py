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
