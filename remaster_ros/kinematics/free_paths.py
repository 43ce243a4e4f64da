# SPDX-License-Identifier: Apache-2.0
"""Collision-free paths between configurations: straight if that is free, else around obstacles.

Paths are polylines of configurations, straight in joint space from each to the next. Effort is
bounded by a number of checked segments, and the same Generator gives the same path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.types import FloatArray

MOST_CHECKS = 400
"""Most segments checked for one path."""
REACH_RAD = 0.6
"""Step of a growing tree: largest joint motion, rad (in m of `SerialChain.per_radian`)."""
_SHORTCUTS = 10
_POINT_COST = 0.2  # Effort of checking one configuration, in segments

WAY_OUT_STEP_M = 0.004
"""Largest motion of a point of the arm in a step of an escape path."""
WAY_OUT_STEPS = 120
"""Most steps of an escape path: half a metre. An arm deeper in a body is freed by hand."""


def free_path(
    model: CollisionModel,
    start: ArrayLike,
    end: ArrayLike,
    rng: np.random.Generator,
    hints: Sequence[FloatArray] = (),
    most_checks: int = MOST_CHECKS,
) -> FloatArray | None:
    """Return a collision-free path between two configurations, rad, (n, k), ends included.

    n is 2 if the straight path is free. None if an end is not free or no path was found.

    Parameters
    ----------
    model
        The arm and everything it can hit.
    start, end
        rad, (k,).
    rng
        Source of randomness.
    hints
        Configurations that may be useful waypoints, rad, (k,) each.
    most_checks
        Largest number of checked segments.
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    search = _Search(model, start, end, most_checks)
    if search.is_blocked:
        return None
    if search.is_free(start, end):
        return np.array([start, end])
    for between in _intermediates(model, start, end, hints):
        way = [start, *between, end]
        if search.is_out_of_effort:
            return None
        if all(search.is_free(a, b) for a, b in pairwise(way)):
            return search.shortened(way, rng)
    grown = search.connect(rng)
    return None if grown is None else search.shortened(grown, rng)


def is_straight_free(model: CollisionModel, start: FloatArray, end: FloatArray) -> bool:
    """Whether a straight path in joint space is free of collisions and within the joint limits.

    The planner's reserve (`RESERVE_M`) is added to the clearance if the start is free with it.
    ``start, end``: rad or m, (k,).
    """
    extra = RESERVE_M if model.free_mask(start[None], RESERVE_M)[0] else 0.0
    return not model.path_trouble(np.array([start, end]), extra)


def _intermediates(
    model: CollisionModel, start: FloatArray, end: FloatArray, hints: Sequence[FloatArray]
) -> Iterator[list[FloatArray]]:
    """Yield lists of one or two waypoints to try between start and end, the likeliest first.

    Each of the `hints` alone; start and end, each moved by 0.35, 0.7 and 1 of the way to zero
    (clipped to the limits) in all joints but the first; then the two corners of the path on which
    the other joints move before the first, or after it.
    """
    for hint in hints:
        yield [np.asarray(hint, dtype=float)]
    chain = model.chain
    middle = np.clip(np.zeros(len(chain)), chain.lower, chain.upper)
    # The first joint turns the arm about its base; the others fold and lift it.
    for share in (0.35, 0.7, 1.0):
        lifted_start, lifted_end = (q + share * (middle - q) for q in (start, end))
        lifted_start[0], lifted_end[0] = start[0], end[0]
        yield [lifted_start, lifted_end]
    for first in (start, end):
        # First the posture, then the rotation of the base; or the base first.
        between = np.array(end if first is start else start)
        between[0] = first[0]
        yield [between]


class _Node(NamedTuple):
    """Configuration in a search tree, and the node from which it was reached (None: the root)."""

    q: FloatArray  # rad, (k,)
    parent: _Node | None

    def branch(self) -> list[FloatArray]:
        """Return the configurations from this node back to the root."""
        branch = [self.q]
        node = self.parent
        while node is not None:
            branch.append(node.q)
            node = node.parent
        return branch


