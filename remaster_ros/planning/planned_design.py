# SPDX-License-Identifier: Apache-2.0
"""From the poses that can be measured to a designed plan, with free ways, and to its order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.free_paths import is_straight_free
from remaster_ros.linear_algebra import one_thread
from remaster_ros.planning.candidates import Plan, PlannedPose, PlanningScene
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.expected_sensors import ExpectedSensor, ToolBox
from remaster_ros.planning.pose_design import (
    HELD_OUT_POSES,
    HELD_OUT_SOLUTIONS,
    Floors,
    Goal,
    choose,
)
from remaster_ros.planning.tour_order import free_way
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import FloatArray, IntArray, Priors

FEW = 2
"""So few places have one order."""
LONGEST_MOVED = 3
"""So many neighbours are moved to another place of the order together."""


def fastest_order(times: FloatArray) -> list[int]:
    """Order the visits of an open tour that begins at the first place.

    The nearest neighbour first, then 2-opt (a part of the order is reversed) and Or-opt (up to
    three neighbours are moved elsewhere) until neither makes it faster (D. S. Johnson and L. A.
    McGeoch, "The Traveling Salesman Problem: A Case Study in Local Optimization", 1997). A search
    from 100 perturbed orders shortens tours of 60 places by another 1 %, of 180 by 1.5 %.

    ``times``: from each place to each, symmetric, s, (n, n); place 0 is where the arm stands.
    Returns all places but the first, in order.
    """
    n = len(times)
    order = _nearest(times)
    # An open tour is a closed one through a place that is as near to all: the end costs nothing.
    padded = np.zeros((n + 1, n + 1))
    padded[:n, :n] = times
    order.append(n)
    while n > FEW and (_reverse(padded, order) or _move(padded, order)):
        pass
    return order[1:-1]


def _nearest(times: FloatArray) -> list[int]:
    order, left = [0], np.ones(len(times), bool)
    left[0] = False
    while left.any():
        order.append(int(np.argmin(np.where(left, times[order[-1]], np.inf))))
        left[order[-1]] = False
    return order


def _reverse(times: FloatArray, order: list[int]) -> bool:
    """Reverse the part whose reversal gains the most, if any does; both ends stay."""
    at = np.array(order)
    # Of the part from i to j: its entry from i - 1, and its exit to j + 1.
    entry, exit_ = times[at[:-2], at[1:-1]], times[at[1:-1], at[2:]]
    gain = (entry[:, None] + exit_[None]) - (
        times[np.ix_(at[:-2], at[1:-1])] + times[np.ix_(at[1:-1], at[2:])]
    )
    gain = np.triu(gain, 1)
    i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
    if gain[i, j] < 1e-9:
        return False
    order[i + 1 : j + 2] = order[i + 1 : j + 2][::-1]
    return True


def _move(times: FloatArray, order: list[int]) -> bool:
    """Move a part elsewhere, either way round, where that gains the most, if anywhere it does."""
    best, found = 1e-9, None
    for size in range(1, LONGEST_MOVED + 1):
        for i in range(1, len(order) - size):
            part, rest = order[i : i + size], np.array(order[:i] + order[i + size :])
            before, after = order[i - 1], order[i + size]
            saved = times[before, part[0]] + times[part[-1], after] - times[before, after]
            gap = times[rest[:-1], rest[1:]]
            for turned in (part, part[::-1]):
                cost = times[rest[:-1], turned[0]] + times[turned[-1], rest[1:]] - gap
                place = int(np.argmin(cost))
                if saved - cost[place] > best:
                    best, found = saved - cost[place], (rest.tolist(), place + 1, turned)
    if found is None:
        return False
    rest_, place, turned = found
    order[:] = [*rest_[:place], *turned, *rest_[place:]]
    return True


NOT_NEEDED = 'not needed by the design'
NO_FREE_PATH = 'no free path'
# Beyond the precision of the paper (Van Wyk et al., Table I: 95 % intervals of 0.005 degrees and
# more) other errors of an arm are larger than those of its zero-offsets: a design does not spend
# minutes on it unless told so.
ENOUGH_RAD = float(np.radians(0.005))
POOL_CANDIDATES = 400
"""Candidate poses that a design chooses from, besides those of the plan that it replaces."""
MOST_CANDIDATES = 1500
"""Configurations that it chooses from at most: about a second of choice for each hundred."""
MOST_TRIES = 5
"""So often a design, or an order, is made anew where a way is not free."""
DETOUR = 2.0
"""A way around something counts as so many times the straight one, until it is planned."""


@dataclass(frozen=True)
class DesignSettings:
    """What the poses to fit are chosen by; see `pose_design`."""

    optimal: bool = False  # False for all poses of the Latin hypercube
    # Visit each pose in all its solutions, nearest first, before the next one; otherwise the
    # design chooses single configurations, and the fastest order comes back to a pose
    whole_poses: bool = True
    # Visit poses, or configurations, in the order of least travel, not the nearest next
    fastest: bool = False
    sensors: tuple[ExpectedSensor, ...] = ()  # What will measure, with its expected noise
    marker_std_m: float = 0.5e-3  # How well the markers' positions are known, m
    tool_share: float = 0.0  # See `Goal`
    # What is to be reached; None for what the Latin hypercube's poses reach, of the joints no less
    # than `ENOUGH_RAD`
    joint_std_rad: float | None = None
    tool_std_m: float | None = None
    box: ToolBox | None = None  # Where the tool is to be accurate; None for wherever the poses are
    priors: Priors = field(default_factory=Priors)  # What is known beforehand

    def before(self, sensors_R: Mapping[str, FloatArray]) -> DesignSettings:
        """Return them for sensors that stand at these places in R, m, (3,) each."""
        placed = [
            replace(sensor, position_R=sensors_R[sensor.name])
            for sensor in self.sensors
            if sensor.name in sensors_R
        ]
        return replace(self, sensors=tuple(placed))

    def information(self, scene: PlanningScene, poses: Sequence[PlannedPose]) -> DesignInformation:
        """Return what poses tell; errors as of `DesignInformation.of`."""
        chain = scene.model.chain
        return DesignInformation.of(
            chain, poses, self.sensors, self.marker_std_m, self.priors, self.box
        )


@dataclass(frozen=True)
class Designed:
    """Plans by a design."""

    plans: Mapping[str, Plan]  # Split -> its poses, each with the solutions that were chosen
    goal: Goal  # What was to be reached
    reached: bool  # Whether it is, with the floors
    floors: Floors
    # What is expected, rad and m
    joint_rms: float
    tool_rms: float

    def describe(self) -> str:
        """Return what is expected, in a line."""
        goal = '' if self.reached else f'; not reached: {self.goal.describe()}'
        return (
            f'expected std of the offsets {np.degrees(self.joint_rms):.4f} deg (RMS), '
            f'error of the predicted markers {self.tool_rms * 1e3:.3f} mm (RMS), with the noise '
            f'that the cell file has{goal}'
        )


@one_thread
def designed_plans(
    scene: PlanningScene,
    settings: DesignSettings,
    plans: Mapping[str, Plan],
    sensors_R: Mapping[str, FloatArray],
    travel: TravelTime,
    rng: np.random.Generator,
) -> Designed:
    """Choose configurations for the precision of these plans, or a stated one, in the least time.

    Parameters
    ----------
    scene
        What poses are planned from.
    settings
        What they are chosen by.
    plans
        Of Latin hypercubes, by split. The poses to fit are among those to choose from, so that
        what they reach can be reached; of those held out as many stay as are needed.
    sensors_R
        Origin in R of each sensor that has to see its marker, m, (3,).
    travel
        What configurations cost.
    rng
        Of the further candidates, and of the choice.
    """
    plan, pool = plans['optimization'], scene.plan(POOL_CANDIDATES, sensors_R, rng)
    poses = [*plan.poses, *pool.poses]
    information = settings.before(sensors_R).information(scene, poses)
    count = sum(len(pose.solutions) for pose in plan.poses)
    reference = range(count)
    goal = Goal(
        settings.joint_std_rad or max(information.joint_rms(reference), ENOUGH_RAD),
        settings.tool_std_m or information.tool_rms(reference),
        settings.tool_share,
    )
    number = np.concatenate([np.arange(len(pose.solutions)) for pose in poses])
    left: IntArray = np.arange(min(len(information), max(MOST_CANDIDATES, count)))
    if settings.whole_poses and len(left) < len(information):
        left = left[information.pose[left] < information.pose[len(left)]]
    for _ in range(MOST_TRIES):
        among, floors = information.only(left), _floors(information, left, settings.whole_poses)
        design = choose(among, travel, goal, rng, floors, whole_poses=settings.whole_poses)
        chosen = left[np.array(design.chosen, dtype=np.int64)]
        apart = _apart(scene.model, information.q[chosen], travel)
        if not apart:
            break
        # What lies nearest to a part that no way leads to is of that part: another design of it
        # would be as much apart.
        q = information.q[left]
        nearest = np.argmin([travel.straight(one, q) for one in information.q[chosen]], axis=0)
        islands = [part for part in apart if len(part) > 1]
        left = left[~np.isin(nearest, np.concatenate([*islands, []]))]
        left = np.setdiff1d(left, chosen[np.concatenate(apart)])
    kept = [
        PlannedPose(poses[index].T_R_T, poses[index].solutions[number[mine]])
        for index in np.unique(information.pose[chosen])
        for mine in [np.sort(chosen[information.pose[chosen] == index])]
    ]
    dropped = _sum(plan.dropped, pool.dropped, {NOT_NEEDED: len(poses) - len(kept)})
    lost_solutions = 0
    if settings.whole_poses:
        # What is missing of a pose is what no way leads to.
        visited = np.isin(information.pose, information.pose[chosen])
        lost_solutions = int(np.sum(visited)) - len(chosen)
    solutions = _sum(
        plan.dropped_solutions,
        pool.dropped_solutions,
        {NO_FREE_PATH: lost_solutions},
        {NOT_NEEDED: len(information) - len(chosen) - lost_solutions},
    )
    designed = {**plans, 'optimization': Plan(tuple(kept), dropped, solutions)}
    if 'validation' in plans:
        solutions_of_each = None if settings.whole_poses else HELD_OUT_SOLUTIONS
        designed['validation'] = _held_out(plans['validation'], solutions_of_each, rng)
    return Designed(
        designed,
        goal,
        design.reached,
        floors,
        information.joint_rms(chosen.tolist()),
        information.tool_rms(chosen.tolist()),
    )


def _floors(information: DesignInformation, left: IntArray, whole_poses: bool) -> Floors:
    """Return the floors, lower where these configurations have not so many poses.

    Of whole poses all are to have two solutions: that is what they are visited for.
    """
    count = np.unique(information.pose[left], return_counts=True)[1]
    floors = Floors()
    repeated = floors.poses if whole_poses else floors.repeated
    return Floors(min(floors.poses, len(count)), min(repeated, int(np.sum(count > 1))))


def _held_out(plan: Plan, solutions: int | None, rng: np.random.Generator) -> Plan:
    """Return as many of the held-out poses as are needed, and of each all solutions or so many."""
    kept = tuple(
        PlannedPose(
            pose.T_R_T,
            pose.solutions[np.sort(rng.permutation(len(pose.solutions))[:solutions])],
        )
        # In the order of a Latin hypercube neighbours have nothing in common.
        for pose in plan.poses[:HELD_OUT_POSES]
    )
    before = sum(len(pose.solutions) for pose in plan.poses)
    after = sum(len(pose.solutions) for pose in kept)
    return Plan(
        kept,
        _sum(plan.dropped, {NOT_NEEDED: len(plan.poses) - len(kept)}),
        _sum(plan.dropped_solutions, {NOT_NEEDED: before - after}),
    )


def visit_order(
    plans: Mapping[str, Plan],
    model: CollisionModel,
    travel: TravelTime,
    *,
    whole_poses: bool = True,
) -> list[tuple[str, int, int]]:
    """Order all configurations of some plans by travel time.

    ``plans``: split -> its plan; those to fit and those held out are mixed; ``model``: what the
    arm must not hit: a way that is not straight counts as longer; ``travel``: how long the ways
    take; ``whole_poses``: visit a pose in all its solutions before the next one: poses count as
    far apart as the nearest of their solutions.
    Returns split, pose and solution of each visit.
    """
    visits = [
        (split, index, number)
        for split, plan in plans.items()
        for index, pose in enumerate(plan.poses)
        for number in range(len(pose.solutions))
    ]
    if not visits:
        return []
    q = np.array([plans[split].poses[index].solutions[number] for split, index, number in visits])
    keys = [visit[:2] if whole_poses else visit for visit in visits]
    begin = [i for i, key in enumerate(keys) if i == 0 or key != keys[i - 1]]
    places = [range(a, b) for a, b in pairwise([*begin, len(visits)])]
    each = travel.between(q)
    # The arm may come from anywhere: as near to all.
    times = np.zeros((len(places) + 1, len(places) + 1))
    times[1:, 1:] = np.minimum.reduceat(np.minimum.reduceat(each, begin, axis=0), begin, axis=1)
    order = fastest_order(times)
    judged: set[tuple[int, int]] = set()
    for _ in range(MOST_TRIES):
        legs = {(min(leg), max(leg)) for leg in pairwise(order)} - judged
        judged |= legs
        blocked = [
            leg for leg in legs if not _is_free(model, q, each, *(places[i - 1] for i in leg))
        ]
        if not blocked:
            break
        for a, b in blocked:
            times[a, b] = times[b, a] = DETOUR * times[a, b]
        order = fastest_order(times)
    return [visits[member] for place in order for member in places[place - 1]]


def _is_free(
    model: CollisionModel, q: FloatArray, times: FloatArray, one: range, other: range
) -> bool:
    """Return whether the shortest way between two places, of configurations each, is free."""
    apart = times[one.start : one.stop, other.start : other.stop]
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return is_straight_free(model, q[one[int(a)]], q[other[int(b)]])


def _apart(model: CollisionModel, q: FloatArray, travel: TravelTime) -> list[IntArray]:
    """Return which of some configurations (n, k) no free way leads to from most of them, in parts.

    Ways are sought from the two nearest of each, then from the largest part that hangs together to
    each of the others, between the two that are nearest.
    """
    times = travel.between(q)
    np.fill_diagonal(times, np.inf)
    limits = model.chain.velocity_limits
    part = np.arange(len(q))

    def joins(index: int, other: int) -> bool:
        if part[index] != part[other]:
            if free_way(model, q[other], q[index], limits, index) is None:
                times[index, other] = times[other, index] = np.inf
                return False
            part[part == part[index]] = part[other]
        return True

    for index in range(len(q)):
        any(joins(index, int(other)) for other in np.argsort(times[index])[:2])
    most = int(np.argmax(np.bincount(part, minlength=1)))
    for number in np.unique(part[part != most]):
        between = np.where(np.outer(part == number, part == most), times, np.inf)
        pair = np.unravel_index(int(np.argmin(between)), between.shape)
        if np.isfinite(between[pair]):
            joins(*map(int, pair))
    return [np.flatnonzero(part == number) for number in np.unique(part[part != most])]


def _sum(*counts: Mapping[str, int]) -> dict[str, int]:
    """Add counts by name; zeros are left out."""
    names = dict.fromkeys(name for count in counts for name in count)
    total = {name: sum(count.get(name, 0) for count in counts) for name in names}
    return {name: count for name, count in total.items() if count}
