"""How well a set of cells explains the residuals: parameters, noise, smoothness, evidence.

With w_s the weight (inverse variance) of stratum s of the data, which are the deviations from the
pose means of one sensor and its pose means of one group size, everything follows from the Gram
matrices G_s of the columns in each stratum, whatever the number of rows::

    H = Σ w_s G_s + Λ,   restricted log likelihood
    L = ½ Σ n_s log w_s − ½ log|H| + ½ log|Λ| − ½ (y'Wy − b'H⁻¹b)

(Patterson & Thompson 1971; Harville 1977). Noise and smoothness maximise L. Two sets of cells are
compared by L in which every unpenalised parameter pays ½ log N (Schwarz 1978) and every penalised
one has its proper Gaussian prior.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from remaster_ros.calibration.posterior import RESOLUTION_M
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Noise, Residuals
from remaster_ros.types import FloatArray, IntArray

# Columns whose norm falls below this share when the others are projected out say nothing new.
ABSORBED = 1e-4
# Of the noise and smoothness coordinates, which are logarithms.
STEPS = 60
# Where the slope in these units falls below this, L is within its square of the maximum.
SLOPE = 0.03
_LARGE = 18.0


@dataclass(frozen=True, eq=False)
class Strata:
    """Gram matrices of [columns | errors] in each stratum.

    Attributes
    ----------
    grams
        (strata, c + 1, c + 1).
    sensor
        Whose stratum, (strata,).
    size
        Group size of pose means; 0 for the deviations from them, (strata,).
    count
        Scalars in it, (strata,).
    """

    grams: FloatArray
    sensor: IntArray
    size: IntArray
    count: IntArray

    @classmethod
    def of(cls, data: Residuals, columns: FloatArray) -> Strata:
        """Compute them for columns (n, 3, c)."""
        rows = data.rows
        joined = np.concatenate((columns, data.errors[:, :, None]), axis=2)
        c = joined.shape[2]
        sums = rows.group_sum(joined.reshape(len(joined), -1), axis=0).reshape(-1, 3, c)
        grams, sensor, size, count = [], [], [], []
        for index, span in rows.spans:
            flat = joined[span].reshape(-1, c)
            within = flat.T @ flat
            mine = rows.group_sensor == index
            for g in np.unique(rows.group_size[mine]):
                part = sums[mine & (rows.group_size == g)].reshape(-1, c)
                gram = part.T @ part / g
                within = within - gram
                grams.append(gram)
                sensor.append(index)
                size.append(g)
                count.append(len(part))
            grams.append(within)
            sensor.append(index)
            size.append(0)
            count.append(3 * int(np.sum(rows.group_size[mine] - 1)))
        return cls(np.array(grams), np.array(sensor), np.array(size), np.array(count))

    def weights(self, noise: Noise) -> FloatArray:
        """Return the inverse variance of each stratum, 1/m², (strata,)."""
        sigma, pose_sigma = noise.sigma[self.sensor], noise.pose_sigma[self.sensor]
        return 1.0 / (sigma**2 + self.size * pose_sigma**2)


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
    log_evidence: float

    def slices(self) -> list[slice]:
        """Return where each cell's parameters are."""
        edges = np.cumsum([0, *(cell.size for cell in self.cells)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]

    def prior_precision(self) -> FloatArray:
        """Return the precision of the Gaussian prior on the parameters, (m, m)."""
        precision = np.zeros_like(self.covariance)
        for cell, factor, where in zip(self.cells, self.smoothness, self.slices(), strict=True):
            if cell.penalty is not None:
                precision[where, where] = factor * cell.penalty
        return precision


def log_prior_one_by_one(cells: Sequence[Cell]) -> float:
    """Return the log prior probability of cells among all that are tried."""
    return -float(sum(np.log(cell.drawn_from) for cell in cells))


def solve(
    data: Residuals,
    cells: Sequence[Cell],
    start: Solution | None = None,
    *,
    prior: float | None = None,
) -> Solution | None:
    """Fit a set of cells; None where the data cannot see one of them beside the others.

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
    """
    cells = tuple(cells)
    columns = data.columns(cells)
    scale = np.sqrt(np.einsum('nim,nim->m', columns, columns))
    free = np.array([cell.penalty is None for cell in cells for _ in cell.parameters], dtype=bool)
    if np.any(scale[free] == 0.0):
        return None
    # The penalty compares neighbours: one unit for all of a cell's splines, also for those at the
    # edge, of which the data see nothing but rounding.
    edges = np.cumsum([0, *(cell.size for cell in cells)])
    for cell, (first, last) in zip(cells, itertools.pairwise(edges), strict=True):
        if cell.penalty is not None:
            scale[first:last] = np.max(scale[first:last]) or 1.0
    p = data.base.shape[2]
    unit = np.concatenate((np.ones(p), scale))
    strata = Strata.of(data, np.concatenate((data.base, columns / scale), axis=2))
    system = _System(data, strata, cells, p, unit)
    if not system.visible():
        return None
    try:
        return system.solution(start, log_prior_one_by_one(cells) if prior is None else prior)
    except np.linalg.LinAlgError:
        # So nearly alike that rounding decides: they cannot be told apart.
        return None


@dataclass(eq=False)
class _System:
    """The mixed-model equations of one set of cells, in scaled columns."""

    data: Residuals
    strata: Strata
    cells: tuple[Cell, ...]
    p: int
    unit: FloatArray

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
        free = np.ones(self.size, dtype=bool)
        for i in self.penalised:
            free[self.where[i]] = False
        # Base first, then unpenalised, then penalised: one Cholesky holds all determinants.
        self.order = np.concatenate((np.flatnonzero(free), np.flatnonzero(~free)))
        self.unpenalised = int(free.sum())
        self.separable = np.flatnonzero(self.data.separable)
        # Each stratum's matrix as one row: sums and traces over strata are then products.
        self.flat = self.strata.grams.reshape(len(self.strata.grams), -1)

    def visible(self) -> bool:
        """Do unpenalised columns say something that the others, and the base, do not?"""
        gram = self.strata.grams.sum(axis=0)[:-1, :-1][np.ix_(self.order, self.order)]
        part = gram[: self.unpenalised, : self.unpenalised]
        try:
            root = np.linalg.cholesky(part + 1e-14 * np.eye(len(part)))
        except np.linalg.LinAlgError:
            return False
        return bool(np.all(np.diag(root)[self.p :] > ABSORBED))

    def noise(self, eta: FloatArray) -> Noise:
        count = self.data.sensors
        sigma = np.exp(eta[:count])
        pose_sigma = np.zeros(count)
        pose_sigma[self.separable] = np.exp(eta[count : count + len(self.separable)])
        return Noise(sigma, pose_sigma)

    def evaluate(self, eta: FloatArray) -> tuple[float, FloatArray]:
        """Return −L and its gradient by eta: log sigmas, log pose sigmas, log smoothness."""
        noise = self.noise(eta)
        weights = self.strata.weights(noise)
        factors = np.exp(eta[len(eta) - len(self.penalised) :])
        _, root, beta = self._solve(weights, factors)
        inverse = self._inverse(root)
        rss = self._squares(beta)
        padded = np.zeros((self.size + 1, self.size + 1))
        padded[:-1, :-1] = inverse
        trace = self.flat @ padded.ravel()
        n = self.strata.count
        value = 0.5 * n @ np.log(weights) - np.sum(np.log(np.diag(root))) - 0.5 * weights @ rss
        by_log_weight = 0.5 * (n - weights * trace - weights * rss)
        # d log w / d log sigma = -2 sigma² w, and the same with g pose_sigma².
        slope = np.zeros(len(eta))
        sensor, size = self.strata.sensor, self.strata.size
        for s in range(self.data.sensors):
            mine = sensor == s
            slope[s] = np.sum((-2.0 * noise.sigma[s] ** 2 * weights * by_log_weight)[mine])
        for i, which in enumerate(self.separable):
            mine = sensor == which
            change = -2.0 * size * noise.pose_sigma[which] ** 2 * weights * by_log_weight
            slope[self.data.sensors + i] = np.sum(change[mine])
        for i, (index, penalty, factor) in enumerate(
            zip(self.penalised, self.penalties, factors, strict=True)
        ):
            where = self.where[index]
            m = len(penalty)
            quadratic = factor * beta[where] @ penalty @ beta[where]
            spread = factor * np.sum(inverse[where, where] * penalty)
            value += 0.5 * (m * np.log(factor) - quadratic)
            slope[len(eta) - len(self.penalised) + i] = 0.5 * (m - spread - quadratic)
        return -value, -slope

    def _solve(
        self, weights: FloatArray, factors: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return H, its lower Cholesky factor (natural order) and the estimate."""
        total = (weights @ self.flat).reshape(self.size + 1, self.size + 1)
        H = total[:-1, :-1].copy()
        for index, penalty, factor in zip(self.penalised, self.penalties, factors, strict=True):
            where = self.where[index]
            H[where, where] += factor * penalty
        root: FloatArray = np.linalg.cholesky(H).astype(float)
        return H, root, cho_solve((root, True), total[:-1, -1], check_finite=False)

    def _inverse(self, root: FloatArray) -> FloatArray:
        """Return the inverse of the matrix with this lower Cholesky factor."""
        lower, _ = dpotri(root, lower=1)
        return np.tril(lower) + np.tril(lower, -1).T

    def _squares(self, beta: FloatArray) -> FloatArray:
        """Return the sum of squared errors in each stratum, m², (strata,)."""
        error = np.append(-beta, 1.0)
        return self.flat @ np.outer(error, error).ravel()

    def solution(self, start: Solution | None, prior: float) -> Solution:
        eta, bounds = self._start(start)
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
        eta = unit * best.x
        noise = self.noise(eta)
        weights = self.strata.weights(noise)
        factors = np.exp(eta[len(eta) - len(self.penalised) :])
        H, root, beta = self._solve(weights, factors)
        evidence = self._evidence(H, weights, factors, beta)
        covariance = self._inverse(root) / np.outer(self.unit, self.unit)
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
            evidence + prior,
        )

    def _evidence(
        self, H: FloatArray, weights: FloatArray, factors: FloatArray, beta: FloatArray
    ) -> float:
        """Return L with ½ log N for each unpenalised parameter in place of its determinant."""
        ordered = np.linalg.cholesky(H[np.ix_(self.order, self.order)])
        logs = np.log(np.diag(ordered))
        rss = self._squares(beta)
        n = self.strata.count
        value = 0.5 * n @ np.log(weights) - 0.5 * weights @ rss - logs[: self.p].sum()
        value -= 0.5 * (self.unpenalised - self.p) * np.log(n.sum() - self.p)
        value -= logs[self.unpenalised :].sum()
        for index, penalty, factor in zip(self.penalised, self.penalties, factors, strict=True):
            where = self.where[index]
            value += 0.5 * (len(penalty) * np.log(factor) + np.linalg.slogdet(penalty)[1])
            value -= 0.5 * factor * beta[where] @ penalty @ beta[where]
        return float(value)

    def _curvature(self) -> FloatArray:
        """Return about what the second derivatives of −L by eta are."""
        sensor, size, count = self.strata.sensor, self.strata.size, self.strata.count
        rows = [2.0 * np.sum(count[sensor == s]) for s in range(self.data.sensors)]
        poses = [0.5 * np.sum(count[(sensor == s) & (size > 0)]) for s in self.separable]
        smooth = [len(penalty) / 6.0 for penalty in self.penalties]
        return np.array([*rows, *poses, *smooth])

    def _start(self, start: Solution | None) -> tuple[FloatArray, list[tuple[float, float]]]:
        noise = self.data.noise if start is None else start.noise
        sigma = np.log(np.maximum(noise.sigma, RESOLUTION_M))
        pose = np.maximum(noise.pose_sigma, 0.1 * noise.sigma)[self.separable]
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
        eta = np.concatenate((sigma, np.log(pose), smooth))
        floor, ceiling = np.log(RESOLUTION_M), np.log(0.1)
        bounds = [(floor, ceiling)] * (len(sigma) + len(pose))
        bounds += [(value - _LARGE, value + _LARGE) for value in smooth]
        return eta, bounds

    def _typical(self, penalty: FloatArray, where: slice, noise: Noise) -> float:
        """Return the factor at which penalty and data weigh about the same."""
        total = np.tensordot(self.strata.weights(noise), self.strata.grams, axes=1)
        return float(np.trace(total[where, where]) / np.trace(penalty))
