# SPDX-License-Identifier: Apache-2.0
"""Planned curves, driven in a hidden world of a moving arm and recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from worlds.moving_bags import imported
from worlds.moving_world import Dynamics, Errors, MovingWorld, Recording

from remaster_ros.motion.trajectory import RAMP_S, Curve
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.types import FloatArray, Session

REST_S = 3.5
"""Standstill between two curves, s."""


class PlannedMotion:
    """Joint angles along curves with standstills before, between and behind them, rad."""

    def __init__(self, curves: Sequence[Curve]) -> None:
        self._curves = curves
        times = np.cumsum([REST_S, *(curve.duration_s + REST_S for curve in curves)])
        self._starts = times[:-1]
        # First and last time, as a spline has them.
        self.x = np.array([0.0, times[-1]])

    def __call__(self, t: FloatArray, derivative: int = 0) -> FloatArray:
        """Return angles or their derivatives at times (n,), (n, k)."""
        index = np.clip(np.searchsorted(self._starts, t, 'right') - 1, 0, len(self._curves) - 1)
        found = np.zeros((len(t), len(self._curves[0].start)))
        for i, curve in enumerate(self._curves):
            mask = index == i
            since = np.clip(t[mask] - self._starts[i], 0.0, curve.duration_s)
            remaining_s = curve.duration_s - since
            speed = np.minimum(np.minimum(since, remaining_s) / RAMP_S, 1.0) * curve.rate
            change = np.where(remaining_s < RAMP_S, -1.0, np.where(since < RAMP_S, 1.0, 0.0))
            change = np.where(
                (since > 0.0) & (remaining_s > 0.0), change * curve.rate / RAMP_S, 0.0
            )
            share = np.array([curve.share(s)[0] for s in since.tolist()])
            first, second = curve.spline.at(share, 1), curve.spline.at(share, 2)
            found[mask] = (
                curve.spline.at(share),
                speed[:, None] * first,
                speed[:, None] ** 2 * second + change[:, None] * first,
            )[derivative]
        return found


def driven(
    cell: Workcell, curves: Sequence[Curve], seed: int, errors: Errors | None = None
) -> tuple[MovingWorld, Recording, Session]:
    """Return a world with the cell's markers, a recording of curves, and its session.

    All rows of the session are to be fitted.
    """
    rng = np.random.default_rng([seed, *b'world'])
    world = MovingWorld(cell.urdf_text, rng)
    world.nominal = np.array(list(cell.markers.values()))
    world.places = world.nominal + 0.5e-3 * rng.standard_normal(world.nominal.shape)
    recording = world.record(PlannedMotion(curves), Dynamics(), errors or Errors())
    session, _ = imported(world, recording, seed)
    fitted = np.zeros(len(session.measurements), bool)
    rows = replace(session.measurements, is_validation=fitted)
    return world, recording, replace(session, measurements=rows)
