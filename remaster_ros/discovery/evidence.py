"""How well a set of cells explains the residuals: parameters, noise, smoothness, evidence.

With w_s the weight (inverse variance) of error group s of the noise model, everything follows
from the Gram matrices G_s of the columns in each group, whatever the number of rows::

    H = Σ w_s G_s + Λ,   restricted log likelihood
    L = ½ Σ n_s log w_s − ½ log|H| + ½ log|Λ| − ½ (y'Wy − b'H⁻¹b)

(Patterson & Thompson 1971; Harville 1977). Noise and smoothness maximise L. Two sets of cells are
compared by L in which every unpenalised parameter pays ½ log N (Schwarz 1978) and every penalised
one has its proper Gaussian prior. What is implausibly large costs more: Λ holds the prior of the
unpenalised parameters, too, a Gaussian about 0 as wide as the largest plausible value.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from remaster_ros.calibration.noise import RESOLUTION_M, Noise, NoiseModel
from remaster_ros.discovery.effects.base import LARGEST_M, Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray

# Columns whose norm falls below this share when the others are projected out add nothing.
ABSORBED = 1e-4
# Of the noise and smoothness coordinates, which are logarithms.
STEPS = 60
# Where the slope in these units falls below this, L is within its square of the maximum.
SLOPE = 0.1
_LARGE = 18.0


def log_prior_one_by_one(cells: Sequence[Cell]) -> float:
    """Return the log prior probability of cells among all that are tried."""
    return -float(sum(np.log(cell.drawn_from) for cell in cells))


def solve(
    data: Residuals,
    cells: Sequence[Cell],
    start: Solution | None = None,
    *,
    prior: float | None = None,
    settled: bool = True,
) -> Solution | None:
    """Fit a set of cells; None where one of them adds nothing to the others.

    Parameters
    ----------
    data
        The residuals.
    cells
        The set, maybe empty.
    start
        A fit whose noise and smoothness are near.
    prior
        Log prior probability of the set; by default that of its cells one by one.
    settled
        False: with noise and smoothness as they are at the start, which costs one evaluation in
        place of half a dozen; the evidence is too low then, if anything.
    """
    # Penalised ones last: one Cholesky factor holds all determinants.
    order = sorted(range(len(cells)), key=lambda index: cells[index].penalty is not None)
    cells = tuple(cells[index] for index in order)
    norms, grams = data.gram_matrices(cells)
    p = data.base.shape[2]
    scale = norms[p:-1]
    free = np.array([cell.penalty is None for cell in cells for _ in cell.parameters], dtype=bool)
    if np.any(scale[free] == 0.0):
        return None
    # The penalty compares neighbours: one unit for all of a cell's splines, also for those at the
    # edge, where no row has more than a rounding error.
    edges = np.cumsum([0, *(cell.size for cell in cells)])
    for cell, (first, last) in zip(cells, itertools.pairwise(edges), strict=True):
        if cell.penalty is not None:
            scale[first:last] = np.max(scale[first:last]) or 1.0
    largest = np.array([cell.largest or np.nan for cell in cells for _ in cell.parameters])
    typical = LARGEST_M * np.sqrt(len(data)) / scale
    std = np.where(np.isnan(largest), typical, largest)
    # Of free forms the heights of a curve have a plausible size, weights of kernels have none.
    sized = np.array(
        [
            cell.penalty is None or cell.curve is not None
            for cell in cells
            for _ in cell.parameters
        ],
        dtype=bool,
    )
    ridge = np.concatenate((np.zeros(p), np.where(sized, (std * scale) ** -2.0, 0.0)))
    unit = np.concatenate((np.ones(p), scale))
    inverse_unit = 1.0 / np.append(unit, 1.0)
    grams = grams * (inverse_unit[:, None] * inverse_unit)
    system = _System(data.noise_model, grams, data.noise, cells, p, unit, ridge)
    if not system.visible():
        return None
    try:
        if prior is None:
            prior = log_prior_one_by_one(cells)
        return system.solution(start, prior, settled).reordered(np.argsort(order))
    except np.linalg.LinAlgError:
        # The columns agree up to rounding: they cannot be distinguished.
        return None


@dataclass(eq=False)
class _System:
    """The mixed-model equations of one set of cells, in scaled columns."""

    model: NoiseModel
    grams: FloatArray
    guess: Noise
    cells: tuple[Cell, ...]
    p: int
    unit: FloatArray
    ridge: FloatArray

    def __post_init__(self) -> None:
        self.size = len(self.unit)
        edges = self.p + np.cumsum([0, *(cell.size for cell in self.cells)])
        self.where = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
        self.penalised = [i for i, cell in enumerate(self.cells) if cell.penalty is not None]
        self.penalties = []
        for i in self.penalised:
            penalty = self.cells[i].penalty
            assert penalty is not None
            u = self.unit[self.where[i]]
            scaled = penalty / np.outer(u, u)
            # Of order one in the scaled columns, so that the factors start near right.
            self.penalties.append(scaled)
        # Of each, for the determinant beside the ridge, which is the same for all of a cell.
        self.spectra = [np.linalg.eigvalsh(penalty) for penalty in self.penalties]
        self.ridges = [float(self.ridge[self.where[i].start]) for i in self.penalised]
        # Base first, then unpenalised, then penalised.
        self.unpenalised = self.where[self.penalised[0]].start if self.penalised else self.size
        self.shares = self.model.shares
        # Each group's matrix as one row: sums and traces over groups are then products.
        self.flat = self.grams.reshape(len(self.grams), -1)
        self._last: tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]] | None = None

    def visible(self) -> bool:
        """Return whether the unpenalised columns add something to the others and to the base."""
        part = self.grams[:, : self.unpenalised, : self.unpenalised].sum(axis=0)
        try:
            root = np.linalg.cholesky(part + 1e-14 * np.eye(len(part)))
        except np.linalg.LinAlgError:
            return False
        return bool(np.all(np.diag(root)[self.p :] > ABSORBED))

    def noise(self, eta: FloatArray) -> Noise:
        count = len(self.model.channels)
        return self.model.noise(np.exp(eta[:count]), np.exp(eta[count : count + len(self.shares)]))

    def evaluate(self, eta: FloatArray) -> tuple[float, FloatArray]:
        """Return −L and its gradient by eta: log sigmas, what rows share, smoothness."""
        noise, weights, factors = self._precisions(eta)
        root, beta, lower = self._solved(eta)
        # Below the diagonal twice: products with symmetric matrices are then those of the whole.
        inverse = 2.0 * lower
        np.fill_diagonal(inverse, np.diag(lower))
        error = np.append(-beta, 1.0)
        factorised = np.zeros((2, self.size + 1, self.size + 1))
        factorised[0, :-1, :-1] = inverse
        np.outer(error, error, out=factorised[1])
        # Of every error group in one pass over the matrices, which are most of the work.
        trace, rss = (self.flat @ factorised.reshape(2, -1).T).T
        n = self.model.freedom
        value = 0.5 * n @ np.log(weights) - np.sum(np.log(np.diag(root))) - 0.5 * weights @ rss
        value -= 0.5 * self.ridge @ beta**2
        by_log_weight = 0.5 * (n - weights * trace - weights * rss)
        # d log w / d log sigma = -2 sigma² w, and the same with g pose_sigma², M frame_sigma².
        slope = np.zeros(len(eta))
        channel, count = self.model.channel_of, len(self.model.channels)
        by_variance = -2.0 * weights * by_log_weight
        by_sigma = np.bincount(channel, by_variance, count).astype(float)
        by_pose_sigma = np.bincount(channel, self.model.size_of * by_variance, count)
        by_frame_sigma = np.bincount(channel, self.model.frame_size_of * by_variance, count)
        slope[:count] = noise.sigma**2 * by_sigma
        slope[count : count + len(self.shares)] = self.model.shared(
            Noise(
                by_sigma,
                noise.pose_sigma**2 * by_pose_sigma,
                noise.frame_sigma**2 * by_frame_sigma,
            )
        )
        for i, (index, penalty, factor) in enumerate(
            zip(self.penalised, self.penalties, factors, strict=True)
        ):
            where = self.where[index]
            prior = factor * self.spectra[i] + self.ridges[i]
            smooth = np.sum(factor * self.spectra[i] / prior)
            quadratic = factor * beta[where] @ penalty @ beta[where]
            spread = factor * np.sum(inverse[where, where] * penalty)
            value += 0.5 * (np.sum(np.log(prior)) - quadratic)
            slope[len(eta) - len(self.penalised) + i] = 0.5 * (smooth - spread - quadratic)
        return -value, -slope

    def _precisions(self, eta: FloatArray) -> tuple[Noise, FloatArray, FloatArray]:
        """Return the noise, the weight of each error group, the factor of each penalty."""
        noise = self.noise(eta)
        weights = 1.0 / self.model.variances(noise)
        return noise, weights, np.exp(eta[len(eta) - len(self.penalised) :])

    def _solved(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the lower Cholesky factor of H, the estimate, and H⁻¹ with zeros above."""
        if self._last is not None and np.array_equal(self._last[0], eta):
            return self._last[1]
        _, weights, factors = self._precisions(eta)
        total = (weights @ self.flat).reshape(self.size + 1, self.size + 1)
        H = total[:-1, :-1] + np.diag(self.ridge)
        for index, penalty, factor in zip(self.penalised, self.penalties, factors, strict=True):
            where = self.where[index]
            H[where, where] += factor * penalty
        root = np.linalg.cholesky(H).astype(float, copy=False)
        beta = cho_solve((root, True), total[:-1, -1], check_finite=False)
        # The transpose is the same memory in LAPACK's order.
        upper, _ = dpotri(root.T, lower=0)
        self._last = eta.copy(), (root, beta, upper.T)
        return self._last[1]

    def _squares(self, beta: FloatArray) -> FloatArray:
        """Return the sum of squared errors in each error group, m², (groups,)."""
        error = np.append(-beta, 1.0)
        return self.flat @ np.outer(error, error).ravel()

    def solution(self, start: Solution | None, prior: float, settled: bool) -> Solution:
        eta, bounds = self._start(start)
        if settled:
            eta = self._most_likely(eta, bounds)
        noise, weights, factors = self._precisions(eta)
        root, beta, lower = self._solved(eta)
        evidence = self._evidence(root, weights, factors, beta)
        covariance = (lower + np.tril(lower, -1).T) / np.outer(self.unit, self.unit)
        beta = beta / self.unit
        smoothness = np.full(len(self.cells), np.nan)
        smoothness[self.penalised] = factors
        return Solution(
            self.cells,
            beta[self.p :],
            covariance[self.p :, self.p :],
            beta[: self.p],
            covariance,
            noise,
            smoothness,
            (self.ridge * self.unit**2)[self.p :],
            evidence + prior,
        )

    def _most_likely(self, eta: FloatArray, bounds: list[tuple[float, float]]) -> FloatArray:
        """Return the noise and smoothness, as logarithms, that maximise L."""
        # In units of about their own standard deviations: L has a curvature near 1 everywhere.
        unit = self._curvature() ** -0.5

        def scaled(x: FloatArray) -> tuple[float, FloatArray]:
            value, gradient = self.evaluate(unit * x)
            return value, unit * gradient

        best = minimize(
            scaled,
            eta / unit,
            jac=True,
            method='L-BFGS-B',
            bounds=np.array(bounds) / unit[:, None],
            options={'maxiter': STEPS, 'ftol': 1e-9, 'gtol': SLOPE},
        )
        most_likely: FloatArray = unit * best.x
        return most_likely

    def _evidence(
        self, root: FloatArray, weights: FloatArray, factors: FloatArray, beta: FloatArray
    ) -> float:
        """Return L with ½ log N for each unpenalised parameter in place of its determinant."""
        logs = np.log(np.diag(root))
        rss = self._squares(beta)
        n = self.model.freedom
        value = 0.5 * n @ np.log(weights) - 0.5 * weights @ rss - logs[: self.p].sum()
        value -= 0.5 * (self.unpenalised - self.p) * np.log(n.sum() - self.p)
        value -= logs[self.unpenalised :].sum() + 0.5 * self.ridge @ beta**2
        for index, penalty, spectrum, ridge, factor in zip(
            self.penalised, self.penalties, self.spectra, self.ridges, factors, strict=True
        ):
            where = self.where[index]
            value += 0.5 * np.sum(np.log(factor * spectrum + ridge))
            value -= 0.5 * factor * beta[where] @ penalty @ beta[where]
        return float(value)

    def _curvature(self) -> FloatArray:
        """Return about what the second derivatives of −L by eta are."""
        channel, count = self.model.channel_of, len(self.model.channels)
        freedom = self.model.freedom
        own, poses, frames = (
            np.bincount(channel, freedom * entering, count).astype(float)
            for entering in (1.0, self.model.size_of > 0, self.model.frame_size_of > 0)
        )
        shared = self.model.shared(Noise(own, poses, frames))
        smooth = [len(penalty) / 6.0 for penalty in self.penalties]
        return np.array([*(2.0 * own), *(0.5 * shared), *smooth])

    def _start(self, start: Solution | None) -> tuple[FloatArray, list[tuple[float, float]]]:
        noise = self.guess if start is None else start.noise
        sigma = np.log(np.maximum(noise.sigma, RESOLUTION_M))
        least = 0.1 * noise.sigma
        shared = self.model.shared(
            Noise(
                noise.sigma,
                np.maximum(noise.pose_sigma, least),
                np.maximum(noise.frame_sigma, least),
            )
        )
        known: dict[object, float] = {}
        if start is not None:
            known = {
                cell.key: factor
                for cell, factor in zip(start.cells, start.smoothness, strict=True)
                if np.isfinite(factor)
            }
        smooth = [
            np.log(known.get(self.cells[i].key, self._typical(penalty, self.where[i], noise)))
            for i, penalty in zip(self.penalised, self.penalties, strict=True)
        ]
        eta = np.concatenate((sigma, np.log(shared), smooth))
        floor, ceiling = np.log(RESOLUTION_M), np.log(0.1)
        bounds = [(floor, ceiling)] * (len(sigma) + len(shared))
        bounds += [(value - _LARGE, value + _LARGE) for value in smooth]
        return eta, bounds

    def _typical(self, penalty: FloatArray, where: slice, noise: Noise) -> float:
        """Return the factor at which penalty and data weigh about the same."""
        total = np.tensordot(1.0 / self.model.variances(noise), self.grams, axes=1)
        return float(np.trace(total[where, where]) / np.trace(penalty))
