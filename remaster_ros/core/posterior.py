"""The exact log density of parameters and noise given the data.

Noise model: the error of a row is independent per point and axis with standard deviation sigma,
plus a part that all rows of one sensor at one pose share, with standard deviation pose_sigma per
axis. With the error's group means m_g and sizes n_g, the likelihood of a sensor is::

    N(deviations from m_g | 0, sigma^2)  x  prod_g N(m_g | 0, pose_sigma^2 + sigma^2 / n_g)

Where a sensor has one row at every pose the two cannot be told apart: sigma is then their sum, and
there is no pose_sigma.

Priors: flat in log sigma, which is the paper's p(sigma^2) ∝ sigma^-2 d(sigma^2) (eq. 14), down to
the resolution no sensor passes (`RESOLUTION_M`); pose_sigma / sigma half-Cauchy with scale 1,
proper at zero and without a unit (Gelman 2006); registrations flat in the turn and shift of the
pinned coordinates of `model`; inner joint offsets flat; markers and base frames Gaussian where
something is known of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.core.model import Model, Rows
from remaster_ros.core.transforms import matrix_from_quaternion_xyzw, matrix_to_rotation_vector
from remaster_ros.core.types import BasePrior, FloatArray, IntArray

# No sensor of this kind resolves better than 0.1 µm; keeps noise-free (simulated) data proper.
RESOLUTION_M = 1e-7
# A prior std of 0 in a session means "as good as known": a micrometre, a microradian.
TIGHTEST_PRIOR = 1e-6
# Forward kinematics of one block of draws; larger blocks fall out of the processor's cache.
BLOCK_ROWS = 40_000


@dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian prior as a function of the natural parameters.

    Attributes
    ----------
    description
        How the report names it: 'the prior on marker sir, 0.5 mm per axis'.
    residual
        Natural parameters (..., size) to whitened residuals (..., m), standard normal a priori.
    """

    description: str
    residual: Callable[[FloatArray], FloatArray]


def marker_prior(model: Model, marker: int, nominal: FloatArray, std_m: float) -> Prior:
    """Return what is known of a marker before: near its nominal place, std_m per axis."""
    where = model.marker(marker)
    width = max(std_m, TIGHTEST_PRIOR)
    return Prior(
        f'the prior on marker {model.marker_names[marker]}, {std_m * 1e3:g} mm per axis',
        lambda x: (x[..., where] - nominal) / width,
    )


def base_prior(model: Model, sensor: int, prior: BasePrior) -> Prior:
    """Return what is known of a sensor's registration T_R_N before."""
    known = matrix_from_quaternion_xyzw(prior.rotation_xyzw)
    widths = max(prior.std_m, TIGHTEST_PRIOR), max(prior.std_rad, TIGHTEST_PRIOR)

    def residual(x: FloatArray) -> FloatArray:
        T_R_N = model.T_R_N(x)[..., sensor, :, :]
        shift = (T_R_N[..., :3, 3] - prior.translation_m) / widths[0]
        turn = matrix_to_rotation_vector(T_R_N[..., :3, :3] @ known.T) / widths[1]
        return np.concatenate((shift, turn), axis=-1)

    return Prior(f'the prior on the base frame of {model.sensor_names[sensor]}', residual)


