# SPDX-License-Identifier: Apache-2.0
"""First registration of the sensors: by three points each, refined by those that follow."""

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

# Poses: the markers of one frame lie too close to each other to register a sensor by.
POINTS = 3
SEARCHED_POINTS = 5
"""Of so many points, the first ones, every marker is tried that they may be."""
CLEARLY_WORSE = 3.0
"""Another choice of markers is out of the question where its points agree so many times worse
than the best, or than a tenth of what is allowed: an arm that is not calibrated is off by that."""


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
    searched
        Sensors that find one of several markers by a search, and these markers: before the
        registration it is not known which of them a reading is of.

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
        searched: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        self._chain, self._markers, self._allowed_m = chain, markers, allowed_m
        self._searched = searched
        # Where the robot has the marker, or each of those that it may be, (m, 3), and the reading.
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
        """Return T_R_N by the choice of markers that agrees best; `InsufficientDataError`."""
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
        found.sort(key=lambda one: one[:2])
        count, rms, T_R_N = found[0]
        limit_m = CLEARLY_WORSE * max(rms, 0.1 * self._allowed_m)
        for other_count, other_rms, other in found[1:]:
            apart = np.linalg.norm(apply(T_R_N, measured) - apply(other, measured), axis=1).max()
            if other_count == count and other_rms < limit_m and apart > self._allowed_m:
                raise InsufficientDataError(
                    f'registration: which of the reflectors was found at {len(measured)} poses '
                    f'cannot be told apart (they agree within {1e3 * rms:.1f} and '
                    f'{1e3 * other_rms:.1f} mm): measure more, or cover all but the first'
                )
        return T_R_N

    def describe(self) -> str:
        """Return how far the registration is, as text."""
        parts = [f'{name}: point {len(stops)} of {POINTS}' for name, stops in self._stops.items()]
        return '; '.join([*parts, *self.troubles.values()])
