# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the true arm and sensors of the fakes, over time.

Effects depend on where the arm stands and how it came there. They are worked out where a motion
ends. While the arm moves, when nothing is measured, they pass smoothly from one end to the
next.
"""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.simulation.chain_arm import ChainArm
from remaster_ros.simulation.hidden_effect import Deviation
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.simulation.world_model import (
    Round,
    circumstances,
    deviation,
    measured,
)
from remaster_ros.types import FloatArray

MOVES_KEPT = 16
"""Number of motions that are kept, for effects at present and in the near past."""


class TrueArm:
    """Deviations of the true arm and sensors over time, and noise-free readings.

    ``chain``: the arm as drawn; ``truth``: its deviations; ``start_s, q``: time, s, and joint
    positions at the beginning, rad, (k,).
    """

    def __init__(
        self, chain: SerialChain, truth: SessionTruth, start_s: float, q: FloatArray
    ) -> None:
        self._arm, self._truth, self._start_s = ChainArm(chain), truth, start_s
        self._stops: list[FloatArray] = [q]
        self._times: list[float] = [start_s]
        still = self._deviation()
        # Start and end of each motion, and the deviations there.
        self._moves: list[tuple[float, float, Deviation, Deviation]] = [
            (start_s, start_s, still, still)
        ]

    def move(self, start_s: float, start: FloatArray, end_s: float, end: FloatArray) -> None:
        """Add a motion from ``start`` to ``end``, reported positions, rad or m, (k,), at times, s.

        It takes the place of the rest of the last motion, if that is not yet over.
        """
        before = self.deviation(start_s)
        self._stops[-1] = start
        self._stops.append(end)
        self._times.append(end_s)
        self._moves.append((start_s, end_s, before, self._deviation()))
        del self._moves[:-MOVES_KEPT]
        if not self._truth.effects:
            # Without effects the earlier stops have no influence; memory stays bounded.
            del self._stops[:-2], self._times[:-2]

    def deviation(self, t: float) -> Deviation:
        """Deviation of arm and sensors at world time t, s, one row (n = 1).

        During a motion it passes smoothly from the deviation at the start of the motion to
        that at its end.
        """
        move = next((m for m in reversed(self._moves) if m[0] <= t), self._moves[0])
        start_s, end_s, before, after = move
        share = 1.0 if t >= end_s else (t - start_s) / (end_s - start_s)
        smooth = share * share * (3.0 - 2.0 * share)
        return before.map(lambda a, b: a + smooth * (b - a), after)

    def marker_in_sensor(self, name: str, t: float, q: FloatArray, marker: str = '') -> FloatArray:
        """Noise-free reading of a marker in the frame N of a sensor, m, (3,), at world time t, s.

        ``name``: of the sensor; ``q``: reported positions, rad or m, (k,); ``marker``: name,
        '' for the first marker of the sensor. Raises KeyError for an unknown sensor or marker.
        """
        sensor, wrong = self._truth.sensors[name], self.deviation(t)
        marker = marker or sensor.marker
        state = self._arm.state(q + self._truth.joint_offsets + wrong.angle)
        return measured(state, name, sensor, marker, self._truth.markers[marker], wrong)[0]

    def _deviation(self) -> Deviation:
        """Deviation of arm and sensors at the last stop, one row (n = 1).

        Effects may depend on earlier stops; all that are kept are taken into account.
        """
        times = np.array(self._times)
        visited = Round(
            q=np.array(self._stops),
            home=self._stops[0],
            time_s=times - self._start_s,
            warming_k=self._truth.warming.at(times),
        )
        c = circumstances(self._arm, visited, self._truth.joint_offsets)
        together = deviation(
            self._truth.effects, c, tuple(self._truth.sensors), tuple(self._truth.markers)
        )
        return together.map(lambda array: array[-1:])
