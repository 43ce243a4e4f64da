# SPDX-License-Identifier: Apache-2.0
"""The order of a collection: which pose is next, and its joint solutions nearest first."""

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
from remaster_ros.planning.candidates import Plan, order_solutions
from remaster_ros.types import FloatArray

REGISTRATION = 'registration'
REFERENCE = 'reference'
FITTED = 'optimization'
HELD_OUT = 'validation'
FIRST_ROUNDS = 2
"""The references are measured so often at the beginning: their difference is the noise."""


class Route(NamedTuple):
    """The way to joint solutions of one pose, in the order of the visits."""

    ids: Sequence[int]  # Which of the pose's planned solutions they are
    # The way to each from the one before (to the first from where the arm stands): configurations
    # to go through in between, rad, (n, k); n = 0 where the straight way is free
    paths: Sequence[FloatArray]
    unreached: Sequence[int]  # The pose's other solutions that no free path leads to


@dataclass(frozen=True)
class PoseVisit:
    """A pose to visit now."""

    # Its number in the session; registration poses have numbers of their own, below zero
    pose: int
    split: str  # ``registration``, ``reference``, ``optimization`` or ``validation``
    T_R_T: FloatArray  # The tool's pose in the robot base, (4, 4)
    solutions: FloatArray  # Joint solutions, nearest first, rad, (m, k)
    index: int  # Which of the poses planned for its split
    # Which of that pose's planned solutions each of `solutions` is, and the way there: a `Route`
    ids: tuple[int, ...]
    paths: tuple[FloatArray, ...] = ()
    unreached: tuple[int, ...] = ()
    correction: str = ''  # As of a `PlannedPose`

    def __post_init__(self) -> None:
        if not self.paths:
            straight = np.empty((0, self.solutions.shape[1]))
            object.__setattr__(self, 'paths', (straight,) * len(self.solutions))


