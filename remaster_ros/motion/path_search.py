# SPDX-License-Identifier: Apache-2.0
"""Find a free path for the arm supervisor; slow, and so not called by the node's callbacks."""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.free_paths import free_path, way_out
from remaster_ros.motion.actions import CheckPath, PathAnswer
from remaster_ros.motion.path_check import FreePath, PointSpeeds

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
        """Free path for a request: the planned one, or another.

        Without one: what is in the way and, from a start that is not free, a way out if known. The
        same request always has the same answer. It takes up to seconds.
        """
        rng = np.random.default_rng(SEED)
        at_start = self._model.trouble(request.start)
        if at_start:
            out = way_out(self._model, request.start, rng)
            path = None if out is None else self._path(out, is_way_out=True)
            return PathAnswer(None, at_start, at_start=True, way_out=path)
        points = np.vstack([request.start, request.waypoints, request.target])
        trouble = self._model.path_trouble(points)
        if not trouble:
            return PathAnswer(self._path(points))
        found = free_path(
            self._model, request.start, request.target, rng, hints=list(request.waypoints)
        )
        return PathAnswer(None, trouble) if found is None else PathAnswer(self._path(found))

    def _path(self, points: np.ndarray, *, is_way_out: bool = False) -> FreePath:
        """Return points (n, k) as a path, with the peak speeds of its lines.

        ``is_way_out``: whether it leads out of a contact, and is gone slowly.
        """
        return FreePath(points, self._speeds.peaks_m(points), is_way_out)