class _Search:
    """RRT-connect search: grows two trees towards each other, up to a number of segments."""

    def __init__(
        self, model: CollisionModel, start: FloatArray, end: FloatArray, most: int
    ) -> None:
        self._model, self._start, self._end = model, start, end
        self._effort = float(most)
        # An arm nearer to a body than a planner would place it may still leave.
        ends = np.array([start, end])
        self._extra = RESERVE_M
        self.is_blocked = False
        if not np.all(model.free_mask(ends, RESERVE_M)):
            self._extra = 0.0
            self.is_blocked = not np.all(model.free_mask(ends))

    @property
    def is_out_of_effort(self) -> bool:
        """Whether the number of checked segments is used up."""
        return self._effort <= 0

    def is_free(self, a: FloatArray, b: FloatArray) -> bool:
        """Whether a straight path is free and within the limits; counts as one segment.

        ``a``, ``b``: its ends, rad or m, (k,).
        """
        self._effort -= 1
        return not self._model.path_trouble(np.array([a, b]), self._extra)

    def connect(self, rng: np.random.Generator) -> list[FloatArray] | None:
        """Return a path found by growing trees from both ends; None if the effort is used up.

        From start to end, both included; not shortened.
        """
        chain = self._model.chain
        low = np.maximum(chain.lower, np.minimum(self._start, self._end) - np.pi)
        high = np.minimum(chain.upper, np.maximum(self._start, self._end) + np.pi)
        trees = [_Node(self._start, None)], [_Node(self._end, None)]
        side = 0
        while not self.is_out_of_effort:
            # Half of the draws lie near the straight path, where detours often are.
            draw = low + rng.random(len(chain)) * (high - low)
            if rng.random() < 0.5:
                along = self._start + rng.random() * (self._end - self._start)
                deviation = rng.normal(0.0, 0.6, len(chain)) * chain.per_radian
                draw = np.clip(along + deviation, low, high)
            if not self._model.free_mask(draw[None], self._extra)[0]:
                self._effort -= _POINT_COST
                continue
            new = self._extend(trees[side], draw)
            met = None if new is None else self._reach(trees[1 - side], new.q)
            if new is not None and met is not None:
                way = [*new.branch()[::-1], *met.branch()[1:]]
                return way if side == 0 else way[::-1]
            side = 1 - side
        return None

    def _extend(self, tree: list[_Node], goal: FloatArray) -> _Node | None:
        """Grow a tree one step towards a configuration; return the new node, None if blocked.

        From its nearest node, by `REACH_RAD` at most, or to the configuration itself. The new
        node is added to ``tree``; distance is the largest difference of a joint.
        """
        ways = np.abs(np.array([node.q for node in tree]) - goal)
        distances = np.max(ways / self._model.chain.per_radian, axis=1)
        nearest = tree[int(np.argmin(distances))]
        share = min(1.0, REACH_RAD / max(float(np.min(distances)), 1e-9))
        new = _Node(nearest.q + share * (goal - nearest.q), nearest)
        if not self.is_free(nearest.q, new.q):
            return None
        tree.append(new)
        return new

    def _reach(self, tree: list[_Node], goal: FloatArray) -> _Node | None:
        """Grow a tree until it reaches a configuration; return the node there.

        None if an obstacle blocks it, or the effort is used up. New nodes are added to ``tree``;
        ``goal``: rad or m, (k,).
        """
        while not self.is_out_of_effort:
            new = self._extend(tree, goal)
            if new is None or np.max(np.abs(new.q - goal)) < 1e-12:
                return new
        return None

    def shortened(self, way: list[FloatArray], rng: np.random.Generator) -> FloatArray:
        """Return a free path with corners cut where that is free, (n, k), with the same ends.

        ``way``: a free path, configurations (k,); at most `_SHORTCUTS` rounds, drawn by ``rng``.
        """
        path = [np.asarray(q) for q in way]
        self._effort = max(self._effort, 2 * _SHORTCUTS)
        for _ in range(_SHORTCUTS):
            i = 0
            while i + 2 < len(path):
                if self.is_free(path[i], path[i + 2]):
                    del path[i + 1]
                else:
                    i += 1
            if len(path) < 3:
                break
            # Between any two points of the path, not only between corners.
            a, b = np.sort(rng.uniform(0, len(path) - 1, 2))
            i, j = int(a), int(b)
            if i == j:
                continue
            first = path[i] + (a - i) * (path[i + 1] - path[i])
            second = path[j] + (b - j) * (path[min(j + 1, len(path) - 1)] - path[j])
            if self.is_free(first, second):
                path[i + 1 : j + 1] = [first, second]
        return np.array(path)


