# SPDX-License-Identifier: Apache-2.0
"""Proposal of the independence sampler: a Student t, adapted to the posterior.

Independent draws of a proposal, weighted by density over proposal, have the moments of the density
for any proposal, if the weights have a variance. If the proposal is poor, its mean and covariance
are replaced by those of the weighted draws (population Monte Carlo; Cappé, Guillin, Marin and
Robert 2004, doi:10.1198/106186004X12803). The largest weights are smoothed by a Pareto
distribution, whose shape k shows whether they are reliable (Vehtari, Simpson, Gelman, Yao and
Gabry 2024, "Pareto smoothed importance sampling", JMLR 25(72)).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.linearisation import log_determinant
from remaster_ros.types import FloatArray

# Degrees of freedom of the noise's Student t, in integrals over the noise.
NOISE_FREEDOM = 10.0
# Share, degrees of freedom and widening of draws with wide tails, which bound the importance
# weights if the main part is too narrow (Hesterberg 1995, doi:10.1080/00401706.1995.10484303).
TAIL_SHARE = 0.05
TAIL_FREEDOM = 5.0
TAIL_WIDENING = 1.3
# Factor on the noise's standard deviation by its curvature at the mode: the noise has longer
# tails. For 20 poses 2,000 draws have 700 effective draws in the tails with it, 280 without, and
# 370 with 1.4.
NOISE_WIDENING = 1.2
# Degrees of freedom of the main part: hardly wider than a Gaussian, as draws of a Student t with
# few degrees of freedom in tens of dimensions are hardly ever in the Gaussian's bulk.
FREEDOM = 100.0
# Largest distance of the noise's coordinates, logarithms, from the mode.
FARTHEST = 5.0
# Largest number of entries in the matrices of one block of draws.
BLOCK_ENTRIES = 1_000_000
# Effective draws for each dimension that moments need. With fewer, the weights are raised to a
# power below 1, so that the proposal moves part of the way.
DRAWS_PER_DIMENSION = 5.0
POWERS = 0.7 ** np.arange(1.0, 25.0)
# Fewest weights that determine a tail (Vehtari et al., section 6).
FEWEST_OF_A_TAIL = 5
# Weight that counts as zero against 1, with a finite inverse.
TINIEST = 1e-300


@dataclass(frozen=True, eq=False)
class StudentT:
    """Multivariate Student t distribution."""

    mean: FloatArray  # (d,)
    factor: FloatArray  # Lower Cholesky factor of the scale matrix, (d, d)
    freedom: float  # Degrees of freedom; small means heavy tails

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Draws (count, d) and their log density (count,)."""
        normal = rng.standard_normal((count, len(self.mean)))
        mixing = rng.chisquare(self.freedom, count) / self.freedom
        points = self.mean + (normal @ self.factor.T) / np.sqrt(mixing)[:, None]
        return points, self.log_density(points)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Normalised log density (n,) of points (n, d)."""
        whitened = np.linalg.solve(self.factor, (points - self.mean).T)
        square, d, freedom = np.sum(whitened**2, axis=0), len(self.mean), self.freedom
        constant = math.lgamma(0.5 * (freedom + d)) - math.lgamma(0.5 * freedom)
        constant -= 0.5 * d * math.log(freedom * math.pi) + float(log_determinant(self.factor))
        density: FloatArray = constant - 0.5 * (freedom + d) * np.log1p(square / freedom)
        return density


@dataclass(frozen=True, eq=False)
class AdaptedProposal:
    """Student t about the linearised posterior, with wide tails for a share of its draws.

    It is defined in coordinates in which the linearised posterior is standard: the noise as it is,
    the parameters p of a draw whitened by their Gaussian given its noise, w = L' (p - mean). With
    few poses the noise may be several times that of the mode, and the width of p with it.
    """

    mode: Mode  # Mode of the linearised posterior
    centre: StudentT  # Main part, of [w | noise], (d,)

    @classmethod
    def about(cls, mode: Mode) -> AdaptedProposal:
        """First proposal: the linearised posterior at a mode."""
        f, e = len(mode.linearisation.posterior.free), len(mode.eta)
        factor = np.eye(f + e)
        factor[f:, f:] = NOISE_WIDENING * _factor(mode.eta_covariance)
        centre = np.concatenate((np.zeros(f), mode.eta))
        return cls(mode, StudentT(centre, factor, FREEDOM))

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.centre.mean)

    @property
    def _tail(self) -> StudentT:
        """Part with wide tails: 1.3 times as wide (`TAIL_WIDENING`), with 5 degrees of freedom."""
        return StudentT(self.centre.mean, TAIL_WIDENING * self.centre.factor, TAIL_FREEDOM)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Draws (count, d) in the posterior's coordinates, and their log density (count,)."""
        inner, _ = self.centre.sample(count, rng)
        wide = np.flatnonzero(rng.random(count) < TAIL_SHARE)
        inner[wide] = self._tail.sample(len(wide), rng)[0]
        blocks = np.array_split(inner, max(1, len(inner) // self._block))
        points, density = zip(*(self._points(block) for block in blocks), strict=True)
        return np.concatenate(points), np.concatenate(density)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Normalised log density (n,) of points (n, d) in the posterior's coordinates."""
        blocks = np.array_split(points, max(1, len(points) // self._block))
        parts = [self._inner(block) for block in blocks]
        return np.concatenate([self._log_density(inner) + volume for inner, volume, _ in parts])

    def linearised(self, points: FloatArray) -> FloatArray:
        """Log density of the linearised posterior (n,) at points (n, d), up to a constant.

        -inf if a common part of the noise is negative or a noise coordinate over 5 from the mode
        (`FARTHEST`). The cost does not depend on the number of observations.
        """
        eta = points[:, self.dimension - len(self.mode.eta) :]
        blocks = np.array_split(points, max(1, len(points) // self._block))
        parts = []
        for block in blocks:
            inner, log_volume, marginal = self._inner(block)
            white = inner[:, : self.dimension - len(self.mode.eta)]
            parts.append(marginal + log_volume - 0.5 * np.sum(white**2, axis=1))
        within_range = np.all(np.abs(eta - self.mode.eta) <= FARTHEST, axis=1)
        inside = self.mode.linearisation.posterior.inside(points)
        return np.where(within_range & inside, np.concatenate(parts), -np.inf)

    def dispersed(self, count: int, rng: np.random.Generator) -> FloatArray:
        """First states of chains, (count, d), dispersed twice as far as the draws."""
        inner, _ = self.centre.sample(count, rng)
        return self._points(self.centre.mean + 2.0 * (inner - self.centre.mean))[0]

    def adapted(self, drawn: Weighted) -> AdaptedProposal:
        """Proposal with the mean and covariance of weighted draws.

        If too few draws are effective, weights are tempered first (`Weighted.with_moments`).
        """
        weight = drawn.with_moments()
        inner = self._inner(drawn.points)[0]
        mean = weight @ inner
        deviation = inner - mean
        return AdaptedProposal(
            self.mode,
            StudentT(mean, _factor((deviation * weight[:, None]).T @ deviation), FREEDOM),
        )

    def _points(self, inner: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (n, d) of inner coordinates (n, d), and the log density of the points (n,).

        Inner coordinates are the whitened parameters, then the noise (see the class). Negative
        common parts of the noise are mirrored at zero, in ``inner`` itself too.
        """
        inner[:, self.dimension - self._shares :] = np.abs(
            inner[:, self.dimension - self._shares :]
        )
        white, eta = np.split(inner, [self.dimension - len(self.mode.eta)], axis=1)
        mean, factor, _ = self._conditional(eta)
        step = np.linalg.solve(np.swapaxes(factor, -1, -2), white[..., None])[..., 0]
        points = np.concatenate((mean + step, eta), axis=1)
        return points, self._log_density(inner) + log_determinant(factor)

    def _inner(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Inner coordinates (n, d) of points (n, d), log determinant, density of the noise.

        Inner coordinates are the whitened parameters, then the noise (see the class). The log
        determinant, of inner coordinates by points, (n,), is to be added to their log density.
        Last result: marginal log density of the noise, (n,).
        """
        parameters, eta = np.split(points, [self.dimension - len(self.mode.eta)], axis=1)
        mean, factor, marginal = self._conditional(eta)
        white = np.einsum('nji,nj->ni', factor, parameters - mean)
        return np.concatenate((white, eta), axis=1), log_determinant(factor), marginal

    def _conditional(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gaussian of the parameters given noise coordinates (n, e): `Linearisation.conditional`.

        Returns mean, Cholesky factor and log density of the noise. Coordinates further than
        `FARTHEST` from the mode are replaced by those at that distance.
        """
        # Outside, rounding removes the information. A proposal may use any function of the noise.
        clipped_eta = np.clip(eta, self.mode.eta - FARTHEST, self.mode.eta + FARTHEST)
        return self.mode.linearisation.conditional(clipped_eta)

    @property
    def _block(self) -> int:
        """Number of draws in a block, at least 1: each draw has a matrix (d, d) in memory."""
        return max(1, BLOCK_ENTRIES // self.dimension**2)

    def _log_density(self, inner: FloatArray) -> FloatArray:
        """Log density (n,) of inner coordinates (n, d).

        It is a mixture of the main Student t and one with wide tails. The common parts of the
        noise count as mirrored at zero.
        """
        # |x| has the density of x and of -x together.
        kept = (1.0,) * (self.dimension - self._shares)
        parts = []
        for signs in itertools.product((1.0, -1.0), repeat=self._shares):
            image = inner * np.array((*kept, *signs))
            parts.append(math.log1p(-TAIL_SHARE) + self.centre.log_density(image))
            parts.append(math.log(TAIL_SHARE) + self._tail.log_density(image))
        density: FloatArray = np.logaddexp.reduce(parts)
        return density

    @property
    def _shares(self) -> int:
        """Number of last coordinates that cannot be negative: the common parts of the noise."""
        return len(self.mode.linearisation.posterior.noise_model.shares)


class Weighted(NamedTuple):
    """Draws of a proposal with their importance weights."""

    points: FloatArray  # (n, d)
    log_weight: FloatArray  # Log density over proposal, (n,)
    weight: FloatArray  # Smoothed, with sum 1, (n,)
    pareto_k: float  # Shape of the weights' upper tail

    @classmethod
    def of(cls, points: FloatArray, log_weight: FloatArray) -> Weighted:
        """Draws (n, d) with smoothed weights from their log weights (n,).

        A log weight of -inf counts as 100 below the least finite one.
        """
        finite = np.isfinite(log_weight)
        # Draws with zero density get a negligible weight.
        least = np.min(log_weight[finite], initial=0.0) - 100.0
        log_weight = np.where(finite, log_weight, least)
        weight, pareto_k = _smoothed(np.exp(log_weight - np.max(log_weight)))
        return cls(points, log_weight, weight / weight.sum(), pareto_k)

    @property
    def effective(self) -> float:
        """Effective number of independent draws of the smoothed weights, 1 to n."""
        return _effective(self.weight)

    def with_moments(self) -> FloatArray:
        """Weights (n,) with sum 1, tempered until the draws suffice for mean and covariance.

        They suffice with 5 effective draws for each dimension (`DRAWS_PER_DIMENSION`). If not,
        the weights are raised to the power 0.7, 0.7², … until they do, at last to 0.7^24.
        """
        weight = self.weight
        for power in POWERS:
            if _effective(weight) >= DRAWS_PER_DIMENSION * self.points.shape[1]:
                break
            weight = np.exp(power * (self.log_weight - np.max(self.log_weight)))
            weight /= weight.sum()
        return weight


def _smoothed(weight: FloatArray) -> tuple[FloatArray, float]:
    """Weights (n,), of which the largest is 1, smoothed, and the Pareto shape of their tail.

    The largest weights become the expected order statistics of the Pareto distribution that fits
    them, up to the largest weight. NaN for equal weights, which need no smoothing; infinite if a
    quarter of the tail does not exceed the weight below the tail, so that no Pareto distribution
    fits.
    """
    count = int(min(0.2 * len(weight), 3.0 * math.sqrt(len(weight))))
    order = np.argsort(weight)
    tail, limit = order[-count:], weight[order[-count - 1]]
    if count < FEWEST_OF_A_TAIL or weight[order[-1]] - weight[order[-count]] < TINIEST:
        return weight, float('nan')
    # Zero among them is rounding.
    above = np.maximum(weight[tail] - limit, TINIEST)
    if above[count // 4] <= TINIEST:
        # One of them is all there is: the worst tail, and no fit to it.
        return weight, float('inf')
    shape, scale = _pareto(above)
    share = (np.arange(count) + 0.5) / count
    # (1 - share)^-k - 1, over k, also where k is nearly 0.
    expected = scale * np.expm1(-shape * np.log1p(-share)) / shape
    smoothed = weight.copy()
    smoothed[tail] = np.minimum(limit + expected, 1.0)
    return smoothed, shape


def _pareto(above: FloatArray) -> tuple[float, float]:
    """Shape and scale of the generalised Pareto distribution fitted to sorted excesses (n,).

    The mean of its posterior by quadrature (Zhang and Stephens 2009, doi:10.1198/tech.2009.08017);
    the shape is shrunk towards 0.5 as by ten further observations (Vehtari et al., appendix C).
    """
    n = len(above)
    grid = np.arange(1, 31 + int(math.sqrt(n))) - 0.5
    quarter = above[int(n / 4.0 + 0.5) - 1]
    theta = 1.0 / above[-1] + (1.0 - np.sqrt((30 + int(math.sqrt(n))) / grid)) / (3.0 * quarter)
    shape = np.mean(np.log1p(-theta[:, None] * above), axis=1)
    log_likelihood = n * (np.log(-theta / shape) - shape - 1.0)
    weight = np.exp(log_likelihood - np.max(log_likelihood))
    best = float(theta @ weight / weight.sum())
    fitted = float(np.mean(np.log1p(-best * above)))
    return (n * fitted + 10.0 * 0.5) / (n + 10.0), -fitted / best


def _effective(weight: FloatArray) -> float:
    """Effective number of independent draws of weights with sum 1 (Kish 1965)."""
    return float(1.0 / np.sum(weight**2))


def _factor(covariance: FloatArray) -> FloatArray:
    """Lower Cholesky factor (d, d) of a covariance with units of very different size.

    Raises numpy.linalg.LinAlgError if it is not positive definite.
    """
    unit = np.sqrt(np.diag(covariance))
    return unit[:, None] * np.asarray(np.linalg.cholesky(covariance / np.outer(unit, unit)))
