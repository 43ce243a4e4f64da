"""A set of cells fitted to the residuals."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

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
