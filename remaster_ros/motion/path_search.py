# SPDX-License-Identifier: Apache-2.0
"""Find a free path for the arm supervisor; slow, and so not called by the node's callbacks."""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.free_paths import free_path, way_out
from remaster_ros.motion.actions import CheckPath, PathAnswer
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.path_check import FreePath, PointSpeeds
from remaster_ros.motion.spline import BEGINS_RAD, SAGITTA_RAD, Spline

SEED = 20


class PathSearch:
    """Check of the planner's path, and search for another if it is not free.

    Parameters
    ----------
    model
        Arm, tool, floor and obstacles.
    speeds
        Of the fastest point.
    """

    def __init__(self, model: CollisionModel, speeds: PointSpeeds) -> None:
        self._model, self._speeds = model, speeds

    def find(self, request: CheckPath) -> PathAnswer:
        """Answer a request with a free path: the planned one if it is free, or another.

        Without one: what is in the way and, from a start that is not free, a way out if known.
        The same request always has the same answer. It takes up to seconds.
        """
        rng = np.random.default_rng(SEED)
        at_start = self._model.trouble(request.start)
        if at_start:
            out = way_out(self._model, request.start, rng)
            path = None if out is None else self._path(out, is_way_out=True)
            return PathAnswer(None, at_start, at_start=True, way_out=path)
        curve = self._curve(request)
        if curve is not None:
            return PathAnswer(curve)
        waypoints = request.waypoints[: 0 if len(request.shares) else None]
        points = np.vstack([request.start, waypoints, request.target])
        trouble = self._model.path_trouble(points)
        if not trouble:
            return PathAnswer(self._path(points))
        found = free_path(self._model, request.start, request.target, rng, hints=list(waypoints))
        return PathAnswer(None, trouble) if found is None else PathAnswer(self._path(found))

    def _curve(self, request: CheckPath) -> FreePath | None:
        """Return the curve of a request as a path; None if it has no curve, or that is not free.

        None also for an arm that stands elsewhere than at the curve's beginning
        (`BEGINS_RAD`): it was stopped on its way, say, and goes to the target by any free
        path.
        """
        shares, points = request.shares, request.waypoints
        if not len(shares):
            return None
        units = JointUnits.of(self._model.chain)
        if units.largest(request.start - points[0]) > BEGINS_RAD:
            return None
        # From where the arm stands: the servo leaves it a little off.
        through = np.vstack([request.start, points[1:], request.target])
        spline = Spline.through(through, np.append(shares, 1.0))
        samples = spline.samples[1]
        if self._model.path_trouble(samples, beside_chords_m(self._model)):
            return None
        fastest = self._speeds.fastest(samples, spline.at(spline.samples[0], 1))
        return FreePath(samples, (float(np.max(fastest)),), curve=spline)

    def _path(self, points: np.ndarray, *, is_way_out: bool = False) -> FreePath:
        """Return points (n, k) as a path, with the peak speeds of its lines.

        ``is_way_out``: whether it leads out of a contact, and is gone slowly.
        """
        return FreePath(points, self._speeds.peaks_m(points), is_way_out)


def beside_chords_m(model: CollisionModel) -> float:
    """Bound on two bodies' relative displacement between a curve and its chords, m.

    The chords join the curve's samples; no joint is further than `SAGITTA_RAD` from them.
    """
    joints = len(model.chain)
    return model.travel(np.zeros(joints), np.full(joints, SAGITTA_RAD))
