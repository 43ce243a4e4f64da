# SPDX-License-Identifier: Apache-2.0
"""From when on a sensor's readings are off: it, or its marker, was moved in mid-session."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from remaster_ros.types import FloatArray, IntArray, Measurements

FEWEST_POSES = 8
# Of any step, at all moments at which one is tried.
SIGNIFICANCE = 1e-3


class Moved(NamedTuple):
    """About which observation is the first after it, and the shift of the readings, m, (3,)."""

    observation: int
    shift: FloatArray


def moved_since(measurements: Measurements, rows: IntArray, errors: FloatArray) -> Moved | None:
    """Return from when on errors are others than before; None where nothing shows it.

    The moment is the one between two poses that divides the means of the poses best. The step is
    tested by F, at all moments (Bonferroni).

    Parameters
    ----------
    measurements
        Of the session.
    rows
        Those of one sensor, in any order, (n,).
    errors
        Measured minus modelled positions of these rows, in any one frame, m, (n, 3).
    """
    order = np.argsort(measurements.stamp_s[rows], kind='stable')
    rows, errors = rows[order], errors[order]
    if len(rows) == 0 or measurements.stamp_s[rows[0]] == measurements.stamp_s[rows[-1]]:
        return None
    _, first, pose = np.unique(measurements.pose[rows], return_index=True, return_inverse=True)
    # Poses in the order of their first row.
    place, poses = np.argsort(np.argsort(first))[pose], len(first)
    if poses < FEWEST_POSES:
        return None
    count = np.bincount(place)
    means = np.column_stack([np.bincount(place, axis) / count for axis in errors.T])
    before = np.arange(1, poses)[:, None]
    after = poses - before
    sums = np.cumsum(means, axis=0)
    step = (sums[-1] - sums[:-1]) / after - sums[:-1] / before
    explained = (before * after / poses)[:, 0] * np.sum(step**2, axis=1)
    at = int(np.argmax(explained))
    left = float(np.sum((means - means.mean(axis=0)) ** 2) - explained[at])
    freedom = 3 * (poses - 2)
    ratio = explained[at] / 3.0 / (max(left, 1e-30) / freedom)
    p_value = scipy.special.fdtrc(3, freedom, ratio) * len(step)
    if p_value > SIGNIFICANCE:
        return None
    return Moved(int(measurements.observation[rows[place > at][0]]), step[at])
