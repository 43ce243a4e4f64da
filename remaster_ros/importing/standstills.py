# SPDX-License-Identifier: Apache-2.0
"""Standstills of streams, the offset between their clocks, and tables of one row a standstill.

A log of joints and a camera's take have a clock each. Both stand still when the arm does: the
offset of the clocks is the one by which most begins and ends of standstills coincide. If the
visits are equally long, several offsets do; then the robot decides: with the right pairs its
modelled points differ little from the measured ones.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from remaster_ros.calibration.arrangement import linear_fit
from remaster_ros.collection.pairing import SensorRules
from remaster_ros.collection.still_frames import are_too_many, of_the_marker
from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Table
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.importing.values import angle_unit, length_unit, numbers, times
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
# Largest difference of begins and ends, s: those of a log of 10 Hz, and a clock that is 50 parts
# in a million fast over an hour.
_TOLERANCE_S = 0.3
# Begins and ends of one clock that are found in two streams differ by less, s.
_SAME_CLOCK_S = 0.05
# Offsets that are looked at, the likeliest first.
_MOST_OFFSETS = 60
# With so many pairs the 15 unknowns of the linear problem leave more equations than that over.
_FEWEST_FOR_ROBOT = 11
# A robot that is paired rightly leaves no larger share of the points' extent: zero-offsets of some
# degrees do, at most.
_LARGEST_ERROR = 0.15
# An offset that explains a tenth fewer standstills is as good: some are lost in either stream.
_ALIKE = 0.9


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
    """Values reported over time."""

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

        `stamps`: s, (n,); `values`: (n, m). Motion before and after counts as unseen.
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

    Longer than 0.5 s, of three values or more that span up to ten standard deviations of the
    quietest tenth, or 1e-4 of the extent. If that is over 1 % of the extent, the marker never
    stood still.
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
    """Standard deviation in the quietest part of a stream, of its noisiest column.

    The 10 % quantile over blocks of 0.5 s, of at least five values; 0 if there is no whole block.
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

    The span is that of each column. A gap between stamps, over 0.5 s and over three usual steps,
    ends a run.
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


@dataclass(frozen=True, eq=False)
class Matching:
    """Pairs of standstills of points and of joints."""

    # Indices, (n,) each.
    points: IntArray
    joints: IntArray
    # What is added to the points' times to have the joints'; None where the pairs are by order.
    offset_s: float | None
    # Median difference of begins and ends then; None where single shots have none.
    apart_s: float | None = None
    # What the robot leaves, as a share of the points' extent; None where there are too few.
    error: float | None = None

    def in_words(self, points: Standstills, joints: Standstills, names: tuple[str, str]) -> str:
        """Sentence on the number of pairs and the clock offset.

        `points`, `joints`: all standstills; `names` are those of points and joints.
        """
        what = 'points' if points.shots else 'standstills'
        text = (
            f'{len(self.points)} of {len(points)} {what} of {names[0]} match '
            f'{len(np.unique(self.joints))} of {len(joints)} standstills of {names[1]}'
        )
        if self.offset_s is None:
            return f'{text}, by their order: no offset of the clocks joins them'
        if self.apart_s is not None:
            text += f'; begins and ends agree within {self.apart_s:.2f} s (median)'
        if self.offset_s == 0.0:
            return f'{text}; the clocks are the same'
        return f'{text}; {names[1]} has the time of {names[0]} {self.offset_s:+.3f} s'


def point_visits(stream: Stream) -> Standstills:
    """Standstills of a stream of points, or the single measurements of an instrument.

    Which of the two is decided by `is_stream`.
    """
    if is_stream(stream.stamps):
        return point_standstills(stream)
    return Standstills.of_shots(stream.stamps, stream.values)


