# SPDX-License-Identifier: Apache-2.0
"""Is a reading this marker, measured now? Against the robot's own motion, before it is recorded.

A stray that is taken for the marker (swapped) stands still or moves in a way of its own: seen from
the tool, it is not where the marker is. A frozen instrument repeats its last reading wherever the
arm goes. Neither can be recognised by the reading alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from remaster_ros.collection.pairing import PairedReading, Rejection
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

LEARNING = 6
"""Readings of a sensor after which its usual deviation is known."""
UNUSUAL = 6.0
"""So many times the usual deviation is another marker."""
SMALLEST_M = 0.01
"""No smaller deviation counts as another marker, m: offsets bend the field of deviations."""
DISTANCE_M = 5e-3
"""No smaller difference of two markers' distance counts as another marker, m."""
UNUSUAL_PLACES = 8.0
"""Nor one below so many times what the markers' places are known to."""
MOVED_M = 1e-3
"""A marker that should have moved further than this cannot have the same reading, m."""
TURNED_RAD = 0.01
"""Nor one of an arm whose joints have turned by more: all solutions of a pose have their marker at
one place of the model, and none of the real arm at the same one to the last bit. A slide by 0.25 m
for each radian."""


class Plausibility:
    """Compare readings with where the robot's model has the marker.

    The model is off by what the calibration is to find: millimetres to a few centimetres. A
    reading further off than `max_deviation_m`, or than six times what is usual for its sensor,
    is of something else.

    Parameters
    ----------
    chain
        The arm.
    markers
        Nominal marker positions in the tool frame, m, (3,) each.
    max_deviation_m
        Beyond this no marker is what it should be, m.
    marker_std_m
        How well the markers' positions are known, per axis, m.
    """

    def __init__(
        self,
        chain: SerialChain,
        markers: Mapping[str, FloatArray],
        max_deviation_m: float = 0.05,
        marker_std_m: float = 0.5e-3,
    ) -> None:
        self._chain, self._markers = chain, markers
        self._max_deviation_m = max_deviation_m
        self._distance_m = max(DISTANCE_M, UNUSUAL_PLACES * marker_std_m)
        self._usual: dict[str, list[float]] = {}
        self._last: dict[tuple[str, str], PairedReading] = {}

    def judge_frame(
        self,
        readings: Sequence[PairedReading],
        T_R_N: FloatArray | None,
        *,
        anywhere: bool = False,
    ) -> list[PairedReading | Rejection]:
        """Judge the markers of one frame, each as `judge` does, and their distances.

        Those are known wherever arm and sensor stand. Where one of them is wrong, markers were
        taken for others or a stray for one of them; which, the distances cannot tell (of two that
        were exchanged, their own distance is right). So none of the frame is taken.
        """
        for one, other in itertools.combinations(readings, 2):
            nominal = np.subtract(self._markers[one.marker], self._markers[other.marker])
            wanted, found = map(np.linalg.norm, (nominal, one.position - other.position))
            if not abs(found - wanted) <= self._distance_m:
                detail = (
                    f'{one.marker} and {other.marker} are {1e3 * found:.0f} mm apart, by the cell '
                    f'file {1e3 * wanted:.0f} mm: are their numbers in the rigid body right?'
                )
                return [Rejection(one.sensor, 'swapped', detail)]
        return [self.judge(reading, T_R_N, anywhere=anywhere) for reading in readings]

    def judge(
        self, reading: PairedReading, T_R_N: FloatArray | None, *, anywhere: bool = False
    ) -> PairedReading | Rejection:
        """Return the reading, or why it is none.

        Parameters
        ----------
        reading
            As paired.
        T_R_N
            The sensor in the robot base, (4, 4); None before it is registered.
        anywhere
            At a reference, where a deviation shows that something was moved: anything up to
            `max_deviation_m` is taken.
        """
        name = reading.sensor
        marker_R = self._place(reading)
        last = self._last.get((name, reading.marker))
        if last is not None and np.array_equal(last.position, reading.position):
            moved = float(np.linalg.norm(marker_R - self._place(last)))
            if moved > MOVED_M:
                detail = f'the same to the last bit, though the arm moved it {1e3 * moved:.0f} mm'
                return Rejection(name, 'frozen', detail)
            if np.max(np.abs(reading.q - last.q) / self._chain.per_radian) > TURNED_RAD:
                detail = 'the same to the last bit as at the configuration before'
                return Rejection(name, 'frozen', detail)
        if T_R_N is not None:
            measured_R = transforms.apply(T_R_N, reading.position)
            deviation = float(np.linalg.norm(measured_R - marker_R))
            allowed = self._max_deviation_m if anywhere else self._allowed_m(name)
            if not deviation <= allowed:
                detail = (
                    f'{1e3 * deviation:.0f} mm from where the robot has the marker (allowed '
                    f'{1e3 * allowed:.0f} mm): another marker, or the sensor was moved?'
                )
                return Rejection(name, 'swapped', detail)
            if not anywhere:
                self._usual.setdefault(name, []).append(deviation)
        self._last[name, reading.marker] = reading
        return reading

    def _place(self, reading: PairedReading) -> FloatArray:
        """Where the robot's model has the marker, in R, m, (3,)."""
        return self._chain.positions(reading.q, np.asarray(self._markers[reading.marker], float))

    def _allowed_m(self, sensor: str) -> float:
        usual = self._usual.get(sensor, ())
        if len(usual) < LEARNING:
            return self._max_deviation_m
        return min(self._max_deviation_m, max(SMALLEST_M, UNUSUAL * float(np.median(usual))))
