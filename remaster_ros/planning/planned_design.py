# SPDX-License-Identifier: Apache-2.0
"""Optimal designs as plans of a collection with free paths, and the order of the visits."""

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
from remaster_ros.planning.tour_order import free_waypoints
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import FloatArray, IntArray, Priors

FEW = 2
"""Number of places up to which there is only one order."""
LONGEST_MOVED = 3
"""Most consecutive places that are moved together."""


def fastest_order(times: FloatArray) -> list[int]:
    """Return the fastest order of the visits of an open tour that begins at place 0.

    The nearest neighbour first, then 2-opt (a part of the order is reversed) and Or-opt (up to
    three neighbours are moved elsewhere) until neither makes it faster (D. S. Johnson and L. A.
    McGeoch, "The Traveling Salesman Problem: A Case Study in Local Optimization", 1997). A search
    from 100 perturbed orders shortens tours of 60 places by another 1 %, of 180 by 1.5 %.

    ``times``: between all places, symmetric, s, (n, n); place 0 is the start. Returns all places
    but the first, in order.
    """
    n = len(times)
    order = _nearest(times)
    # An open tour is a closed one through an extra place at distance 0 from all others.
    padded = np.zeros((n + 1, n + 1))
    padded[:n, :n] = times
    order.append(n)
    while n > FEW and (_reverse(padded, order) or _move(padded, order)):
        pass
    return order[1:-1]


def _nearest(times: FloatArray) -> list[int]:
    """Return the nearest-neighbour order of all places."""
    order, unvisited = [0], np.ones(len(times), bool)
    unvisited[0] = False
    while unvisited.any():
        order.append(int(np.argmin(np.where(unvisited, times[order[-1]], np.inf))))
        unvisited[order[-1]] = False
    return order


def _reverse(times: FloatArray, order: list[int]) -> bool:
    """Reverse the part of the order that gains most, ends excepted; return whether any gains."""
    at = np.array(order)
    # Times of the part from i to j: entry from i - 1, exit to j + 1.
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
    """Move the part of the order that gains most; return whether any move gains."""
    best, move = 1e-9, None
    for size in range(1, LONGEST_MOVED + 1):
        for i in range(1, len(order) - size):
            part, others = order[i : i + size], np.array(order[:i] + order[i + size :])
            previous, following = order[i - 1], order[i + size]
            saving = (
                times[previous, part[0]] + times[part[-1], following] - times[previous, following]
            )
            gap = times[others[:-1], others[1:]]
            for turned in (part, part[::-1]):
                cost = times[others[:-1], turned[0]] + times[turned[-1], others[1:]] - gap
                place = int(np.argmin(cost))
                if saving - cost[place] > best:
                    best, move = saving - cost[place], (others.tolist(), place + 1, turned)
    if move is None:
        return False
    others_list, place, turned = move
    order[:] = [*others_list[:place], *turned, *others_list[place:]]
    return True


NOT_NEEDED = 'not needed by the design'
NO_FREE_PATH = 'no free path'
# Smallest standard deviation that a design aims at unless a smaller one is stated, rad: that of
# the paper (Van Wyk et al., Table I: 95 % intervals of 0.005 degrees and more), below which other
# errors of an arm are larger than those of its zero-offsets.
ENOUGH_RAD = float(np.radians(0.005))
POOL_CANDIDATES = 400
"""Candidate poses of a design besides those of the plan that it replaces."""
MOST_CANDIDATES = 1500
"""Most candidate configurations: the choice takes about a second per hundred."""
MOST_TRIES = 5
"""Most repetitions of a design, or an order, if a path is not free."""
DETOUR = 2.0
"""Assumed length of a path around an obstacle over that of the straight one."""


