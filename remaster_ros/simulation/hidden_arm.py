# SPDX-License-Identifier: Apache-2.0
"""True arm of the fakes: the package's chain in the form that `simulation.world_model` needs."""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.simulation.hidden_effects import Deviation
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.simulation.world_model import (
    ArmState,
    Round,
    WorldModel,
    circumstances,
    deviation,
    measured,
    placed,
)
from remaster_ros.types import FloatArray

# What is wrong with the true arm and sensors of the fakes, over time.
#
# Effects depend on where the arm stands and how it came there. They are worked out where a motion
# ends. While the arm moves, when nothing is measured, they pass smoothly from one end to the
# next.


MOVES_KEPT = 16
"""Number of motions that are kept, for effects at present and in the near past."""


class TrueArm:
    """True arm in front of the true sensors.

    ``chain``: the arm as drawn; ``truth``: its deviations; ``start_s, q``: time and joint
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
        """Add a motion from `start` to `end` (reported, rad or m, (k,)), between two times, s.

        It takes the place of the rest of the last one.
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
        """Deviation of arm and sensors at a time, s, one row.

        During a motion it passes smoothly from that before to that at its end.
        """
        move = next((m for m in reversed(self._moves) if m[0] <= t), self._moves[0])
        start_s, end_s, before, after = move
        share = 1.0 if t >= end_s else (t - start_s) / (end_s - start_s)
        smooth = share * share * (3.0 - 2.0 * share)
        return before.map(lambda a, b: a + smooth * (b - a), after)

    def marker_in_sensor(self, name: str, t: float, q: FloatArray, marker: str = '') -> FloatArray:
        """Noise-free reading of a marker in the sensor's frame N, m, (3,), for reported q, (k,).

        `name`: of the sensor; `marker`: '' for the sensor's first; `t`: world time, s.
        """
        sensor, wrong = self._truth.sensors[name], self.deviation(t)
        marker = marker or sensor.marker
        state = self._arm.state(q + self._truth.joint_offsets + wrong.angle)
        return measured(state, name, sensor, marker, self._truth.markers[marker], wrong)[0]

    def _deviation(self) -> Deviation:
        """Deviation at the last stop, one row, with the history of all kept stops."""
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


GRAVITY = (0.0, 0.0, -9.81)
SECONDS_PER_CONFIGURATION = 10.0
"""Approximate time of a configuration: motion, settling and measurement."""


class ChainArm:
    """`Arm` of a `SerialChain`."""

    def __init__(self, chain: SerialChain) -> None:
        self._chain = chain
        self.joints, self.slides = len(chain), chain.slides

    def state(self, q: FloatArray) -> ArmState:
        """State of every joint for true joint positions q, rad or m, (n, k)."""
        chain = self._chain
        frames = chain.frames(q)
        tool = frames[:, -1] @ chain.T_fixed[-1]
        carriers = np.concatenate(
            (np.broadcast_to(np.eye(3), (len(q), 1, 3, 3)), frames[:, :-1, :3, :3]), axis=1
        )
        # A joint that slides moves its origin.
        moved = np.where(chain.slides, q, 0.0)[..., None] * chain.axes_in_base(frames)
        return ArmState(
            origin=frames[..., :3, 3] - moved,
            before=carriers @ chain.T_fixed[:-1, :3, :3],
            after=frames[..., :3, :3],
            axis=chain.axes_in_base(frames),
            tool_origin=tool[:, :3, 3],
            tool=tool[:, :3, :3],
        )

    def gravity_torque(self, q: FloatArray) -> FloatArray:
        """Gravity's torque about each joint, in its positive direction, N m, (n, k).

        The force along it, N, for a joint that slides.
        """
        return self._chain.gravity_torque(q, GRAVITY)

    def base_moment(self, q: FloatArray) -> FloatArray:
        """Moment of the moving links' weight about the base's origin, in R, N m, (n, 3)."""
        centers = apply(self._chain.frames(q), self._chain.centers_of_mass)
        moment = np.sum(self._chain.masses[:, None] * centers, axis=1)
        return np.cross(moment, np.array(GRAVITY))

    def carried_moment(self, q: FloatArray) -> FloatArray:
        """Gravity's moment on what each joint carries about its origin, in R, N m, (n, k, 3)."""
        chain = self._chain
        frames = chain.frames(q)
        centers = apply(frames, chain.centers_of_mass)
        moments = np.zeros((len(q), len(chain), 3))
        for j in range(len(chain)):
            arms = centers[:, j:] - frames[:, j, :3, 3][:, None]
            total = np.einsum('l,nlx->nx', chain.masses[j:], arms)
            moments[:, j] = np.cross(total, np.array(GRAVITY))
        return moments

    def segments(self) -> FloatArray:
        """Vector from each joint to the next, from the last to the tool, m, (k + 1, 3).

        Segment j is fixed in the frame after joint j; segment 0, before joint 1, in the base.
        """
        return self._chain.T_fixed[:, :3, 3]


def tool_points(chain: SerialChain, truth: SessionTruth, q: FloatArray, marker: str) -> FloatArray:
    """True positions of a marker at the stops of a tour, in the base's frame R, m, (m, 3).

    ``chain``: the arm as drawn; ``truth``: its deviations; ``q``: reported joint angles in the
    order of the tour, rad, (m, k); ``marker``: name of the marker.
    """
    tour = model_of_tour(chain, truth, q)
    names = tuple(truth.sensors), tuple(truth.markers)
    wrong = deviation(truth.effects, tour.circumstances, *names)
    state = tour.arm.state(q + truth.joint_offsets + wrong.angle)
    return placed(state, truth.markers[marker], wrong)


def model_of_tour(chain: SerialChain, truth: SessionTruth, q: FloatArray) -> WorldModel:
    """True arm on a tour through the configurations q, rad or m, (m, k), in that order.

    It begins at the first one; a configuration takes 10 s (`SECONDS_PER_CONFIGURATION`).
    """
    time_s = SECONDS_PER_CONFIGURATION * np.arange(len(q), dtype=float)
    visited = Round(q, q[0], time_s, truth.warming.at(truth.warming.start_s + time_s))
    return WorldModel(ChainArm(chain), visited, truth.sensors, truth.markers, truth.joint_offsets)