class Tour:
    """Poses by proximity to where the arm is, those to fit and those held out among each other.

    So what drifts or warms up meanwhile is met by both, and not extrapolated from the one to the
    other; and a collection that ends early has some of both.

    A plan of the split ``reference`` is visited again and again: a round of all its poses, twice
    at the beginning, then before more than `reference_every` other configurations were visited,
    and at the end. Its poses come in their order, and each is reached from the one before it, so
    that backlash is the same each time.

    Parameters
    ----------
    chain
        The arm.
    plans
        Split -> its plan.
    in_order
        Visit the poses as they come, split by split, instead of the nearest first.
    one_solution
        Visit only the nearest solution of each pose.
    model
        What the arm must not hit on its way; None where that does not matter (an arm that is
        computed).
    reference_every
        How many configurations lie between two rounds of the references at most; a pose with more
        solutions than that is not interrupted.
    order
        Split, pose and solution of each visit, in order: a pose may be visited again for others of
        its solutions. Without it the nearest pose is next, in all its solutions.
    begin_at
        Number of the first pose: of a tour behind others of its session.
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
        once = {split: plan for split, plan in plans.items() if split != REFERENCE}
        references = plans.get(REFERENCE)
        self.references = len(references.poses) if references is not None else 0
        # Which reference is next, of how many rounds that are due; and what was visited since.
        self._reference, self._rounds_due = 0, FIRST_ROUNDS if self.references else 0
        self._since = self.reference_stops = 0
        # Of each pose the solutions that were not visited; poses without any are taken out.
        self._left = {
            split: {
                index: list(range(len(pose.solutions))) for index, pose in enumerate(plan.poses)
            }
            for split, plan in once.items()
        }
        # A pose keeps its number when it is visited again.
        self._numbers: dict[tuple[str, int], int] = {}
        self.poses = {split: len(plan.poses) for split, plan in once.items()}
        self.configurations = {
            split: sum(1 if one_solution else len(pose.solutions) for pose in plan.poses)
            for split, plan in once.items()
        }
        self.dropped: Counter[str] = Counter()
        self.dropped_solutions: Counter[str] = Counter()
        for plan in plans.values():
            self.dropped.update(plan.dropped)
            self.dropped_solutions.update(plan.dropped_solutions)
        self.visited = 0

    @property
    def to_fit(self) -> int:
        """How many configurations to fit it was planned with."""
        return sum(len(pose.solutions) for pose in self.plans.get(FITTED, Plan(())).poses)

    @property
    def judges(self) -> Literal['', 'verify', 'check']:
        """What its poses are for, where that is not a calibration: they are all held out."""
        if FITTED not in self.plans or self.plans[FITTED].poses:
            return ''
        held_out = self.plans.get(HELD_OUT, Plan(())).poses
        return 'verify' if any(pose.correction for pose in held_out) else 'check'

    def fork(self) -> Tour:
        """Return a tour as far as this one, which can go on without it."""
        other = copy(self)
        other._left, other._numbers = deepcopy(self._left), dict(self._numbers)
        return other

    def only_first(self, count: int) -> Tour:
        """Return a tour of the first poses of each split alone."""
        plans = {
            split: replace(plan, poses=plan.poses[:count]) for split, plan in self.plans.items()
        }
        return self._again(plans, self._model)

    def afresh(self) -> Tour:
        """Return the tour from its beginning, with every way straight."""
        return self._again(self.plans, None)

    def _again(self, plans: Mapping[str, Plan], model: CollisionModel | None) -> Tour:
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
        """Return the next stop for an arm at joint positions `q` (rad, (k,)); None at the end."""
        proposed = self.propose(q)
        return None if proposed is None else self.take(proposed)

    def propose(self, q: FloatArray) -> PoseVisit | None:
        """Return what `next` would, and leave the tour as it is: a thread may do this."""
        if self._rounds_due:
            return self._propose_reference(q)
        left = [(split, index) for split, indices in self._left.items() for index in indices]
        if not left:
            return self._propose_reference(q) if self.references and self._since else None
        split, index = self._nearest(left, q) if not self.order else self._in_order()[0][:2]
        route = self._route(split, index, self._due(split, index), q)
        after = self._since + len(route.ids)
        if self.references and self._since and after > self.reference_every:
            return self._propose_reference(q)
        return self._stop(split, index, route)

    def _nearest(self, left: Sequence[tuple[str, int]], q: FloatArray) -> tuple[str, int]:
        """Return which pose is next where no order is given."""
        here = self.chain.forward(q)[:3, 3]
        places = [self.plans[split].poses[index].T_R_T[:3, 3] for split, index in left]
        distances = np.linalg.norm(np.array(places) - here, axis=1)
        return left[0 if self.in_order else int(np.argmin(distances))]

    def _in_order(self) -> list[tuple[str, int, int]]:
        """Return the visits of the given order that are left."""
        return [v for v in self.order if v[2] in self._left[v[0]].get(v[1], ())]

    def _due(self, split: str, index: int) -> list[int]:
        """Return the solutions of a pose to visit now: all, or those next to each other."""
        if not self.order:
            return self._left[split][index]
        run = takewhile(lambda visit: visit[:2] == (split, index), self._in_order())
        return [number for _, _, number in run]

    @property
    def poses_begun(self) -> int:
        """How many poses were begun that are no references."""
        return len(self._numbers)

    def ask_round(self) -> None:
        """Begin a round of the references with the next stop."""
        if self.references:
            self._reference, self._rounds_due = 0, max(self._rounds_due, 1)

    def _propose_reference(self, q: FloatArray) -> PoseVisit:
        index = self._reference
        return self._stop(REFERENCE, index, self._route(REFERENCE, index, [0], q))

    def _route_to_reference(self, index: int, q: FloatArray) -> FloatArray | None:
        """Return what to go through to a reference, by way of the one before it; None for no way.

        rad, (n, k). Where the one before it cannot be reached the way leads there directly.
        """
        goals = [pose.solutions[0] for pose in self.plans[REFERENCE].poses]
        goal, before = goals[index], goals[index - 1]
        last = free_way(self._model, before, goal, self.chain.velocity_limits, index)
        if last is not None:
            if nearest_solution(before[None], q, JointUnits.of(self.chain)) is not None:
                return last
            first = free_way(self._model, q, before, self.chain.velocity_limits, index)
            if first is not None:
                return np.concatenate((first, before[None], last))
        return free_way(self._model, q, goal, self.chain.velocity_limits, index)

    def take(self, proposed: PoseVisit) -> PoseVisit:
        """Count a proposed stop visited and return it with its number."""
        route = proposed.ids, proposed.paths, proposed.unreached
        return self.go_to(proposed.split, proposed.index, *route)

    def reroute(self, stop: PoseVisit, q: FloatArray) -> PoseVisit:
        """Return a stop with the ways to its solutions, and their order, found anew from `q`."""
        return self.along(stop, *self._route(stop.split, stop.index, stop.ids, q))

    def along(
        self,
        stop: PoseVisit,
        ids: Sequence[int],
        paths: Sequence[FloatArray] = (),
        unreached: Sequence[int] = (),
    ) -> PoseVisit:
        """Return a stop at the same pose with another route (see `Route`)."""
        other = self._stop(stop.split, stop.index, Route(ids, paths, unreached))
        return replace(other, pose=stop.pose)

    def go_to(
        self,
        split: str,
        index: int,
        ids: Sequence[int],
        paths: Sequence[FloatArray] = (),
        unreached: Sequence[int] = (),
    ) -> PoseVisit:
        """Return the stop at one planned pose along a route (see `Route`), and count it visited.

        A tour that was begun before is taken up by this: the stops so far, in their order.
        """
        stop = self._stop(split, index, Route(ids, paths, unreached))
        if split == REFERENCE:
            self._begin_reference(index)
        else:
            self._numbers.setdefault((split, index), stop.pose)
            done = {*ids, *unreached} if self.order else set(self._left[split][index])
            left = [number for number in self._left[split].pop(index) if number not in done]
            if left:
                self._left[split][index] = left
            self._since += len(ids)
        self.visited += 1
        return stop

    def leave_out(self, split: str, reason: str) -> None:
        """Visit nothing more of a split: what is left of it counts as dropped for this reason."""
        left, self._left[split] = self._left[split], {}
        for index, numbers in left.items():
            self.dropped_solutions[reason] += len(numbers)
            self.configurations[split] -= len(numbers)
            if (split, index) not in self._numbers:
                self.dropped[reason] += 1
                self.poses[split] -= 1

    def has_left(self, split: str) -> bool:
        """Whether anything of a split is still to be visited."""
        return bool(self._left.get(split))

    def _begin_reference(self, index: int) -> None:
        """Count a reference visited: the round is over with its last one."""
        self.reference_stops += 1
        self._rounds_due = max(self._rounds_due, 1)
        self._reference = index + 1
        if self._reference >= self.references:
            self._reference, self._since = 0, 0
            self._rounds_due -= 1

    def _stop(self, split: str, index: int, route: Route) -> PoseVisit:
        pose = self.plans[split].poses[index]
        number = self.begin_at + self.visited if split != REGISTRATION else -1 - self.visited
        number = self._numbers.get((split, index), number)
        ids, paths, unreached = tuple(route.ids), tuple(route.paths), tuple(route.unreached)
        solutions = pose.solutions[list(ids)]
        way = ids, paths, unreached
        return PoseVisit(number, split, pose.T_R_T, solutions, index, *way, pose.correction)

    def _route(self, split: str, index: int, ids: Iterable[int], q: FloatArray) -> Route:
        """Order these solutions of a pose; see `free_order`."""
        ids = list(ids)
        if split == REFERENCE:
            way = self._route_to_reference(index, q) if ids else None
            return Route((), (), ids) if way is None else Route(ids, [way], ())
        solutions = self.plans[split].poses[index].solutions[ids]
        # The same draws whenever this pose is planned: a tour can be repeated.
        rng = np.random.default_rng([index, *split.encode()])
        order, paths = free_order(
            self._model, q, solutions, self.chain.velocity_limits, rng, self.one_solution
        )
        found = [ids[i] for i in order]
        if self.one_solution:
            # One is visited; where none can be, one is lost.
            return Route(found, paths, () if found else ids[:1])
        return Route(found, paths, [number for number in ids if number not in found])

    def describe(self) -> str:
        """Return what was planned and dropped, in a line."""
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
    """Return which solution (m, k) the arm stands at, rad; None if no joint-wise match is near.

    The tolerance is far above what an arm that arrived is off by, and far below what tells two
    solutions of a pose apart: ten times what the bridge takes for arrived by default.
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
    one: bool = False,
) -> tuple[list[int], list[FloatArray]]:
    """Order joint solutions so that each can be reached from the one before.

    The nearest to where the arm stands of those that a free straight way leads to is first, then
    the next from there, and so on. Where no straight way is free, one around is looked for, to the
    nearest first; a solution that cannot be reached is tried again from each that could be.

    ``model``: what must not be hit; with None every straight way is free; ``q``: where the arm
    stands, rad, (k,); ``solutions``: rad, (m, k); ``velocity_limits``: rad/s, (k,); ``one``: one
    solution is enough.
    Returns order, paths: indices into solutions, without those that could not be reached, and for
    each the configurations to go through before it, rad, (n, k).
    """
    left = [int(i) for i in order_solutions(solutions, q, velocity_limits)]
    straight = np.empty((0, solutions.shape[1]))
    if model is None:
        left = left[:1] if one else left
        return left, [straight] * len(left)
    order: list[int] = []
    paths: list[FloatArray] = []
    here = q
    while left:
        way = straight
        found = next((i for i in left if is_straight_free(model, here, solutions[i])), None)
        if found is None:
            for i in left:
                around = free_path(model, here, solutions[i], rng)
                if around is not None:
                    found, way = i, around[1:-1]
                    break
        if found is None:
            break
        order.append(found)
        paths.append(way)
        if one:
            break
        left.remove(found)
        here = solutions[found]
    return order, paths


def free_way(
    model: CollisionModel | None,
    q: FloatArray,
    goal: FloatArray,
    velocity_limits: FloatArray,
    seed: int,
) -> FloatArray | None:
    """Return what to go through from `q` to one configuration, rad, (n, k); None for no way.

    The same way each time, for the same ends and seed.
    """
    rng = np.random.default_rng([seed, *b'reference'])
    order, paths = free_order(model, q, goal[None], velocity_limits, rng)
    return paths[0] if order else None
