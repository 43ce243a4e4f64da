# SPDX-License-Identifier: Apache-2.0
"""First registration of the sensors: by three points each, refined by the points that follow."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from remaster_ros.calibration.registration import register_ransac
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray

# Number of poses: the markers of one frame are too close to each other to register a sensor.
POINTS = 3
SEARCHED_POINTS = 5
"""Number of first points for which every possible marker is tried."""
CLEARLY_WORSE = 3.0
"""Ratio of the points' RMS with another choice of markers to that with the best choice, or to a
tenth of the allowed distance (the error of an uncalibrated arm), from which it is excluded."""


class FirstRegistration:
    """First registrations of the sensors, by points at three configurations or more.

    Parameters
    ----------
    chain
        The arm.
    markers
        Marker positions in the tool frame, m, (3,), by name.
    sensors
        Names of the sensors.
    allowed_m
        Largest deviation of a point that is used, m.
    searched
        Sensors that find one of several markers by a search, with these markers: before the
        registration the marker of a reading is not known.

    Attributes
    ----------
    T_R_N
        Registrations: sensor -> (4, 4).
    troubles
        Reason why the points of a sensor give no registration: sensor -> message.
    """

    def __init__(
        self,
        chain: SerialChain,
        markers: Mapping[str, FloatArray],
        sensors: Iterable[str],
        allowed_m: float,
        searched: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        self._chain, self._markers, self._allowed_m = chain, markers, allowed_m
        self._searched = searched
        # Positions by the robot of each marker that a point may be of, (m, 3), and its reading.
        self._points: dict[str, list[tuple[FloatArray, FloatArray]]] = {n: [] for n in sensors}
        # Configurations of the arm, one for all markers of a frame.
        self._stops: dict[str, set[bytes]] = {name: set() for name in self._points}
        self.T_R_N: dict[str, FloatArray] = {}
        self.troubles: dict[str, str] = {}

    def add(self, readings: Iterable[PairedReading]) -> list[str]:
        """Add readings at registration poses; return the sensors that they register (again).

        A sensor is registered with `POINTS` configurations or more; if its points give no
        registration, `troubles` says why, and it keeps an earlier one. Raises KeyError for an
        unknown sensor.
        """
        registered: list[str] = []
        taken: dict[str, None] = {}
        for reading in readings:
            name = reading.sensor
            candidates = [reading.marker]
            if name in self._searched and len(self._points[name]) < SEARCHED_POINTS:
                candidates = list(self._searched[name])
            markers_T = np.array([self._markers[marker] for marker in candidates])
            places_R = self._chain.positions(reading.q, markers_T)
            self._points[name].append((places_R, reading.position))
            self._stops[name].add(np.asarray(reading.q, float).tobytes())
            taken[name] = None
        for name in taken:
            if len(self._stops[name]) < POINTS:
                continue
            options, measured = zip(*self._points[name])
            try:
                self.T_R_N[name] = self._frame(options, np.array(measured))
            except InsufficientDataError as error:
                self.troubles[name] = f'{name}: {error}'
                continue
            self.troubles.pop(name, None)
            registered.append(name)
        return registered

    def _frame(self, options: Sequence[FloatArray], measured: FloatArray) -> FloatArray:
        """Registration, (4, 4), by the assignment of markers to points that agrees best.

        Best: most points within `allowed_m`, then the least RMS. ``options``: for each point
        the positions in the robot base frame of the markers that it may be of, m, (m, 3) each;
        ``measured``: points in the sensor's frame, (n, 3), m. Raises InsufficientDataError if
        no assignment gives a registration, or another one that differs agrees as well
        (`CLEARLY_WORSE`).
        """
        failure: InsufficientDataError | None = None
        found = []
        for choice in itertools.product(*options):
            robot = np.array(choice)
            try:
                T_R_N, agree = register_ransac(robot, measured, self._allowed_m)
            except InsufficientDataError as error:
                failure = failure or error
                continue
            off = np.linalg.norm(apply(T_R_N, measured) - robot, axis=1)[agree]
            found.append((-int(agree.sum()), float(np.sqrt(np.mean(off**2))), T_R_N))
        if not found:
            assert failure is not None
            raise failure
        found.sort(key=lambda entry: entry[:2])
        count, rms, T_R_N = found[0]
        limit_m = CLEARLY_WORSE * max(rms, 0.1 * self._allowed_m)
        for other_count, other_rms, other in found[1:]:
            largest_m = np.linalg.norm(
                apply(T_R_N, measured) - apply(other, measured), axis=1
            ).max()
            if other_count == count and other_rms < limit_m and largest_m > self._allowed_m:
                raise InsufficientDataError(
                    f'registration: which of the reflectors was found at {len(measured)} poses '
                    f'cannot be told apart (they agree within {1e3 * rms:.1f} and '
                    f'{1e3 * other_rms:.1f} mm): measure more, or cover all but the first'
                )
        return T_R_N

    def describe(self) -> str:
        """Progress of the registration, as text: points of each sensor, then troubles."""
        parts = [f'{name}: point {len(stops)} of {POINTS}' for name, stops in self._stops.items()]
        return '; '.join([*parts, *self.troubles.values()])