def match(
    points: Standstills,
    joints: Standstills,
    names: tuple[str, str],
    chain: SerialChain,
    offset_s: float | None = None,
) -> Matching:
    """Pair the standstills of points with those of the joints, rad.

    `names` are those of points and joints, for messages; `offset_s` is the clock offset, s, None
    to find it. The best one has pairs that the robot fits to 15 % of the points' extent, if there
    are 11 or more, else the most pairs; equal clocks and equal numbers in order are tried, too.
    Raises InputError if nothing stood still, no offset joins them, or several do equally well.
    """

    def error_of(i: IntArray, j: IntArray) -> float:
        """Residual of the robot for pairs, as a share of the points' extent."""
        return float(linear_fit(chain, joints.mean[j][None], points.mean[i])[0][0])

    for name, standstills in zip(names, (points, joints)):
        if not len(standstills):
            raise InputError(
                f'{name}: nothing in it stands still for {SWING_S:g} s, and only what is measured '
                'at a standstill belongs to one configuration; let the arm stop at each pose'
            )
    offsets = [offset_s] if offset_s is not None else [0.0, *_offsets(points, joints)]
    found = [_matching(points, joints, offset, error_of) for offset in offsets]
    found = [matching for matching in found if len(matching.points)]
    if offset_s is not None:
        if not found:
            raise InputError(
                f'--clock-offset {offset_s:g}: no standstills of {names[0]} and {names[1]} fall '
                'together; leave it out to have it found'
            )
        return found[0]
    if len(points) == len(joints):
        order = np.arange(len(points))
        found.append(_judged(order, order, None, None, error_of))
    right = [
        matching
        for matching in found
        if matching.error is not None and matching.error < _LARGEST_ERROR
    ]
    if right:
        least = min(matching.error for matching in right if matching.error is not None)
        # Twice the least: what a few wrong pairs add.
        found = [
            matching
            for matching in right
            if matching.error is not None and matching.error <= 2.0 * least
        ]
    else:
        found = [matching for matching in found if matching.offset_s is not None]
    if not found:
        raise InputError(
            f'{names[0]} and {names[1]}: no offset of their clocks brings their standstills '
            f'together ({len(points)} and {len(joints)}); are they of the same run? state the '
            'offset with --clock-offset, or join by name or by order (--join)'
        )
    most = max(len(matching.points) for matching in found)
    likely = [matching for matching in found if len(matching.points) >= _ALIKE * most]
    # Clocks that are the same need no robot: a part of the points is measured in motion then.
    same = [
        matching
        for matching in found
        if matching.offset_s == 0.0 and 2 * len(matching.points) >= most
    ]
    likely = likely if right else same or likely
    best = max(likely, key=lambda matching: (matching.offset_s == 0.0, len(matching.points)))
    rivals = [
        matching.offset_s
        for matching in likely
        if matching.offset_s is not None
        and best.offset_s is not None
        and abs(matching.offset_s - best.offset_s) > STREAM_S
        and not np.array_equal(matching.joints, best.joints)
    ]
    if rivals and not right and best.offset_s != 0.0:
        listed = ', '.join(
            f'{offset:.2f}' for offset in sorted([best.offset_s or 0.0, *rivals])[:5]
        )
        raise InputError(
            f'{names[0]} and {names[1]}: their standstills match as well with several offsets of '
            f'the clocks ({listed} s), and the robot fits none; state it with --clock-offset'
        )
    return best


def _matching(
    points: Standstills,
    joints: Standstills,
    offset: float,
    error_of: Callable[[IntArray, IntArray], float],
) -> Matching:
    """Pairs of standstills that overlap with a clock offset, s, with the refined offset.

    Each standstill of the joints gets one of the points, with which it shares over half of the
    shorter one's time; of shots all that fall into it. ``apart_s`` is the median difference of
    begins and ends then. No pairs if none overlap.
    """
    begin, end = points.begin + offset, points.end + offset
    before = np.searchsorted(joints.end, begin)
    after = np.searchsorted(joints.begin, end, side='right')
    pairs: dict[int, tuple[float, int]] = {}
    rows, of = [], []
    for i in range(len(points)):
        for j in range(before[i], after[i]):
            common = min(end[i], joints.end[j]) - max(begin[i], joints.begin[j])
            shorter = min(end[i] - begin[i], joints.end[j] - joints.begin[j])
            if points.shots:
                if common >= 0.0:
                    rows.append(i)
                    of.append(j)
            elif common > 0.5 * shorter and common > pairs.get(j, (0.0, 0))[0]:
                pairs[j] = common, i
    if not points.shots:
        of = sorted(pairs)
        rows = [pairs[j][1] for j in of]
    a, b = np.array(rows, dtype=np.int64), np.array(of, dtype=np.int64)
    if points.shots or not len(a):
        return _judged(a, b, offset, None, error_of)
    begins = (joints.begin[b] - points.begin[a])[joints.opened[b] & points.opened[a]]
    ends = (joints.end[b] - points.end[a])[joints.closed[b] & points.closed[a]]
    if not len(begins) + len(ends):
        return _judged(a, b, offset, None, error_of)
    # What is found to stand still for longer begins earlier and ends later: that is no offset.
    refined = float(np.mean([np.median(edges) for edges in (begins, ends) if len(edges)]))
    if offset == 0.0 and abs(refined) <= _SAME_CLOCK_S:
        # Clocks that are the same but for how the standstills are found stay so.
        refined = 0.0
    differences = np.abs(np.concatenate((begins, ends)) - refined)
    return _judged(a, b, refined, float(np.median(differences)), error_of)


