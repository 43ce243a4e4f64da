# SPDX-License-Identifier: Apache-2.0
"""The order of a collection: the next pose, its joint solutions nearest first, and the paths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Literal, NamedTuple

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.free_paths import free_path, is_straight_free
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.spline import BEGINS_RAD
from remaster_ros.planning.candidates import Plan, order_solutions
from remaster_ros.types import FloatArray

REGISTRATION = 'registration'
REFERENCE = 'reference'
FITTED = 'optimization'
HELD_OUT = 'validation'
FIRST_ROUNDS = 2
"""Rounds of the references at the beginning: the noise is estimated from their difference."""


class Route(NamedTuple):
    """The joint solutions of one pose in the order of visiting, and the paths to them."""

    ids: Sequence[int]  # Indices into the pose's planned solutions
    # Waypoints from the previous solution to each (to the first from the arm's configuration),
    # rad, (n, k); n = 0 if the straight path is free
    paths: Sequence[FloatArray]
    unreached: Sequence[int]  # Indices of solutions without a free path
    # Of a path that is a curve (`CurvedWay`) the shares of its points, (n,); () if none is
    shares: Sequence[FloatArray] = ()


@dataclass(frozen=True)
class PoseVisit:
    """A visit to a pose: its number, its joint solutions in order, and the paths to them.

    Without ``paths`` each path is a straight line.
    """

    # Number of the pose in the session; those of registration poses are negative
    pose: int
    split: str  # ``registration``, ``reference``, ``optimization`` or ``validation``
    T_R_T: FloatArray  # The tool's pose in the robot base, (4, 4)
    solutions: FloatArray  # Joint solutions, nearest first, rad, (m, k)
    index: int  # Index of the pose in the plan of its split
    # The `Route` to `solutions`
    ids: tuple[int, ...]
    paths: tuple[FloatArray, ...] = ()
    unreached: tuple[int, ...] = ()
    correction: str = ''  # See `PlannedPose`
    shares: tuple[FloatArray, ...] = ()  # (0,) each where the path is no curve

    def __post_init__(self) -> None:
        count = len(self.solutions)
        if not self.paths:
            straight = np.empty((0, self.solutions.shape[1]))
            object.__setattr__(self, 'paths', (straight,) * count)
        if not self.shares:
            object.__setattr__(self, 'shares', (np.empty(0),) * count)


class Tour:
    """The visits of a collection, one pose after the other, the nearest pose next.

    Poses of the splits ``optimization`` and ``validation`` are mixed, so that drift and warming
    affect both alike, and a collection that ends early has some of both.

    A plan of the split ``reference`` is visited repeatedly: a round of all its poses, twice at the
    beginning, then before more than `reference_every` other configurations were visited, and at
    the end. References are visited in the order of the plan, each from the one before it, so that
    backlash is the same in every round.

    Parameters
    ----------
    chain
        The arm.
    plans
        Split -> its plan.
    in_order
        Visit the poses in the order of the plans, split by split, instead of the nearest next.
    one_solution
        Visit only the nearest solution of each pose.
    model
        Obstacles that paths avoid; None for straight paths without checks (a simulated arm).
    reference_every
        Most configurations between two rounds of the references; a pose with more solutions is
        not interrupted.
    order
        Split, pose and solution of each visit, in order, in which a pose may occur several times
        with different solutions. Without it the nearest pose is next, in all its solutions.
    begin_at
        Number of the first pose: that of a tour after others of its session.
    """

    def __init__(
        self,
        chain: SerialChain,
        plans: Mapping[str, Plan],
        *,
        in_order: bool = False,
        one_solution: bool = False,
        model: CollisionModel | None = None,
        reference_every: int = 0,
        order: Sequence[tuple[str, int, int]] = (),
        begin_at: int = 0,
    ) -> None:
        self.chain, self._model = chain, model
        self.order, self.begin_at = tuple(order), begin_at
        self.reference_every = reference_every
        self.in_order, self.one_solution = in_order, one_solution
        self.plans = dict(plans)
        visited_once = {split: plan for split, plan in plans.items() if split != REFERENCE}
        references = plans.get(REFERENCE)
        self.references = len(references.poses) if references is not None else 0
        # Index of the next reference, rounds due, and configurations visited since the last round.
        self._reference, self._rounds_due = 0, FIRST_ROUNDS if self.references else 0
        self._since = self.reference_visits = 0
        # Split -> pose -> its solutions that were not visited; poses without any are removed.
        self._unvisited = {
            split: {
                index: list(range(len(pose.solutions))) for index, pose in enumerate(plan.poses)
            }
            for split, plan in visited_once.items()
        }
        # A pose keeps its number when it is visited again.
        self._numbers: dict[tuple[str, int], int] = {}
        self.poses = {split: len(plan.poses) for split, plan in visited_once.items()}
        self.configurations = {
            split: sum(1 if one_solution else len(pose.solutions) for pose in plan.poses)
            for split, plan in visited_once.items()
        }
        self.dropped: Counter[str] = Counter()
        self.dropped_solutions: Counter[str] = Counter()
        for plan in plans.values():
            self.dropped.update(plan.dropped)
            self.dropped_solutions.update(plan.dropped_solutions)
        self.visited = 0

    @property
    def to_fit(self) -> int:
        """Number of configurations planned for the fit."""
        return sum(len(pose.solutions) for pose in self.plans.get(FITTED, Plan(())).poses)

    @property
    def inspection(self) -> Literal['', 'verify', 'check']:
        """Inspection that the tour serves, with all its poses held out; '' for a calibration.

        ``verify`` if any of its poses states a correction, else ``check``.
        """
        if FITTED not in self.plans or self.plans[FITTED].poses:
            return ''
        held_out = self.plans.get(HELD_OUT, Plan(())).poses
        return 'verify' if any(pose.correction for pose in held_out) else 'check'

    def fork(self) -> Tour:
        """Return a copy of the tour in its present state, which does not change with this one."""
        other = copy(self)
        other._unvisited, other._numbers = deepcopy(self._unvisited), dict(self._numbers)
        return other

    def first_poses(self, count: int) -> Tour:
        """Return a new tour of the first `count` poses of each split, none of them visited."""
        plans = {
            split: replace(plan, poses=plan.poses[:count]) for split, plan in self.plans.items()
        }
        return self._restarted(plans, self._model)

    def restarted_straight(self) -> Tour:
        """Return a new tour of the same plans, with straight paths that are not checked."""
        return self._restarted(self.plans, None)

    def _restarted(self, plans: Mapping[str, Plan], model: CollisionModel | None) -> Tour:
        """Return a new tour with other plans and collision model, and the options of this one.

        No pose is visited.
        """
        return Tour(
            self.chain,
            plans,
            in_order=self.in_order,
            one_solution=self.one_solution,
            model=model,
            reference_every=self.reference_every,
            order=self.order,
            begin_at=self.begin_at,
        )

    def next(self, q: FloatArray) -> PoseVisit | None:
        """Return the next visit for an arm at joint positions q, (k,), and count it as made.

        q: rad or m. None at the end.
        """
        proposed = self.propose(q)
        return None if proposed is None else self.accept(proposed)

    def propose(self, q: FloatArray) -> PoseVisit | None:
        """Return the visit that `next` would, without counting it; safe in another thread.

        A round of references, if one is due, comes first. None at the end. Its `solutions` are
        empty if none has a free path.
        """
        if self._rounds_due:
            return self._propose_reference(q)
        unvisited = [
            (split, index) for split, indices in self._unvisited.items() for index in indices
        ]
        if not unvisited:
            return self._propose_reference(q) if self.references and self._since else None
        split, index = self._nearest(unvisited, q) if not self.order else self._in_order()[0][:2]
        route = self._route(split, index, self._due(split, index), q)
        after = self._since + len(route.ids)
        if self.references and self._since and after > self.reference_every:
            return self._propose_reference(q)
        return self._visit(split, index, route)

    def _nearest(self, unvisited: Sequence[tuple[str, int]], q: FloatArray) -> tuple[str, int]:
        """Return split and index of the next pose of a tour without a given order.

        Nearest by the distance of the tool; the first one if the tour is `in_order`.
        ``unvisited``: split and index of the poses to choose from; q: rad or m, (k,).
        """
        position = self.chain.forward(q)[:3, 3]
        places = [self.plans[split].poses[index].T_R_T[:3, 3] for split, index in unvisited]
        distances = np.linalg.norm(np.array(places) - position, axis=1)
        return unvisited[0 if self.in_order else int(np.argmin(distances))]

    def _in_order(self) -> list[tuple[str, int, int]]:
        """Return the visits of `order` that are not done: split, pose and solution of each."""
        return [v for v in self.order if v[2] in self._unvisited[v[0]].get(v[1], ())]

    def _due(self, split: str, index: int) -> list[int]:
        """Return the solutions of a pose to visit now, as indices into its solutions.

        All that are not visited; of a tour with a given order those that come next in it, up
        to the first visit to another pose ([] if that is next). ``split, index``: of the pose.
        """
        if not self.order:
            return self._unvisited[split][index]
        run = takewhile(lambda visit: visit[:2] == (split, index), self._in_order())
        return [number for _, _, number in run]

    @property
    def poses_begun(self) -> int:
        """Number of poses begun, references not counted."""
        return len(self._numbers)

    def request_reference_round(self) -> None:
        """Start a round of the references with the next visit; nothing without references.

        A round under way begins anew.
        """
        if self.references:
            self._reference, self._rounds_due = 0, max(self._rounds_due, 1)

    def _propose_reference(self, q: FloatArray) -> PoseVisit:
        """Return the visit to the next reference of the round; nothing is counted.

        ``q``: where the arm is, rad or m, (k,). Without a path the visit has no solution.
        """
        index = self._reference
        return self._visit(REFERENCE, index, self._route(REFERENCE, index, [0], q))

    def _route_to_reference(self, index: int, q: FloatArray) -> FloatArray | None:
        """Return waypoints to a reference, rad or m, (n, k); None if there is no free path.

        The path goes by way of the previous reference (of the first one the last), or directly if
        that cannot be reached. ``index``: of the reference, from 0; q: where the arm is, (k,).
        """
        goals = [pose.solutions[0] for pose in self.plans[REFERENCE].poses]
        goal, previous = goals[index], goals[index - 1]
        from_previous = free_waypoints(
            self._model, previous, goal, self.chain.velocity_limits, index
        )
        if from_previous is not None:
            if nearest_solution(previous[None], q, JointUnits.of(self.chain)) is not None:
                return from_previous
            to_previous = free_waypoints(
                self._model, q, previous, self.chain.velocity_limits, index
            )
            if to_previous is not None:
                return np.concatenate((to_previous, previous[None], from_previous))
        return free_waypoints(self._model, q, goal, self.chain.velocity_limits, index)

    def accept(self, proposed: PoseVisit) -> PoseVisit:
        """Count a proposed visit as made, and return it with its number.

        Not checked: the tour must be in the state in which the visit was proposed.
        """
        p = proposed
        return self.record_visit(p.split, p.index, p.ids, p.paths, p.unreached, p.shares)

    def reroute(self, visit: PoseVisit, q: FloatArray) -> PoseVisit:
        """Return a visit to the same solutions, with new paths and order from configuration q.

        ``q``: rad or m, (k,). Solutions without a path become `unreached`; nothing is counted.
        """
        return self.with_route(visit, *self._route(visit.split, visit.index, visit.ids, q))

    def with_route(
        self,
        visit: PoseVisit,
        ids: Sequence[int],
        paths: Sequence[FloatArray] = (),
        unreached: Sequence[int] = (),
        shares: Sequence[FloatArray] = (),
    ) -> PoseVisit:
        """Return a visit to the same pose with another route (see `Route`); nothing is counted."""
        other = self._visit(visit.split, visit.index, Route(ids, paths, unreached, shares))
        return replace(other, pose=visit.pose)

    def record_visit(
        self,
        split: str,
        index: int,
        ids: Sequence[int],
        paths: Sequence[FloatArray] = (),
        unreached: Sequence[int] = (),
        shares: Sequence[FloatArray] = (),
    ) -> PoseVisit:
        """Count a visit to a planned pose as made, and return it.

        ``split, index``: the pose's plan, and its index there; the other arguments are those
        of `Route`. Without a given order all solutions of the pose are done then, else those
        of the route. A tour is resumed by calling this for all visits made so far, in their
        order.
        Raises KeyError for a pose that is done already.
        """
        visit = self._visit(split, index, Route(ids, paths, unreached, shares))
        if split == REFERENCE:
            self._begin_reference(index)
        else:
            self._numbers.setdefault((split, index), visit.pose)
            done = {*ids, *unreached} if self.order else set(self._unvisited[split][index])
            unvisited = [
                number for number in self._unvisited[split].pop(index) if number not in done
            ]
            if unvisited:
                self._unvisited[split][index] = unvisited
            self._since += len(ids)
        self.visited += 1
        return visit

    def drop_remaining(self, split: str, reason: str) -> None:
        """Drop the remaining visits of a split; they are counted with the reason.

        A pose that was begun counts as visited. Raises KeyError for a split that is not planned.
        """
        unvisited, self._unvisited[split] = self._unvisited[split], {}
        for index, numbers in unvisited.items():
            self.dropped_solutions[reason] += len(numbers)
            self.configurations[split] -= len(numbers)
            if (split, index) not in self._numbers:
                self.dropped[reason] += 1
                self.poses[split] -= 1

    def has_unvisited(self, split: str) -> bool:
        """Whether visits of a split remain; False for a split that is not planned."""
        return bool(self._unvisited.get(split))

    def _begin_reference(self, index: int) -> None:
        """Count a visit to a reference; the last one ends the round.

        ``index``: of the reference, from 0.
        """
        self.reference_visits += 1
        self._rounds_due = max(self._rounds_due, 1)
        self._reference = index + 1
        if self._reference >= self.references:
            self._reference, self._since = 0, 0
            self._rounds_due -= 1

    def _visit(self, split: str, index: int, route: Route) -> PoseVisit:
        """Return the visit to a planned pose along a route; nothing is counted.

        Its number is that of an earlier visit to the pose, else the next one; negative for a
        registration.
        """
        pose = self.plans[split].poses[index]
        number = self.begin_at + self.visited if split != REGISTRATION else -1 - self.visited
        number = self._numbers.get((split, index), number)
        ids, paths, unreached = tuple(route.ids), tuple(route.paths), tuple(route.unreached)
        solutions = pose.solutions[list(ids)]
        return PoseVisit(
            number,
            split,
            pose.T_R_T,
            solutions,
            index,
            ids,
            paths,
            unreached,
            pose.correction,
            tuple(route.shares),
        )

    def _route(self, split: str, index: int, ids: Iterable[int], q: FloatArray) -> Route:
        """Return the route to solutions of a pose from configuration q; nothing is counted.

        To a reference as `_route_to_reference`; along the pose's curve if the arm is at its
        begin; else in the order of `free_order`. ``ids``: indices into the pose's solutions;
        those without a path are in `unreached`. The same arguments give the same route.
        """
        ids = list(ids)
        if split == REFERENCE:
            waypoints = self._route_to_reference(index, q) if ids else None
            return Route((), (), ids) if waypoints is None else Route(ids, [waypoints], ())
        pose = self.plans[split].poses[index]
        if pose.way is not None and ids:
            units = JointUnits.of(self.chain)
            if units.largest(pose.way.points[0] - q) <= BEGINS_RAD:
                return Route(ids, [pose.way.points], (), [pose.way.shares])
        solutions = pose.solutions[ids]
        # Seeded by the pose, so that a tour is repeatable.
        rng = np.random.default_rng([index, *split.encode()])
        order, paths = free_order(
            self._model, q, solutions, self.chain.velocity_limits, rng, self.one_solution
        )
        reached = [ids[i] for i in order]
        if self.one_solution:
            # One solution is visited; if none can be, one counts as unreached.
            return Route(reached, paths, () if reached else ids[:1])
        return Route(reached, paths, [number for number in ids if number not in reached])

    def describe(self) -> str:
        """Return the counts of planned and dropped poses in one line, with reasons."""
        kept = ', '.join(
            f'{counted(count, f"{split} pose")} with '
            f'{counted(self.configurations[split], "configuration")}'
            for split, count in self.poses.items()
        )
        reasons = ', '.join(f'{count} {reason}' for reason, count in self.dropped.most_common())
        watched = (
            f'; {self.references} reference configurations, measured again every '
            f'{self.reference_every}'
        ) * bool(self.references)
        return f'planned {kept}{watched}; dropped poses: {reasons or "none"}'


def nearest_solution(
    solutions: FloatArray, q: FloatArray, units: JointUnits, tolerance_rad: float = 0.02
) -> int | None:
    """Return the index of the solution (m, k) at which the arm stands; None if there is none.

    All joints must agree within the tolerance, rad (of a prismatic joint by `units`); turns by
    2 pi differ. If several do, the nearest. The default is ten times what the bridge accepts
    as arrived by default, and far below the difference between two solutions of a pose. Raises
    ValueError if m is 0. ``q``: configuration of the arm, (k,).
    """
    distance = np.max(np.abs(solutions - q) / units.per_radian, axis=1)
    nearest = int(np.argmin(distance))
    return nearest if distance[nearest] <= tolerance_rad else None


def free_order(
    model: CollisionModel | None,
    q: FloatArray,
    solutions: FloatArray,
    velocity_limits: FloatArray,
    rng: np.random.Generator,
    one_solution: bool = False,
) -> tuple[list[int], list[FloatArray]]:
    """Return an order of joint solutions in which each can be reached from the one before.

    The nearest solution with a free straight path is next. If no straight path is free, a path
    around obstacles is searched, to the nearest solution first; a solution that cannot be reached
    is tried again from each later one.

    ``model``: obstacles; with None every straight path is free; ``q``: start configuration, rad,
    (k,); ``solutions``: rad, (m, k); ``velocity_limits``: rad/s, (k,); ``one_solution``: stop
    after one solution.
    Returns indices into solutions, without unreachable ones, and for each the waypoints before it,
    rad, (n, k).
    """
    remaining = [int(i) for i in order_solutions(solutions, q, velocity_limits)]
    straight = np.empty((0, solutions.shape[1]))
    if model is None:
        remaining = remaining[:1] if one_solution else remaining
        return remaining, [straight] * len(remaining)
    order: list[int] = []
    paths: list[FloatArray] = []
    position = q
    while remaining:
        waypoints = straight
        nearest = next(
            (i for i in remaining if is_straight_free(model, position, solutions[i])), None
        )
        if nearest is None:
            for i in remaining:
                detour = free_path(model, position, solutions[i], rng)
                if detour is not None:
                    nearest, waypoints = i, detour[1:-1]
                    break
        if nearest is None:
            break
        order.append(nearest)
        paths.append(waypoints)
        if one_solution:
            break
        remaining.remove(nearest)
        position = solutions[nearest]
    return order, paths


def free_waypoints(
    model: CollisionModel | None,
    q: FloatArray,
    goal: FloatArray,
    velocity_limits: FloatArray,
    seed: int,
) -> FloatArray | None:
    """Return waypoints between q and goal (both excluded) of a free path, rad or m, (n, k).

    None if no path is found. ``model``: obstacles; with None the straight path is free, n = 0.
    Repeatable: the same ends and seed give the same path. ``velocity_limits``: per s, (k,);
    ``seed``: of the search.
    """
    rng = np.random.default_rng([seed, *b'reference'])
    order, paths = free_order(model, q, goal[None], velocity_limits, rng)
    return paths[0] if order else None
