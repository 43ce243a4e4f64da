# SPDX-License-Identifier: Apache-2.0
"""Optimal design of the poses to measure: greedy choice, then exchange.

A-optimal for the joint offsets (least sum of their variances), I-optimal for the tool (least mean
variance of the predicted markers in a box), or a mixture of both. A unit of the choice is a pose
with all its joint solutions, or a single configuration. Units are added one by one, each the one
that lowers the criterion most for its time, until the wanted standard deviations are reached;
units that are no longer needed are removed. Then poses are exchanged as long as that saves robot
time: one is added with all its solutions, or some are removed and the design is filled up, and
superfluous units are removed again.

Single configurations are not exchanged, as V. V. Fedorov's and T. J. Mitchell's (DETMAX)
algorithms do: because of the error common to the configurations of a pose, the first of them tells
little, and all of them together much, so that such exchanges end in poor local optima. For the
same reason the information of configurations does not add up: a design by weights (convex
relaxation) has to weigh subsets of the solutions of a pose. benchmarks/RESULTS.md compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.discovery.thinning import FEWEST_TO_SEARCH
from remaster_ros.errors import InsufficientDataError
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import BoolArray, FloatArray, IntArray

REPEATED_POSES = 6
"""Least number of poses measured in two or more solutions. Only their differences distinguish the
noise of a reading from the error common to a pose: with M markers, 6 of them give the standard
deviation of the former to 1 / sqrt(2 * 18 M), 17 % with one marker."""
HELD_OUT_POSES = 12
"""Least number of validation poses, as many as a search for causes needs;
12 poses of 3 coordinates give their RMS error to 12 %."""
HELD_OUT_SOLUTIONS = 2
"""Solutions of each, if not all are visited: the relative metric compares two."""
MOST_CONFIGURATIONS = 400
"""Most configurations of a design."""
MOST_EXCHANGES, EFFORT = 200, 6000
"""Most exchanges of poses, and most exchanges times units: with many units each takes longer."""
MOST_MORE = 6
"""Configurations that an exchange may add before superfluous ones are removed."""
WORTHWHILE_S = 1e-3
"""Least saving of an exchange, s."""
URGENCY = 0.5
"""Exponent of the time by which a gain is divided. 0 leads to the fewest configurations, 1 to many
that are near to one another; the least time lies between them."""
FIRST, LOOKED_AT = 12, 64
"""From `FIRST` chosen units on, only the `LOOKED_AT` best candidates to first order are tried."""


@dataclass(frozen=True)
class Floors:
    """Least numbers of poses, and of repeated poses, in a design.

    With them a search for causes can find unexpected ones: a design for the offsets alone
    would repeat few poses; they would lie where the offsets' model is most sensitive, and
    nothing would test the model in between.
    """

    # Different poses to fit, as many as a search for causes needs
    poses: int = FEWEST_TO_SEARCH
    repeated: int = REPEATED_POSES  # Poses with at least two solutions

    def hold(self, pose: IntArray) -> bool:
        """Whether a design has at least `poses` poses, and `repeated` with two configurations.

        ``pose``: number of the pose of each configuration of the design, (n,).
        """
        count = np.unique(pose, return_counts=True)[1]
        return len(count) >= self.poses and int(np.sum(count > 1)) >= self.repeated


@dataclass(frozen=True)
class Goal:
    """The precision to reach, and the weights of joints and tool."""

    # Root mean square of the standard deviations of the identifiable joints, rad
    joint_std_rad: float
    tool_std_m: float  # Root mean square 3-D error of the predicted markers in the box, m
    # Weight of the tool: 0 for joints only (A-optimal), 1 for tool only (I-optimal); in a mixture
    # each counts in units of its standard deviation above
    tool_share: float = 0.0

    def weights(self, information: DesignInformation) -> FloatArray:
        """Return L (f, r) with criterion trace(L' M^-1 L), which is at most 1 at the goal.

        M is an information matrix. If both joints and tool count, the variance of each is
        divided by that of its goal, and weighted by 1 - `tool_share` (joints) and `tool_share`
        (tool). Raises InsufficientDataError if no joint is identifiable, unless only the tool
        counts.
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
        """Whether standard deviations of joints, rad, and tool, m, reach the goal.

        At a `tool_share` of 1 the joints do not count, at a `tool_share` of 0 the tool does
        not.
        """
        joints = self.tool_share == 1.0 or joint_rms <= self.joint_std_rad
        return joints and (self.tool_share == 0.0 or tool_rms <= self.tool_std_m)

    def is_reached(self, information: DesignInformation, chosen: Sequence[int]) -> bool:
        """Return whether chosen configurations reach the goal."""
        return self.is_met(information.joint_rms(chosen), information.tool_rms(chosen))

    def describe(self) -> str:
        """Return the goal as text, such as '0.01 deg for the offsets and 0.1 mm for the tool'.

        Only what has a weight (`tool_share`).
        """
        joints = f'{np.degrees(self.joint_std_rad):.3g} deg for the offsets'
        tool = f'{self.tool_std_m * 1e3:.3g} mm for the tool'
        counting = [joints] * (self.tool_share < 1.0) + [tool] * (self.tool_share > 0.0)
        return ' and '.join(counting)


@dataclass(frozen=True)
class Design:
    """The chosen configurations, and whether they reach the goal."""

    chosen: tuple[int, ...]  # Indices of the configurations, in no order
    reached: bool  # Whether goal and floors are reached


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
    """Choose configurations that reach a goal in the least robot time.

    ``information``: of all candidates; ``travel``: their cost; ``goal, floors``: what to reach;
    ``rng``: for exchanges; ``most``: largest number of configurations; ``exchanges``: largest
    number tried; ``whole_poses``: choose poses with all their configurations, not single ones. If
    the goal cannot be reached, the design has `reached` False and `most` configurations or all;
    the last pose may exceed `most`. Raises InsufficientDataError as `Goal.weights`.
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
    """The units of the choice: configurations, or poses with all their configurations.

    ``whole_poses``: whether they are poses.
    Attributes: ``information``: of each of the n units; ``members``: indices of each unit's
    configurations; ``solutions``: number of them, (n,); ``stay_s``: time of measuring them and
    of the motions between them, s, (n,).
    """

    def __init__(
        self, information: DesignInformation, travel: TravelTime, whole_poses: bool
    ) -> None:
        self.information, self.whole = information, whole_poses
        self.members = list(np.arange(len(information))[:, None])
        if whole_poses:
            self.information, self.members = information.whole_poses()
        self.solutions: IntArray = np.array([len(from_solution) for from_solution in self.members])
        self._travel, self._q = (
            travel,
            [information.q[from_solution] for from_solution in self.members],
        )
        self._by_joints = replace(travel, limits=replace(travel.limits, tool_speed=np.inf))
        self._first = np.cumsum(self.solutions) - self.solutions
        between = np.array([self._time_within(q) for q in self._q])
        self.stay_s: FloatArray = self.solutions * travel.measuring_s + between
        self._near: dict[int, FloatArray] = {}

    def _time_within(self, q: FloatArray) -> float:
        """Return the mean time of motion through all solutions (m, k) of a pose, s.

        They are visited in the order of the travel time from the first one; the mean is over
        which one is first. 0 for a single solution.
        """
        times = self._travel.between(q)
        order = np.argsort(times, axis=1)
        along = np.take_along_axis(times[order[:, :-1]], order[:, 1:, None], axis=2)
        return float(np.mean(np.sum(along, axis=(1, 2))))

    def near(self, index: int) -> FloatArray:
        """Return the travel time from a unit to each unit, s, (n,); infinite to itself.

        Between their nearest configurations, by a straight line; kept after the first call.
        ``index``: of the unit.
        """
        if index not in self._near:
            # The nearest pair is found without the limit of the tool's speed, which takes long.
            q, solutions_of_unit = np.concatenate(self._q), self._q[index]
            joints = np.array([self._by_joints.straight(each, q) for each in solutions_of_unit])
            from_solution = np.argmin(joints, axis=0)
            least = np.min(joints, axis=0)
            ends = [
                first + int(np.argmin(least[first : first + count]))
                for first, count in zip(self._first, self.solutions, strict=True)
            ]
            travel_s = np.empty(len(ends))
            for start in np.unique(from_solution[ends]):
                units_of_start = np.flatnonzero(from_solution[ends] == start)
                travel_s[units_of_start] = self._travel.straight(
                    solutions_of_unit[start], q[np.array(ends)[units_of_start]]
                )
            self._near[index] = travel_s
            # A unit is no neighbour of itself.
            self._near[index][index] = np.inf
        return self._near[index]

    def configurations(self, chosen: Sequence[int]) -> tuple[int, ...]:
        """Return the indices of the configurations of chosen units, unit by unit."""
        return tuple(int(each) for index in chosen for each in self.members[index])


class _Search:
    """Greedy choice and exchange of units (configurations or poses), by gain and robot time."""

    def __init__(self, units: _Units, goal: Goal, floors: Floors) -> None:
        self._units, self._information, self._goal = units, units.information, goal
        self._floors, self._root = floors, goal.weights(units.information)

    def _criteria(self, matrices: FloatArray) -> FloatArray:
        """Return the criterion trace(L' M^-1 L) of each information matrix, (...).

        L are the weights of the goal. ``matrices``: M, (..., f, f), to which a ridge is added.
        """
        finite = self._information.finite(matrices)
        root = np.broadcast_to(self._root, (*finite.shape[:-2], *self._root.shape))
        return np.einsum('ij,...ij->...', self._root, np.linalg.solve(finite, root))

    def _with_each(self, chosen: Sequence[int], allowed: BoolArray) -> tuple[IntArray, FloatArray]:
        """Return the indices of m promising units, and the criterion if each is added, (m,).

        Promising are all allowed and not chosen; of more than `LOOKED_AT`, once more than
        `FIRST` are chosen, those with the largest first-order gain for their time. ``chosen``:
        indices; ``allowed``: (n,).
        """
        information = self._information
        allowed = allowed.copy()
        allowed[np.array(chosen, dtype=np.int64)] = False
        candidates = np.flatnonzero(allowed)
        if len(candidates) > LOOKED_AT and len(chosen) > FIRST:
            total = information.finite(information.total(chosen))
            steps = np.asarray(np.linalg.solve(total, self._root), dtype=np.float64)
            gains = (
                information.gains(chosen, steps)[candidates]
                / self._times(chosen)[candidates] ** URGENCY
            )
            candidates = candidates[np.argpartition(-gains, LOOKED_AT)[:LOOKED_AT]]
        return candidates, self._criteria(information.with_each(chosen, candidates))

    def _times(self, chosen: Sequence[int]) -> FloatArray:
        """Return the robot time that each unit would add to the chosen ones, s, (n,).

        For travel from the nearest chosen unit, and for measuring; travel is 0 if none is
        chosen, infinite for the only chosen unit itself. ``chosen``: indices of units.
        """
        if not chosen:
            return self._units.stay_s
        travel_s = np.min([self._units.near(index) for index in chosen], axis=0)
        return travel_s + self._units.stay_s

    def is_done(self, chosen: Sequence[int]) -> bool:
        """Whether chosen units reach the goal's precision and the floors' numbers of poses."""
        return self._floors.hold(self._poses(chosen)) and self._goal.is_reached(
            self._information, chosen
        )

    def _poses(self, chosen: Sequence[int]) -> IntArray:
        """Return the pose of each configuration of chosen units, (m,)."""
        which = np.array(chosen, dtype=np.int64)
        return np.repeat(self._information.pose[which], self._units.solutions[which])

    def _best_addition(self, chosen: Sequence[int]) -> int:
        """Return the index of the unit to add: that with the largest gain for its time.

        The gain is the decrease of the criterion's logarithm, divided by the time to the power
        `URGENCY`. If the goal is reached, but not the least numbers of poses (`Floors`), only
        units that bring these nearer are considered (`_missing`); if units are whole poses,
        the one that takes the least time is taken. ``chosen``: indices of units, not all.
        """
        allowed = np.ones(len(self._information), bool)
        if chosen and self._goal.is_reached(self._information, chosen):
            missing = self._missing(chosen)
            allowed = missing if missing.any() else allowed
            if self._units.whole and missing.any():
                # The goal is reached: only the time counts.
                return int(np.argmin(np.where(missing, self._times(chosen), np.inf)))
        candidates, criteria = self._with_each(chosen, allowed)
        now = self._criteria(self._information.total(chosen))
        return int(
            candidates[
                np.argmax(np.log(now / criteria) / self._times(chosen)[candidates] ** URGENCY)
            ]
        )

    def _missing(self, chosen: Sequence[int]) -> BoolArray:
        """Whether each unit brings the design nearer to the least numbers of poses, (n,).

        The least numbers are those of `Floors`. If there are fewer poses than `Floors.poses`,
        every unit of a new pose does; if fewer than `Floors.repeated` have several solutions
        chosen, one more solution of a pose with a single one. If units are whole poses and
        there are fewer than `Floors.repeated`, only new poses with several solutions do.
        ``chosen``: indices of units.
        """
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
        """Return the chosen units and more, until goal and floors are reached (`is_done`).

        The list is a new one. It also ends with `most` configurations, or when all units are
        chosen. ``chosen``: indices of units.
        """
        chosen = list(chosen)
        while len(chosen) < len(self._information) and not self.is_done(chosen):
            if len(self._poses(chosen)) >= most:
                break
            chosen.append(self._best_addition(chosen))
        return chosen

    def with_other_poses(self, chosen: Sequence[int], rng: np.random.Generator) -> list[int]:
        """Return a random exchange: a pose added, or a few removed and the design filled up.

        Each with probability 1/2. An added pose comes with all its units; with none left to add
        the design is unchanged. If poses are removed, they are one to four, and units are added
        (`filled`) until the design reaches its goals or has `MOST_MORE` configurations more than
        before; the last unit may exceed that. ``chosen``: indices of units. A new list.
        """
        pose = self._information.pose
        poses_in = np.unique(pose[np.array(chosen, dtype=np.int64)])
        if rng.random() < 0.5:
            poses_out = np.setdiff1d(pose, poses_in)
            if not len(poses_out):
                return list(chosen)
            return [*chosen, *np.flatnonzero(pose == rng.choice(poses_out)).tolist()]
        removed = rng.choice(
            poses_in, rng.integers(1, max(2, min(5, len(poses_in) // 3 + 1))), replace=False
        )
        remaining = [index for index in chosen if pose[index] not in removed]
        return self.filled(remaining, len(self._poses(chosen)) + MOST_MORE)

    def thinned(self, chosen: Sequence[int]) -> list[int]:
        """Return the design with superfluous units removed, the least useful first, in a new list.

        Goal and floors remain reached (`is_done`); at least one unit remains. ``chosen``:
        indices of units.
        """
        chosen = list(chosen)
        while len(chosen) > 1 and self.is_done(fewer := self._without_least(chosen)):
            chosen = fewer
        return chosen

    def _without_least(self, chosen: Sequence[int]) -> list[int]:
        """Return the design without its least useful unit.

        That is the one without which log criterion + `URGENCY` log robot time is least, among
        those without which the floors are kept, if any. ``chosen``: indices of two or more
        units.
        """
        which = np.array(chosen, dtype=np.int64)
        without = [[kept_unit for kept_unit in chosen if kept_unit != index] for index in chosen]
        matrices = np.array([self._information.total(remaining) for remaining in without])
        travel_s = np.array([self._units.near(index)[which] for index in chosen])
        stay_s = self._units.stay_s[which]
        # A single remaining unit has no neighbour, and no travel.
        travel_s[~np.isfinite(travel_s)] = np.inf if len(chosen) > 2 else 0.0
        spent = [
            np.sum(np.min(np.delete(np.delete(travel_s, i, 0), i, 1), axis=0))
            for i in range(len(chosen))
        ]
        times = np.array(spent) + np.sum(stay_s) - stay_s
        cost = np.log(self._criteria(matrices)) + URGENCY * np.log(times)
        has_floors = np.array([self._floors.hold(self._poses(remaining)) for remaining in without])
        return without[int(np.argmin(np.where(has_floors | ~has_floors.any(), cost, np.inf)))]

    def spent(self, chosen: Sequence[int]) -> float:
        """Return the robot time of units, each reached from its nearest neighbour, s.

        With measuring; without travel for a single unit. ``chosen``: indices of units.
        """
        which = np.array(chosen, dtype=np.int64)
        travel_s = np.min([self._units.near(index)[which] for index in chosen], axis=0)
        ways = float(np.sum(travel_s)) if len(chosen) > 1 else 0.0
        return ways + float(np.sum(self._units.stay_s[which]))
