"""First registration of the sensors: by three points each, refined by those that follow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from remaster_ros.calibration.registration import register_ransac
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

POINTS = 3


class FirstRegistration:
    """Collect points of each sensor; from the third on they give T_R_N.

    Parameters
    ----------
    chain
        The arm.
    markers
        Marker positions in the tool frame, m, (3,), by name.
    sensors
        Their names.
    allowed_m
        A point that is off by more is not used, m.

    Attributes
    ----------
    T_R_N
        What is registered: sensor -> (4, 4).
    troubles
        Why the points of a sensor register nothing: sensor -> message.
    """

    def __init__(
        self,
        chain: SerialChain,
        markers: Mapping[str, FloatArray],
        sensors: Iterable[str],
        allowed_m: float,
    ) -> None:
        self._chain, self._markers, self._allowed_m = chain, markers, allowed_m
        self._points: dict[str, list[tuple[FloatArray, FloatArray]]] = {n: [] for n in sensors}
        self.T_R_N: dict[str, FloatArray] = {}
        self.troubles: dict[str, str] = {}

    def add(self, readings: Iterable[PairedReading]) -> list[str]:
        """Take the readings of one pose; return the sensors that are registered anew by them."""
        registered = []
        for reading in readings:
            name = reading.sensor
            marker_R = self._chain.positions(reading.q, self._markers[reading.marker])
            points = self._points[name]
            points.append((marker_R, reading.position))
            if len(points) < POINTS:
                continue
            robot, measured = (np.array(side) for side in zip(*points))
            try:
                self.T_R_N[name], _ = register_ransac(robot, measured, self._allowed_m)
            except InsufficientDataError as error:
                self.troubles[name] = f'{name}: {error}'
                continue
            self.troubles.pop(name, None)
            registered.append(name)
        return registered

    def describe(self) -> str:
        """Return how far the registration is, as text."""
        parts = [
            f'{name}: point {len(points)} of {POINTS}' for name, points in self._points.items()
        ]
        return '; '.join([*parts, *self.troubles.values()])
