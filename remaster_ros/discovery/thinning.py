"""Large sessions: part of the rows is searched, and the rest tests what was found.

The search holds thousands of columns of every row it is given, 0.1 MB each. An effect stands out
of the noise with the root of their number, so beyond `MOST_ROWS` rows little is gained: an effect
that 100,000 rows just show is a seventh of the size of one that 2,000 just show, a few hundredths
of the noise of one reading. So the search is given a part of them, drawn evenly over time and
sensors. Everything else works on all rows: the offsets before, the sampled model with the causes,
the gain. The rows that were not searched test the causes with their parameters frozen.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from remaster_ros.calibration.smooth_functions import evenly
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray, Measurements

MOST_ROWS = 2_000
"""Rows from which on a session is searched in part.

Time and memory grow with the rows that are searched: with 3,000 those of 20,000 rows take 1.3 GiB
in place of 0.9 (benchmarks/bench_large_session.py). The least effect that shows in a session of
3,000 rows is larger by a fifth, as the square root of the rows.
"""
FEWEST_TO_SEARCH = 12
"""Poses from which on a search for causes is worth its while."""
FEWEST_POSES = 500
"""Of the poses that the same sensors measured: fewer rows of each are drawn before fewer poses."""
FEWEST_ROWS = 2
"""Of a sensor at a pose: what is common to a pose shows in no single row."""


class Thinning(Struct, frozen=True):
    """Number of rows searched for causes, and RMS errors of the rows that were not searched."""

    # Rows that were searched, and all that could have been
    searched: int
    rows: int
    # RMS of the 3-D error over the rows that were not, m: what the offsets leave, and what is left
    # with the causes as the search fitted them, frozen
    others_rms_before_m: float
    others_rms_after_m: float


def draw_rows(
    measurements: Measurements,
    rows: IntArray,
    rng: np.random.Generator,
    most: int = MOST_ROWS,
) -> IntArray:
    """Return about `most` of the given rows, drawn evenly over time; all if they are fewer.

    Whole poses are drawn, one of every few consecutive ones that the same sensors measured. If
    that would leave fewer than `FEWEST_POSES` of these, so many are drawn, with fewer rows of
    each. ``rows``: indices; the result is sorted.
    """
    if len(rows) <= most:
        return rows
    share = most / len(rows)
    rows = rows[np.lexsort((rows, measurements.stamp_s[rows]))]
    _, first, pose = np.unique(measurements.pose[rows], return_index=True, return_inverse=True)
    seen = np.zeros((len(first), int(measurements.sensor.max()) + 1), bool)
    seen[pose, measurements.sensor[rows]] = True
    kept = []
    kinds = np.unique(seen, axis=0, return_inverse=True)[1].ravel()
    for kind in range(int(kinds.max()) + 1):
        poses = np.flatnonzero(kinds == kind)
        poses = poses[np.argsort(first[poses])]
        wanted = share * len(poses)
        drawn = poses
        if len(poses) > FEWEST_POSES:
            drawn = poses[_one_of_each(len(poses), max(FEWEST_POSES, round(wanted)), rng)]
        mine = np.flatnonzero(np.isin(pose, drawn))
        if wanted < FEWEST_POSES:
            group = pose[mine] * seen.shape[1] + measurements.sensor[rows[mine]]
            mine = mine[_some_of_each_group(group, wanted / len(drawn), rng)]
        kept.append(rows[mine])
    return np.sort(np.concatenate(kept))


def of_spread_poses(measurements: Measurements, rows: IntArray) -> IntArray:
    """Return about `MOST_ROWS` of the given rows (indices), of evenly spread poses.

    All rows if they are fewer.
    """
    pose = np.unique(measurements.pose[rows], return_inverse=True)[1]
    kept = evenly(int(pose.max(initial=-1)) + 1, MOST_ROWS / max(MOST_ROWS, len(rows)))
    return rows[np.isin(pose, kept)]


def judge_by_others(
    data: Residuals, rows: IntArray, searched: IntArray, empty: Solution, solution: Solution
) -> Thinning:
    """Measure how the causes, as the search fitted them, predict rows that it did not see.

    ``rows``: indices of all rows that could have been searched; ``searched``: those that were;
    ``empty``, ``solution``: fits without and with the causes.
    """
    unsearched_rows = np.setdiff1d(rows, searched)

    def left(fit: Solution) -> float:
        errors: FloatArray = data.unexplained(fit)[unsearched_rows]
        return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))

    return Thinning(len(searched), len(rows), left(empty), left(solution))


def _one_of_each(count: int, strata: int, rng: np.random.Generator) -> IntArray:
    """Draw one index from each of `strata` successive parts of 0 … count − 1, (strata,).

    The parts are of about equal length; count is at least strata.
    """
    edges = np.linspace(0, count, strata + 1).astype(np.int64)
    return edges[:-1] + (rng.random(strata) * np.diff(edges)).astype(np.int64)


def _some_of_each_group(group: IntArray, share: float, rng: np.random.Generator) -> IntArray:
    """Return sorted indices of a random share of each group's members, evenly in their order.

    ``group``: number of each member's group, (n,). At least `FEWEST_ROWS` of a group, or all.
    """
    order = np.argsort(group, kind='stable')
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    kept = []
    for start, size in zip(starts, np.diff(np.append(starts, len(group))), strict=True):
        wanted = min(int(size), max(FEWEST_ROWS, round(share * size)))
        kept.append(order[start + _one_of_each(int(size), wanted, rng)])
    return np.sort(np.concatenate(kept))
