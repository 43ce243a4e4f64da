# SPDX-License-Identifier: Apache-2.0
"""Plausibility of a reading against the robot's own motion, before it is recorded.

A stray that is taken for the marker (swapped) stands still or moves differently: seen from the
tool, it is not at the marker's position. A frozen instrument repeats its last reading at any
configuration of the arm. Neither can be recognised by one reading.
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
"""Number of readings of a sensor after which its usual deviation is known."""
UNUSUAL = 6.0
"""Ratio of a deviation to the usual one from which the reading is of another marker."""
SMALLEST_M = 0.01
"""Smallest deviation that counts as another marker, m: offsets bend the field of deviations."""
DISTANCE_M = 5e-3
"""Smallest difference of two markers' distance that counts as another marker, m."""
UNUSUAL_PLACES = 8.0
"""Smallest such difference in standard deviations of the markers' positions."""
MOVED_M = 1e-3
"""Expected movement of a marker, m, from which an identical reading is implausible."""
TURNED_RAD = 0.01
"""Movement of a joint, rad, from which an identical reading is implausible: all solutions of a
pose have their marker at one position of the model, but never of the real arm to the last bit. For
a slide 0.25 m count as a radian."""


class Plausibility:
    """Comparison of readings with the marker's position by the robot's model.

    The model is off by the errors that the calibration is to find: millimetres to a few
    centimetres. A reading further off than `max_deviation_m`, or than six times the usual
    deviation of its sensor, is of something else.

    Parameters
    ----------
    chain
        The arm.
    markers
        Nominal marker positions in the tool frame, m, (3,) each.
    max_deviation_m
        Largest plausible deviation of a marker, m.
    marker_std_m
        Standard deviation of the markers' positions, per axis, m.
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
        """Judgement of the markers of one frame, each as by `judge`, and of their distances.

        The distances are known for any place of arm and sensor. If a distance is wrong, markers
        were exchanged or a stray was taken for one of them; the distances cannot tell which marker
        is wrong (the distance of two exchanged markers is right). So no reading of the frame is
        used. ``T_R_N``, ``anywhere``: as in `judge`. If a distance is wrong, the list is one
        Rejection (``swapped``) for the whole frame, else as long as ``readings``.
        """
        for first, second in itertools.combinations(readings, 2):
            nominal = np.subtract(self._markers[first.marker], self._markers[second.marker])
            wanted, found = map(np.linalg.norm, (nominal, first.position - second.position))
            if not abs(found - wanted) <= self._distance_m:
                detail = (
                    f'{first.marker} and {second.marker} are {1e3 * found:.0f} mm apart, by the '
                    'cell '
                    f'file {1e3 * wanted:.0f} mm: are their numbers in the rigid body right?'
                )
                return [Rejection(first.sensor, 'swapped', detail)]
        return [self.judge(reading, T_R_N, anywhere=anywhere) for reading in readings]

    def judge(
        self, reading: PairedReading, T_R_N: FloatArray | None, *, anywhere: bool = False
    ) -> PairedReading | Rejection:
        """Return the reading, or a Rejection with the reason why it is not plausible.

        ``frozen``: the same to the last bit as the one before, though the arm moved
        (`MOVED_M`, `TURNED_RAD`); ``swapped``: further from the model than allowed. Plausible
        readings are kept to judge later ones. ``T_R_N``: sensor in the robot base, (4, 4),
        None before it is registered, when only ``frozen`` is judged; ``anywhere``: at a
        reference, where a deviation shows a change, any deviation up to `max_deviation_m` is
        plausible.
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
        """Marker position by the robot's model for a reading, in the robot base, m, (3,)."""
        return self._chain.positions(reading.q, np.asarray(self._markers[reading.marker], float))

    def _allowed_m(self, sensor: str) -> float:
        """Largest plausible deviation of a sensor's reading, m.

        `UNUSUAL` times the median of its deviations so far, between `SMALLEST_M` and
        `max_deviation_m`; the latter before `LEARNING` of them.
        """
        usual = self._usual.get(sensor, ())
        if len(usual) < LEARNING:
            return self._max_deviation_m
        return min(self._max_deviation_m, max(SMALLEST_M, UNUSUAL * float(np.median(usual))))
