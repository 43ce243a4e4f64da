"""Paths that were found free, and how fast the fastest point of arm and tool moves on them.

This takes milliseconds to seconds: it never runs in the callbacks that serve a stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray

PEAK_STEP_RAD = 0.02
"""The peak speed on a line is looked for every so many radians of its fastest joint."""


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
        How far from each joint a point that it moves can be in any configuration, m, (k,).
    """

    def __init__(self, chain: SerialChain, extents: Sequence[FloatArray]) -> None:
        if len(extents) != len(chain):
            raise ValueError(f'{len(extents)} bodies for {len(chain)} joints')
        self._chain, self._extents = chain, extents
        # The way from each joint along the links behind it to the farthest point, at full stretch.
        links = [0.0, *np.linalg.norm(chain.T_fixed[1:-1, :3, 3], axis=1)]
        origins = np.cumsum(links)
        bodies = [
            origin + max(np.linalg.norm(points, axis=1), default=0.0) if len(points) else 0.0
            for origin, points in zip(origins, extents)
        ]
        farthest = np.maximum.accumulate(bodies[::-1])[::-1]
        self.reach_m: FloatArray = np.maximum(farthest - origins, 0.0)

    def fastest(self, q: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the speed of the fastest point, m/s, (n,), at q and joint velocities (n, k)."""
        frames = self._chain.frames(q)
        axes, origins = self._chain.axes_in_base(frames), frames[..., :3, 3]
        turn = np.cumsum(velocity[..., None] * axes, axis=-2)
        # Each link's motion as a turn and the velocity of the point of it at the base's origin.
        shift = np.cumsum(velocity[..., None] * np.cross(origins, axes), axis=-2)
        fastest = np.zeros(len(q))
        for joint, points in enumerate(self._extents):
            if not len(points):
                continue
            places = points @ np.swapaxes(frames[..., joint, :3, :3], -1, -2)
            places += origins[..., joint, None, :]
            speeds = shift[..., joint, None, :] + np.cross(turn[..., joint, None, :], places)
            squares = np.max(np.sum(speeds**2, axis=2), axis=1)
            fastest = np.maximum(fastest, np.sqrt(squares))
        return fastest

    def peak_m(self, start: FloatArray, end: FloatArray) -> float:
        """Return the fastest point's peak speed where the line takes a second, m/s."""
        way = end - start
        count = 3 + int(np.max(np.abs(way)) / PEAK_STEP_RAD)
        q = start + np.linspace(0.0, 1.0, count)[:, None] * way
        return float(np.max(self.fastest(q, np.broadcast_to(way, q.shape))))

    def peaks_m(self, points: FloatArray) -> tuple[float, ...]:
        """Return `peak_m` of each line of a polyline, m/s, for points (n, k), rad."""
        return tuple(self.peak_m(start, end) for start, end in pairwise(points))


@dataclass(frozen=True)
class FreePath:
    """A polyline in joint space that was found free.

    Attributes
    ----------
    points
        From where the arm stands to the target, rad, (n, k).
    peaks_m
        For each line the peak speed of the fastest point where it takes a second, m/s, (n - 1,);
        none where no such limit is kept.
    way_out
        It leads out of a contact or a margin, and is gone slowly.
    """

    points: FloatArray
    peaks_m: tuple[float, ...] = ()
    way_out: bool = False

    def distance(self, q: FloatArray) -> float:
        """Return how far a configuration (rad, (k,)) lies off the polyline, rad."""
        starts, ways = self.points[:-1], np.diff(self.points, axis=0)
        lengths = np.sum(ways**2, axis=1)
        shares = np.sum((q - starts) * ways, axis=1) / np.where(lengths > 0.0, lengths, 1.0)
        nearest = starts + np.clip(shares, 0.0, 1.0)[:, None] * ways
        return float(np.min(np.max(np.abs(nearest - q), axis=1)))
