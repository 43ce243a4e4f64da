# SPDX-License-Identifier: Apache-2.0
"""Residuals while a session is measured: how far the markers are from where the model has them.

A look beside the session, not a part of it: every reading since the arm has settled counts as it
came, and the registration is that of least squares over all configurations so far. What is
recorded is decided by the recorder, and what is fitted by the fit.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.calibration.registration import register_points
from remaster_ros.errors import RemasterError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray

FEWEST = 5
"""Points before residuals are stated: three of them fit any registration well."""
MOST = 2000
"""Points of a sensor that are kept; the first ones are dropped beyond."""


class LiveResiduals:
    """Pairs where the arm has settled with the mean of what each sensor reads there.

    Parameters
    ----------
    chain
        The arm.
    markers
        Sensor -> its markers -> their positions in the tool frame, m, (3,).
    """

    def __init__(
        self, chain: SerialChain, markers: Mapping[str, Mapping[str, FloatArray]]
    ) -> None:
        self._chain = chain
        self._markers = {name: dict(places) for name, places in markers.items()}
        self._offsets: FloatArray | None = None
        self._q: FloatArray | None = None
        # Of each sensor and marker the sum of the readings, and their number.
        self._sums = {(name, marker): np.zeros(4) for name in markers for marker in markers[name]}
        # Configuration, marker, where it was read.
        self._pairs: dict[str, list[tuple[FloatArray, str, FloatArray]]] = {
            name: [] for name in markers
        }
        # How many of them, the first ones, are of the registration.
        self._registering = dict.fromkeys(markers, 0)
        self._found: dict[str, tuple[FloatArray, FloatArray]] = {}

    def settled(self, q: FloatArray) -> None:
        """Begin at a configuration, rad, (k,); readings before this do not count."""
        self._q = q
        for total in self._sums.values():
            total[:] = 0.0

    def reading(self, sensor: str, marker: str, position_N: FloatArray) -> None:
        """Take a reading of a marker in the sensor's frame, m, (3,); NaN while it is hidden."""
        if self._q is not None and np.all(np.isfinite(position_N)):
            self._sums[sensor, marker] += [*position_N, 1.0]

    def ended(self, *, recorded: bool, registering: bool = False) -> None:
        """End a configuration, of the registration or not; it counts where it was recorded."""
        if self._q is not None and recorded:
            for (name, marker), total in self._sums.items():
                if total[3]:
                    self._pairs[name].append((self._q, marker, total[:3] / total[3]))
                    self._registering[name] += registering
                    gone = len(self._pairs[name][:-MOST])
                    self._registering[name] = max(0, self._registering[name] - gone)
                    del self._pairs[name][:-MOST]
                    self._found.pop(name, None)
        self._q = None

    def use_offsets(self, joint_offsets: FloatArray) -> None:
        """State residuals of the arm with these zero-offsets from now on, rad, (k,)."""
        self._offsets = joint_offsets
        self._found.clear()

    def use_markers(self, markers: Mapping[str, FloatArray]) -> None:
        """Take markers as they were fitted from now on, marker -> m, (3,)."""
        for places in self._markers.values():
            places.update({name: markers[name] for name in places if name in markers})
        self._found.clear()

    @property
    def corrected(self) -> bool:
        """Whether the residuals are those with fitted zero-offsets."""
        return self._offsets is not None

    def norms_m(self, sensor: str) -> FloatArray:
        """Return the length of each residual, m, (n,); n = 0 for too few."""
        return self._fitted(sensor)[0]

    def of_registration(self, sensor: str) -> int:
        """Return the number of residuals of registration poses, which come first."""
        return self._registering[sensor]

    def points_R(self, sensor: str) -> FloatArray:
        """Return the measured points in the robot base, m, (n, 3); n = 0 for too few."""
        return self._fitted(sensor)[1]

    def _fitted(self, sensor: str) -> tuple[FloatArray, FloatArray]:
        if sensor not in self._found:
            self._found[sensor] = self._fit(sensor)
        return self._found[sensor]

    def _fit(self, sensor: str) -> tuple[FloatArray, FloatArray]:
        pairs = self._pairs[sensor]
        nothing = np.empty(0), np.empty((0, 3))
        if len(pairs) < FEWEST:
            return nothing
        q, markers, points = zip(*pairs, strict=True)
        places, read = (
            np.array([self._markers[sensor][name] for name in markers]),
            np.array(points),
        )
        expected = self._chain.positions(np.array(q), places, self._offsets)
        try:
            T_R_N, _ = register_points(expected, read)
        except RemasterError:
            return nothing
        measured = apply(T_R_N, read)
        return np.linalg.norm(measured - expected, axis=1), measured