def _judged(
    i: IntArray,
    j: IntArray,
    offset: float | None,
    difference: float | None,
    error_of: Callable[[IntArray, IntArray], float],
) -> Matching:
    """Matching of pairs (indices of points `i` and joints `j`), with the residual of the robot.

    The residual is None for fewer than 11 pairs. `offset`, `difference`: s.
    """
    error = error_of(i, j) if len(i) >= _FEWEST_FOR_ROBOT else None
    return Matching(i, j, offset, difference, error)


def _offsets(points: Standstills, joints: Standstills) -> list[float]:
    """Clock offsets, s, that bring many standstills together, the likeliest first.

    To be added to the points' times; 60 at most, over 0.3 s apart, each with at least half as many
    begins and ends as the best.
    """
    if points.shots:
        return _offsets_of_shots(points.begin, joints)
    differences = [
        (joints.begin[joints.opened][None] - points.begin[points.opened][:, None]).ravel(),
        (joints.end[joints.closed][None] - points.end[points.closed][:, None]).ravel(),
    ]
    lags = np.sort(np.concatenate(differences))
    if not len(lags):
        lags = np.sort((joints.begin[None] - points.begin[:, None]).ravel())
    count = np.searchsorted(lags, lags + _TOLERANCE_S, side='right') - np.arange(len(lags))
    offsets: list[float] = []
    for at in np.argsort(-count, kind='stable'):
        offset = float(np.median(lags[at : at + count[at]]))
        if all(abs(offset - other) > _TOLERANCE_S for other in offsets):
            offsets.append(offset)
        if len(offsets) == _MOST_OFFSETS or count[at] < 0.5 * count.max():
            break
    return offsets


def _offsets_of_shots(shots: FloatArray, joints: Standstills) -> list[float]:
    """Clock offsets, s, with which most shots fall into standstills: the middle of each range.

    The likeliest first, 60 at most. `shots`: their times, s.
    """
    starts = (joints.begin[None] - shots[:, None]).ravel()
    stops = (joints.end[None] - shots[:, None]).ravel()
    at = np.concatenate((starts, stops))
    order = np.argsort(at, kind='stable')
    at = at[order]
    count = np.cumsum(np.where(order < len(starts), 1, -1))
    offsets: list[float] = []
    # A range of offsets ends where a shot leaves its standstill.
    ranges = np.flatnonzero((np.diff(count) < 0) & (np.diff(at) > 0.0))
    for i in ranges[np.argsort(-count[ranges], kind='stable')][:_MOST_OFFSETS]:
        offsets.append(float(0.5 * (at[i] + at[i + 1])))
    return offsets


def mean_of(rows: FloatArray) -> FloatArray:
    """Mean of rows (n, m), (m,), which is exact for equal rows.

    The plain mean of equal numbers is rounded and may differ from them in the last digit.
    """
    return np.asarray(rows[0] + (rows - rows[0]).mean(axis=0))


