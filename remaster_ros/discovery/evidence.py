"""How well a set of candidates explains the residuals: parameters, noise, smoothness, evidence.

With w_s the weight (inverse variance) of error group s of the noise model, everything follows
from the Gram matrices G_s of the columns in each group, whatever the number of rows::

    H = Σ w_s G_s + Λ,   restricted log likelihood
    L = ½ Σ n_s log w_s − ½ log|H| + ½ log|Λ| − ½ (y'Wy − b'H⁻¹b)

(Patterson & Thompson 1971; Harville 1977). Noise and smoothness maximise L, by Newton's method
with the average of observed and expected information, which follows from the factor of H (Gilmour,
Thompson & Cullis 1995, Biometrics 51). Two sets of candidates are compared by L in which every
unpenalised parameter pays ½ log N (Schwarz 1978) and every penalised one has its proper Gaussian
prior. What is implausibly large costs more: Λ holds the prior of the unpenalised parameters, too,
a Gaussian about 0 as wide as the largest plausible value.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.blas import dspmv
from scipy.linalg.lapack import dpotrf, dpotri

from remaster_ros.calibration.noise import RESOLUTION_M, Noise, NoiseModel
from remaster_ros.discovery import packed
from remaster_ros.discovery.effects.base import LARGEST_M, RANDOM, Candidate
from remaster_ros.discovery.residuals import Residuals, units
from remaster_ros.discovery.solution import Covariances, Solution
from remaster_ros.types import FloatArray

# Columns whose norm falls below this share when the others are projected out add nothing.
ABSORBED = 1e-4
# Of the noise and smoothness coordinates, which are logarithms.
STEPS = 60
# Where Newton's step is to raise L by less than half of this, it is at its maximum.
GAIN = 0.05
# A step that is to raise L by less than half of this is the last: what is left is of second order.
LAST = 0.25
# A step that raises L by δ more or less than half of what was promised leaves δ² times this over
# what was promised to the next: 9 of a cubic, 4 of a curvature that was wrong.
NEXT = 9.0
# Longest step, of these logarithms.
STRIDE = 2.0
# Step that no longer raises L by more than rounding.
SHORTEST = 1e-3
_LARGE = 18.0


def log_prior_one_by_one(candidates: Sequence[Candidate]) -> float:
    """Return the log prior probability of a set of candidates: sum of -log(`drawn_from`).

    `Candidate.drawn_from` is the number of candidates of its kind of which each is one.
    """
    return -float(sum(np.log(candidate.drawn_from) for candidate in candidates))


def solve(
    data: Residuals, candidates: Sequence[Candidate], start: Solution | None = None
) -> Solution | None:
    """Fit a set of candidates, which may be empty; None if they cannot be distinguished.

    Noise and smoothness maximise the restricted likelihood; the search begins at those of
    ``start``, if given.
    """
    system = System.of(data, candidates)
    if system is None or not system.visible():
        return None
    try:
        return system.solution(start, log_prior_one_by_one(candidates))
    except np.linalg.LinAlgError:
        # The columns agree up to rounding: they cannot be distinguished.
        return None


@dataclass(eq=False)
class System:
    """Mixed-model equations of one set of candidates, in scaled columns.

    Penalised parameters are random effects. The Gram matrices are `packed`, (error groups,
    length of size + 1).
    """

    model: NoiseModel
    grams: FloatArray
    guess: Noise
    candidates: tuple[Candidate, ...]
    base_precision: FloatArray
    unit: FloatArray
    ridge: FloatArray

    @classmethod
    def of(cls, data: Residuals, candidates: Sequence[Candidate]) -> System | None:
        """Assemble the equations of some candidates.

        None if an unpenalised one has a parameter that displaces no marker.
        """
        # Penalised ones last: one Cholesky factor holds all determinants.
        candidates = tuple(sorted(candidates, key=lambda candidate: candidate.penalty is not None))
        norms, grams = data.gram_matrices(candidates)
        p = data.base.shape[2]
        free = np.array([c.penalty is None for c in candidates for _ in c.parameters], dtype=bool)
        if np.any(norms[p:-1][free] == 0.0):
            return None
        scale = units(candidates, norms[p:-1])
        largest = np.array(
            [candidate.largest or np.nan for candidate in candidates for _ in candidate.parameters]
        )
        typical = LARGEST_M * np.sqrt(len(data)) / scale
        std = np.where(np.isnan(largest), typical, largest)
        # Heights of a curve and weights of a kind have a plausible size, weights of kernels none.
        sized = np.array(
            [
                candidate.penalty is None
                or candidate.curve is not None
                or candidate.form == RANDOM
                for candidate in candidates
                for _ in candidate.parameters
            ],
            dtype=bool,
        )
        ridge = np.concatenate((np.zeros(p), np.where(sized, (std * scale) ** -2.0, 0.0)))
        unit = np.concatenate((np.ones(p), scale))
        return cls(
            data.noise_model, grams, data.noise, candidates, data.base_precision, unit, ridge
        )

    def __post_init__(self) -> None:
        self.p = len(self.base_precision)
        self.size = len(self.unit)
        edges = self.p + np.cumsum([0, *(candidate.size for candidate in self.candidates)])
        self.where = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
        self.penalised = [
            i for i, candidate in enumerate(self.candidates) if candidate.penalty is not None
        ]
        # Of each the penalty, of order one in the scaled columns so that the factors start near
        # right, and for the determinant its spectrum and the ridge, the same for all of it.
        self.penalties, self.spectra, self.ridges = [], [], []
        for i in self.penalised:
            candidate, u = self.candidates[i], self.unit[self.where[i].start]
            assert candidate.penalty is not None
            self.penalties.append(candidate.penalty / u**2)
            self.spectra.append(candidate.roughness / u**2)
            self.ridges.append(float(self.ridge[self.where[i].start]))
        # Base first, then unpenalised, then penalised.
        self.unpenalised = self.where[self.penalised[0]].start if self.penalised else self.size
        # Share of the square of each coordinate of the noise in the variance of each error group.
        model, count = self.model, len(self.model.channels)
        entering = np.arange(count)[:, None] == model.channel_of
        self.entering = np.concatenate(
            (
                entering.astype(float),
                entering[list(model.separable)] * model.size_of,
                entering[list(model.framed)] * model.frame_size_of,
            )
        )
        self._last: tuple[FloatArray, tuple[FloatArray, _Cholesky, FloatArray]] | None = None
        # The errors are the last row.
        self.of_parameters = packed.length(self.size)

    def visible(self) -> bool:
        """Return whether the unpenalised columns are linearly independent.

        Both of each other and of the base columns, which the offsets model can absorb.
        """
        part = self.grams[:, : packed.length(self.unpenalised)].sum(axis=0)
        part[packed.diagonal(self.unpenalised)] += 1e-14
        root, wrong = dpotrf(packed.upper(part, self.unpenalised), overwrite_a=1)
        return not wrong and bool(np.all(np.diag(root)[self.p :] > ABSORBED))

    def noise(self, eta: FloatArray) -> Noise:
        """Return the noise at some coordinates.

        ``eta``: logs of noise sigmas, of sigmas of common parts, of smoothness factors, (e,).
        """
        count = len(self.model.channels)
        return self.model.noise(np.exp(eta[:count]), np.exp(eta[count : len(self.entering)]))

    def value(self, eta: FloatArray) -> float:
        """Return the restricted log likelihood L of the errors, with the Gaussian priors.

        ``eta``: logs of noise sigmas, of sigmas of common parts, of smoothness factors, (e,).
        Raises numpy.linalg.LinAlgError if H, the posterior precision, is not positive definite.
        """
        weights, factors = self._precisions(eta)
        total, factor, beta = self._solved(eta)
        value = self._likelihood(total, weights, beta) - np.sum(np.log(np.diag(factor.root)))
        return float(value + self._smooth(factors, beta))

    def marginal(self, eta: FloatArray) -> float:
        """Return `value` plus half the log prior precision of each unpenalised parameter.

        That completes the normalised Gaussian prior of these parameters.
        ``eta``: logs of noise sigmas, of sigmas of common parts, of smoothness factors, (e,).
        """
        prior = self.ridge[self.p : self.unpenalised]
        return self.value(eta) + 0.5 * float(np.sum(np.log(prior)))

    def most_likely(self, start: Mapping[object, float], noise: Noise | None) -> FloatArray:
        """Return logs eta of noise and smoothness that maximise the restricted likelihood, (e,).

        Smoothness is the factor of a candidate's penalty. ``start``: its value by key of
        candidate, and ``noise``: at which the search begins; a candidate not in ``start``, and
        noise None, begin at a first guess. Raises LinAlgError if columns cannot be distinguished.
        """
        return self._most_likely(*self._start(start, self.guess if noise is None else noise))

    def factors(self, eta: FloatArray) -> dict[object, float]:
        """Return the smoothness factor of each penalised candidate, by its key.

        ``eta``: logs of noise sigmas, of sigmas of common parts, of smoothness factors, (e,).
        """
        values = np.exp(eta[len(self.entering) :])
        return {
            self.candidates[i].key: float(v) for i, v in zip(self.penalised, values, strict=True)
        }

    def estimate(self, eta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return posterior mean (size,) and covariance (size, size) of all parameters.

        First the coefficients of the offsets model's columns, then the candidates' parameters.
        ``eta``: logs of noise sigmas, of sigmas of common parts, of smoothness factors, (e,).
        """
        _, cholesky, beta = self._solved(eta)
        return beta / self.unit, _covariances(cholesky, self.unit, 0)[0]

    def derivatives(self, eta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gradient (e,) and average information (e, e) of the log likelihood L by eta.

        ``eta``: logs of noise sigmas, of sigmas of common parts, of smoothness factors, (e,).
        """
        count = len(self.entering)
        weights, factors = self._precisions(eta)
        total, cholesky, beta = self._solved(eta)
        inverse = cholesky.inverse
        # Beside the diagonal twice: products with symmetric matrices are then those of the whole.
        twice = packed.of_upper(inverse)
        twice *= 2.0
        twice[packed.diagonal(self.size)] *= 0.5
        error = np.append(-beta, 1.0)
        trace, pulls = np.empty(len(weights)), np.empty((len(weights), len(error)))
        # Both of one matrix after the other: it is read from memory once.
        for index, gram in enumerate(self.grams):
            trace[index] = gram[: self.of_parameters] @ twice
            pulls[index] = dspmv(len(error), 1.0, gram, error)
        rss = pulls @ error
        n = self.model.freedom
        by_variance = 0.5 * weights * (weights * (trace + rss) - n)
        # d variance / d log sigma = 2 sigma², of what rows share times its share.
        change = 2.0 * np.exp(2.0 * eta[:count, None]) * self.entering
        slope = np.concatenate((change @ by_variance, np.zeros(len(factors))))
        turns = np.zeros((self.size, len(factors)))
        for i, (index, penalty, factor) in enumerate(
            zip(self.penalised, self.penalties, factors, strict=True)
        ):
            where = self.where[index]
            ridge = self.ridges[i]
            smooth = np.sum(factor * self.spectra[i] / (factor * self.spectra[i] + ridge))
            quadratic = factor * beta[where] @ penalty @ beta[where]
            product = inverse[where, where] * penalty
            spread = factor * (2.0 * np.sum(product) - np.trace(product))
            slope[count + i] = 0.5 * (smooth - spread - quadratic)
            turns[where, i] = beta[where]
            if ridge > 0.0:
                # The change of the covariance by a logarithm of the factor is that of its inverse.
                prior = factor * penalty + ridge * np.eye(len(penalty))
                turns[where, i] -= ridge * np.linalg.solve(prior, beta[where])
        # ½ q_j' P q_k with q_j = (∂V/∂eta_j) P y and P = W − W X H⁻¹ X' W.
        moved = np.zeros_like(turns)
        for i, turn in enumerate(turns.T):
            moved[:, i] = dspmv(self.size, 1.0, total[: self.of_parameters], turn)
        noise_part = (change * weights**2) @ pulls[:, :-1]
        both = np.concatenate((noise_part.T, -moved), axis=1)
        square = np.zeros((len(eta), len(eta)))
        square[:count, :count] = (change * weights**3 * rss) @ change.T
        square[:count, count:] = -noise_part @ turns
        square[count:, :count] = square[:count, count:].T
        square[count:, count:] = turns.T @ moved
        information = 0.5 * (square - both.T @ cholesky.solve(both))
        return slope, information

    def _precisions(self, eta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the precision of each error group, and each penalised candidate's smoothness."""
        count = len(self.entering)
        return 1.0 / (np.exp(2.0 * eta[:count]) @ self.entering), np.exp(eta[count:])

    def _solved(self, eta: FloatArray) -> tuple[FloatArray, _Cholesky, FloatArray]:
        """Return the weighted sum of the Gram matrices, Cholesky factor of H, and estimate.

        The sum is `packed`. H: posterior precision of all parameters; the estimate is in scaled
        columns, (size,). ``eta``: as of `value`; the result for the last one is cached. Raises
        numpy.linalg.LinAlgError if H is not positive definite.
        """
        if self._last is not None and np.array_equal(self._last[0], eta):
            return self._last[1]
        weights, factors = self._precisions(eta)
        total = weights @ self.grams
        H = packed.upper(total, self.size)
        np.einsum('ii->i', H)[:] += self.ridge
        H[: self.p, : self.p] += self.base_precision
        for index, penalty, factor in zip(self.penalised, self.penalties, factors, strict=True):
            where = self.where[index]
            H[where, where] += factor * penalty
        root, wrong = dpotrf(H, overwrite_a=1)
        if wrong:
            raise np.linalg.LinAlgError
        cholesky = _Cholesky(root)
        beta = cholesky.solve(total[self.of_parameters : -1])
        self._last = eta.copy(), (total, cholesky, beta)
        return self._last[1]

    def solution(self, start: Solution | None, prior: float) -> Solution:
        """Return the fit at the noise and smoothness that maximise L.

        ``start``: fit at whose noise and smoothness the search begins, or None for a first
        guess; ``prior``: log prior probability, added to the log evidence.
        """
        known = {} if start is None else start.factors()
        noise = self.guess if start is None else start.noise
        eta = self._most_likely(*self._start(known, noise))
        weights, factors = self._precisions(eta)
        total, cholesky, beta = self._solved(eta)
        evidence = self._evidence(total, cholesky.root, weights, factors, beta)
        beta = beta / self.unit
        smoothness = np.full(len(self.candidates), np.nan)
        smoothness[self.penalised] = factors
        return Solution(
            self.candidates,
            beta[self.p :],
            beta[: self.p],
            self.noise(eta),
            smoothness,
            (self.ridge * self.unit**2)[self.p :],
            Covariances(partial(_covariances, cholesky, self.unit, self.unpenalised)),
            evidence + prior,
        )

    def _most_likely(self, eta: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return the coordinates eta that maximise L between two bounds, by Newton steps, (e,).

        Ends after `STEPS` steps, or if the next one promises little.
        """
        value = self.value(eta)
        for _ in range(STEPS):
            slope, information = self.derivatives(eta)
            free = np.where(slope > 0.0, eta < high, eta > low)
            step = _step(slope[free], information[np.ix_(free, free)])
            promised = step @ slope[free]
            if promised < GAIN:
                break
            while True:
                trial = eta.copy()
                trial[free] = np.clip(eta[free] + step, low[free], high[free])
                gain = self.value(trial) - value
                if gain > 0.0:
                    break
                step *= 0.25
                if np.max(np.abs(step)) < SHORTEST:
                    return eta
            eta, value = trial, value + gain
            if promised < LAST or NEXT * (gain - 0.5 * promised) ** 2 < GAIN * promised:
                break
        return eta

    def _evidence(
        self,
        total: FloatArray,
        root: FloatArray,
        weights: FloatArray,
        factors: FloatArray,
        beta: FloatArray,
    ) -> float:
        """Return L with ½ log N for each unpenalised parameter in place of its log determinant.

        That is the Bayesian information criterion; N: degrees of freedom. ``total``: weighted
        Gram matrix, `packed`; ``root``: Cholesky factor of H; ``weights``, ``factors``: as
        returned by `_precisions`; ``beta``: the estimate in scaled columns, (size,).
        """
        logs = np.log(np.diag(root))
        value = self._likelihood(total, weights, beta) - logs[: self.p].sum()
        value -= 0.5 * (self.unpenalised - self.p) * np.log(self.model.freedom.sum() - self.p)
        return float(value - logs[self.unpenalised :].sum() + self._smooth(factors, beta))

    def _likelihood(self, total: FloatArray, weights: FloatArray, beta: FloatArray) -> float:
        """Return the log likelihood at an estimate, with all priors except the smoothness.

        ``total``: weighted Gram matrix, `packed`; ``weights``: precision of each error group;
        ``beta``: the estimate in scaled columns, (size,).
        """
        error = np.append(-beta, 1.0)
        square = error @ dspmv(len(error), 1.0, total, error)
        value = 0.5 * self.model.freedom @ np.log(weights) - 0.5 * square
        return float(value - 0.5 * self._implausible(beta))

    def _smooth(self, factors: FloatArray, beta: FloatArray) -> float:
        """Return the log prior density of the penalised parameters by their smoothness penalties.

        ``factors``: smoothness factor of each penalty; ``beta``: the estimate in scaled columns,
        (size,). The quadratic term of the ridge is left to `_implausible`.
        """
        value = 0.0
        for index, penalty, spectrum, ridge, factor in zip(
            self.penalised, self.penalties, self.spectra, self.ridges, factors, strict=True
        ):
            where = self.where[index]
            value += 0.5 * float(np.sum(np.log(factor * spectrum + ridge)))
            value -= 0.5 * factor * float(beta[where] @ penalty @ beta[where])
        return value

    def _implausible(self, beta: FloatArray) -> float:
        """Return the quadratic form beta' P beta of the estimate in scaled columns, (size,).

        P: prior precision of all parameters without the smoothness penalties.
        """
        base = beta[: self.p]
        return float(self.ridge @ beta**2 + base @ self.base_precision @ base)

    def _start(
        self, known: Mapping[object, float], noise: Noise
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the start of the search for noise and smoothness, and its bounds, (e,) each.

        Lower, then upper bounds. ``known``: smoothness by key of candidates, others begin at a
        typical one; ``noise``: to begin at.
        """
        sigma = np.log(np.maximum(noise.sigma, RESOLUTION_M))
        least = 0.1 * noise.sigma
        shared = self.model.shared(
            Noise(
                noise.sigma,
                np.maximum(noise.pose_sigma, least),
                np.maximum(noise.frame_sigma, least),
            )
        )
        factors = [
            known[key] if (key := self.candidates[i].key) in known else self._typical(which, noise)
            for which, i in enumerate(self.penalised)
        ]
        smooth = np.log(factors)
        eta = np.concatenate((sigma, np.log(shared), smooth))
        bound = np.full(len(self.entering), np.log(RESOLUTION_M))
        low = np.concatenate((bound, smooth - _LARGE))
        high = np.concatenate((np.full(len(bound), np.log(0.1)), smooth + _LARGE))
        least = np.array([self.candidates[i].least for i in self.penalised])
        with np.errstate(divide='ignore'):
            high[len(bound) :] = np.minimum(high[len(bound) :], -2.0 * np.log(least))
        low = np.minimum(low, high)
        return np.clip(eta, low, high), low, high

    def _typical(self, which: int, noise: Noise) -> float:
        """Return the smoothness factor at which penalty and data have about equal weight.

        ``which``: number of the candidate among the penalised ones.
        """
        where = self.where[self.penalised[which]]
        diagonal = self.grams[:, packed.diagonal(self.size)[where]].sum(axis=1)
        data = diagonal @ (1.0 / self.model.variances(noise))
        return float(data / np.trace(self.penalties[which]))


@dataclass(frozen=True, eq=False)
class _Cholesky:
    """Positive definite matrix, stored as its upper Cholesky factor, zeros below the diagonal."""

    root: FloatArray

    @cached_property
    def inverse(self) -> FloatArray:
        """Upper triangle of the inverse of the matrix, zeros below the diagonal."""
        return np.asarray(dpotri(self.root)[0])

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution of the matrix with right-hand sides, (size,) or (size, r)."""
        return np.asarray(cho_solve((self.root, False), right, check_finite=False))


def _covariances(H: _Cholesky, unit: FloatArray, first: int) -> tuple[FloatArray, FloatArray]:
    """Return two covariances: of all parameters, and of the first ones if the others are known.

    They are the inverses of H and of its block of the first ``first`` parameters, (size, size)
    and (first, first). ``unit``: scales of the columns, by which both are divided, (size,).
    """
    full = H.inverse + H.inverse.T
    np.einsum('ii->i', full)[:] *= 0.5
    full /= unit[:, None]
    full /= unit
    unit = unit[:first]
    return full, _Cholesky(H.root[:first, :first]).solve(np.eye(first)) / np.outer(unit, unit)


def _step(slope: FloatArray, information: FloatArray) -> FloatArray:
    """Return Newton's step for a gradient, at most `STRIDE` long along each eigenvector."""
    values, vectors = np.linalg.eigh(information)
    along = (vectors.T @ slope) / np.maximum(values, SHORTEST)
    step: FloatArray = vectors @ np.clip(along, -STRIDE, STRIDE)
    return step