def way_out(
    model: CollisionModel, start: ArrayLike, rng: np.random.Generator
) -> FloatArray | None:
    """Return a short escape path to a free configuration, rad, (n, k), start included.

    For an arm within a clearance or in contact. In each step the violated distances grow (one may
    shrink by the tolerance of `CollisionModel.escape_trouble`), and all other pairs keep their
    clearance. n is 1 if the start is free. None if no path was found.

    ``model``: the arm and everything it can hit; ``start``: rad, (k,); ``rng``: for directions.
    """
    q = np.asarray(start, dtype=float)
    chain = model.chain
    if not np.all(np.isfinite(q)):
        return None
    way = [q]
    directions = np.concatenate((np.eye(len(chain)), -np.eye(len(chain))))
    heading = np.zeros(len(chain))
    for _ in range(WAY_OUT_STEPS):
        short = model.shortfalls(q[None])
        if not short:
            path = _fewest_lines(model, np.array(way))
            return path if not model.escape_trouble(path) else None
        pairs = np.array([each.pair for each in short])
        distances = np.array([each.distance for each in short])
        kept = np.array([each.kept for each in short])
        drawn = rng.standard_normal((12, len(chain)))
        tries = np.concatenate((heading[None], directions, drawn))
        # The sum of the directions in which each single joint increases the distances.
        single = model.pair_distances(q + 1e-3 * np.eye(len(chain)), pairs) - distances
        tries = np.concatenate((tries, (single / (kept - distances + 1e-3)).sum(axis=1)[None]))
        lengths = np.array([model.travel(np.zeros(len(chain)), d) for d in tries])
        tries = tries[lengths > 1e-9] / lengths[lengths > 1e-9, None]
        steps = np.clip(q + WAY_OUT_STEP_M * tries, chain.lower, chain.upper)
        # A joint outside its limits may stay there, or come back.
        steps = np.where((q < chain.lower) | (q > chain.upper), q + WAY_OUT_STEP_M * tries, steps)
        after = model.pair_distances(steps, pairs)
        worst = np.min(np.minimum(after - distances, kept - distances), axis=1)
        gain = np.sum(np.minimum(after, kept) - np.minimum(distances, kept), axis=1)
        for best in np.argsort(-gain):
            if gain[best] <= 1e-7:
                return None
            if worst[best] < -1e-6:
                continue
            if not model.escape_trouble(np.array([q, steps[best]]), ends_free=False):
                break
        else:
            return None
        heading = steps[best] - q
        q = steps[best]
        way.append(q)
    return None


def _fewest_lines(model: CollisionModel, way: FloatArray) -> FloatArray:
    """Return an escape path (m, k) through some of the waypoints of a given one, ``way``, (n, k).

    As few as a greedy search finds: both ends are kept, and each straight line between
    waypoints is an escape again. The arm comes to rest at each waypoint.
    """
    kept, corner, last = [way[0]], 0, len(way) - 1
    while corner < last:
        next_corner = last
        while next_corner > corner + 1 and model.escape_trouble(
            way[[corner, next_corner]], ends_free=next_corner == last
        ):
            next_corner = corner + (next_corner - corner) // 2
        kept.append(way[next_corner])
        corner = next_corner
    return np.array(kept)
