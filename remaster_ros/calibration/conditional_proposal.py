"""A proposal for models with many effects: these given the arm, the arm by a Student t.

Effects enter nearly linearly: given the zero-offsets, registrations, markers and the noise they
are Gaussian. But where they lie, and how wide, depends on those: a curve of a joint moves a marker
that is further out by more. Where the core (offsets, registrations, markers) is badly determined
this is no small thing, and a Gaussian of all parameters together, or a Student t, has hardly a
draw in the bulk of the posterior. Here only the core and the noise are drawn from a Student t,
which can be adapted to a dozen dimensions; the effects from what the errors say given these.

With steps d of the core and δ of the effects from the mode the errors are, to second order, ::

    e = a(d) - B(d) δ,   a = e0 - J d - ½ d' H d,   B = B0 + Σ u_k ∂B/∂u_k

and δ has the precision P = B' W B + Q and the mean P⁻¹ (B' W a + q), with W the weights of the
noise, Q and q of the priors: sums of Gram matrices that are known before anything is drawn. The
u_k are steps along those principal axes of the core that change B by anything that counts: the
badly determined ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.linearisation import log_determinant
from remaster_ros.calibration.proposal import (
    StudentT,
    folded,
    folded_density,
    tail_density,
    with_tails,
)
from remaster_ros.calibration.surrogate import bent_pairs, second_derivatives
from remaster_ros.types import FloatArray, IntArray

# Tails of the core and the noise.
FREEDOM = 10.0
# Numbers in the Gram matrices, at most: 160 MB, some times that in what is made of them. And in
# the derivatives of all rows.
MOST_ENTRIES = 20_000_000
MOST_DERIVATIVES = 5_000_000
# With more effects a draw takes milliseconds, and where so many are in the model the core is not
# what makes it hard: of 380 effects draws were worth as little as of a Gaussian.
MOST_EFFECTS = 250
# Of the core in the derivatives, in its standard deviations.
STEP = 0.1
# What an axis may change in the logarithm of the effects' volume, and leave out, a standard
# deviation away.
NEGLIGIBLE = 0.1
# The effects of so many parameters cost as much as a density.
EFFECTS_OF_A_DENSITY = 60.0
# Numbers in the matrices of the draws that are made at a time.
BLOCK_ENTRIES = 2_000_000


@dataclass(frozen=True, eq=False)
class ConditionalProposal:
    """Core and noise from a Student t, the effects from their Gaussian given both.

    Attributes
    ----------
    mode
        About which errors are expanded.
    outer
        Of the core's steps from the mode and the noise coordinates, (c + e) dimensions.
    axes
        Steps along the axes that change what the effects do, from the core's steps, (b, c).
    first, second
        The pairs of the core's parameters whose product moves a prediction, (pairs,) each.
    unit
        Standard deviation of each effect given the core at the mode, (m,).
    precision
        Of pairs k <= l of 1 and the steps along axes by error group, in units: what stands on and
        above the diagonal, (error groups, k l, m (m + 1) / 2).
    pull
        Products of the effects' derivatives for each of 1 and these steps with [e0, J, H] by error
        group, (error groups, 1 + b, 1 + c + pairs, m), in units.
    prior
        Gram matrix of the priors: their rows of the effects, (m, f + 1), in units.
    """

    mode: Mode
    outer: StudentT
    axes: FloatArray
    first: IntArray
    second: IntArray
    unit: FloatArray
    precision: FloatArray
    pull: FloatArray
    prior: FloatArray

    # Few draws tell of so few dimensions, and each is dear.
    first_draws = 1000

    @classmethod
    def of(cls, mode: Mode) -> ConditionalProposal | None:
        """Expand about a mode; None where there are no effects, or too many."""
        posterior = mode.linearisation.posterior
        model, free = posterior.model, posterior.free
        c = int(np.sum(free < model.core))
        m = len(free) - c
        if not 0 < m <= MOST_EFFECTS or 3 * len(posterior.rows) * m > MOST_DERIVATIVES:
            return None
        covariance = mode.covariance
        unit = np.diag(mode.linearisation.gram(mode.eta))[c:-1] ** -0.5
        groups = len(posterior.noise_model.error_groups)
        most = int(np.sqrt(MOST_ENTRIES / groups)) // m - 1
        if most < 1:
            return None
        along, axes = _bending(mode, covariance[:c, :c], unit, most)
        lines = 1 + len(axes)
        size = m * lines
        pairs = bent_pairs(model, free)
        first, second = (np.searchsorted(free, [pair[side] for pair in pairs]) for side in (0, 1))

        def joined(rows: Rows, _: slice) -> FloatArray:
            straight = model.jacobian(mode.z, rows)[:, :, free]
            bending = [_changed(mode, rows, axis) for axis in along]
            errors = (rows.target - model.predict(mode.z, rows))[:, :, None]
            bent = second_derivatives(model, mode.z, rows, pairs)
            parts = (straight[:, :, c:], *bending, errors, straight[:, :, :c], bent)
            return np.concatenate(parts, axis=2)

        grams = posterior.noise_model.gram(joined, size + 1 + c + len(pairs))
        prior = mode.linearisation.prior
        of_effects = grams[:, :size, :size].reshape(groups, lines, m, lines, m)
        of_effects = of_effects * unit[:, None, None] * unit
        of_effects += np.transpose(of_effects, (0, 3, 2, 1, 4))
        upper = np.triu_indices(lines)
        above = np.triu_indices(m)
        pairs_of_lines = of_effects[:, upper[0], :, upper[1], :].swapaxes(0, 1)
        precision = pairs_of_lines[:, :, above[0], above[1]]
        precision[:, upper[0] == upper[1]] *= 0.5
        pull = grams[:, :size, size:].reshape(groups, lines, m, -1) * unit[:, None]
        scale = np.zeros((c + len(mode.eta),) * 2)
        scale[:c, :c], scale[c:, c:] = covariance[:c, :c], mode.eta_covariance
        centre = np.concatenate((np.zeros(c), mode.eta))
        return cls(
            mode,
            StudentT(centre, np.asarray(np.linalg.cholesky(scale)), FREEDOM),
            axes,
            first,
            second,
            unit,
            np.ascontiguousarray(precision),
            np.ascontiguousarray(pull.swapaxes(2, 3)),
            unit[:, None] * prior[c:-1],
        )

    @property
    def cost(self) -> float:
        """Of a draw, in evaluations of a density, as measured."""
        return 1.0 + (len(self.unit) / EFFECTS_OF_A_DENSITY) ** 2

    @property
    def dimension(self) -> int:
        """Of what is adapted."""
        return len(self.outer.mean)

    def adapted(self, points: FloatArray, weight: FloatArray) -> ConditionalProposal:
        """Return the proposal with core and noise as weighted points (n, d) have them."""
        return replace(self, outer=StudentT.of(self._outside(points), weight, FREEDOM))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) of the posterior and their log density (count,)."""
        outside = folded(self.outer.sample(count, rng)[0], self._shares)
        m = len(self.unit)
        whitened = with_tails(rng.standard_normal((count, m)), rng)
        inner, log_det = np.empty((count, m)), np.empty(count)
        for part in self._blocks(count):
            half, factor = self._conditional(outside[part])
            right = half + whitened[part]
            inner[part] = [
                dtrtrs(one, row, lower=1, trans=1)[0]
                for one, row in zip(factor, right, strict=True)
            ]
            log_det[part] = log_determinant(factor)
        return self._points(outside, inner), self._density(outside, whitened, log_det)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        outside, c = self._outside(points), self._core
        inner = (points[:, c : c + len(self.unit)] - self._centre[c:]) / self.unit
        whitened, log_det = np.empty_like(inner), np.empty(len(points))
        for part in self._blocks(len(points)):
            half, factor = self._conditional(outside[part])
            whitened[part] = np.einsum('nji,nj->ni', factor, inner[part]) - half
            log_det[part] = log_determinant(factor)
        return self._density(outside, whitened, log_det)

    def _conditional(self, outside: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the Gaussian of the effects: L' mean, (n, m), and L with precision L L'."""
        c, m, n = self._core, len(self.unit), len(outside)
        step, eta = outside[:, :c], outside[:, c:]
        weight = 1.0 / self.mode.linearisation.posterior.variances(eta)
        line = np.concatenate((np.ones((n, 1)), step @ self.axes.T), axis=1)
        upper = np.triu_indices(line.shape[1])
        products = line[:, upper[0]] * line[:, upper[1]]
        factors = (weight[:, :, None] * products[:, None]).reshape(n, -1)
        # Symmetric: what stands below the diagonal is neither computed nor read.
        above = np.triu_indices(m)
        precision = np.zeros((n, m, m))
        packed = factors @ self.precision.reshape(-1, len(above[0]))
        packed += (self.prior[:, c:-1] * self.unit)[above]
        precision.reshape(n, -1)[:, np.ravel_multi_index(above, (m, m))] = packed
        bent = np.concatenate(
            (np.ones((n, 1)), -step, -step[:, self.first] * step[:, self.second]), axis=1
        )
        products = (line[:, :, None] * bent[:, None]).reshape(n, -1)
        factors = (weight[:, :, None] * products[:, None]).reshape(n, -1)
        pull = factors @ self.pull.reshape(-1, m) + self.prior[:, -1] - step @ self.prior[:, :c].T
        # One by one: of many matrices at once NumPy solves none as the triangle it is.
        for one, right in zip(precision, pull, strict=True):
            factor, fails = dpotrf(one.T, lower=1)
            if fails:
                raise np.linalg.LinAlgError('the effects are not determined')
            one[...] = factor
            right[...] = dtrtrs(factor, right, lower=1)[0]
        return pull, precision

    def _density(
        self, outside: FloatArray, whitened: FloatArray, log_det: FloatArray
    ) -> FloatArray:
        """Return the log density (n,) of core and noise, and of effects at whitened places."""
        value = folded_density(self.outer, outside, self._shares)
        value += tail_density(whitened) + log_det
        return value - float(np.sum(np.log(self.unit)))

    def _points(self, outside: FloatArray, inner: FloatArray) -> FloatArray:
        c = self._core
        parameters = np.concatenate((outside[:, :c], inner * self.unit), axis=1) + self._centre
        return np.concatenate((parameters, outside[:, c:]), axis=1)

    def _outside(self, points: FloatArray) -> FloatArray:
        """Return the core's steps and the noise of points (n, d), (n, c + e)."""
        c = self._core
        core = points[:, :c] - self._centre[:c]
        return np.concatenate((core, points[:, c + len(self.unit) :]), axis=1)

    def _blocks(self, count: int) -> list[slice]:
        factors = self.pull.shape[0] * self.pull.shape[1] * self.pull.shape[2]
        size = max(1, BLOCK_ENTRIES // max(factors, len(self.unit) ** 2))
        return [slice(start, start + size) for start in range(0, count, size)]

    @property
    def _core(self) -> int:
        return len(self.outer.mean) - len(self.mode.eta)

    @property
    def _centre(self) -> FloatArray:
        return self.mode.z[self.mode.linearisation.posterior.free]

    @property
    def _shares(self) -> int:
        """Number of noise coordinates that cannot be negative."""
        return len(self.mode.linearisation.posterior.noise_model.shares)


def _bending(
    mode: Mode, covariance: FloatArray, unit: FloatArray, most: int
) -> tuple[FloatArray, FloatArray]:
    """Return the axes of the core along which the effects' derivatives change.

    Parameters
    ----------
    mode
        About which errors are expanded.
    covariance
        Of the core, (c, c).
    unit
        Of each effect, (m,).
    most
        Axes, those that change most.

    Returns
    -------
    along
        One standard deviation of the core along each, (b, c).
    inverse
        From steps of the core to steps along them, (b, c).
    """
    posterior = mode.linearisation.posterior
    noise = posterior.noise(mode.eta)
    width = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(width, width))
    root = np.sqrt(np.maximum(values, np.finfo(float).eps))
    along = (width[:, None] * vectors * root).T
    inverse = (vectors / width[:, None] / root).T
    shares = []
    for axis in along:
        changed = posterior.noise_model.whitened(_changed(mode, posterior.rows, axis), noise)
        norm = np.linalg.norm(changed.reshape(-1, len(unit)), axis=0)
        shares.append(float(norm @ unit))
    order = np.argsort(shares)[::-1][:most]
    kept = order[np.array(shares)[order] > NEGLIGIBLE]
    return along[kept], inverse[kept]


def _changed(mode: Mode, rows: Rows, axis: FloatArray) -> FloatArray:
    """Return how a step of the core (c,) changes the derivative by the effects, (n, 3, m)."""
    posterior = mode.linearisation.posterior
    model, free = posterior.model, posterior.free
    step = np.zeros(model.size)
    step[free[: len(axis)]] = STEP * axis
    ahead, behind = (
        model.jacobian(z, rows)[:, :, free[len(axis) :]] for z in (mode.z + step, mode.z - step)
    )
    difference: FloatArray = (ahead - behind) / (2.0 * STEP)
    return difference
