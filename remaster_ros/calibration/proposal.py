# SPDX-License-Identifier: Apache-2.0
"""What the independence sampler proposes from: a Student t, moved to where the posterior is.

Independent draws of a proposal, weighted by density over proposal, have the moments of the density
whatever the proposal, if the weights have a variance. Where it is poor its mean and covariance are
moved to those of the weighted draws (population Monte Carlo; Cappé, Guillin, Marin and Robert
2004, doi:10.1198/106186004X12803). The largest weights are smoothed by a Pareto distribution,
whose shape k tells whether they can be relied on (Vehtari, Simpson, Gelman, Yao and Gabry 2024,
"Pareto smoothed importance sampling", JMLR 25(72)).
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

# Of the noise by itself, where it is integrated over.
NOISE_FREEDOM = 10.0
# Of a twentieth of the draws, which bound the importance weights where the rest is too narrow
# (Hesterberg 1995, doi:10.1080/00401706.1995.10484303).
TAIL_SHARE = 0.05
TAIL_FREEDOM = 5.0
TAIL_WIDENING = 1.3
# Of the noise beside its curvature at the mode: it has longer tails. Of 20 poses 2,000 draws are
# worth 700 in the tails with it, 280 without, and 370 with 1.4.
NOISE_WIDENING = 1.2
# Of most draws: hardly wider than a Gaussian, whose bulk a Student t of few degrees of freedom
# hardly ever hits in tens of dimensions.
FREEDOM = 100.0
# Of the noise's coordinates, logarithms, about the mode.
FARTHEST = 5.0
# Of the matrices of draws that are worked on together.
BLOCK_ENTRIES = 1_000_000
# Effective draws that moments take for each dimension. Where weighted draws are worth fewer, their
# weights are raised to a power below 1, which leads part of the way.
DRAWS_PER_DIMENSION = 5.0
POWERS = 0.7 ** np.arange(1.0, 25.0)
# Fewer weights determine no tail (Vehtari et al., section 6).
FEWEST_OF_A_TAIL = 5
# Zero beside a weight of 1; its inverse is still a number.
TINIEST = 1e-300


@dataclass(frozen=True, eq=False)
class StudentT:
    """A multivariate Student t distribution."""

    mean: FloatArray  # (d,)
    factor: FloatArray  # Lower Cholesky factor of the scale matrix, (d, d)
    freedom: float  # Degrees of freedom; small means heavy tails

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) and their log density (count,)."""
        normal = rng.standard_normal((count, len(self.mean)))
        mixing = rng.chisquare(self.freedom, count) / self.freedom
        points = self.mean + (normal @ self.factor.T) / np.sqrt(mixing)[:, None]
        return points, self.log_density(points)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        whitened = np.linalg.solve(self.factor, (points - self.mean).T)
        square, d, freedom = np.sum(whitened**2, axis=0), len(self.mean), self.freedom
        constant = math.lgamma(0.5 * (freedom + d)) - math.lgamma(0.5 * freedom)
        constant -= 0.5 * d * math.log(freedom * math.pi) + float(log_determinant(self.factor))
        density: FloatArray = constant - 0.5 * (freedom + d) * np.log1p(square / freedom)
        return density


