"""First registration of the sensors: by three points each, refined by those that follow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from remaster_ros.calibration.registration import register_ransac
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

# Poses: the markers of one frame lie too close to each other to register a sensor by.
POINTS = 3


class FirstRegistration:
    """Collect points of each sensor; from the third pose on they give T_R_N.

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
        # Where the arm stood: the same for the markers of a frame.
        self._stops: dict[str, set[bytes]] = {name: set() for name in self._points}
        self.T_R_N: dict[str, FloatArray] = {}
        self.troubles: dict[str, str] = {}

    def add(self, readings: Iterable[PairedReading]) -> list[str]:
        """Take readings at registration poses; return the sensors registered anew by them."""
        registered: list[str] = []
        taken: dict[str, None] = {}
        for reading in readings:
            name = reading.sensor
            marker_R = self._chain.positions(reading.q, self._markers[reading.marker])
            self._points[name].append((marker_R, reading.position))
            self._stops[name].add(np.asarray(reading.q, float).tobytes())
            taken[name] = None
        for name in taken:
            if len(self._stops[name]) < POINTS:
                continue
            robot, measured = (np.array(side) for side in zip(*self._points[name]))
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
        parts = [f'{name}: point {len(stops)} of {POINTS}' for name, stops in self._stops.items()]
        return '; '.join([*parts, *self.troubles.values()])
