"""The order of a collection: which pose is next, and its joint solutions nearest first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InsufficientDataError
from remaster_ros.core.planning import Plan, order_solutions
from remaster_ros.core.types import FloatArray

REGISTRATION = 'registration'


@dataclass(frozen=True)
class Stop:
    """A pose to visit now.

    Attributes
    ----------
    pose
        Its number in the session; registration poses have numbers of their own, below zero.
    split
        ``registration``, ``optimization`` or ``validation``.
    T_R_T
        The tool's pose in the robot base, (4, 4).
    solutions
        Joint solutions, nearest first, rad, (m, k).
    index
        Which of the poses planned for its split.
    ids
        Which of that pose's planned solutions each of `solutions` is.
    """

    pose: int
    split: str
    T_R_T: FloatArray
    solutions: FloatArray
    index: int
    ids: tuple[int, ...]

    def only(self, ids: Collection[int]) -> Stop:
        """Return the stop with only these solutions, in the same order."""
        kept = [i for i, number in enumerate(self.ids) if number in ids]
        return replace(self, solutions=self.solutions[kept], ids=tuple(self.ids[i] for i in kept))


class Tour:
    """Poses by proximity to where the arm is, those to fit and those held out among each other.

    So what drifts or warms up meanwhile is met by both, and not extrapolated from the one to the
    other; and a collection that ends early has some of both.

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
    """

    def __init__(
        self,
        chain: SerialChain,
        plans: Mapping[str, Plan],
        *,
        in_order: bool = False,
        one_solution: bool = False,
    ) -> None:
        self._chain = chain
        self.in_order, self.one_solution = in_order, one_solution
        self.plans = dict(plans)
        self._left = {split: list(range(len(plan.poses))) for split, plan in plans.items()}
        self.poses = {split: len(plan.poses) for split, plan in plans.items()}
        self.configurations = {
            split: sum(1 if one_solution else len(pose.solutions) for pose in plan.poses)
            for split, plan in plans.items()
        }
        self.dropped: Counter[str] = Counter()
        for plan in plans.values():
            self.dropped.update(plan.dropped)
        self.visited = 0

    def next(self, q: FloatArray) -> Stop | None:
        """Return the next stop for an arm at joint positions `q` (rad, (k,)); None at the end."""
        left = [(split, index) for split, indices in self._left.items() for index in indices]
        if not left:
            return None
        here = self._chain.forward(q)[:3, 3]
        places = [self.plans[split].poses[index].T_R_T[:3, 3] for split, index in left]
        distances = np.linalg.norm(np.array(places) - here, axis=1)
        split, index = left[0 if self.in_order else int(np.argmin(distances))]
        solutions = self.plans[split].poses[index].solutions
        order = order_solutions(solutions, q, self._chain.velocity_limits)
        if self.one_solution:
            order = order[:1]
        return self.go_to(split, index, [int(number) for number in order])

    def go_to(self, split: str, index: int, ids: Sequence[int]) -> Stop:
        """Return the stop at one planned pose with these of its solutions, and count it visited.

        This is how a tour that was begun before takes up where it was: the stops so far, in order.
        """
        self._left[split].remove(index)
        pose = self.plans[split].poses[index]
        number = self.visited if split != REGISTRATION else -1 - self.visited
        self.visited += 1
        return Stop(number, split, pose.T_R_T, pose.solutions[list(ids)], index, tuple(ids))

    def describe(self) -> str:
        """Return what was planned and dropped, in a line."""
        kept = ', '.join(
            f'{count} {split} poses with {self.configurations[split]} configurations'
            for split, count in self.poses.items()
        )
        reasons = ', '.join(f'{count} {reason}' for reason, count in self.dropped.most_common())
        return f'planned {kept}; dropped poses: {reasons or "none"}'


def registration_tour(chain: SerialChain, plan: Plan, markers_T: Sequence[FloatArray]) -> Tour:
    """Choose poses for a three-point registration: the first three span the largest triangle.

    The others follow in case a sensor cannot see one of them.

    Parameters
    ----------
    chain
        The arm.
    plan
        Poses that face roughly towards the sensors.
    markers_T
        The markers that are seen, in the tool frame, m, (3,) each.

    Raises
    ------
    InsufficientDataError
        If there are fewer than three poses.
    """
    if len(plan.poses) < 3:
        reasons = ', '.join(f'{count} {reason}' for reason, count in plan.dropped.items())
        raise InsufficientDataError(
            f'only {len(plan.poses)} of the poses for the registration can be reached '
            f'({reasons}); correct rough_position_m of the sensors or the ranges of poses'
        )
    # The triangle of the worst-off marker counts: every sensor is registered by its own.
    points = np.array(
        [[chain.positions(pose.solutions[0], m) for m in markers_T] for pose in plan.poses]
    )
    candidates = list(combinations(range(len(plan.poses)), 3))
    areas = [
        np.min(np.linalg.norm(np.cross(points[b] - points[a], points[c] - points[a]), axis=-1))
        for a, b, c in candidates
    ]
    best = candidates[int(np.argmax(areas))]
    rest = [i for i in range(len(plan.poses)) if i not in best]
    poses = tuple(plan.poses[i] for i in (*best, *rest))
    ordered = Plan(poses, plan.dropped, plan.dropped_solutions)
    return Tour(chain, {REGISTRATION: ordered}, in_order=True, one_solution=True)


def nearest_solution(
    solutions: FloatArray, q: FloatArray, tolerance_rad: float = 0.02
) -> int | None:
    """Return which solution (m, k) the arm stands at, rad; None if no joint-wise match is near.

    The tolerance is far above what an arm that arrived is off by, and far below what tells two
    solutions of a pose apart.
    """
    distance = np.max(np.abs(solutions - q), axis=1)
    nearest = int(np.argmin(distance))
    return nearest if distance[nearest] <= tolerance_rad else None
