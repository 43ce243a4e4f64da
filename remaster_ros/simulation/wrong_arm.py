"""What is wrong with the true arm and sensors of the fakes, over time.

Effects depend on where the arm stands and how it came there. They are worked out where a motion
ends, and pass over from one end to the next while the arm moves, when nobody measures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.simulation.hidden_arm import ChainArm
from remaster_ros.simulation.hidden_effects import Deviation, HiddenEffect
from remaster_ros.simulation.world_model import (
    Round,
    StagedSensor,
    circumstances,
    deviation,
    placed,
)
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class Warming:
    """An arm warms up: by ``kelvin`` in the end, with this time constant, from ``start_s``."""

    kelvin: float
    time_s: float
    start_s: float

    def at(self, t: FloatArray) -> FloatArray:
        """Temperature above that of the beginning, K."""
        since = np.maximum(np.asarray(t, float) - self.start_s, 0.0)
        return self.kelvin * (1.0 - np.exp(-since / self.time_s))


class WrongArm:
    """The true arm in front of true sensors.

    Parameters
    ----------
    chain
        The arm as drawn.
    joint_offsets
        True joint angle minus reported one, rad, (k,).
    sensors, markers
        By name; where they truly are (m, in R and in the tool frame).
    effects
        What else is wrong.
    start_s, q
        When and where the arm stands at first, rad, (k,).
    warming
        Temperature above that of the beginning at a time, K.
    """

    def __init__(
        self,
        chain: SerialChain,
        joint_offsets: FloatArray,
        sensors: Mapping[str, StagedSensor],
        markers: Mapping[str, FloatArray],
        effects: Sequence[HiddenEffect],
        start_s: float,
        q: FloatArray,
        warming: Warming,
    ) -> None:
        self._arm, self._joint_offsets = ChainArm(chain), joint_offsets
        self._sensors, self._markers, self._effects = sensors, markers, tuple(effects)
        self._start_s, self._warming = start_s, warming
        self._stops: list[FloatArray] = [q]
        self._times: list[float] = [start_s]
        still = self._deviation()
        # Start and end of each motion, and the deviations there.
        self._moves: list[tuple[float, float, Deviation, Deviation]] = [
            (start_s, start_s, still, still)
        ]

    def move(self, start_s: float, start: FloatArray, end_s: float, end: FloatArray) -> None:
        """Learn of a motion (rad, (k,)); it replaces what was still to come of the last one."""
        before = self.deviation(start_s)
        self._stops[-1] = start
        self._stops.append(end)
        self._times.append(end_s)
        self._moves.append((start_s, end_s, before, self._deviation()))
        # Nobody asks for times long gone; where nothing is wrong they leave no trace either.
        del self._moves[:-16]
        if not self._effects:
            del self._stops[:-2], self._times[:-2]

    def deviation(self, t: float) -> Deviation:
        """What is wrong at a time, one row."""
        move = next((m for m in reversed(self._moves) if m[0] <= t), self._moves[0])
        start_s, end_s, before, after = move
        share = 1.0 if t >= end_s else (t - start_s) / (end_s - start_s)
        smooth = share * share * (3.0 - 2.0 * share)
        return before.map(lambda a, b: a + smooth * (b - a), after)

    def marker_in_sensor(self, sensor: str, t: float, q: FloatArray) -> FloatArray:
        """What a sensor would measure without noise, in its frame N, m, (3,), for reported q."""
        staged, wrong = self._sensors[sensor], self.deviation(t)
        state = self._arm.state(q + self._joint_offsets + wrong.angle)
        in_base = placed(state, self._markers[staged.marker] + wrong.marker, wrong)
        return wrong.measured(sensor, (in_base - staged.origin) @ staged.rotation)[0]

    def _deviation(self) -> Deviation:
        """Work out what is wrong at the last stop, with all that went before."""
        times = np.array(self._times)
        visited = Round(
            q=np.array(self._stops),
            home=self._stops[0],
            time_s=times - self._start_s,
            warming_k=self._warming.at(times),
        )
        c = circumstances(self._arm, visited, self._joint_offsets)
        together = deviation(self._effects, c, tuple(self._sensors))
        return together.map(lambda array: array[-1:])
