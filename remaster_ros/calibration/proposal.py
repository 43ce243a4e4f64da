"""What the independence sampler proposes from: a Student t, or the linearised posterior.

The independence sampler corrects whatever they leave out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.linearisation import log_determinant
from remaster_ros.types import FloatArray

# Tails of the proposal: of the noise always, of the parameters in this share of the draws. They
# bound the importance weights where the linearised posterior is too narrow.
NOISE_FREEDOM = 10.0
TAIL_SHARE = 0.05
TAIL_FREEDOM = 5.0
TAIL_WIDENING = 1.3
# Draws by which it is seen whether a proposal has to be adapted, and the tails of what it then
# becomes: in tens of dimensions a Student t of few degrees of freedom hardly ever hits the bulk.
TRIED_DRAWS, ADAPTED_FREEDOM = 4000, 15.0
# Draws at a time: the matrices of more do not fit into the processor's cache. With one matrix for
# each draw they have so many entries at most.
BLOCK = 1024
BLOCK_ENTRIES = 2_000_000


@dataclass(frozen=True, eq=False)
class StudentT:
    """A multivariate Student t distribution.

    Attributes
    ----------
    mean
        (d,).
    factor
        Lower Cholesky factor of the scale matrix, (d, d).
    freedom
        Degrees of freedom; small means heavy tails.
    """

    mean: FloatArray
    factor: FloatArray
    freedom: float

    # So many draws tell whether it has to be adapted; a draw costs as much as a density.
    first_draws, cost = TRIED_DRAWS, 1.0

    @classmethod
    def of(cls, points: FloatArray, weight: FloatArray, freedom: float) -> StudentT:
        """Return the one with the mean and covariance of weighted points (n, d)."""
        mean = weight @ points
        apart = points - mean
        covariance = (apart * weight[:, None]).T @ apart
        return cls(mean, np.asarray(np.linalg.cholesky(covariance)), freedom)

    @property
    def dimension(self) -> int:
        """Of what is adapted."""
        return len(self.mean)

    def adapted(self, points: FloatArray, weight: FloatArray) -> StudentT:
        """Return the one with the moments of weighted points (n, d)."""
        return self.of(points, weight, self.freedom)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) and their log density (count,)."""
        normal = rng.standard_normal((count, len(self.mean)))
        mixing = rng.chisquare(self.freedom, count) / self.freedom
        points = self.mean + (normal @ self.factor.T) / np.sqrt(mixing)[:, None]
        return points, self.log_density(points)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        whitened = np.linalg.solve(self.factor, (points - self.mean).T)
        square = np.sum(whitened**2, axis=0)
        return _log_student_t(square, len(self.mean), self.freedom) - log_determinant(self.factor)


