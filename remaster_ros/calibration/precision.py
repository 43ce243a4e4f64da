# SPDX-License-Identifier: Apache-2.0
"""Precision of the offsets and of the tool after a fit, and the number of data that would suffice.

Given the noise the parameters are Gaussian (`laplace`). Their covariance is that over the draws of
the noise: the mean of the covariances, and the covariance of the means. With few observations the
noise itself is uncertain, and the standard deviation at its most probable value is too small: by
that value a collection would end early if the noise happens to look small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.proposal import NOISE_FREEDOM, StudentT
from remaster_ros.types import BoolArray, FloatArray

NOISE_DRAWS = 256
"""Number of draws of the noise, for standard deviations to about 1 %."""
MOST_TIMES = 1e4
"""Largest factor on the data at hand that a collection asks for."""


@dataclass(frozen=True, eq=False)
class NoiseMixture:
    """Posterior of the f free parameters as a mixture of Gaussians over n draws of the noise."""

    weight: FloatArray  # With sum 1, (n,)
    mean: FloatArray  # Free pinned parameters, (n, f)
    covariance: FloatArray  # (n, f, f)

    @classmethod
    def of(cls, mode: Mode, rng: np.random.Generator) -> NoiseMixture:
        """Mixture over 256 draws of the noise (`NOISE_DRAWS`) about a mode.

        The weights are the density of the noise with the parameters integrated out, over that of
        the draws.
        """
        # That density is the same for a negative ratio of the noises: no draw is mirrored.
        factor = np.asarray(np.linalg.cholesky(mode.eta_covariance))
        eta, drawn = StudentT(mode.eta, factor, NOISE_FREEDOM).sample(NOISE_DRAWS, rng)
        mean, precision, log_marginal = mode.linearisation.conditional(eta)
        weight = np.exp(log_marginal - drawn - np.max(log_marginal - drawn))
        root = np.linalg.inv(precision)
        return cls(weight / weight.sum(), mean, np.swapaxes(root, -1, -2) @ root)

    @property
    def total(self) -> FloatArray:
        """Covariance of the free parameters, (f, f)."""
        deviation = self.mean - self.weight @ self.mean
        within: FloatArray = np.einsum('n,nij->ij', self.weight, self.covariance)
        return within + (deviation * self.weight[:, None]).T @ deviation


@dataclass(frozen=True, eq=False)
class Precision:
    """Covariance of the f free parameters of a fit, with the errors of offsets and tool."""

    # Index of each joint among the free parameters, (k,); -1 if it is not identifiable
    joints: tuple[int, ...]
    covariance: FloatArray  # The noise integrated out, (f, f)
    # Mean of J'J over the counted predicted markers, m² per unit, (f, f); None without markers
    tool: FloatArray | None
    prior: FloatArray  # Information of the priors, (f, f)
    freedom: int  # Number of measured coordinates less that of free parameters
    per_radian: FloatArray  # Of `SerialChain`, (k,)

    @classmethod
    def of(cls, found: Estimate, counting: BoolArray, rng: np.random.Generator) -> Precision:
        """Precision of a fit.

        ``counting``: rows of the session's measurements, fitted or not, at which the tool's error
        counts, (n,); ``rng``: for the draws of the noise.
        """
        posterior, free = found.posterior, found.posterior.free
        place = {int(index): i for i, index in enumerate(free)}
        tool = None
        if counting.any():
            model = found.model
            rows = Rows.of(found.problem.measurements, np.flatnonzero(counting), model.reference)
            by_z = model.jacobian(found.mode.z, rows)[:, :, free]
            tool = np.einsum('nij,nik->jk', by_z, by_z) / len(rows)
        return cls(
            tuple(
                -1 if why else place.get(joint, -1) for joint, why in enumerate(found.gauge.why)
            ),
            NoiseMixture.of(found.mode, rng).total,
            tool,
            found.mode.linearisation.prior[:-1, :-1],
            int(posterior.noise_model.freedom.sum()) - len(free),
            found.problem.chain.per_radian,
        )

    @property
    def parameters(self) -> int:
        """Number of free parameters f."""
        return len(self.covariance)

    @property
    def joint_std(self) -> tuple[float | None, ...]:
        """Standard deviation of each joint's offset, rad or m, k values.

        None if not identifiable.
        """
        std = np.sqrt(np.diag(self.covariance))
        return tuple(float(std[i]) if i >= 0 else None for i in self.joints)

    @property
    def joint_rms(self) -> float:
        """Root mean square of the standard deviations of identifiable joints, rad.

        Infinite without any. That of a joint that slides is divided by `SerialChain.per_radian`.
        """
        return self._joint_rms(self.covariance)

    @property
    def tool_rms(self) -> float:
        """Root mean square of the 3-D error of the predicted markers by the parameters, m.

        Over the counted rows; infinite without any.
        """
        return self._tool_rms(self.covariance)

    def _joint_rms(self, covariance: FloatArray) -> float:
        """Root mean square of joints' std by a covariance (f, f), rad; infinite without any.

        Only identifiable joints count.
        """
        variances = [
            covariance[i, i] / unit**2
            for i, unit in zip(self.joints, self.per_radian, strict=True)
            if i >= 0
        ]
        return float(np.sqrt(np.mean(variances))) if variances else np.inf

    def _tool_rms(self, covariance: FloatArray) -> float:
        """Root mean square of the markers' error by a covariance (f, f), m; inf without any."""
        return np.inf if self.tool is None else float(np.sqrt(np.sum(covariance * self.tool)))

    def shortfall(self, joint_std: float | None, tool_std: float | None) -> float:
        """Largest ratio of a standard deviation to the wanted one; 0 if none is wanted.

        ``joint_std, tool_std``: wanted `joint_rms`, rad, and `tool_rms`, m; None if it does not
        matter.
        """
        return self._shortfall(self.covariance, joint_std, tool_std)

    def _shortfall(
        self, covariance: FloatArray, joint_std: float | None, tool_std: float | None
    ) -> float:
        """Largest ratio of std to wanted std by a covariance (f, f); 0 if none is wanted.

        ``joint_std``: wanted RMS of the offsets; ``tool_std``: of the markers' error, m; None for
        no wish.
        """
        joints = 0.0 if joint_std is None else self._joint_rms(covariance) / joint_std
        tool = 0.0 if tool_std is None else self._tool_rms(covariance) / tool_std
        return max(joints, tool)

    def times_the_data(self, joint_std: float | None, tool_std: float | None) -> float:
        """Factor on the data with which the wanted precision is reached; 1 if it is reached.

        Infinite if 10,000 times the data (`MOST_TIMES`) do not reach it. Further configurations
        are assumed to be as informative as the present ones on average. ``joint_std, tool_std``:
        as of `shortfall`.
        """
        information = np.linalg.inv(self.covariance)
        data = information - self.prior

        def excess(log_times: float) -> float:
            covariance = np.linalg.inv(np.exp(log_times) * data + self.prior)
            return self._shortfall(covariance, joint_std, tool_std) - 1.0

        if excess(0.0) <= 0.0:
            return 1.0
        most = float(np.log(MOST_TIMES))
        if excess(most) > 0.0:
            return np.inf
        return float(np.exp(scipy.optimize.brentq(excess, 0.0, most, xtol=1e-4)))
