# SPDX-License-Identifier: Apache-2.0
"""Optimal designs as plans of a collection with free paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
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
"""Most repetitions of a design if a path is not free."""


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
        """Return a copy with the sensors at other positions, and without those that have none.

        ``sensors_R``: sensor -> position in the robot base frame R, m, (3,).
        """
        placed = [
            replace(sensor, position_R=sensors_R[sensor.name])
            for sensor in self.sensors
            if sensor.name in sensors_R
        ]
        return replace(self, sensors=tuple(placed))

    def information(self, scene: PlanningScene, poses: Sequence[PlannedPose]) -> DesignInformation:
        """Return the Fisher information of poses, each in all its joint solutions, for a fit.

        The arm is the scene's, nominal; sensors, priors and tool box are those of these settings.
        Raises InputError without any solution, or without one with the tool in the box, and
        InsufficientDataError if all solutions together do not determine the parameters.
        """
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
        """Return the expected precision in one line: deg of the offsets, mm of the markers.

        With the goal if that is not reached.
        """
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
    """Choose the configurations to fit that reach a precision in the least robot time.

    The precision is that stated in ``settings``, or else that of ``plans``.

    ``scene``: the arm, its obstacles and sensors; ``plans``: of Latin hypercubes, by split;
    the poses to fit are among the candidates, so that the precision of these plans can be
    reached; of the validation poses the first `HELD_OUT_POSES` are kept; ``sensors_R``:
    position in R of each sensor that has to see its marker, m, (3,); ``travel``: cost of
    configurations; ``rng``: for candidates and choice. If a chosen configuration has no path
    to the others, the choice is repeated without it, at most `MOST_TRIES` times.

    Raises InputError and InsufficientDataError as `DesignInformation.of` and `Goal.weights`.
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
    """Return the least numbers of poses and of repeated poses that a design must have.

    Lowered to what the candidates can reach. With ``whole_poses`` (a pose is visited in all
    its solutions) all of the least number of poses should have two solutions or more.
    ``candidates``: indices of the candidate configurations.
    """
    count = np.unique(information.pose[candidates], return_counts=True)[1]
    floors = Floors()
    repeated = floors.poses if whole_poses else floors.repeated
    return Floors(min(floors.poses, len(count)), min(repeated, int(np.sum(count > 1))))


def _held_out(plan: Plan, solutions: int | None, rng: np.random.Generator) -> Plan:
    """Return a plan of the first `HELD_OUT_POSES` validation poses of a plan.

    The other poses and solutions are counted as dropped, with the reason 'not needed'
    (`NOT_NEEDED`). ``solutions``: how many of each pose are drawn at random; None for all.
    """
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


def _isolated_groups(model: CollisionModel, q: FloatArray, travel: TravelTime) -> list[IntArray]:
    """Return the groups of configurations that have no free path to the largest group.

    Each as indices, (m,). Paths are searched from each configuration to its two nearest, then
    between groups, the largest first, once for each pair of groups: between their two nearest
    configurations. That ends when the remaining groups together are no larger than the largest.
    ``q``: configurations, (n, k).
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
    # Two nearest may be in one cluster, so that a group is not all that is connected: of an arm
    # between walls the larger side fell into pieces, and the smaller one was kept.
    remaining = np.unique(part)
    while True:
        number = remaining[int(np.argmax([np.sum(part == each) for each in remaining]))]
        remaining = remaining[remaining != number]
        order = [np.min(times[np.ix_(part == number, part == each)]) for each in remaining]
        for each in remaining[np.argsort(order)]:
            between = np.where(np.outer(part == each, part == number), times, np.inf)
            pair = np.unravel_index(int(np.argmin(between)), between.shape)
            if np.isfinite(between[pair]) and joins(*map(int, pair)):
                remaining = remaining[remaining != each]
        most = int(np.argmax(np.bincount(part, minlength=1)))
        if np.sum(np.isin(part, remaining)) <= np.sum(part == most):
            break
    return [np.flatnonzero(part == number) for number in np.unique(part[part != most])]


def _sum(*counts: Mapping[str, int]) -> dict[str, int]:
    """Return the sum of counts by name, without zeros."""
    names = dict.fromkeys(name for count in counts for name in count)
    total = {name: sum(count.get(name, 0) for count in counts) for name in names}
    return {name: count for name, count in total.items() if count}
