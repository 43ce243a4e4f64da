# SPDX-License-Identifier: Apache-2.0
"""Exact log density of parameters and noise given the data.

The noise is that of `noise`. Priors: flat in log sigma, which is the paper's p(sigma^2) ∝ sigma^-2
d(sigma^2) (eq. 14), down to the resolution that no sensor exceeds (`RESOLUTION_M`); pose_sigma /
sigma and frame_sigma / sigma half-Cauchy with scale 1, proper at zero and without a unit (Gelman
2006); registrations flat in the rotation and shift of the pinned coordinates of `model`; inner
joint offsets Gaussian about 0 with `priors.OFFSET_STD`, if nothing else is known; markers and base
frames Gaussian if something is known of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.noise import RESOLUTION_M, Noise, NoiseModel
from remaster_ros.calibration.priors import Prior
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Number of forward kinematics in one block of draws; larger blocks exceed the processor's cache.
BLOCK_ROWS = 40_000


@dataclass(frozen=True, eq=False)
class Posterior:
    """Density of the free parameters and the noise, given the optimization rows.

    A point is a flat vector (d,): the free pinned parameters, then the noise coordinates eta: log
    sigma of every channel, and asinh(pose_sigma / sigma) >= 0 of the channels with a pose_sigma,
    then asinh(frame_sigma / sigma) likewise. These are nearly linear near zero and logarithmic far
    from it, so that the posterior has the same shape for any pose_sigma; their prior is sech.
    """

    # Model that is fitted, and the prior knowledge
    model: Model
    priors: tuple[Prior, ...]
    free: IntArray  # Indices of the parameters that are not held, (f,)
    reference: FloatArray  # Pinned parameters; those not in ``free`` keep these values, (size,)
    # Fitted rows with the variances of their errors
    noise_model: NoiseModel

    @classmethod
    def of(
        cls,
        model: Model,
        rows: Rows,
        priors: Sequence[Prior],
        free: IntArray,
        reference: FloatArray,
        split: Sequence[int] = (),
    ) -> Posterior:
        """Posterior of a model by n rows and priors.

        ``free``: indices of the parameters that are not held, (f,); ``reference``: pinned
        parameters near the mode, (size,); ``split``: sensors with separate noise along and across
        their line of sight. A channel of a sensor with several frames at some pose has a
        pose_sigma, one with several markers in some frame a frame_sigma.
        """
        noise_model = NoiseModel.of(rows, model.reference, split)
        return cls(model, tuple(priors), free, reference, noise_model)

    @property
    def rows(self) -> Rows:
        """Fitted rows."""
        return self.noise_model.rows

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names of the sensors, then '<sensor>.orientation' of those that measure orientations."""
        names = self.model.sensor_names
        return (*names, *(f'{names[sensor]}.orientation' for sensor in self.rows.turning))

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free parameters, f."""
        return tuple(self.model.names[index] for index in self.free)

    def with_independent_rows(self) -> Posterior:
        """Posterior under noise that is independent between all rows: no pose or frame parts."""
        return replace(self, noise_model=replace(self.noise_model, separable=(), framed=()))

    @property
    def size(self) -> int:
        """Length d of a point: free parameters, then noise coordinates."""
        noise = self.noise_model
        return len(self.free) + len(noise.channels) + len(noise.shares)

    def parameters(self, points: FloatArray) -> FloatArray:
        """Pinned parameters (..., size of the model) of points (..., d), with the held ones."""
        z = np.broadcast_to(self.reference, (*points.shape[:-1], self.model.size)).copy()
        z[..., self.free] = points[..., : len(self.free)]
        return z

    def noise(self, eta: FloatArray) -> Noise:
        """Noise of each channel, m, of noise coordinates (..., e)."""
        count = len(self.noise_model.channels)
        sigma = np.exp(eta[..., :count])
        shared = sigma[..., self.noise_model.shares] * np.sinh(np.abs(eta[..., count:]))
        return self.noise_model.noise(sigma, shared)

    def variances(self, eta: FloatArray) -> FloatArray:
        """Variance of each error group, m², (..., error groups)."""
        return self.noise_model.variances(self.noise(eta))

    def log_noise_prior(self, eta: FloatArray) -> FloatArray:
        """Log prior density (...) of noise coordinates (..., e), up to a constant.

        Flat in log sigma above the sensors' resolution; half-Cauchy in the ratios of the common
        parts.
        """
        count = len(self.noise_model.channels)
        # A half-normal wall at the resolution instead of a jump: as good as one pseudo-reading.
        wall = 0.5 * np.sum((RESOLUTION_M * np.exp(-eta[..., :count])) ** 2, axis=-1)
        # The half-Cauchy of each ratio, times the derivative of the ratio by its coordinate.
        ratio = eta[..., count:]
        return -wall - np.sum(np.logaddexp(ratio, -ratio), axis=-1)

    def inside(self, points: FloatArray) -> BoolArray:
        """Whether no pose_sigma or frame_sigma is negative, (...), of points (..., d)."""
        ratios = points[..., len(self.free) + len(self.noise_model.channels) :]
        return np.all(ratios >= 0.0, axis=-1)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Log posterior density (...) of points (..., d), up to a constant; -inf outside.

        Computed in blocks of draws, so that memory does not grow with their number.
        """
        flat = points.reshape(-1, points.shape[-1])
        block = max(1, BLOCK_ROWS // len(self.rows))
        parts = [self._log_density(flat[i : i + block]) for i in range(0, len(flat), block)]
        return np.concatenate(parts).reshape(points.shape[:-1])

    def _log_density(self, points: FloatArray) -> FloatArray:
        """Log posterior density of points (..., d), up to a constant; -inf outside the bounds."""
        z = self.parameters(points)
        eta = points[..., len(self.free) :]
        errors = self.rows.target - self.model.predict(z, self.rows)
        variances = self.variances(eta)
        value = self.log_noise_prior(eta) - 0.5 * np.sum(
            self.noise_model.freedom * np.log(variances)
            + self.noise_model.sums_of_squares(errors) / variances,
            axis=-1,
        )
        if self.priors:
            x = self.model.natural(z)
            for prior in self.priors:
                value -= 0.5 * np.sum(prior.residual(x) ** 2, axis=-1)
        if self.model.extension is not None:
            theta = self.model.theta(z)
            value -= 0.5 * np.sum((theta @ self.model.extension.prior_precision) * theta, axis=-1)
        return np.where(self.inside(points), value, -np.inf)
