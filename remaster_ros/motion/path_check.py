# SPDX-License-Identifier: Apache-2.0
"""Paths that were found free, and how fast the fastest point of arm and tool moves on them.

This takes milliseconds to seconds: it never runs in the callbacks that serve a stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import with_z_along
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.spline import Spline
from remaster_ros.types import FloatArray

PEAK_STEP_RAD = 0.02
"""The peak speed on a line is looked for every so many radians of its fastest joint; of one that
slides every `SerialChain.per_radian` times as many metres."""


class PointSpeeds:
    """Speeds of the points that an arm and its tool consist of.

    Parameters
    ----------
    chain
        The arm.
    extents
        For each joint points in the frame after it, m, (n, 3), whose convex hull holds all that
        moves with it: a speed is largest at a corner of a convex body.

    Attributes
    ----------
    reach_m
        How far from each joint a point that it moves can be in any configuration, m, (k,): its
        speed in m/s for each rad/s of the joint. A joint that slides has 1, for each m/s.
    """

    def __init__(self, chain: SerialChain, extents: Sequence[FloatArray]) -> None:
        if len(extents) != len(chain):
            raise ValueError(f'{len(extents)} bodies for {len(chain)} joints')
        self._steps = [_carried(T) for T in chain.T_fixed_z[:-1]]
        self._points = [
            _velocities(points @ with_z_along(axis)) if len(points) else None
            for axis, points in zip(chain.axes, extents, strict=True)
        ]
        self._slides, self._per_radian = chain.slides, chain.per_radian
        # The way from each joint along the links behind it to the farthest point, at full stretch.
        links = np.array([0.0, *np.linalg.norm(chain.T_fixed[1:-1, :3, 3], axis=1)])
        # What slides carries its own origin along.
        travel = np.maximum(np.abs(chain.lower), np.abs(chain.upper))
        origins = np.cumsum(links + np.where(chain.slides, travel, 0.0))
        bodies = [
            origin + max(np.linalg.norm(points, axis=1), default=0.0) if len(points) else 0.0
            for origin, points in zip(origins, extents)
        ]
        farthest = np.maximum.accumulate(bodies[::-1])[::-1]
        self.reach_m: FloatArray = np.maximum(farthest - origins, 0.0)
        self.reach_m[chain.slides] = 1.0

    def fastest(self, q: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the speed of the fastest point, m/s, (n,), at q and joint velocities (n, k).

        rad and rad/s, or m and m/s; 0 for an arm without points.
        """
        # The turn and the velocity of its joint's point of each link, in its own frame with the
        # joint's axis as Z (Featherstone, "Rigid Body Dynamics Algorithms", 2008, eq. 5.14): a
        # fixed step is one product, a turn about Z mixes X and Y, and points stand still.
        motion = np.zeros((len(q), 2, 3))
        fastest = np.zeros(len(q))
        sines, cosines = np.sin(q), np.cos(q)
        for joint, (step, points) in enumerate(zip(self._steps, self._points, strict=True)):
            motion = (motion.reshape(-1, 6) @ step).reshape(-1, 2, 3)
            x, y = motion[..., 0].copy(), motion[..., 1].copy()
            if self._slides[joint]:
                # The origin has gone along Z: it moves with v + w × q Z, and by the joint.
                motion[:, 1, 0] += y[:, 0] * q[:, joint]
                motion[:, 1, 1] -= x[:, 0] * q[:, joint]
                motion[:, 1, 2] += velocity[:, joint]
            else:
                s, c = sines[:, joint, None], cosines[:, joint, None]
                motion[..., 0], motion[..., 1] = c * x + s * y, c * y - s * x
                motion[:, 0, 2] += velocity[:, joint]
            if points is not None:
                squares = ((motion.reshape(-1, 6) @ points) ** 2).reshape(len(q), 3, -1)
                fastest = np.maximum(fastest, np.max(np.sum(squares, axis=1), axis=1))
        return np.sqrt(fastest)

    def peak_m(self, start: FloatArray, end: FloatArray) -> float:
        """Return the fastest point's peak speed along a line that takes one second, m/s.

        ``start, end``: joint positions, rad or m, (k,).
        """
        way = end - start
        count = 3 + int(np.max(np.abs(way) / self._per_radian) / PEAK_STEP_RAD)
        q = start + np.linspace(0.0, 1.0, count)[:, None] * way
        return float(np.max(self.fastest(q, np.broadcast_to(way, q.shape))))

    def peaks_m(self, points: FloatArray) -> tuple[float, ...]:
        """Return `peak_m` of each line of a polyline, m/s, for points (n, k), rad or m."""
        return tuple(self.peak_m(start, end) for start, end in pairwise(points))


def _carried(T: FloatArray) -> FloatArray:
    """Return the matrix (6, 6) from the twist of a frame to that of a frame fixed in it.

    A twist is a row of angular velocity and velocity of the origin, each in its own frame's
    axes; it is multiplied by the matrix from the right. ``T``: the fixed frame in the first
    one, (4, 4). Its origin moves with v + w × p.
    """
    rotation = T[:3, :3]
    across = np.cross(np.eye(3), T[:3, 3])
    return np.block([[rotation, across @ rotation], [np.zeros((3, 3)), rotation]])


def _velocities(points: FloatArray) -> FloatArray:
    """Return the matrix (6, 3 n) from the twist of a frame to velocities of points fixed in it.

    ``points``: in the frame, (n, 3). To be multiplied from the right to rows of angular
    velocity and velocity of the origin; columns are the points' x, then y, then z.
    """
    across = np.cross(np.eye(3)[:, None], points)
    by_turn = np.moveaxis(across, 1, 2).reshape(3, -1)
    return np.vstack((by_turn, np.repeat(np.eye(3), len(points), axis=1)))


@dataclass(frozen=True)
class FreePath:
    """A polyline or a curve in joint space that was found free."""

    # From where the arm stands to the target, rad or m, (n, k); of a curve its samples
    points: FloatArray
    # For each line the peak speed of the fastest point where it takes a second, m/s, (n - 1,),
    # for a curve that of all of it, (1,); none if no such limit is kept
    peaks_m: tuple[float, ...] = ()
    way_out: bool = False  # It leads out of a contact or a margin, and is gone slowly
    curve: Spline | None = None  # What the arm follows in place of the polyline

    def offs(self, q: FloatArray, units: JointUnits) -> FloatArray:
        """Return the offsets of configurations, rad or m, (n, k), from the path, (n, k).

        From the nearest place on the path: on a curve by the sum of squares, on a polyline as
        of `off`.
        """
        if self.curve is not None:
            return np.asarray(q - self.curve.at(self.curve.nearest(q, units)))
        return np.array([self.off(each, units) for each in q])

    def off(self, q: FloatArray, units: JointUnits) -> FloatArray:
        """Return the offset of a configuration, rad or m, (k,), from the polyline, (k,).

        From the nearest place on it: along each line by the sum of squares, among the lines by
        the largest joint.
        """
        points = self.points / units.per_radian
        starts, ways, here = points[:-1], np.diff(points, axis=0), q / units.per_radian
        lengths = np.sum(ways**2, axis=1)
        shares = np.sum((here - starts) * ways, axis=1) / np.where(lengths > 0.0, lengths, 1.0)
        off = here - (starts + np.clip(shares, 0.0, 1.0)[:, None] * ways)
        nearest = off[int(np.argmin(np.max(np.abs(off), axis=1)))]
        return np.asarray(nearest * units.per_radian)
