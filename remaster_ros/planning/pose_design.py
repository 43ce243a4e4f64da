# SPDX-License-Identifier: Apache-2.0
"""Choose poses that tell the most in the least time: greedy, then exchange.

A-optimal for the joint offsets (least sum of their variances), I-optimal for the tool (least mean
variance of the predicted markers in a box), or a mixture of both. What is chosen is a pose in all
its joint solutions, with their information and their time, or single configurations. They are
added one by one, each the one that lowers the criterion the most for its time, until the wanted
standard deviations are reached; those that are not needed any more are left out. Then poses are
exchanged while that saves robot time: one is brought in with all its solutions, or some are left
out and what is missing is filled up, and again what is not needed is left out.

Single configurations are not exchanged, as V. V. Fedorov's and T. J. Mitchell's (DETMAX)
algorithms do: the error that the configurations of a pose share makes the first of a pose tell
little, and all of them together much, so that such exchanges end in poor local optima. For the
same reason the information of configurations does not add up: a design by weights (convex
relaxation) has to weigh subsets of the solutions of a pose. benchmarks/RESULTS.md compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.discovery.screening import FEWEST_POSES
from remaster_ros.errors import InsufficientDataError
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import BoolArray, FloatArray, IntArray

REPEATED_POSES = 6
"""Poses measured in two solutions or more, at least. Their differences alone distinguish the noise
of a reading from the error that a pose shares: with M markers, 6 of them give a standard deviation
of the former that is known to 1 / sqrt(2 * 18 M), 17 % with one marker."""
HELD_OUT_POSES = 12
"""Poses held out, at least: from 12 on the p-values of a search for causes come from flipped poses
(`discovery.screening`), on held-out rows as on the others, and 12 poses of 3 coordinates give the
RMS error on them to 12 %."""
HELD_OUT_SOLUTIONS = 2
"""Solutions of each, where not all are visited: two are what the relative metric compares."""
MOST_CONFIGURATIONS = 400
"""A design that needs more is not reached."""
MOST_EXCHANGES, EFFORT = 200, 6000
"""Exchanges of poses that are tried; with many configurations fewer, as each takes longer."""
MOST_MORE = 6
"""Configurations that a design may have more than before, before it is thinned."""
WORTHWHILE_S = 1e-3
"""What an exchange must gain, s."""
URGENCY = 0.5
"""Gain is weighed against this power of its time. With 0 the fewest configurations are chosen,
with 1 many that are near to one another; between them lies the least time."""
FIRST, LOOKED_AT = 12, 64
"""From so many chosen on, only the candidates that promise the most to first order are tried."""


@dataclass(frozen=True)
class Floors:
    """What a design has at the least, so that a search for causes finds what no one expected.

    A design for the offsets alone would repeat few poses. The offsets' model is then fitted where
    it is bent the most, and nothing looks whether it holds in between.
    """

    # Different poses to fit; `discovery.screening` needs as many for its p-values
    poses: int = FEWEST_POSES
    repeated: int = REPEATED_POSES  # Of them with at least two solutions

    def hold(self, pose: IntArray) -> bool:
        """Tell whether chosen configurations of these poses (n,) reach them."""
        count = np.unique(pose, return_counts=True)[1]
        return len(count) >= self.poses and int(np.sum(count > 1)) >= self.repeated


@dataclass(frozen=True)
class Goal:
    """What is to be reached, and what to weigh by."""

    # Root mean square of the standard deviations of the identifiable joints, rad
    joint_std_rad: float
    tool_std_m: float  # Root mean square of the 3-D error of the predicted markers in the box, m
    # 0 for the joints alone (A-optimal), 1 for the tool alone (I-optimal); between them for a
    # mixture, in which each counts in units of what is to be reached
    tool_share: float = 0.0

    def weights(self, information: DesignInformation) -> FloatArray:
        """Return L with criterion = trace(L' M^-1 L), (f, r), 1 or less at the goal.

        Raises InsufficientDataError: no joint is identifiable.
        """
        parts = []
        if self.tool_share < 1.0:
            places = list(information.identifiable.values())
            if not places:
                raise InsufficientDataError('the poses determine the zero-offset of no joint')
            units = information.per_radian[list(information.identifiable)]
            joints = np.zeros((len(information.scale), len(places)))
            joints[places, np.arange(len(places))] = information.scale[places] / units
            share = (1.0 - self.tool_share) / len(places)
            parts.append(np.sqrt(share) / self.joint_std_rad * joints)
        if self.tool_share > 0.0:
            values, vectors = np.linalg.eigh(information.tool)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            parts.append(np.sqrt(self.tool_share) / self.tool_std_m * root)
        return np.concatenate(parts, axis=1)

    def is_met(self, joint_rms: float, tool_rms: float) -> bool:
        """Tell whether these, rad and m, reach each of what counts."""
        joints = self.tool_share == 1.0 or joint_rms <= self.joint_std_rad
        return joints and (self.tool_share == 0.0 or tool_rms <= self.tool_std_m)

    def is_reached(self, information: DesignInformation, chosen: Sequence[int]) -> bool:
        """Tell whether each of what counts is reached."""
        return self.is_met(information.joint_rms(chosen), information.tool_rms(chosen))

    def describe(self) -> str:
        """Return what is to be reached, for people."""
        joints = f'{np.degrees(self.joint_std_rad):.3g} deg for the offsets'
        tool = f'{self.tool_std_m * 1e3:.3g} mm for the tool'
        counting = [joints] * (self.tool_share < 1.0) + [tool] * (self.tool_share > 0.0)
        return ' and '.join(counting)


@dataclass(frozen=True)
class Design:
    """Chosen configurations."""

    chosen: tuple[int, ...]  # Indices of the configurations, in no order
    reached: bool  # Whether the goal and the floors are reached


def choose(
    information: DesignInformation,
    travel: TravelTime,
    goal: Goal,
    rng: np.random.Generator,
    floors: Floors = Floors(),
    most: int = MOST_CONFIGURATIONS,
    exchanges: int = MOST_EXCHANGES,
    *,
    whole_poses: bool = True,
) -> Design:
    """Choose configurations.

    ``information``: of all that can be measured; ``travel``: what they cost; ``goal, floors``:
    what is to be reached; ``rng``: which poses are tried in exchange; ``most``: configurations
    chosen at most; ``exchanges``: tried at most; ``whole_poses``: choose poses with all their
    configurations; single ones otherwise.
    """
    units = _Units(information, travel, whole_poses)
    search = _Search(units, goal, floors)
    chosen = search.filled([], most)
    if not search.is_done(chosen):
        return Design(units.configurations(chosen), reached=False)
    best = search.thinned(chosen)
    for _ in range(min(exchanges, EFFORT // len(best))):
        tried = search.with_other_poses(best, rng)
        if search.is_done(tried):
            tried = search.thinned(tried)
            if search.spent(tried) < search.spent(best) - WORTHWHILE_S:
                best = tried
    return Design(units.configurations(best), reached=True)


class _Units:
    """What is chosen one by one: configurations, or poses with all of theirs.

    ``whole``: whether they are poses; ``information``: of each of the n units; ``members``: which
    configurations each is; ``solutions``: how many, (n,); ``stay_s``: time of measuring them and
    of the ways between them, s, (n,).
    """

    def __init__(self, information: DesignInformation, travel: TravelTime, whole: bool) -> None:
        self.information, self.whole = information, whole
        self.members = list(np.arange(len(information))[:, None])
        if whole:
            self.information, self.members = information.whole_poses()
        self.solutions: IntArray = np.array([len(mine) for mine in self.members])
        self._travel, self._q = travel, [information.q[mine] for mine in self.members]
        self._by_joints = replace(travel, limits=replace(travel.limits, tool_speed=np.inf))
        self._first = np.cumsum(self.solutions) - self.solutions
        between = np.array([self._between(q) for q in self._q])
        self.stay_s: FloatArray = self.solutions * travel.measuring_s + between
        self._near: dict[int, FloatArray] = {}

    def _between(self, q: FloatArray) -> float:
        """Return the mean time through solutions (m, k) of a pose, nearest first, s."""
        times = self._travel.between(q)
        order = np.argsort(times, axis=1)
        along = np.take_along_axis(times[order[:, :-1]], order[:, 1:, None], axis=2)
        return float(np.mean(np.sum(along, axis=(1, 2))))

    def near(self, index: int) -> FloatArray:
        """Return the time from one unit to each, s, (n,)."""
        if index not in self._near:
            # Which two are the nearest, by the joints alone; looking at the tool takes long.
            q, own = np.concatenate(self._q), self._q[index]
            joints = np.array([self._by_joints.straight(one, q) for one in own])
            mine = np.argmin(joints, axis=0)
            least = np.min(joints, axis=0)
            ends = [
                first + int(np.argmin(least[first : first + count]))
                for first, count in zip(self._first, self.solutions, strict=True)
            ]
            near = np.empty(len(ends))
            for start in np.unique(mine[ends]):
                these = np.flatnonzero(mine[ends] == start)
                near[these] = self._travel.straight(own[start], q[np.array(ends)[these]])
            self._near[index] = near
            # Its own place is no neighbour of it.
            self._near[index][index] = np.inf
        return self._near[index]

    def configurations(self, chosen: Sequence[int]) -> tuple[int, ...]:
        """Return the configurations of chosen units."""
        return tuple(int(each) for index in chosen for each in self.members[index])


class _Search:
    """The criterion of candidates, and what they cost."""

    def __init__(self, units: _Units, goal: Goal, floors: Floors) -> None:
        self._units, self._information, self._goal = units, units.information, goal
        self._floors, self._root = floors, goal.weights(units.information)

    def _criteria(self, matrices: FloatArray) -> FloatArray:
        """Return trace(L' M^-1 L) of information (..., f, f), (...)."""
        finite = self._information.finite(matrices)
        root = np.broadcast_to(self._root, (*finite.shape[:-2], *self._root.shape))
        return np.einsum('ij,...ij->...', self._root, np.linalg.solve(finite, root))

    def _with_each(self, chosen: Sequence[int], allowed: BoolArray) -> tuple[IntArray, FloatArray]:
        """Return the units that promise the most, and the criterion with each, (m,)."""
        information = self._information
        allowed = allowed.copy()
        allowed[np.array(chosen, dtype=np.int64)] = False
        among = np.flatnonzero(allowed)
        if len(among) > LOOKED_AT and len(chosen) > FIRST:
            total = information.finite(information.total(chosen))
            steps = np.asarray(np.linalg.solve(total, self._root), dtype=np.float64)
            gains = information.gains(chosen, steps)[among] / self._times(chosen)[among] ** URGENCY
            among = among[np.argpartition(-gains, LOOKED_AT)[:LOOKED_AT]]
        return among, self._criteria(information.with_each(chosen, among))

    def _times(self, chosen: Sequence[int]) -> FloatArray:
        """Return what each unit adds to the robot's time beside the chosen, s, (n,)."""
        if not chosen:
            return self._units.stay_s
        near = np.min([self._units.near(index) for index in chosen], axis=0)
        return near + self._units.stay_s

    def is_done(self, chosen: Sequence[int]) -> bool:
        return self._floors.hold(self._poses(chosen)) and self._goal.is_reached(
            self._information, chosen
        )

    def _poses(self, chosen: Sequence[int]) -> IntArray:
        """Return the pose of each configuration of the chosen, (m,)."""
        which = np.array(chosen, dtype=np.int64)
        return np.repeat(self._information.pose[which], self._units.solutions[which])

    def _best_addition(self, chosen: Sequence[int]) -> int:
        """Return which unit gains the most for its time."""
        allowed = np.ones(len(self._information), bool)
        if chosen and self._goal.is_reached(self._information, chosen):
            missing = self._missing(chosen)
            allowed = missing if missing.any() else allowed
            if self._units.whole and missing.any():
                # Beyond the goal what its further solutions tell is not worth their time.
                return int(np.argmin(np.where(missing, self._times(chosen), np.inf)))
        among, criteria = self._with_each(chosen, allowed)
        now = self._criteria(self._information.total(chosen))
        return int(
            among[np.argmax(np.log(now / criteria) / self._times(chosen)[among] ** URGENCY)]
        )

    def _missing(self, chosen: Sequence[int]) -> BoolArray:
        """Return which units come nearer to the floors, (n,)."""
        pose, several = self._information.pose, self._units.solutions > 1
        count = np.bincount(self._poses(chosen), minlength=int(pose.max()) + 1)
        poses, repeated = np.sum(count > 0), np.sum(count > 1)
        new = (count[pose] == 0) & (poses < self._floors.poses)
        if repeated < self._floors.repeated:
            if self._units.whole:
                return (count[pose] == 0) & several
            new |= count[pose] == 1
        return new

    def filled(self, chosen: Sequence[int], most: int) -> list[int]:
        """Add what gains the most for its time until goal and floors are reached."""
        chosen = list(chosen)
        while len(chosen) < len(self._information) and not self.is_done(chosen):
            if len(self._poses(chosen)) >= most:
                break
            chosen.append(self._best_addition(chosen))
        return chosen

    def with_other_poses(self, chosen: Sequence[int], rng: np.random.Generator) -> list[int]:
        """Bring a pose in with all its solutions, or leave a few out and fill up again."""
        pose = self._information.pose
        own = np.unique(pose[np.array(chosen, dtype=np.int64)])
        if rng.random() < 0.5:
            others = np.setdiff1d(pose, own)
            if not len(others):
                return list(chosen)
            return [*chosen, *np.flatnonzero(pose == rng.choice(others)).tolist()]
        out = rng.choice(own, rng.integers(1, max(2, min(5, len(own) // 3 + 1))), replace=False)
        left = [index for index in chosen if pose[index] not in out]
        return self.filled(left, len(self._poses(chosen)) + MOST_MORE)

    def thinned(self, chosen: Sequence[int]) -> list[int]:
        """Leave out one after the other while goal and floors are reached."""
        chosen = list(chosen)
        while len(chosen) > 1 and self.is_done(fewer := self._without_least(chosen)):
            chosen = fewer
        return chosen

    def _without_least(self, chosen: Sequence[int]) -> list[int]:
        """Leave out the one that tells the least for its time, the floors kept if possible."""
        which = np.array(chosen, dtype=np.int64)
        without = [[other for other in chosen if other != index] for index in chosen]
        matrices = np.array([self._information.total(rest) for rest in without])
        near = np.array([self._units.near(index)[which] for index in chosen])
        stay_s = self._units.stay_s[which]
        # One that is left alone has no neighbour, and no way.
        near[~np.isfinite(near)] = np.inf if len(chosen) > 2 else 0.0
        spent = [
            np.sum(np.min(np.delete(np.delete(near, i, 0), i, 1), axis=0))
            for i in range(len(chosen))
        ]
        times = np.array(spent) + np.sum(stay_s) - stay_s
        cost = np.log(self._criteria(matrices)) + URGENCY * np.log(times)
        kept = np.array([self._floors.hold(self._poses(rest)) for rest in without])
        return without[int(np.argmin(np.where(kept | ~kept.any(), cost, np.inf)))]

    def spent(self, chosen: Sequence[int]) -> float:
        """Return about how long the robot takes, s: each is reached from the nearest other one."""
        which = np.array(chosen, dtype=np.int64)
        near = np.min([self._units.near(index)[which] for index in chosen], axis=0)
        ways = float(np.sum(near)) if len(chosen) > 1 else 0.0
        return ways + float(np.sum(self._units.stay_s[which]))
