# SPDX-License-Identifier: Apache-2.0
"""Posterior of the model linearised about a point: Gaussian given the noise.

Its mean and precision follow from a few Gram matrices for any noise. Registrations turn by less
than a degree, so that the linearised posterior is nearly the exact one and serves as the proposal
of the exact sampler.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotri

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.priors import prior_rows
from remaster_ros.types import FloatArray


def linearise(posterior: Posterior, z: FloatArray) -> Linearisation:
    """Posterior with the predictions and priors replaced by their tangents at z (size,)."""
    model, free = posterior.model, posterior.free

    def joined(rows: Rows, _: slice) -> FloatArray:
        # One matrix holds derivative and error: its Gram matrix holds all the products needed.
        errors = rows.target - model.predict(z, rows)
        return np.concatenate((model.jacobian(z, rows)[:, :, free], errors[:, :, None]), axis=2)

    residual, by_z = prior_rows(model, posterior.priors, z)
    rows = np.column_stack((-by_z[:, free], residual))
    return Linearisation(
        posterior, z, posterior.noise_model.gram(joined, len(free) + 1), rows.T @ rows
    )


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Posterior of the model linearised about ``z``: Gaussian given the noise."""

    posterior: Posterior  # The exact posterior
    z: FloatArray  # Pinned parameters, (size,)
    # Gram matrix of [derivative | error] in each error group, (error groups, f+1, f+1)
    grams: FloatArray
    prior: FloatArray  # Gram matrix of the priors, (f+1, f+1)

    def gram(self, eta: FloatArray) -> FloatArray:
        """Gram matrices of [derivative | error], (..., f+1, f+1), for noise coordinates (..., e).

        Each error group is divided by its variance, and the priors' matrix is added.
        """
        return np.tensordot(1.0 / self.posterior.variances(eta), self.grams, axes=1) + self.prior

    def conditional(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gaussian of the f free parameters given the noise, and marginal density of the noise.

        ``eta``: noise coordinates, (..., e). Returns the mean of the free pinned parameters
        (..., f), the lower Cholesky factor of their precision (..., f, f), and the log density
        of the noise coordinates with the parameters integrated out (...). Raises as `whitened`.
        """
        factor, pull, log_marginal = self.whitened(eta)
        step = np.linalg.solve(np.swapaxes(factor, -1, -2), pull[..., None])[..., 0]
        return self.z[self.posterior.free] + step, factor, log_marginal

    def whitened(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Factor L of the precision (..., f, f), L' (mean - z) (..., f), and log density (...).

        ``eta``: noise coordinates, (..., e), whose log density it is, with the parameters
        integrated out. All three follow from one Cholesky factor of the bordered matrix: its
        last row is the vector, its last entry the root of the weighted sum of squares that
        remains at the mean. Raises numpy.linalg.LinAlgError if a parameter has no information.
        """
        posterior = self.posterior
        gram = self.gram(eta)
        f = len(posterior.free)
        # The scale of the parameters (rad, m) and of their information differs by many powers.
        information = np.diagonal(gram, axis1=-2, axis2=-1).copy()
        if not np.all(information[..., :f] > 0.0):
            raise np.linalg.LinAlgError('a parameter without any information')
        # Data without any noise leave nothing, and rounding may leave less than that.
        gram[..., f, f] += 1e-9 + 1e-12 * information[..., f]
        information[..., f] = 1.0
        scale = np.sqrt(information)
        factor = np.linalg.cholesky(gram / (scale[..., :, None] * scale[..., None, :]))
        factor *= scale[..., :, None]
        inner = factor[..., :f, :f]
        log_scale = np.log(posterior.variances(eta)) @ posterior.noise_model.freedom
        log_marginal = (
            posterior.log_noise_prior(eta)
            - 0.5 * (log_scale + factor[..., f, f] ** 2)
            - log_determinant(inner)
        )
        return inner, factor[..., f, :f], log_marginal

    def by_variances(self, eta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Log density of the noise, with gradient and information for each group's log variance.

        One Cholesky factor gives all three; finite differences would need dozens. ``eta``: (e,).
        Returns the log density as in `conditional`; its gradient without the prior of the noise,
        (error groups,); and the average of observed and expected information (Gilmour, Thompson &
        Cullis 1995, Biometrics 51), (error groups, error groups).
        """
        factor, pull, log_marginal = self.whitened(eta)
        root = np.asfortranarray(factor)
        lower, _ = dpotri(root, lower=1)
        # Beside the diagonal twice: products with symmetric matrices are then those of the whole.
        inverse = 2.0 * lower.T
        np.fill_diagonal(inverse, np.diag(lower))
        f = len(pull)
        error = np.append(-solve_triangular(root, pull, lower=True, trans='T'), 1.0)
        trace = np.array([np.vdot(gram[:f, :f], inverse) for gram in self.grams])
        pulls = (self.grams @ error) / self.posterior.variances(eta)[:, None]
        square = pulls @ error
        white_pulls = solve_triangular(root, pulls[:, :f].T, lower=True)
        slope = 0.5 * (square + trace / self.posterior.variances(eta))
        slope -= 0.5 * self.posterior.noise_model.freedom
        return float(log_marginal), slope, 0.5 * (np.diag(square) - white_pulls.T @ white_pulls)


def log_determinant(factor: FloatArray) -> FloatArray:
    """Log determinants (...) of triangular factors (..., f, f) with positive diagonals."""
    return np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
