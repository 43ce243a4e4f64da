# SPDX-License-Identifier: Apache-2.0
"""Standstills of streams of joints and points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from remaster_ros.collection.pairing import SensorRules
from remaster_ros.collection.still_frames import are_too_many, of_the_marker
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.settling import SettleRules
from remaster_ros.types import BoolArray, FloatArray, IntArray

# The arm may still swing so long after its encoders stand still, s.
SWING_S = 0.5
# Rows closer than this are a stream: no arm moves, stops and is measured within a second, s.
STREAM_S = 1.0
# Fewer samples have no standard deviation worth the name.
FEWEST_SAMPLES = 5
# Fewer rows of a table between two motions are no standstill that was recorded.
_FEWEST_ROWS = 3
# Of the blocks of a stream at least so many are of standstills, which gives the noise.
_STILL_SHARE = 0.1
# Largest range of so many normal samples, in standard deviations: 1e4 of them keep within 8.
_RANGE_STDS = 10.0
# A stream whose quietest part ranges over more than this share of its extent never stands still.
_QUIETEST = 0.01


def refuse_sliding(chain: SerialChain, path: Path) -> None:
    """Raise InputError for an arm with a prismatic joint: standstills are judged by angles.

    `path`: of the stream, for the message.
    """
    for joint in np.flatnonzero(chain.slides)[:1]:
        raise InputError(
            f"{path}: it is a stream, and joint '{chain.joint_names[joint]}' slides; standstills "
            'are found for arms whose joints all turn: give a table with one row for each '
            'configuration'
        )


@dataclass(frozen=True, eq=False)
class Stream:
    """Values reported over time: n stamps, s, with m values each."""

    # s, rising, (n,).
    stamps: FloatArray
    # (n, m).
    values: FloatArray

    @classmethod
    def of(cls, stamps: FloatArray, values: FloatArray) -> Stream:
        """Stream of the rows that are finite, in the order of their stamps, s."""
        finite = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(stamps))
        order = finite[np.argsort(stamps[finite], kind='stable')]
        return cls(stamps[order], values[order])


@dataclass(frozen=True, eq=False)
class Standstills:
    """Begin, end and mean value of each standstill of a stream."""

    # s, (n,); equal for single shots.
    begin: FloatArray
    end: FloatArray
    # (n, m).
    mean: FloatArray
    # Whether motion was seen before the begin and after the end, (n,): else the record begins or
    # ends there.
    opened: BoolArray
    closed: BoolArray

    def __len__(self) -> int:
        """Number of standstills."""
        return len(self.begin)

    @property
    def shots(self) -> bool:
        """Whether all are single measurements at one moment; True if there are none."""
        return bool(np.all(self.begin == self.end))

    @classmethod
    def of_shots(cls, stamps: FloatArray, values: FloatArray) -> Standstills:
        """Single measurements of an instrument, each taken while the arm stood still.

        `stamps`: s, (n,), begin and end of each; `values`: (n, m), the means. They are marked
        as neither `opened` nor `closed`: no motion before or after them was recorded.
        """
        none = np.zeros(len(stamps), bool)
        return cls(stamps, stamps, values, none, none)


def is_stream(stamps: FloatArray) -> bool:
    """Whether rows follow each other faster than an arm can stop and be measured.

    The median step is below 1 s and not 0; False for three rows or fewer. `stamps`: s, in any
    order.
    """
    if len(stamps) <= _FEWEST_ROWS:
        return False
    # Times that are all the same are none.
    return 0.0 < float(np.median(np.diff(np.sort(stamps)))) < STREAM_S


def joint_standstills(stream: Stream, fewest: int = 1) -> Standstills:
    """Standstills of joints, rad, that are longer than the arm may swing, 0.5 s.

    Each has at least `fewest` reports, which span up to 0.2 mrad in each joint, or ten standard
    deviations of the noise if that is more, and never over 1 mrad.
    """
    rules = SettleRules()
    noise = min(_RANGE_STDS * _quietest(stream), 5.0 * rules.still_tolerance)
    return _standstills(stream, max(rules.still_tolerance, noise), fewest)


def point_standstills(stream: Stream) -> Standstills:
    """Standstills of a marker, in any unit; empty if it never stood still.

    Longer than 0.5 s, of three values or more that span up to the tolerance: ten standard
    deviations of the noise (quietest tenth of the stream), or 1e-4 of the extent if that is
    more. If the tolerance is over 1 % of the extent, the marker never stood still.
    """
    # A frame that jumps is no motion.
    values = _median_of_five(stream.values)
    smooth = Stream(stream.stamps, values)
    extent = float(np.ptp(values, axis=0).max(initial=0.0))
    tolerance = max(_RANGE_STDS * _quietest(smooth), 1e-4 * extent)
    if tolerance > _QUIETEST * extent:
        return Standstills.of_shots(np.empty(0), np.empty((0, values.shape[1])))
    return _standstills(smooth, tolerance, _FEWEST_ROWS)


def _median_of_five(values: FloatArray) -> FloatArray:
    """Running median over five values, (n, m), with the ends repeated.

    Fewer than five values stay as they are.
    """
    if len(values) < FEWEST_SAMPLES:
        return values
    padded = np.pad(values, ((2, 2), (0, 0)), mode='edge')
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)
    return np.asarray(np.median(windows, axis=-1))


def _quietest(stream: Stream) -> float:
    """Standard deviation of the noise: that in the quietest tenth of a stream, 0 if unknown.

    The 10 % quantile over blocks of 0.5 s, at least five values, each with its noisiest
    column. 0 if the stream is shorter than a block.
    """
    step = float(np.median(np.diff(stream.stamps))) if len(stream.stamps) > 1 else SWING_S
    size = max(FEWEST_SAMPLES, round(SWING_S / max(step, 1e-4)))
    blocks = len(stream.values) // size
    if not blocks:
        return 0.0
    cut = stream.values[: blocks * size].reshape(blocks, size, -1)
    return float(np.quantile(cut.std(axis=1).max(axis=1), _STILL_SHARE))


def _standstills(stream: Stream, tolerance: float, fewest: int) -> Standstills:
    """Runs, longer than `SWING_S`, of at least `fewest` values that span `tolerance` or less.

    The span is that of each column, in the unit of the values. A gap between stamps, over 0.5
    s and over three usual steps, ends a run.
    """
    stamps, values = stream.stamps, stream.values
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    gap = max(SettleRules().max_gap_s, _FEWEST_ROWS * step)
    found: list[tuple[float, float, FloatArray, bool, bool]] = []
    first = 0
    low = high = values[0] if len(values) else np.empty(0)
    for i in range(1, len(values) + 1):
        joined = i < len(values) and stamps[i] - stamps[i - 1] <= gap
        if joined:
            lower, higher = np.minimum(low, values[i]), np.maximum(high, values[i])
            if np.all(higher - lower <= tolerance):
                low, high = lower, higher
                continue
        if stamps[i - 1] - stamps[first] > SWING_S and i - first >= fewest:
            opened = first > 0 and stamps[first] - stamps[first - 1] <= gap
            found.append((stamps[first], stamps[i - 1], mean_of(values[first:i]), opened, joined))
        if i < len(values):
            first, low, high = i, values[i], values[i]
    begin, end, mean, opened, closed = zip(*found, strict=True) if found else ((),) * 5
    return Standstills(
        np.array(begin, dtype=float),
        np.array(end, dtype=float),
        np.array(mean, dtype=float).reshape(len(found), values.shape[1]),
        np.array(opened, dtype=bool),
        np.array(closed, dtype=bool),
    )


def point_visits(stream: Stream) -> Standstills:
    """Standstills of a stream of points, or the single measurements of an instrument.

    Which of the two is decided by `is_stream`.
    """
    if is_stream(stream.stamps):
        return point_standstills(stream)
    return Standstills.of_shots(stream.stamps, stream.values)


def mean_of(rows: FloatArray) -> FloatArray:
    """Mean of rows (n, m), (m,), which is exact for equal rows.

    The plain mean of equal numbers is rounded and may differ from them in the last digit.
    """
    return np.asarray(rows[0] + (rows - rows[0]).mean(axis=0))


def reading_of(points: FloatArray) -> tuple[FloatArray, FloatArray, IntArray] | None:
    """Mean (3,) and standard deviation (3,) of a marker at a standstill.

    Last result: indices of the points used. `points` are in m, (n, 3), at least one. Of fewer
    than five the last is taken, with NaN as deviation. Else outliers, far from the median
    point compared with the median distance (`of_the_marker`), are not used. None if the marker
    was not still: over a tenth of the points (and more than one) are outliers, or the
    deviation along an axis is over 0.5 mm.
    """
    if len(points) < FEWEST_SAMPLES:
        # Shots of an instrument: the last one is the one that was kept.
        return points[-1], np.full(3, np.nan), np.array([len(points) - 1])
    kept = of_the_marker(points)
    if are_too_many(len(points) - int(kept.sum()), len(points)):
        return None
    # Of equal points 0, as `mean_of`.
    std = (points[kept] - points[kept][0]).std(axis=0, ddof=1)
    if std.max() > SensorRules('', '').max_std_m:
        return None
    return mean_of(points[kept]), std, np.flatnonzero(kept)


def between(stream: Stream, begin: float, end: float) -> slice:
    """Slice of a stream from 0.5 s (`SWING_S`) after `begin` to before `end`, s; may be empty."""
    first, last = np.searchsorted(stream.stamps, (begin + SWING_S, end))
    return slice(int(first), int(last))
