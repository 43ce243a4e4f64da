# SPDX-License-Identifier: Apache-2.0
"""The best possible test: it is given the noise, and the effect to look for.

It uses the rows to fit without the gross errors, the noise's true covariance, and the effect's
true response. What registration, offsets and marker can take up does not count, as no
method can detect it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2
from worlds.hidden_world import HiddenTruth, HiddenWorld

from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.types import FloatArray


class Oracle:
    """Whitened least squares on the rows to fit.

    Parameters
    ----------
    world, truth
        Of one session.
    """

    def __init__(self, world: HiddenWorld, truth: HiddenTruth) -> None:
        self.world = world
        use = ~world.visits.is_validation[world.configuration]
        use[truth.outliers] = False
        self._rows = rows = np.flatnonzero(use)
        pose = world.visits.pose[world.configuration]
        together = (pose[rows, None] == pose[rows]) & (
            world.sensor[rows, None] == world.sensor[rows]
        )
        # The axes err independently: one triangular factor each.
        self._factors = []
        for axis in range(3):
            common = truth.pose_std[rows, axis]
            covariance = together * np.outer(common, common)
            covariance[np.diag_indices(len(rows))] += truth.std[rows, axis] ** 2
            self._factors.append(np.linalg.cholesky(covariance))
        nuisance = self._whitened(world.nuisance)
        # The nominal markers are known to some extent: rows of their own.
        first = nuisance.shape[1] - 3 * len(world.markers)
        prior = np.eye(nuisance.shape[1])[first:] / world.marker_std_m
        basis, singular, _ = np.linalg.svd(np.concatenate((nuisance, prior)), full_matrices=False)
        self._basis = basis[:, singular > 1e-9 * singular[0]]

    def information(self, effect: HiddenEffect, *alternatives: HiddenEffect) -> float:
        """Noncentrality λ: what is left of the effect in units of the noise, squared and summed.

        Parameters
        ----------
        effect
            Of its true size.
        alternatives
            What may explain it instead, each of any size.
        """
        residual = self._remainder(self.world.response(effect)[..., None])[:, 0]
        if alternatives:
            rivals = np.stack([self.world.response(other) for other in alternatives], axis=-1)
            rivals = self._remainder(rivals)
            rivals = rivals / np.maximum(np.linalg.norm(rivals, axis=0), 1e-30)
            residual = residual - rivals @ np.linalg.lstsq(rivals, residual, rcond=1e-9)[0]
        return float(residual @ residual)

    def chi_square(self, effect: HiddenEffect, errors: FloatArray) -> float:
        """Likelihood-ratio statistic of an effect of one value, for errors (n, 3) of all rows."""
        residual = self._remainder(self.world.response(effect)[..., None])[:, 0]
        return float(
            (residual @ self._remainder(errors[..., None])[:, 0]) ** 2 / (residual @ residual)
        )

    def size_for_power(
        self, effect: HiddenEffect, power: float = 0.9, false_alarms: float = 0.02
    ) -> float:
        """Size at which the test finds the effect that often, as a multiple of its size now.

        A likelihood-ratio test of all values of the effect at once: chi-square, which under the
        effect has the noncentrality λ.
        """
        values = int(np.count_nonzero(effect.values))
        threshold = chi2.isf(false_alarms, values)
        needed = brentq(lambda x: ncx2.sf(threshold, values, x) - power, 1e-3, 1e3)
        return float(np.sqrt(needed / self.information(effect)))

    def _whitened(self, columns: FloatArray) -> FloatArray:
        """Whiten (n, 3, p) of all rows: (3 m, p) of the used ones."""
        used = columns[self._rows]
        return np.concatenate(
            [solve_triangular(f, used[:, a], lower=True) for a, f in enumerate(self._factors)]
        )

    def _remainder(self, columns: FloatArray) -> FloatArray:
        """Whiten (n, 3, p) and take out what the nuisance can take up."""
        white = self._whitened(columns)
        white = np.concatenate((white, np.zeros((3 * len(self.world.markers), white.shape[1]))))
        return white - self._basis @ (self._basis.T @ white)
