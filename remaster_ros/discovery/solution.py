"""A set of candidates fitted to the residuals."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.types import FloatArray


@dataclass(frozen=True, eq=False)
class Covariances:
    """Covariances of a fit, computed when first asked for."""

    # Returns the covariance of everything together, (p + m, p + m), and that of the columns of the
    # offsets model and the unpenalised parameters, were the penalised ones known, (p + u, p + u)
    compute: Callable[[], tuple[FloatArray, FloatArray]]

    @cached_property
    def both(self) -> tuple[FloatArray, FloatArray]:
        """Covariance of all, and that of base and unpenalised if the penalised are known.

        Of the p base coefficients and the parameters, (p + m, p + m) and (p + u, p + u): m
        parameters, u of them without a penalty. Computed once.
        """
        return self.compute()


@dataclass(frozen=True, eq=False)
class Solution:
    """Set of candidates fitted to the residuals, with noise, smoothness and log evidence."""

    candidates: tuple[Candidate, ...]  # The set; of a fit those with a penalty are last
    parameters: FloatArray  # Of all the candidates in order, SI, (m,)
    base: FloatArray  # Of the offsets model's columns, (p,)
    noise: Noise  # Re-estimated
    # Precision factor of each penalised candidate, in order of the candidates (NaN for the others)
    smoothness: FloatArray
    ridge: FloatArray  # Prior precision of each unpenalised parameter (0 for the others), (m,)
    covariances: Covariances  # Of base and parameters, in this order
    log_evidence: float  # With the prior probability of the candidates

    @property
    def full_covariance(self) -> FloatArray:
        """Covariance of the offsets model's coefficients and the parameters, (p + m, p + m)."""
        return self.covariances.both[0]

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the parameters, (m, m)."""
        return self.full_covariance[len(self.base) :, len(self.base) :]

    def slices(self) -> list[slice]:
        """Return the slice of each candidate's parameters in `parameters`."""
        edges = np.cumsum([0, *(candidate.size for candidate in self.candidates)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]

    def factors(self) -> dict[object, float]:
        """Return the smoothness of each penalised candidate, by the candidate's key."""
        return {
            candidate.key: float(factor)
            for candidate, factor in zip(self.candidates, self.smoothness, strict=True)
            if np.isfinite(factor)
        }

    def weight_precisions(self) -> dict[Candidate, float]:
        """Return the prior precision of the weights of each family of random effects.

        By the family's candidate: smoothness factor plus ridge. The other candidates are keys,
        too: NaN if they have no penalty.
        """
        first = [where.start for where in self.slices()]
        return dict(zip(self.candidates, self.smoothness + self.ridge[first], strict=True))

    def unphysical(self) -> set[int]:
        """Return the indices of candidates with a parameter of a sign that physics excludes.

        Opposite to their `sign`; set() if there are none.
        """
        return {
            index
            for index, (candidate, where) in enumerate(
                zip(self.candidates, self.slices(), strict=True)
            )
            if np.any(candidate.sign * self.parameters[where] < 0.0)
        }

    def prior_precision(self) -> FloatArray:
        """Return the precision of the Gaussian prior on the parameters, (m, m)."""
        precision = np.diag(self.ridge)
        for candidate, factor, where in zip(
            self.candidates, self.smoothness, self.slices(), strict=True
        ):
            if candidate.penalty is not None:
                precision[where, where] += factor * candidate.penalty
        return precision
