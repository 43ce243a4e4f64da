# SPDX-License-Identifier: Apache-2.0
"""Checks of an arm, day by day, with what has changed at one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from worlds.verified_arms import Case, found_arm

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.checking import Measured, chosen_poses, seen

NOISE_M = 1e-4
POSES = 8


class CheckedArm:
    """A true arm, its correction, and the eight poses of its checks."""

    def __init__(self, seed: int, name: str = 'iiwa7') -> None:
        self.true, self.found = found_arm(Case(seed, 0.1, 0.1, 'in_use', name=name))
        self.rng = np.random.default_rng((seed, 2))
        candidates = self.rng.uniform(-1.8, 1.8, (200, self.true.joints))
        rows, self.sizes = chosen_poses(self.found, candidates, 'mocap', 'sir', POSES, self.rng)
        self.q = candidates[rows]
        self.levers = seen(self.found, self.check()).lever_m

    def joint(self, joint: int, size_m: float) -> ArmModel:
        """Return the arm with a zero that has changed by so much at the tool."""
        offsets = self.true.joint_offsets.copy()
        offsets[joint] += size_m / self.levers[joint]
        return replace(self.true, joint_offsets=offsets)

    def marker(self, size_m: float) -> ArmModel:
        """Return the arm with its marker moved on the tool."""
        place = self.true.markers['sir'] + np.array([size_m, 0.0, 0.0])
        return replace(self.true, markers={'sir': place})

    def check(self, arm: ArmModel | None = None, noise_m: float = NOISE_M) -> Measured:
        """Return a check of the arm."""
        arm = self.true if arm is None else arm
        q = self.q + 1e-5 * self.rng.standard_normal(self.q.shape)
        places = arm.in_sensor(arm.state(q), 'mocap', 'sir')
        noise = noise_m * self.rng.standard_normal(places.shape)
        return Measured(q, ('mocap',) * len(q), ('sir',) * len(q), places + noise)

    def days(self, count: int, arm: ArmModel | None = None) -> list[Measured]:
        """Return so many checks."""
        return [self.check(arm) for _ in range(count)]
