# SPDX-License-Identifier: Apache-2.0
"""Matching of standstills of points and of joints, with the offset between their clocks.

A log of joints and a camera's take have a clock each. Both stand still when the arm does: the
offset of the clocks is the one by which most begins and ends of standstills coincide. If the
visits are equally long, several offsets do; then the robot decides: with the right pairs its
modelled points differ little from the measured ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.arrangement import linear_fit
from remaster_ros.errors import InputError
from remaster_ros.importing.standstills import STREAM_S, SWING_S, Standstills
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray

# Largest difference of begins and ends, s: those of a log of 10 Hz, and a clock that is 50 parts
# in a million fast over an hour.
_TOLERANCE_S = 0.3
# Begins and ends of one clock that are found in two streams differ by less, s.
_SAME_CLOCK_S = 0.05
# Offsets that are looked at, the likeliest first.
_MOST_OFFSETS = 60
# With so many pairs the 15 unknowns of the linear problem leave more equations than that over.
FEWEST_FOR_ROBOT = 11
# A robot that is paired rightly leaves no larger share of the points' extent: zero-offsets of some
# degrees do, at most.
LARGEST_ERROR = 0.15
# An offset that explains a tenth fewer standstills is as good: some are lost in either stream.
_ALIKE = 0.9


@dataclass(frozen=True, eq=False)
class Matching:
    """Pairs of standstills of points and of joints, with the offset between their clocks."""

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


def match(
    points: Standstills,
    joints: Standstills,
    names: tuple[str, str],
    chain: SerialChain,
    offset_s: float | None = None,
) -> Matching:
    """Pair the standstills of points with those of the joints (mean: rad, (n, k)).

    `names`: of the streams of points and of joints, for messages. `offset_s`: clock offset, s,
    added to the points' times to have the joints'; None to choose among 0, the offsets that
    bring most standstills together and, if both are equally many, pairing by order. Chosen is
    what the robot fits to 15 % of the points' extent, tested with 11 pairs or more; if nothing
    does, the offset with most pairs, where 0 needs half as many. Raises InputError if nothing
    stood still, no offset gives pairs, or several give as many and the robot fits none.
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
        if matching.error is not None and matching.error < LARGEST_ERROR
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
    """Pairs of standstills that overlap with a clock offset, and the refined offset, s.

    `offset`: added to the points' times, s. Each standstill of the joints is paired with the
    standstill of points with which it shares most time, which must be over half of the shorter
    one; or with all single shots that fall into it. ``apart_s`` of the result is the median
    difference of begins and ends after the refined offset, None for shots. The result has no
    pairs if none overlap. `error_of`: function of the index arrays of points and joints:
    residual of the robot.
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
    """Matching of given pairs, with the residual by which the robot fits them.

    `i`, `j`: indices of points and joints, (n,); `offset`: of the clocks, s; `difference`: of
    begins and ends, s; `error_of`: residual of pairs as a share of the points' extent. The
    residual is None for fewer than 11 pairs.
    """
    error = error_of(i, j) if len(i) >= FEWEST_FOR_ROBOT else None
    return Matching(i, j, offset, difference, error)


def _offsets(points: Standstills, joints: Standstills) -> list[float]:
    """Clock offsets, s, that bring many standstills together, the likeliest first.

    To be added to the points' times. 60 at most, over 0.3 s apart, each with at least half as
    many coinciding begins and ends as the best one; of single shots those of
    `_offsets_of_shots`.
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
    """Clock offsets, s, with which most single shots fall into standstills of the joints.

    Those with most shots first, 60 at most. The number of shots is constant over a range of
    offsets; each result is the middle of such a range. `shots`: their times, s, (n,).
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
