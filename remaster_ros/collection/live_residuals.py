# SPDX-License-Identifier: Apache-2.0
"""Residuals during the measurement of a session: distances of the markers from the model.

These residuals are for display and not a part of the session: every reading since the arm has
settled counts as received, and the registration is by least squares over all configurations so
far. The recorder decides on the recorded rows, and the fit on the fitted ones.
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
"""Fewest points for residuals: three points fit any registration well."""
MOST = 2000
"""Largest number of points of a sensor; of more the first ones are dropped."""


class LiveResiduals:
    """Residuals of the markers' positions during a collection, for display.

    They are of pairs of a settled configuration and the mean of each sensor's readings there.

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
        # Sum of the readings of each sensor and marker, and their number.
        self._sums = {(name, marker): np.zeros(4) for name in markers for marker in markers[name]}
        # Configuration, marker, and mean reading.
        self._pairs: dict[str, list[tuple[FloatArray, str, FloatArray]]] = {
            name: [] for name in markers
        }
        # Number of first pairs that are of the registration.
        self._registering = dict.fromkeys(markers, 0)
        self._found: dict[str, tuple[FloatArray, FloatArray]] = {}

    def settled(self, q: FloatArray) -> None:
        """Begin at a configuration, rad, (k,); earlier readings do not count."""
        self._q = q
        for total in self._sums.values():
            total[:] = 0.0

    def reading(self, sensor: str, marker: str, position_N: FloatArray) -> None:
        """Add a reading of a marker in the sensor's frame, m, (3,); NaN while it is hidden.

        Nothing if it is not finite, or no configuration is open. Raises KeyError for an unknown
        marker. The mean of a configuration's readings counts, once it was recorded.
        """
        if self._q is not None and np.all(np.isfinite(position_N)):
            self._sums[sensor, marker] += [*position_N, 1.0]

    def ended(self, *, recorded: bool, registering: bool = False) -> None:
        """End the open configuration; its mean readings count if it was recorded.

        ``registering``: whether it is of the registration. Nothing if none is open.
        """
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
        """Use these joint zero-offsets for all residuals from now on, rad, (k,)."""
        self._offsets = joint_offsets
        self._found.clear()

    def use_markers(self, markers: Mapping[str, FloatArray]) -> None:
        """Use these fitted marker positions from now on, by name, m, (3,) each.

        Names that no sensor has are ignored; markers that are not given keep their positions.
        """
        for places in self._markers.values():
            places.update({name: markers[name] for name in places if name in markers})
        self._found.clear()

    @property
    def corrected(self) -> bool:
        """Whether the residuals are those with fitted zero-offsets."""
        return self._offsets is not None

    def norms_m(self, sensor: str) -> FloatArray:
        """Length of each residual, m, (n,), in order; n = 0 with fewer than `FEWEST` points.

        The order is that of recording; n = 0 also if the points do not register the sensor. Raises
        KeyError for an unknown sensor.
        """
        return self._fitted(sensor)[0]

    def of_registration(self, sensor: str) -> int:
        """Number of residuals of registration poses, which come first.

        Counted also while there are too few points for residuals. Raises KeyError for an unknown
        sensor.
        """
        return self._registering[sensor]

    def points_R(self, sensor: str) -> FloatArray:
        """Measured points in the robot base frame, m, (n, 3); n = 0 with fewer than `FEWEST`.

        In the order of `norms_m`; n = 0 also if they do not register the sensor. Raises
        KeyError for an unknown sensor.
        """
        return self._fitted(sensor)[1]

    def _fitted(self, sensor: str) -> tuple[FloatArray, FloatArray]:
        """Result of `_fit`, computed anew only after pairs, markers or offsets have changed."""
        if sensor not in self._found:
            self._found[sensor] = self._fit(sensor)
        return self._found[sensor]

    def _fit(self, sensor: str) -> tuple[FloatArray, FloatArray]:
        """Residual lengths of a sensor, m, (n,), and its points in the robot base, m, (n, 3).

        By the registration that fits all its pairs. Both are empty (n = 0) with fewer than
        `FEWEST` pairs, or if these do not register the sensor.
        """
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