@dataclass(frozen=True, eq=False)
class LaplaceProposal:
    """Noise from a Student t; parameters given the noise from their Gaussian, with t tails.

    Attributes
    ----------
    mode
        About which it proposes.
    factorised
        Whether the precision of the parameters is factorised for the noise of every draw, which
        takes ten times as long, or that of the mode's noise serves for all. For few poses: there
        the noise may be several times that of the mode, and the width of the parameters with it.
    """

    mode: Mode
    factorised: bool = False

    # So many draws tell whether it has to be adapted; a draw costs as much as a density.
    first_draws, cost = TRIED_DRAWS, 1.0

    @property
    def dimension(self) -> int:
        """Of what is adapted."""
        return len(self.mode.linearisation.posterior.free) + len(self.mode.eta)

    def adapted(self, points: FloatArray, weight: FloatArray) -> StudentT:
        """Return a Student t with the moments of weighted points (n, d)."""
        return StudentT.of(points, weight, ADAPTED_FREEDOM)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) of the posterior and their log density (count,)."""
        block = BLOCK
        if self.factorised:
            entries = len(self.mode.linearisation.posterior.free) ** 2
            block = min(BLOCK, max(1, BLOCK_ENTRIES // entries))
        sizes = [min(block, count - start) for start in range(0, count, block)]
        points, densities = zip(*(self._sample(size, rng) for size in sizes), strict=True)
        return np.concatenate(points), np.concatenate(densities)

    def _sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        eta = folded(self._noise.sample(count, rng)[0], self._shares)
        mean, factor, _ = self._conditional(eta)
        whitened = with_tails(rng.standard_normal((count, mean.shape[-1])), rng)
        upper = np.swapaxes(factor, -1, -2)
        if self.factorised:
            step = np.linalg.solve(upper, whitened[..., None])[..., 0]
        else:
            step = np.linalg.solve(upper, whitened.T).T
        return np.concatenate((mean + step, eta), axis=1), self._density(eta, whitened, factor)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        parameters, eta = np.split(points, [points.shape[1] - len(self.mode.eta)], axis=1)
        mean, factor, _ = self._conditional(eta)
        whitened = np.einsum('...ji,...j->...i', factor, parameters - mean)
        return self._density(eta, whitened, factor)

    def dispersed(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return starts for chains: spread twice as far as the posterior, (count, d)."""
        points, _ = self.sample(count, rng)
        free = self.mode.linearisation.posterior.free
        centre = np.concatenate((self.mode.z[free], self.mode.eta))
        starts = centre + 2.0 * (points - centre)
        return folded(starts, self._shares)

    def _conditional(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `Linearisation.conditional` of every draw's noise, or of the mode's."""
        return self.mode.linearisation.conditional(eta if self.factorised else self.mode.eta)

    def _density(self, eta: FloatArray, whitened: FloatArray, factor: FloatArray) -> FloatArray:
        """Return the log density (n,) of noise (n, e) and parameters at whitened places (n, f)."""
        noise = folded_density(self._noise, eta, self._shares)
        return noise + tail_density(whitened) + log_determinant(factor)

    @property
    def _shares(self) -> int:
        """Number of noise coordinates that cannot be negative: all but those of sigma."""
        return len(self.mode.linearisation.posterior.noise_model.shares)

    @property
    def _noise(self) -> StudentT:
        factor = np.asarray(np.linalg.cholesky(self.mode.eta_covariance))
        return StudentT(self.mode.eta, factor, NOISE_FREEDOM)


def with_tails(normal: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return standard normal draws (n, f), some of them replaced by those of a wider Student t."""
    tail = np.flatnonzero(rng.random(len(normal)) < TAIL_SHARE)
    mixing = np.sqrt(rng.chisquare(TAIL_FREEDOM, len(tail)) / TAIL_FREEDOM)
    normal[tail] *= (TAIL_WIDENING / mixing)[:, None]
    return normal


def tail_density(whitened: FloatArray) -> FloatArray:
    """Return the log density (n,) of what `with_tails` returns, (n, f)."""
    f = whitened.shape[1]
    square = np.sum(whitened**2, axis=-1)
    centre = np.log1p(-TAIL_SHARE) - 0.5 * square - 0.5 * f * np.log(2.0 * np.pi)
    tail = np.log(TAIL_SHARE) - f * np.log(TAIL_WIDENING)
    tail += _log_student_t(square / TAIL_WIDENING**2, f, TAIL_FREEDOM)
    density: FloatArray = np.logaddexp(centre, tail)
    return density


def folded(points: FloatArray, count: int) -> FloatArray:
    """Return points (n, d), the last coordinates without their sign: shared parts of a noise."""
    points[:, points.shape[1] - count :] = np.abs(points[:, points.shape[1] - count :])
    return points


def folded_density(distribution: StudentT, points: FloatArray, count: int) -> FloatArray:
    """Return the log density (n,) of what `folded` makes of draws."""
    # |x| has the density of x and of -x together.
    kept = (1.0,) * (points.shape[1] - count)
    signs = itertools.product((1.0, -1.0), repeat=count)
    images = [points * np.array((*kept, *sign)) for sign in signs]
    density: FloatArray = np.logaddexp.reduce([distribution.log_density(one) for one in images])
    return density


def _log_student_t(square: FloatArray, d: int, freedom: float) -> FloatArray:
    """Return the log density of a standard t in d dimensions at squared distances (...)."""
    constant = math.lgamma(0.5 * (freedom + d)) - math.lgamma(0.5 * freedom)
    constant -= 0.5 * d * math.log(freedom * math.pi)
    return constant - 0.5 * (freedom + d) * np.log1p(square / freedom)
