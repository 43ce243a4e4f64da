# SPDX-License-Identifier: Apache-2.0
"""Closed-form inverse kinematics of a spherical-roll-spherical arm, the judge of the tests.

Written from the geometry, with nothing of the package: shoulder at (0, 0, d_base), elbow and
wrist at distances l_upper and l_lower, tool at d_tool along the last axis, rotations
Rz(q1) Ry(s2 q2) Rz(q3) Ry(s4 q4) Rz(q5) Ry(s6 q6) Rz(q7) with s = ±1, and q3 held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def rot_z(angle):
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack((c, -s, o, s, c, o, o, o, i), axis=-1).reshape(*np.shape(angle), 3, 3)


def rot_y(angle):
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack((c, o, s, o, i, o, -s, o, c), axis=-1).reshape(*np.shape(angle), 3, 3)


@dataclass(frozen=True)
class SrsArm:
    """Lengths in m; ``signs`` are those of joints 2, 4 and 6 about +Y."""

    d_base: float
    l_upper: float
    l_lower: float
    d_tool: float
    signs: tuple[int, int, int]

    def forward(self, q):
        """Return the rotation (..., 3, 3) and position (..., 3) of the tool."""
        s2, s4, s6 = self.signs
        z = np.array([0.0, 0.0, 1.0])
        upper = rot_z(q[..., 0]) @ rot_y(s2 * q[..., 1]) @ rot_z(q[..., 2])
        lower = upper @ rot_y(s4 * q[..., 3])
        hand = lower @ rot_z(q[..., 4]) @ rot_y(s6 * q[..., 5]) @ rot_z(q[..., 6])
        position = self.d_base * z + upper @ z * self.l_upper
        return hand, position + lower @ z * self.l_lower + hand @ z * self.d_tool

    def inverse(self, rotation, position, q3):
        """Return all eight branches, (n, 8, 7): NaN where a branch is out of reach.

        Where a branch is singular, its undetermined angle is what atan2(0, 0) makes of it.
        """
        s2, s4, s6 = self.signs
        z = np.array([0.0, 0.0, 1.0])
        wrist = position - self.d_tool * rotation[..., 2] - self.d_base * z
        cosine = (np.sum(wrist**2, axis=-1) - self.l_upper**2 - self.l_lower**2) / (
            2 * self.l_upper * self.l_lower
        )
        branches = []
        for elbow in (1, -1):
            bend = elbow * _arccos(cosine)
            # The wrist seen from the shoulder, in the frame after joint 2.
            u = self.l_upper * z + (rot_z(q3 + 0 * bend) @ rot_y(bend) @ z) * self.l_lower
            tilt = np.arctan2(u[..., 0], u[..., 2])
            reach = np.hypot(u[..., 0], u[..., 2])
            for shoulder in (1, -1):
                lean = shoulder * _arccos(wrist[..., 2] / reach) - tilt
                along = np.cos(lean) * u[..., 0] + np.sin(lean) * u[..., 2]
                turn = np.arctan2(wrist[..., 1], wrist[..., 0]) - np.arctan2(u[..., 1], along)
                arm = rot_z(turn) @ rot_y(lean) @ rot_z(q3 + 0 * bend) @ rot_y(bend)
                hand = np.swapaxes(arm, -1, -2) @ rotation
                for flip in (1, -1):
                    swing = flip * np.arctan2(
                        np.hypot(hand[..., 0, 2], hand[..., 1, 2]), hand[..., 2, 2]
                    )
                    roll = np.arctan2(flip * hand[..., 1, 2], flip * hand[..., 0, 2])
                    # What is left of the rotation turns about the last axis alone.
                    remainder = np.swapaxes(rot_z(roll) @ rot_y(swing), -1, -2) @ hand
                    last = np.arctan2(remainder[..., 1, 0], remainder[..., 0, 0])
                    joints = (turn, s2 * lean, q3 + 0 * bend, s4 * bend, roll, s6 * swing, last)
                    branches.append(np.stack(joints, axis=-1))
        return np.stack(branches, axis=-2)


def _arccos(value):
    """Return the arc cosine; rounding past ±1 is a straight arm, further past is NaN."""
    is_inside = np.abs(value) < 1 + 1e-12
    return np.arccos(np.where(is_inside, np.clip(value, -1, 1), np.nan))
