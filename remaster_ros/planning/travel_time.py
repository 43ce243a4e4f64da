# SPDX-License-Identifier: Apache-2.0
"""Travel time of an arm between configurations, and of a whole tour.

The straight lines are those of `motion.trajectory`, at the speeds of the motion gate; here they
are computed for many pairs of configurations at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.path_check import PointSpeeds
from remaster_ros.motion.spline import Spline
from remaster_ros.motion.trajectory import (
    HEADROOM,
    RAMP_S,
    STOPPABLE,
    Curve,
    Trajectory,
    plan_trajectory,
)
from remaster_ros.types import FloatArray

SPEED_SHARE = 0.3
"""Defaults of bridge and recorder, used unless stated otherwise."""
SETTLE_S = 3.0
DWELL_S = 0.5
SAMPLES = 5
"""Number of points of a line at which the speed of the fastest point is computed."""


@dataclass(frozen=True, eq=False)
class TravelTime:
    """Model of the time that an arm's motion, settling and measuring take."""

    limits: MotionLimits  # Speeds and accelerations of the bridge
    speeds: PointSpeeds  # Of the fastest point of arm and tool
    # Time that the arm stands still before a reading, and time of the reading, s
    settle_s: float = SETTLE_S
    dwell_s: float = DWELL_S

    @classmethod
    def of(
        cls,
        model: CollisionModel,
        speed_share: float = SPEED_SHARE,
        tool_speed: float = np.inf,
        acceleration: FloatArray | float | None = None,
        settle_s: float = SETTLE_S,
        dwell_s: float = DWELL_S,
    ) -> TravelTime:
        """Return the model of an arm.

        Parameters
        ----------
        model
            The arm and its tool.
        speed_share
            Share of each joint's velocity limit that is used.
        tool_speed
            Largest speed of the fastest point of arm and tool, m/s; infinite for none.
        acceleration
            Acceleration limits, as of `MotionLimits.of`.
        settle_s, dwell_s
            See the attributes.
        """
        limits = MotionLimits.of(
            model.chain, speed_share, acceleration=acceleration, tool_speed=tool_speed
        )
        speeds = PointSpeeds(model.chain, model.extent_points)
        return cls(limits, speeds, settle_s, dwell_s)

    @property
    def measuring_s(self) -> float:
        """Time that one configuration takes besides motion: settling and dwell, s."""
        return self.settle_s + self.dwell_s

    def straight(self, start: FloatArray, ends: FloatArray) -> FloatArray:
        """Return the times of the straight lines from one configuration to n others, s, (n,).

        ``start``: rad or m, (k,); ``ends``: rad or m, (n, k). From rest to rest, at least 2
        `RAMP_S`, also for no way at all; without settling and dwell.
        """
        way = ends - start
        size = np.maximum(np.abs(way), 1e-12)
        speeds = np.minimum(self.limits.velocity, STOPPABLE * self.limits.acceleration * RAMP_S)
        rate = np.min(speeds / size, axis=1)
        if np.isfinite(self.limits.tool_speed):
            at = np.linspace(0.0, 1.0, SAMPLES)[:, None, None]
            q = (start + at * way).reshape(-1, len(start))
            fastest = self.speeds.fastest(q, np.tile(way, (SAMPLES, 1))).reshape(SAMPLES, -1)
            peak = np.maximum(fastest.max(axis=0), 1e-12)
            rate = np.minimum(rate, self.limits.tool_speed / peak)
        return 1.0 / np.minimum(HEADROOM * rate, 1.0 / RAMP_S) + RAMP_S

    def between(self, q: FloatArray) -> FloatArray:
        """Return the times of the straight lines between configurations q (n, k), s, (n, n).

        Symmetric but for rounding; the diagonal is not 0, see `straight`.
        """
        return np.array([self.straight(start, q) for start in q])

    def along(self, points: FloatArray) -> float:
        """Return the travel time along a polyline (n + 1, k), rad or m, stopping at corners, s."""
        return self.trajectory(points)[0].duration_s

    def trajectory(self, points: FloatArray) -> tuple[Trajectory, float]:
        """Return the trajectory along a polyline (n + 1, k), and its largest point speed, m/s.

        The speed is of the fastest point of arm and tool, also if no such limit is kept. n >= 1.
        """
        peaks = self.speeds.peaks_m(points)
        limited = peaks if np.isfinite(self.limits.tool_speed) else ()
        trajectory = plan_trajectory(self.limits, points, limited)
        rates = [line.rate for line in trajectory.lines]
        return trajectory, float(np.max(np.multiply(peaks, rates)))

    def curve(self, points: FloatArray, shares: FloatArray) -> tuple[Curve, float]:
        """Return the fastest motion along a spline curve, and its largest point speed, m/s.

        ``points``: configurations that the curve passes, with begin and end, rad or m, (n, k);
        ``shares``: curve parameter at all of them but the end, ascending from 0, (n - 1,); at
        the end it is 1. Raises ValueError as `Spline.through`.
        """
        spline = Spline.through(points, np.append(shares, 1.0))
        at, places = spline.samples
        peak = float(np.max(self.speeds.fastest(places, spline.at(at, 1))))
        limited = peak if np.isfinite(self.limits.tool_speed) else 0.0
        curve = Curve.within(self.limits, spline, limited)
        return curve, peak * curve.rate