@dataclass(frozen=True)
class DesignSettings:
    """Settings by which the poses to fit are chosen; see `pose_design`."""

    optimal: bool = False  # False for all poses of the Latin hypercube
    # Visit each pose in all its solutions before the next one; otherwise single configurations
    # are chosen, and the fastest order may return to a pose
    whole_poses: bool = True
    # Visit poses, or configurations, in the order of least travel, not the nearest next
    fastest: bool = False
    sensors: tuple[ExpectedSensor, ...] = ()  # With their expected noise
    marker_std_m: float = 0.5e-3  # Prior of the markers' positions, per axis, m
    tool_share: float = 0.0  # See `Goal`
    # Precision to reach; None for that of the Latin hypercube's poses, of the joints at least
    # `ENOUGH_RAD`
    joint_std_rad: float | None = None
    tool_std_m: float | None = None
    # Where the tool has to be accurate; None for wherever the poses are
    box: ToolBox | None = None
    priors: Priors = field(default_factory=Priors)  # Of offsets, markers and registrations

    def with_sensors_at(self, sensors_R: Mapping[str, FloatArray]) -> DesignSettings:
        """Return the settings for sensors at these positions in R, m, (3,) each, and no others."""
        placed = [
            replace(sensor, position_R=sensors_R[sensor.name])
            for sensor in self.sensors
            if sensor.name in sensors_R
        ]
        return replace(self, sensors=tuple(placed))

    def information(self, scene: PlanningScene, poses: Sequence[PlannedPose]) -> DesignInformation:
        """Return the information of poses; errors as of `DesignInformation.of`."""
        chain = scene.model.chain
        return DesignInformation.of(
            chain, poses, self.sensors, self.marker_std_m, self.priors, self.box
        )


@dataclass(frozen=True)
class DesignResult:
    """The plans of an optimal design, with the expected precision."""

    plans: Mapping[str, Plan]  # Split -> its poses, each with the solutions that were chosen
    goal: Goal
    reached: bool  # Whether goal and floors are reached
    floors: Floors
    joint_rms: float  # Expected RMS standard deviation of the offsets, rad
    tool_rms: float  # Expected RMS error of the predicted markers, m

    def describe(self) -> str:
        """Return the expected precision in one line."""
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
) -> DesignResult:
    """Choose configurations that reach a precision in least time: a stated one, or that of plans.

    ``scene, settings``: see there; ``plans``: of Latin hypercubes, by split; the poses to fit are
    among the candidates, so that the precision of these plans can be reached; of the validation
    poses as many are kept as are needed; ``sensors_R``: position in R of each sensor that has to
    see its marker, m, (3,); ``travel``: cost of configurations; ``rng``: for candidates and
    choice.
    """
    plan, pool = plans['optimization'], scene.plan(POOL_CANDIDATES, sensors_R, rng)
    poses = [*plan.poses, *pool.poses]
    information = settings.with_sensors_at(sensors_R).information(scene, poses)
    count = sum(len(pose.solutions) for pose in plan.poses)
    reference = range(count)
    goal = Goal(
        settings.joint_std_rad or max(information.joint_rms(reference), ENOUGH_RAD),
        settings.tool_std_m or information.tool_rms(reference),
        settings.tool_share,
    )
    number = np.concatenate([np.arange(len(pose.solutions)) for pose in poses])
    candidates: IntArray = np.arange(min(len(information), max(MOST_CANDIDATES, count)))
    if settings.whole_poses and len(candidates) < len(information):
        candidates = candidates[information.pose[candidates] < information.pose[len(candidates)]]
    for _ in range(MOST_TRIES):
        reduced, floors = (
            information.only(candidates),
            _floors(information, candidates, settings.whole_poses),
        )
        design = choose(reduced, travel, goal, rng, floors, whole_poses=settings.whole_poses)
        chosen = candidates[np.array(design.chosen, dtype=np.int64)]
        isolated = _isolated_groups(scene.model, information.q[chosen], travel)
        if not isolated:
            break
        # Candidates nearest to an isolated group belong to that group: they are removed, since
        # another design with them would be isolated as well.
        q = information.q[candidates]
        nearest = np.argmin([travel.straight(each, q) for each in information.q[chosen]], axis=0)
        islands = [part for part in isolated if len(part) > 1]
        candidates = candidates[~np.isin(nearest, np.concatenate([*islands, []]))]
        candidates = np.setdiff1d(candidates, chosen[np.concatenate(isolated)])
    chosen_poses = [
        PlannedPose(poses[index].T_R_T, poses[index].solutions[number[indices]])
        for index in np.unique(information.pose[chosen])
        for indices in [np.sort(chosen[information.pose[chosen] == index])]
    ]
    dropped = _sum(plan.dropped, pool.dropped, {NOT_NEEDED: len(poses) - len(chosen_poses)})
    lost_solutions = 0
    if settings.whole_poses:
        # Solutions missing of a chosen pose are those without a free path.
        visited = np.isin(information.pose, information.pose[chosen])
        lost_solutions = int(np.sum(visited)) - len(chosen)
    solutions = _sum(
        plan.dropped_solutions,
        pool.dropped_solutions,
        {NO_FREE_PATH: lost_solutions},
        {NOT_NEEDED: len(information) - len(chosen) - lost_solutions},
    )
    designed = {**plans, 'optimization': Plan(tuple(chosen_poses), dropped, solutions)}
    if 'validation' in plans:
        solutions_of_each = None if settings.whole_poses else HELD_OUT_SOLUTIONS
        designed['validation'] = _held_out(plans['validation'], solutions_of_each, rng)
    return DesignResult(
        designed,
        goal,
        design.reached,
        floors,
        information.joint_rms(chosen.tolist()),
        information.tool_rms(chosen.tolist()),
    )