@dataclass(frozen=True, eq=False)
class AdaptedProposal:
    """A Student t about the linearised posterior, a part of its draws with wide tails.

    It lies in coordinates in which the linearised posterior is standard: the noise as it is, the
    parameters p of a draw whitened by their Gaussian given its noise, w = L' (p - mean). Where
    poses are few the noise may be several times that of the mode, and the width of p with it.
    """

    mode: Mode  # About which it proposes
    centre: StudentT  # Of most draws: [w | noise], (d,)

    @classmethod
    def about(cls, mode: Mode) -> AdaptedProposal:
        """Begin with the linearised posterior at its mode."""
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
        return StudentT(self.centre.mean, TAIL_WIDENING * self.centre.factor, TAIL_FREEDOM)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) of the posterior and their log density (count,)."""
        inner, _ = self.centre.sample(count, rng)
        far = np.flatnonzero(rng.random(count) < TAIL_SHARE)
        inner[far] = self._tail.sample(len(far), rng)[0]
        blocks = np.array_split(inner, max(1, len(inner) // self._block))
        points, density = zip(*(self._points(block) for block in blocks), strict=True)
        return np.concatenate(points), np.concatenate(density)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        blocks = np.array_split(points, max(1, len(points) // self._block))
        parts = [self._inner(block) for block in blocks]
        return np.concatenate([self._log_density(inner) + volume for inner, volume, _ in parts])

    def linearised(self, points: FloatArray) -> FloatArray:
        """Return the log density of the linearised posterior (n,), up to a constant.

        What it costs does not depend on the number of observations.
        """
        eta = points[:, self.dimension - len(self.mode.eta) :]
        blocks = np.array_split(points, max(1, len(points) // self._block))
        parts = []
        for block in blocks:
            inner, log_volume, marginal = self._inner(block)
            white = inner[:, : self.dimension - len(self.mode.eta)]
            parts.append(marginal + log_volume - 0.5 * np.sum(white**2, axis=1))
        near = np.all(np.abs(eta - self.mode.eta) <= FARTHEST, axis=1)
        inside = self.mode.linearisation.posterior.inside(points)
        return np.where(near & inside, np.concatenate(parts), -np.inf)

    def dispersed(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return starts for chains: spread twice as far as the draws, (count, d)."""
        inner, _ = self.centre.sample(count, rng)
        return self._points(self.centre.mean + 2.0 * (inner - self.centre.mean))[0]

    def adapted(self, drawn: Weighted) -> AdaptedProposal:
        """Return the one with the mean and covariance of weighted draws."""
        weight = drawn.with_moments()
        inner = self._inner(drawn.points)[0]
        mean = weight @ inner
        apart = inner - mean
        return AdaptedProposal(
            self.mode, StudentT(mean, _factor((apart * weight[:, None]).T @ apart), FREEDOM)
        )

    def _points(self, inner: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the points of inner coordinates, shared parts of the noise folded at zero."""
        inner[:, self.dimension - self._shares :] = np.abs(
            inner[:, self.dimension - self._shares :]
        )
        white, eta = np.split(inner, [self.dimension - len(self.mode.eta)], axis=1)
        mean, factor, _ = self._conditional(eta)
        step = np.linalg.solve(np.swapaxes(factor, -1, -2), white[..., None])[..., 0]
        points = np.concatenate((mean + step, eta), axis=1)
        return points, self._log_density(inner) + log_determinant(factor)

    def _inner(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the inner coordinates (n, d) of points, and the log of what a volume becomes.

        And the log density of their noise with the parameters integrated out.
        """
        parameters, eta = np.split(points, [self.dimension - len(self.mode.eta)], axis=1)
        mean, factor, marginal = self._conditional(eta)
        white = np.einsum('nji,nj->ni', factor, parameters - mean)
        return np.concatenate((white, eta), axis=1), log_determinant(factor), marginal

    def _conditional(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `Linearisation.conditional` of noise (n, e)."""
        # Beyond, rounding leaves no information. To propose, any function of the noise would do.
        near = np.clip(eta, self.mode.eta - FARTHEST, self.mode.eta + FARTHEST)
        return self.mode.linearisation.conditional(near)

    @property
    def _block(self) -> int:
        """Draws at a time: each has a matrix."""
        return max(1, BLOCK_ENTRIES // self.dimension**2)

    def _log_density(self, inner: FloatArray) -> FloatArray:
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
        """Number of last coordinates that cannot be negative: the shared parts of the noise."""
        return len(self.mode.linearisation.posterior.noise_model.shares)


class Weighted(NamedTuple):
    """Draws of a proposal with their weights."""

    points: FloatArray  # (n, d)
    log_weight: FloatArray  # Log density over proposal, (n,)
    weight: FloatArray  # Smoothed, with sum 1, (n,)
    pareto_k: float  # Shape of their upper tail

    @classmethod
    def of(cls, points: FloatArray, log_weight: FloatArray) -> Weighted:
        """Smooth the weights."""
        finite = np.isfinite(log_weight)
        # Draws where there is no density count for nothing.
        least = np.min(log_weight[finite], initial=0.0) - 100.0
        log_weight = np.where(finite, log_weight, least)
        weight, pareto_k = _smoothed(np.exp(log_weight - np.max(log_weight)))
        return cls(points, log_weight, weight / weight.sum(), pareto_k)

    @property
    def effective(self) -> float:
        """What number of independent draws they are worth."""
        return _effective(self.weight)

    def with_moments(self) -> FloatArray:
        """Return the weights, (n,), so even that they have moments."""
        weight = self.weight
        for power in POWERS:
            if _effective(weight) >= DRAWS_PER_DIMENSION * self.points.shape[1]:
                break
            weight = np.exp(power * (self.log_weight - np.max(self.log_weight)))
            weight /= weight.sum()
        return weight


def _smoothed(weight: FloatArray) -> tuple[FloatArray, float]:
    """Return weights (n,) of which the largest is 1, smoothed, and the shape of their tail.

    The largest become the expected order statistics of the Pareto distribution that fits them,
    none larger than the largest was. Where they are all the same nothing is to be smoothed, and
    nothing can be where a quarter of the tail is no more than what is beside it.
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
    """Fit a generalised Pareto distribution to sorted excesses (n,): shape and scale.

    The mean of its posterior by quadrature (Zhang and Stephens 2009, doi:10.1198/tech.2009.08017);
    the shape is drawn towards 0.5 as by ten observations more (Vehtari et al., appendix C).
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
    """Return what number of independent draws weights with sum 1 are worth (Kish 1965)."""
    return float(1.0 / np.sum(weight**2))


def _factor(covariance: FloatArray) -> FloatArray:
    """Return the Cholesky factor of a covariance whose units differ by many powers."""
    unit = np.sqrt(np.diag(covariance))
    return unit[:, None] * np.asarray(np.linalg.cholesky(covariance / np.outer(unit, unit)))