def prior_rows(
    model: Model, priors: Sequence[Prior], z: FloatArray, *, natural: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (m,) of all priors and their derivative (m, size) at z.

    Numerical differences: the priors are smooth, few, and written as plain functions. ``natural``
    says that z and the derivative are in natural, not in pinned coordinates.
    """
    # Priors are on the core; theta's is linear, so differences would only cost.
    step, core = 1e-6 * np.eye(model.core, model.size), model.core
    points = np.concatenate((z[None], z + step, z - step))
    x = points if natural else model.natural(points)
    values = np.concatenate(
        [np.zeros((len(x), 0)), *(prior.residual(x) for prior in priors)], axis=-1
    )
    by_z = np.zeros((values.shape[1], model.size))
    by_z[:, :core] = (values[1 : core + 1] - values[core + 1 :]).T / 2e-6
    root = extension_root(model)
    by_theta = np.concatenate((np.zeros((len(root), core)), root), axis=1)
    return (
        np.concatenate((values[0], root @ model.theta(z))),
        np.concatenate((by_z, by_theta)),
    )


def extension_root(model: Model) -> FloatArray:
    """Return W with W theta standard normal by the extension's prior, (rank, m)."""
    if model.extension is None:
        return np.zeros((0, 0))
    values, vectors = np.linalg.eigh(model.extension.prior_precision)
    kept = values > 1e-12 * max(values.max(initial=0.0), 0.0)
    root: FloatArray = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    return root


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the optimization rows say about the free parameters and the noise.

    A point is a flat vector (d,): the free pinned parameters, then the noise coordinates eta:
    log sigma of every sensor, and asinh(pose_sigma / sigma) >= 0 of the sensors where it can be
    told apart. The latter is as good as linear near zero and as a logarithm far from it, so the
    posterior looks alike whether pose_sigma is nothing or nearly all; its prior is sech.

    Attributes
    ----------
    model, rows, priors
        What is fitted, to which rows, and what is known beforehand.
    free
        Indices of the parameters that are not held, (f,).
    reference
        Pinned parameters; those not in ``free`` keep these values, (size,).
    separable
        Sensor indices with a pose_sigma of their own, ascending.
    """

    model: Model
    rows: Rows
    priors: tuple[Prior, ...]
    free: IntArray
    reference: FloatArray
    separable: tuple[int, ...]

    @classmethod
    def of(
        cls,
        model: Model,
        rows: Rows,
        priors: Sequence[Prior],
        free: IntArray,
        reference: FloatArray,
    ) -> Posterior:
        """Assemble; find out for which sensors the pose-common part can be told apart."""
        several = np.unique(rows.group_sensor[rows.group_size > 1])
        return cls(model, rows, tuple(priors), free, reference, tuple(int(s) for s in several))

    @property
    def noises(self) -> int:
        """Number of noise parameters."""
        return len(self.model.sensor_names) + len(self.separable)

    @property
    def size(self) -> int:
        """Length of a point."""
        return len(self.free) + self.noises

    def parameters(self, points: FloatArray) -> FloatArray:
        """Return the full pinned parameters (..., size of the model) of points (..., d)."""
        z = np.broadcast_to(self.reference, (*points.shape[:-1], self.model.size)).copy()
        z[..., self.free] = points[..., : len(self.free)]
        return z

    def noise(self, eta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and pose_sigma of each sensor, m, (..., sensors) each.

        pose_sigma is zero for the sensors where it cannot be told apart.
        """
        sensors = len(self.model.sensor_names)
        sigma = np.exp(eta[..., :sensors])
        pose_sigma = np.zeros_like(sigma)
        separable = list(self.separable)
        pose_sigma[..., separable] = sigma[..., separable] * np.sinh(np.abs(eta[..., sensors:]))
        return sigma, pose_sigma

    def log_noise_prior(self, eta: FloatArray) -> FloatArray:
        """Return the log prior density of the noise coordinates (..., e), (...)."""
        sensors = len(self.model.sensor_names)
        # A half-normal wall at the resolution instead of a jump: as good as one pseudo-reading.
        wall = 0.5 * np.sum((RESOLUTION_M * np.exp(-eta[..., :sensors])) ** 2, axis=-1)
        # The half-Cauchy of the ratio, times the derivative of the ratio by its coordinate.
        ratio = eta[..., sensors:]
        return -wall - np.sum(np.logaddexp(ratio, -ratio), axis=-1)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the log posterior density up to a constant.

        Parameters
        ----------
        points
            (..., d).

        Returns
        -------
        ndarray
            (...).
        """
        flat = points.reshape(-1, points.shape[-1])
        block = max(1, BLOCK_ROWS // len(self.rows))
        parts = [self._log_density(flat[i : i + block]) for i in range(0, len(flat), block)]
        return np.concatenate(parts).reshape(points.shape[:-1])

    def _log_density(self, points: FloatArray) -> FloatArray:
        z = self.parameters(points)
        eta = points[..., len(self.free) :]
        errors = self.rows.target - self.model.predict(z, self.rows)
        square, mean_square = self.sums_of_squares(errors)
        value = self.log_likelihood(square, mean_square, eta) + self.log_noise_prior(eta)
        if self.priors:
            x = self.model.natural(z)
            for prior in self.priors:
                value -= 0.5 * np.sum(prior.residual(x) ** 2, axis=-1)
        if self.model.extension is not None:
            theta = self.model.theta(z)
            value -= 0.5 * np.sum((theta @ self.model.extension.prior_precision) * theta, axis=-1)
        inside = np.all(eta[..., len(self.model.sensor_names) :] >= 0.0, axis=-1)
        return np.where(inside, value, -np.inf)

    def sums_of_squares(self, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return per group the sum of squares within and the square of the mean.

        Parameters
        ----------
        errors
            m, (..., n, 3).

        Returns
        -------
        within, mean_square
            m², (..., groups) each; ``within`` is about the group's mean.
        """
        size = self.rows.group_size
        mean = self.rows.group_sum(errors, axis=-2) / size[:, None]
        mean_square = np.einsum('...gi,...gi->...g', mean, mean)
        square = self.rows.group_sum(np.einsum('...ni,...ni->...n', errors, errors), axis=-1)
        # Cancellation may leave a group of one a hair below zero.
        return np.maximum(square - size * mean_square, 0.0), mean_square

    def log_likelihood(
        self, within: FloatArray, mean_square: FloatArray, eta: FloatArray
    ) -> FloatArray:
        """Return the log likelihood of errors with these sums of squares, (...)."""
        sigma, pose_sigma = self.noise(eta)
        size, sensor = self.rows.group_size, self.rows.group_sensor
        variance = sigma[..., sensor] ** 2
        total = variance + size * pose_sigma[..., sensor] ** 2
        return -0.5 * np.sum(
            3.0 * ((size - 1) * np.log(variance) + np.log(total))
            + within / variance
            + size * mean_square / total,
            axis=-1,
        )