def _floors(information: DesignInformation, candidates: IntArray, whole_poses: bool) -> Floors:
    """Return the floors, lowered to what these configurations can reach.

    All whole poses should have two solutions, for which they are visited whole.
    """
    count = np.unique(information.pose[candidates], return_counts=True)[1]
    floors = Floors()
    repeated = floors.poses if whole_poses else floors.repeated
    return Floors(min(floors.poses, len(count)), min(repeated, int(np.sum(count > 1))))


def _held_out(plan: Plan, solutions: int | None, rng: np.random.Generator) -> Plan:
    """Return the first validation poses, and of each all solutions (None) or a random few."""
    kept = tuple(
        PlannedPose(
            pose.T_R_T,
            pose.solutions[np.sort(rng.permutation(len(pose.solutions))[:solutions])],
        )
        # The first poses of a Latin hypercube are as spread as any.
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
    """Return split, pose and solution of each visit in an order of least travel time.

    ``plans``: by split; poses to fit and to validate are mixed; ``model``: obstacles: a path that
    is not straight counts as longer; ``travel``: travel times; ``whole_poses``: visit a pose in
    all its solutions before the next one; distances are then between nearest solutions.
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
    times_between = travel.between(q)
    # The start is unknown: at distance 0 from all places.
    times = np.zeros((len(places) + 1, len(places) + 1))
    times[1:, 1:] = np.minimum.reduceat(
        np.minimum.reduceat(times_between, begin, axis=0), begin, axis=1
    )
    order = fastest_order(times)
    checked: set[tuple[int, int]] = set()
    for _ in range(MOST_TRIES):
        legs = {(min(leg), max(leg)) for leg in pairwise(order)} - checked
        checked |= legs
        blocked = [
            leg
            for leg in legs
            if not _is_free(model, q, times_between, *(places[i - 1] for i in leg))
        ]
        if not blocked:
            break
        for a, b in blocked:
            times[a, b] = times[b, a] = DETOUR * times[a, b]
        order = fastest_order(times)
    return [visits[member] for place in order for member in places[place - 1]]


def _is_free(
    model: CollisionModel, q: FloatArray, times: FloatArray, first: range, second: range
) -> bool:
    """Return whether the straight path between the nearest pair of two places is free."""
    between = times[first.start : first.stop, second.start : second.stop]
    a, b = np.unravel_index(int(np.argmin(between)), between.shape)
    return is_straight_free(model, q[first[int(a)]], q[second[int(b)]])


def _isolated_groups(model: CollisionModel, q: FloatArray, travel: TravelTime) -> list[IntArray]:
    """Return the groups of configurations (n, k) without a free path to the largest group.

    Paths are searched from each configuration to its two nearest, then from the largest connected
    group to each other group, between their two nearest configurations.
    """
    times = travel.between(q)
    np.fill_diagonal(times, np.inf)
    limits = model.chain.velocity_limits
    part = np.arange(len(q))

    def joins(index: int, other: int) -> bool:
        if part[index] != part[other]:
            if free_waypoints(model, q[other], q[index], limits, index) is None:
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
    """Return the sum of counts by name, without zeros."""
    names = dict.fromkeys(name for count in counts for name in count)
    total = {name: sum(count.get(name, 0) for count in counts) for name in names}
    return {name: count for name, count in total.items() if count}
