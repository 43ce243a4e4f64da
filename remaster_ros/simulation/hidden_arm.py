"""The true arm of the fakes: the package's chain as `simulation.world_model` needs it."""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.simulation.world_model import ArmState, Round, WorldModel
from remaster_ros.types import FloatArray

GRAVITY = (0.0, 0.0, -9.81)
SECONDS_PER_CONFIGURATION = 10.0
"""About what a configuration takes: motion, settling and measuring."""


class ChainArm:
    """An `Arm` made of a `SerialChain`."""

    def __init__(self, chain: SerialChain) -> None:
        self._chain = chain
        self.joints = len(chain)

    def state(self, q: FloatArray) -> ArmState:
        """Where every joint is for true joint angles q, rad, (n, k)."""
        chain = self._chain
        frames = chain.frames(q)
        tool = frames[:, -1] @ chain.T_fixed[-1]
        carriers = np.concatenate(
            (np.broadcast_to(np.eye(3), (len(q), 1, 3, 3)), frames[:, :-1, :3, :3]), axis=1
        )
        return ArmState(
            origin=frames[..., :3, 3],
            before=carriers @ chain.T_fixed[:-1, :3, :3],
            after=frames[..., :3, :3],
            axis=chain.axes_in_base(frames),
            tool_origin=tool[:, :3, 3],
            tool=tool[:, :3, :3],
        )

    def gravity_torque(self, q: FloatArray) -> FloatArray:
        """Torque with which gravity turns each joint its own way, N m, (n, k)."""
        return self._chain.gravity_torque(q, GRAVITY)

    def base_moment(self, q: FloatArray) -> FloatArray:
        """Moment of the moving links' weight about the base's origin, N m, (n, 3)."""
        centers = apply(self._chain.frames(q), self._chain.centers_of_mass)
        moment = np.sum(self._chain.masses[:, None] * centers, axis=1)
        return np.cross(moment, np.array(GRAVITY))

    def segments(self) -> FloatArray:
        """From each joint to the next one, the last to the tool, m, (k + 1, 3)."""
        return self._chain.T_fixed[:, :3, 3]


def model_of_tour(chain: SerialChain, truth: SessionTruth, q: FloatArray) -> WorldModel:
    """Return the true arm on its way through the configurations q, rad, (m, k), in that order."""
    time_s = SECONDS_PER_CONFIGURATION * np.arange(len(q), dtype=float)
    visited = Round(q, q[0], time_s, truth.warming.at(truth.warming.start_s + time_s))
    return WorldModel(ChainArm(chain), visited, truth.sensors, truth.markers, truth.joint_offsets)
