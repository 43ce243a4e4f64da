# SPDX-License-Identifier: Apache-2.0
"""Velocities and accelerations of a moving chain's links, and the torques of their inertia.

The recursion of Luh, Walker and Paul (1980, J. Dyn. Sys. Meas. Control 102), without gravity, in
the frame of the base R. The mass of each link counts as a point at its centre of mass: the URDF's
inertia tensors add little to the torques of an arm's large joints, and many URDFs have none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray


@dataclass(frozen=True, eq=False)
class MovingLinks:
    """Velocities and accelerations of an arm's k links in the base R, at n configurations."""

    chain: SerialChain
    frames: FloatArray  # T_R_link, (n, k, 4, 4)
    angular_velocity: FloatArray  # rad/s, (n, k, 3)
    angular_acceleration: FloatArray  # rad/s², (n, k, 3)
    acceleration: FloatArray  # Of the frame's origin, m/s², (n, k, 3)

    @classmethod
    def of(
        cls, chain: SerialChain, q: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> MovingLinks:
        """Motion of the links by joint positions, velocities and accelerations, (n, k) each.

        rad, rad/s and rad/s²; m, m/s and m/s² for joints that slide.
        """
        frames = chain.frames(q)
        axes, origins = chain.axes_in_base(frames), frames[..., :3, 3]
        n, k = q.shape
        spin, turned, moved = np.zeros((3, n, k, 3))
        omega, alpha, linear, origin = np.zeros((4, n, 3))
        for i in range(k):
            along = axes[:, i] * velocity[:, i, None]
            along2 = axes[:, i] * acceleration[:, i, None]
            arm = origins[:, i] - origin
            linear = linear + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
            if chain.slides[i]:
                linear = linear + along2 + 2.0 * np.cross(omega, along)
            else:
                alpha = alpha + along2 + np.cross(omega, along)
                omega = omega + along
            origin = origins[:, i]
            spin[:, i], turned[:, i], moved[:, i] = omega, alpha, linear
        return cls(chain, frames, spin, turned, moved)

    def point_acceleration(self, points: FloatArray, link: int = -1) -> FloatArray:
        """Acceleration of points (n, 3) of R that are fixed to a link, m/s², (n, 3).

        ``points``: m, one for each configuration; ``link``: index from 0, -1 for the last.
        """
        arm = points - self.frames[:, link, :3, 3]
        omega, alpha = self.angular_velocity[:, link], self.angular_acceleration[:, link]
        turning = np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
        result: FloatArray = self.acceleration[:, link] + turning
        return result

    def inertial_torque(self) -> FloatArray:
        """Torque of the links' inertia about each joint, N m, (n, k).

        Positive if it drives the joint in its positive direction, as `SerialChain.gravity_torque`:
        the motor applies the negative. For a joint that slides it is the force along the joint, N.
        """
        chain = self.chain
        centers = apply(self.frames, chain.centers_of_mass)
        force = np.stack(
            [
                -mass * self.point_acceleration(centers[:, i], i)
                for i, mass in enumerate(chain.masses)
            ],
            axis=1,
        )
        moment = np.cross(centers, force)

        def carried(values: FloatArray) -> FloatArray:
            """Sum over the joint's link and all links beyond."""
            total: FloatArray = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
            return total

        force, moment = carried(force), carried(moment)
        about = moment - np.cross(self.frames[..., :3, 3], force)
        along = np.where(chain.slides[:, None], force, about)
        torque: FloatArray = np.sum(chain.axes_in_base(self.frames) * along, axis=-1)
        return torque
