# SPDX-License-Identifier: Apache-2.0
"""True arm of the fakes as `simulation.world_model` needs it."""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.simulation.world_model import (
    ArmState,
    Round,
    WorldModel,
    deviation,
    placed,
)
from remaster_ros.types import FloatArray

GRAVITY = (0.0, 0.0, -9.81)
SECONDS_PER_CONFIGURATION = 10.0
"""Approximate time of a configuration: motion, settling and measurement."""


class ChainArm:
    """Kinematics and gravity of an arm as drawn, computed from its serial chain (see `Arm`)."""

    def __init__(self, chain: SerialChain) -> None:
        self._chain = chain
        self.joints, self.slides = len(chain), chain.slides

    def state(self, q: FloatArray) -> ArmState:
        """Origins, frames and axes of all joints, and the tool, at true positions q (n, k).

        In the robot base frame R. ``q``: rad or m.
        """
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

        The force along it, N, for a joint that slides. ``q``: true positions, rad or m, (n,
        k).
        """
        return self._chain.gravity_torque(q, GRAVITY)

    def base_moment(self, q: FloatArray) -> FloatArray:
        """Torque of the moving links' weight about the origin of the base, N m, (n, 3).

        In the robot base frame R. ``q``: true positions, rad or m, (n, k).
        """
        centers = apply(self._chain.frames(q), self._chain.centers_of_mass)
        moment = np.sum(self._chain.masses[:, None] * centers, axis=1)
        return np.cross(moment, np.array(GRAVITY))

    def carried_moment(self, q: FloatArray) -> FloatArray:
        """Gravity's torque on all links behind each joint about its origin, N m, (n, k, 3).

        In the robot base frame R. ``q``: true positions, rad or m, (n, k).
        """
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
        """Vectors from the base to joint 1, from joint to joint, and to the tool, m, (k + 1, 3).

        As drawn. Row j is in the frame after joint j, row 0 in that of the base.
        """
        return self._chain.T_fixed[:, :3, 3]


def tool_points(chain: SerialChain, truth: SessionTruth, q: FloatArray, marker: str) -> FloatArray:
    """True positions of a marker at the configurations of a tour, in the base frame R, m, (m, 3).

    ``chain``: the arm as drawn; ``truth``: its deviations; ``q``: reported joint angles in the
    order of the tour, rad, (m, k); ``marker``: name of the marker. Raises KeyError for an
    unknown one.
    """
    tour = model_of_tour(chain, truth, q)
    names = tuple(truth.sensors), tuple(truth.markers)
    wrong = deviation(truth.effects, tour.circumstances, *names)
    state = tour.arm.state(q + truth.joint_offsets + wrong.angle)
    return placed(state, truth.markers[marker], wrong)


def model_of_tour(chain: SerialChain, truth: SessionTruth, q: FloatArray) -> WorldModel:
    """Model of the true arm and sensors on a tour through reported configurations, in this order.

    ``q``: rad or m, (m, k). The tour begins at the first one; each takes 10 s
    (`SECONDS_PER_CONFIGURATION`). Effects of ``truth`` are not in the model.
    """
    time_s = SECONDS_PER_CONFIGURATION * np.arange(len(q), dtype=float)
    visited = Round(q, q[0], time_s, truth.warming.at(truth.warming.start_s + time_s))
    return WorldModel(ChainArm(chain), visited, truth.sensors, truth.markers, truth.joint_offsets)
