"""Proposals from the linearised posterior, in batches, for the exact sampler to judge."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.laplace import Mode, log_determinant
from remaster_ros.calibration.metropolis import StudentT, log_student_t
from remaster_ros.types import FloatArray

# Tails of the proposal: of the noise always, of the parameters in this share of the draws. They
# bound the importance weights where the linear picture is too narrow.
NOISE_FREEDOM = 10.0
TAIL_SHARE = 0.05
TAIL_FREEDOM = 5.0
TAIL_WIDENING = 1.3
# Draws at a time: more fall out of the processor's cache.
BLOCK = 1024


@dataclass(frozen=True, eq=False)
class LaplaceProposal:
    """Noise from a Student t; parameters given the noise from their Gaussian, with t tails.

    Together a heavy-tailed, skewed relative of the multivariate t: the width of the parameters
    goes with the noise drawn. To factorise their precision for every draw would cost more than all
    the rest, so the Gaussian is interpolated along each principal direction of the noise: its mean
    is quadratic, and so is the logarithm of the diagonal of its factor; the rest of the factor is
    linear. What this leaves out the sampler corrects.

    Attributes
    ----------
    mode
        About which it proposes.
    basis
        Principal directions of the noise, one standard deviation long, (e, e).
    root
        Inverse of the lower factor of the precision at the mode, (f, f).
    mean
        Slope and curvature of the mean along each direction, (e, 2, f).
    log_diagonal
        The same of the logarithm of the diagonal of the covariance's factor, (e, 2, f).
    lower
        Slope of what is below that diagonal, (e, f, f).
    """

    mode: Mode
    basis: FloatArray
    root: FloatArray
    mean: FloatArray
    log_diagonal: FloatArray
    lower: FloatArray

    @classmethod
    def of(cls, mode: Mode) -> LaplaceProposal:
        """Factorise at the mode and a standard deviation of the noise to either side of it."""
        linearisation = mode.linearisation
        centre, factor, _ = linearisation.conditional(mode.eta)
        basis: FloatArray = np.asarray(np.linalg.cholesky(mode.eta_covariance)).T
        count = len(linearisation.posterior.noise_model.channels)
        means, diagonals, lowers = [], [], []
        for direction in basis:
            # Behind the boundary of the folded coordinates the density is mirrored, not smooth.
            behind = mode.eta - direction
            behind[count:] = np.maximum(behind[count:], 0.0)
            reach = float(np.linalg.norm(mode.eta - behind) / np.linalg.norm(direction))
            sides = []
            for eta in (mode.eta + direction, behind):
                mean, moved, _ = linearisation.conditional(eta)
                # Lower too: the covariance's factor relative to the one at the mode.
                ratio = np.linalg.solve(moved, factor)
                sides.append((mean - centre, np.log(np.diag(ratio)), np.tril(ratio, -1)))
            (m1, d1, l1), (m2, d2, l2) = sides
            means.append(_parabola(m1, m2, reach))
            diagonals.append(_parabola(d1, d2, reach))
            lowers.append((l1 - l2) / (1.0 + reach))
        root: FloatArray = np.asarray(np.linalg.inv(factor))
        return cls(mode, basis, root, np.array(means), np.array(diagonals), np.array(lowers))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) of the posterior and their log density (count,)."""
        points, density = np.empty((count, len(self.root) + len(self.basis))), np.empty(count)
        for start in range(0, count, BLOCK):
            chosen = slice(start, min(start + BLOCK, count))
            points[chosen], density[chosen] = self._sample(chosen.stop - start, rng)
        return points, density

    def _sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        # The folded coordinates have a mirrored half: |x| has the density of x and of -x together.
        eta = self._fold(self._noise.sample(count, rng)[0])
        whitened = rng.standard_normal((count, len(self.root)))
        tail = np.flatnonzero(rng.random(count) < TAIL_SHARE)
        mixing = np.sqrt(rng.chisquare(TAIL_FREEDOM, len(tail)) / TAIL_FREEDOM)
        whitened[tail] *= (TAIL_WIDENING / mixing)[:, None]
        parameters, log_volume = self._placed(eta, whitened)
        density = self._noise_density(eta) + _whitened_density(whitened) + log_volume
        return np.concatenate((parameters, eta), axis=1), density

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        f = len(self.root)
        eta = points[:, f:]
        whitened, log_volume = self._whitened(eta, points[:, :f])
        return self._noise_density(eta) + _whitened_density(whitened) + log_volume

    def dispersed(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return starts for chains: spread twice as far as the posterior, (count, d)."""
        mode = self.mode
        points, _ = self.sample(count, rng)
        centre = np.concatenate((mode.z[mode.linearisation.posterior.free], mode.eta))
        starts = centre + 2.0 * (points - centre)
        f = len(self.root)
        starts[:, f:] = self._fold(starts[:, f:])
        return starts

    def _placed(self, eta: FloatArray, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the parameters at standard normal places (n, f), and the log density's scale."""
        mean, log_diagonal, u = self._conditional(eta)
        right = np.exp(log_diagonal) * whitened
        for share, lower in zip(u.T, self.lower, strict=True):
            right += share[:, None] * (whitened @ lower)
        return mean + right @ self.root, self._log_volume(log_diagonal)

    def _whitened(self, eta: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the places of parameters (n, f), and the log density's scale (n,)."""
        f = len(self.root)
        mean, log_diagonal, u = self._conditional(eta)
        ratio = np.tensordot(u, self.lower, axes=1)
        ratio[:, np.arange(f), np.arange(f)] = np.exp(log_diagonal)
        right = np.linalg.solve(self.root.T, (parameters - mean).T).T
        whitened = np.linalg.solve(np.swapaxes(ratio, -1, -2), right[..., None])[..., 0]
        return whitened, self._log_volume(log_diagonal)

    def _log_volume(self, log_diagonal: FloatArray) -> FloatArray:
        return np.asarray(-log_determinant(self.root) - log_diagonal.sum(axis=-1))

    def _conditional(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mean and log diagonal of the factor (n, f), and eta by principal direction."""
        u = (eta - self.mode.eta) @ np.linalg.inv(self.basis)
        centre = self.mode.z[self.mode.linearisation.posterior.free]
        mean = centre + u @ self.mean[:, 0] + u**2 @ self.mean[:, 1]
        log_diagonal = u @ self.log_diagonal[:, 0] + u**2 @ self.log_diagonal[:, 1]
        # Far out the parabola may turn: a bound keeps the proposal from collapsing.
        return mean, np.clip(log_diagonal, -2.0, 2.0), u

    def _fold(self, eta: FloatArray) -> FloatArray:
        count = len(self.mode.linearisation.posterior.noise_model.channels)
        return np.concatenate((eta[:, :count], np.abs(eta[:, count:])), axis=1)

    def _noise_density(self, eta: FloatArray) -> FloatArray:
        count = len(self.mode.linearisation.posterior.noise_model.channels)
        folded = eta.shape[1] - count
        signs = itertools.product((1.0, -1.0), repeat=folded)
        mirrored = [eta * np.array((*(1.0,) * count, *sign)) for sign in signs]
        return np.logaddexp.reduce([self._noise.log_density(image) for image in mirrored])

    @property
    def _noise(self) -> StudentT:
        return StudentT(self.mode.eta, self.basis.T, NOISE_FREEDOM)


class FactorisedProposal(LaplaceProposal):
    """The same with the Gaussian factorised for every draw: ten times the cost of a draw.

    For few poses. There the noise common to a pose may be several times what it is at the mode,
    where the interpolation is no picture of the posterior any more.
    """

    def _placed(self, eta: FloatArray, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, factor, _ = self.mode.linearisation.conditional(eta)
        step = np.linalg.solve(np.swapaxes(factor, -1, -2), whitened[..., None])[..., 0]
        return mean + step, log_determinant(factor)

    def _whitened(self, eta: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, factor, _ = self.mode.linearisation.conditional(eta)
        whitened = np.swapaxes(factor, -1, -2) @ (parameters - mean)[..., None]
        return whitened[..., 0], log_determinant(factor)


def _whitened_density(whitened: FloatArray) -> FloatArray:
    """Return the log density (n,) of places (n, f): normal with t tails."""
    f = whitened.shape[1]
    square = np.sum(whitened**2, axis=-1)
    centre = np.log1p(-TAIL_SHARE) - 0.5 * square - 0.5 * f * np.log(2.0 * np.pi)
    tail = (
        np.log(TAIL_SHARE)
        + log_student_t(square / TAIL_WIDENING**2, f, TAIL_FREEDOM)
        - f * np.log(TAIL_WIDENING)
    )
    return np.logaddexp(centre, tail)


def _parabola(plus: FloatArray, minus: FloatArray, reach: float) -> FloatArray:
    """Return slope and curvature (2, f) through 0 at 0, ``plus`` at 1, ``minus`` at -reach."""
    if reach < 0.1:
        return np.array([plus, np.zeros_like(plus)])
    curvature = (minus + reach * plus) / (reach * (1.0 + reach))
    return np.array([plus - curvature, curvature])