def reading_of(points: FloatArray) -> tuple[FloatArray, FloatArray, IntArray] | None:
    """Mean (3,) and standard deviation (3,) of a marker at a standstill.

    Last result: indices of the points used. `points` are in m, (n, 3), at least one. Of fewer than
    five the last is taken, with NaN as deviation. None if the marker was not still: over a tenth
    of the points (and more than one) are far from the median, or the deviation along an axis is
    over 0.5 mm.
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


# Tables that are streams (a take, a log of joints) as tables of standstills, one row each.


# Reports of a table at one standstill, at least: two equal rows may be two shots.
FEWEST_REPORTS = 3


@dataclass(frozen=True, eq=False)
class Stopped:
    """Tables of points and joints, one row a standstill, that belong together row by row."""

    points: Table
    joints: Table
    # When each was measured, or the standstill ended, by the clock of the joints, s, (n,).
    stamp_s: FloatArray
    # How, and what was left out, a sentence each.
    description: tuple[str, ...]
    warnings: tuple[str, ...]


def stopped(
    points: Table,
    joints: Table,
    chain: SerialChain,
    angles: str = '',
    length: str = '',
    clock_offset_s: float | None = None,
    in_order: bool = False,
) -> Stopped | None:
    """Tables with one row a standstill if the joints are a stream; None if they are not.

    `angles`, `length`: units that the user stated, '' if none; `clock_offset_s`: added to the
    points' times to have the joints', None to find it. `in_order`: pair points with standstills by
    their order, as the user said; None also if the rows are then equally many. Raises InputError
    for a stream that never stands still, standstills that do not match, no point at one, or a
    prismatic joint.
    """
    reported = times(*joints)
    if reported is None or not is_stream(reported):
        return None
    same = points[0] is joints[0]
    if in_order and (same or len(points[0].rows) == len(joints[0].rows)):
        return None
    when = reported if same else times(*points)
    refuse_sliding(chain, joints[0].path)
    unit = ANGLES[angle_unit(*joints, angles)[0]]
    q = Stream.of(reported, unit * numbers(joints[0], joints[1].joints, optional=True))
    still = joint_standstills(q, FEWEST_REPORTS)
    if same and not len(still) and np.median(np.diff(np.sort(reported))) >= SWING_S:
        # Rows of single readings with times of their own kind.
        return None
    if not len(still):
        raise InputError(
            f'{joints[0].path}: the joints never stand still for {SWING_S:g} s, and only what is '
            'measured at a standstill belongs to one configuration; let the arm stop at each pose'
        )
    names = points[0].path.name, joints[0].path.name
    if when is None or in_order:
        return _by_order(points, joints, chain, still, reported, unit, names, in_order)
    markers = {
        name: Stream.of(when, numbers(points[0], columns, optional=True))
        for name, columns in points[1].points.items()
    }
    first = max(markers.values(), key=lambda stream: _extent(stream.values))
    if not len(first.stamps):
        raise InputError(f'{points[0].path}: it has no point that was measured')
    dense = same or is_stream(first.stamps)
    # Where the points are in the time of their own table, for each standstill of the joints.
    windows = np.column_stack((still.begin, still.end))
    how = f'{len(still)} standstills'
    if not same:
        seen = point_visits(first)
        matching = match(seen, still, names, chain, clock_offset_s)
        how = matching.in_words(seen, still, names)
        if not dense:
            rows = _rows_of(first.stamps[matching.points], when)
            return Stopped(
                (points[0].select(rows), points[1]),
                _at_rest(joints, still, matching.joints, reported, unit),
                still.end[matching.joints]
                if matching.offset_s is None
                else when[rows] + matching.offset_s,
                (how,),
                (
                    *_unpaired(points, rows, when, q.stamps, matching.offset_s),
                    *_lost(len(still), matching.joints, names[1]),
                ),
            )
        if matching.offset_s is not None:
            windows = windows - matching.offset_s
        else:
            windows = np.full_like(windows, np.nan)
            windows[matching.joints] = np.column_stack((seen.begin, seen.end))[matching.points]
    scale = _scale(points, chain, length, first, windows, still)
    at, table, unsteady = _means(points, when, windows, scale)
    if not len(at):
        raise InputError(
            f'{names[0]}: at none of the {len(still)} standstills of {names[1]} was a point still'
        )
    return Stopped(
        table,
        _at_rest(joints, still, at, reported, unit),
        still.end[at],
        (f'{how}; means from {SWING_S:g} s after the arm stood still',),
        (
            *[f'{unsteady} readings of a marker that was not still were left out']
            * bool(unsteady),
            *_lost(len(still), at, names[1]),
        ),
    )


def _by_order(
    points: Table,
    joints: Table,
    chain: SerialChain,
    still: Standstills,
    reported: FloatArray,
    unit: float,
    names: tuple[str, str],
    is_stated: bool,
) -> Stopped:
    """Pair points without times with equally many standstills, if the robot agrees or `is_stated`.

    The robot agrees if it fits the first marker of 11 points or more to 15 % of their extent.
    `reported`: times of the joints' rows, s; `unit`: of their angles, rad. Raises InputError if
    the numbers differ or the robot disagrees.
    """
    raw = numbers(points[0], points[1].point, optional=True)
    rows = np.flatnonzero(np.isfinite(raw).any(axis=1))
    if len(rows) != len(still):
        raise InputError(
            f'{names[0]}: {len(rows)} points, and {len(still)} standstills in {names[1]}; only '
            'equally many can be joined by their order: remove what has no standstill, or give '
            'the points the times at which they were measured'
        )
    order = np.arange(len(still))
    if not is_stated:
        of_first = raw[rows, : len('xyz')]
        known = np.flatnonzero(np.isfinite(of_first).all(axis=1))
        error = np.inf
        if len(known) >= _FEWEST_FOR_ROBOT:
            error = float(linear_fit(chain, still.mean[known][None], of_first[known])[0][0])
        if error > _LARGEST_ERROR:
            raise InputError(
                f'{names[0]} has no times, and by their order its points are not those of the '
                f'standstills in {names[1]}; give them the times at which they were measured, or '
                'say --join order if they are right so'
            )
    what = 'by their order, as told' if is_stated else 'by their order, with which the robot fits'
    return Stopped(
        (points[0].select(rows.tolist()), points[1]),
        _at_rest(joints, still, order, reported, unit),
        still.end,
        (f'{len(rows)} points of {names[0]} match the standstills of {names[1]} {what}',),
        (),
    )


def _unpaired(
    points: Table, kept: IntArray, when: FloatArray, span: FloatArray, offset: float | None
) -> tuple[str, ...]:
    """Sentences on shots that belong to no standstill: in motion, or outside the record.

    `kept`: rows that belong to one; `when`: times of all rows, s; `span`: times of the joints, s,
    in order; `offset`: of the clocks, s, None for 0.
    """
    lost = np.setdiff1d(np.flatnonzero(np.isfinite(when)), kept)
    clock = when[lost] + (offset or 0.0)
    inside = (clock >= span[0]) & (clock <= span[-1])
    notes = []
    for rows, why in (
        (lost[inside], 'measured while the arm moved'),
        (lost[~inside], 'measured before or after the record of the joints'),
    ):
        if len(rows):
            notes.append(f'{points[0].at_rows(rows.tolist())}: {why}, left out')
    return tuple(notes)


def _lost(count: int, kept: IntArray, name: str) -> tuple[str, ...]:
    """Sentence on the standstills without a point; () if there are none.

    `count`: of all standstills; `kept`: indices of those with a point.
    """
    lost = count - len(np.unique(kept))
    return (f'{lost} standstills of {name} without a point were left out',) * bool(lost)


def _extent(values: FloatArray) -> float:
    """Longest side of the box around points (n, m); 0 without points."""
    return float(np.ptp(values, axis=0).max()) if len(values) else 0.0


def _rows_of(stamps: FloatArray, when: FloatArray) -> IntArray:
    """Index in `when` of each stamp; equal stamps are different rows, in order."""
    order = np.argsort(when, kind='stable')
    sorted_when = when[order]
    taken: dict[float, int] = {}
    rows = []
    for stamp in stamps:
        rows.append(order[np.searchsorted(sorted_when, stamp) + taken.get(stamp, 0)])
        taken[stamp] = taken.get(stamp, 0) + 1
    return np.array(rows, dtype=np.int64)


def _scale(
    points: Table,
    chain: SerialChain,
    stated_unit: str,
    stream: Stream,
    windows: FloatArray,
    still: Standstills,
) -> float:
    """Scale of the points to m, from their unit; 1 if no window has a point.

    By the stated unit (`stated_unit`), the header, or the modelled tool at the standstills.
    `windows`: begin and end of each by the points' clock, s, (n, 2).
    """
    parts = [stream.values[between(stream, *window)] for window in windows]
    seen = [j for j, part in enumerate(parts) if len(part)]
    if not seen:
        return 1.0
    raw = np.array([np.median(parts[j], axis=0) for j in seen])
    modelled = chain.forward(still.mean[seen])[:, :3, 3]
    return LENGTHS[length_unit(*points, stated_unit, raw, modelled)[0]]


def _means(
    points: Table, when: FloatArray, windows: FloatArray, scale: float
) -> tuple[IntArray, Table, int]:
    """Indices of the standstills with a point, and the table of their mean points.

    Columns for standard deviations and the number of samples are added at the end. Last result:
    the number of readings left out because the marker was not still. `windows`: begin and end of
    each standstill by the clock of `when`, s, (n, 2); `scale`: unit of the points, m.
    """
    table, columns = points
    spread = {
        name: tuple(range(len(table.names) + 3 * i, len(table.names) + 3 * i + 3))
        for i, name in enumerate(columns.points)
    }
    width = len(table.names) + 3 * len(spread)
    streams = {}
    for name, marker_columns in columns.points.items():
        both = numbers(
            table, (*marker_columns, *columns.orientations.get(name, ())), optional=True
        )
        streams[name] = Stream.of(when, np.column_stack((both, np.arange(len(both)))))
    at, rows, lines, unsteady = [], [], [], 0
    for j, window in enumerate(windows):
        cells: list[str] = []
        for name, stream in streams.items():
            values = stream.values[between(stream, *window)]
            if not len(values):
                continue
            reading = reading_of(scale * values[:, :3])
            if reading is None:
                unsteady += 1
                continue
            _, std, kept = reading
            # In the unit of the table, as one of its rows would have it.
            mean = mean_of(values[kept, :3])
            if not cells:
                first = int(values[kept[0], -1])
                blank = {*columns.point, *columns.others.get('samples', ())}
                cells = ['' if i in blank else cell for i, cell in enumerate(table.rows[first])]
                cells += [''] * (width - len(cells)) + [str(len(kept))]
                lines.append(table.lines[first])
            turned = columns.orientations.get(name, ())
            for column, value in (
                *zip(columns.points[name], mean),
                *zip(spread[name], std / scale),
                *zip(turned, _mean_turn(values[kept, 3:-1]) if turned else ()),
            ):
                cells[column] = '' if np.isnan(value) else _text(value, table.decimal)
        if cells:
            at.append(j)
            rows.append(tuple(cells))
    names = [f'std {axis} of {name or "the point"}' for name in spread for axis in 'xyz']
    other_columns = {kind: list(of) for kind, of in columns.others.items()}
    other_columns['samples'] = [width]
    return (
        np.array(at, dtype=np.int64),
        (
            replace(
                table,
                names=(*table.names, *names, 'samples of the mean'),
                rows=tuple(rows),
                lines=tuple(lines),
            ),
            replace(
                columns,
                stds=spread,
                others=defaultdict(list, other_columns),
                ambiguous_orientation=(),
            ),
        ),
        unsteady,
    )


def _mean_turn(turns: FloatArray) -> FloatArray:
    """Mean of quaternions (n, 4) that are near each other, but for their sign; length 1, (4,)."""
    mean = (turns * np.where(turns @ turns[0] < 0.0, -1.0, 1.0)[:, None]).mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _at_rest(
    joints: Table, still: Standstills, at: IntArray, reported: FloatArray, unit: float
) -> Table:
    """Table of joints with one row, the mean, for each of the standstills `at` (indices).

    Other cells are those of the first row of the standstill. `reported`: times of the rows, s;
    `unit`: of the angles, rad.
    """
    table, columns = joints
    rows, lines = [], []
    order = np.argsort(reported, kind='stable')
    for j in at:
        first = int(order[np.searchsorted(reported[order], still.begin[j])])
        cells = list(table.rows[first])
        for column, value in zip(columns.joints, still.mean[j] / unit, strict=True):
            cells[column] = _text(value, table.decimal)
        rows.append(tuple(cells))
        lines.append(table.lines[first])
    return replace(table, rows=tuple(rows), lines=tuple(lines)), columns


def _text(value: float, decimal: str) -> str:
    """A number as text, with all its digits and `decimal` as its decimal sign."""
    return repr(float(value)).replace('.', decimal)
