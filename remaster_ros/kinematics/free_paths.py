# SPDX-License-Identifier: Apache-2.0
"""Free paths between configurations: straight where that is free, else around what is in the way.

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
"""Segments checked for one path at most."""
REACH_RAD = 0.6
"""How far a tree grows at a time, in its largest joint angle (`SerialChain.per_radian`)."""
_SHORTCUTS = 10
_POINT_COST = 0.2  # of looking at one configuration, in segments

WAY_OUT_STEP_M = 0.004
"""No point of the arm moves more in a step of a way out."""
WAY_OUT_STEPS = 120
"""Steps of a way out at most: half a metre. An arm that is deeper inside is freed by hand."""


def free_path(
    model: CollisionModel,
    start: ArrayLike,
    end: ArrayLike,
    rng: np.random.Generator,
    hints: Sequence[FloatArray] = (),
    most_checks: int = MOST_CHECKS,
) -> FloatArray | None:
    """Return a free way between two configurations.

    Parameters
    ----------
    model
        The arm and all it can hit.
    start, end
        rad, (k,).
    rng
        Source of randomness.
    hints
        Configurations that may be worth going through, rad, (k,) each.
    most_checks
        Segments that are checked at most.

    Returns
    -------
    ndarray or None
        rad, (n, k), start and end included; n is 2 where the straight way is free. None where an
        end is not free or no way was found.
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
    """Whether the straight way is free, with the reserve where the start has it too."""
    extra = RESERVE_M if model.free_mask(start[None], RESERVE_M)[0] else 0.0
    return not model.path_trouble(np.array([start, end]), extra)


def _intermediates(
    model: CollisionModel, start: FloatArray, end: FloatArray, hints: Sequence[FloatArray]
) -> Iterator[list[FloatArray]]:
    """Yield what may lie between, the likeliest first."""
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
        # One arm's posture first, the turn of the base after it, or the other way round.
        between = np.array(end if first is start else start)
        between[0] = first[0]
        yield [between]


class _Node(NamedTuple):
    """A configuration of a tree, rad, (k,), and the node that it was reached from."""

    q: FloatArray
    parent: _Node | None

    def branch(self) -> list[FloatArray]:
        """Return the configurations from this one back to the root."""
        branch = [self.q]
        node = self.parent
        while node is not None:
            branch.append(node.q)
            node = node.parent
        return branch


class _Search:
    """Counts the effort, and grows two trees towards each other (RRT-connect)."""

    def __init__(
        self, model: CollisionModel, start: FloatArray, end: FloatArray, most: int
    ) -> None:
        self._model, self._start, self._end = model, start, end
        self._left = float(most)
        # An arm that stands a little nearer than a planner would put it may still leave.
        ends = np.array([start, end])
        self._extra = RESERVE_M
        self.is_blocked = False
        if not np.all(model.free_mask(ends, RESERVE_M)):
            self._extra = 0.0
            self.is_blocked = not np.all(model.free_mask(ends))

    @property
    def is_out_of_effort(self) -> bool:
        return self._left <= 0

    def is_free(self, a: FloatArray, b: FloatArray) -> bool:
        self._left -= 1
        return not self._model.path_trouble(np.array([a, b]), self._extra)

    def connect(self, rng: np.random.Generator) -> list[FloatArray] | None:
        """Return a way found by growing trees from both ends; None where effort runs out."""
        chain = self._model.chain
        low = np.maximum(chain.lower, np.minimum(self._start, self._end) - np.pi)
        high = np.minimum(chain.upper, np.maximum(self._start, self._end) + np.pi)
        trees = [_Node(self._start, None)], [_Node(self._end, None)]
        side = 0
        while not self.is_out_of_effort:
            # Half of the draws lie about the straight way, where the way around often is.
            draw = low + rng.random(len(chain)) * (high - low)
            if rng.random() < 0.5:
                along = self._start + rng.random() * (self._end - self._start)
                beside = rng.normal(0.0, 0.6, len(chain)) * chain.per_radian
                draw = np.clip(along + beside, low, high)
            if not self._model.free_mask(draw[None], self._extra)[0]:
                self._left -= _POINT_COST
                continue
            new = self._extend(trees[side], draw)
            met = None if new is None else self._reach(trees[1 - side], new.q)
            if new is not None and met is not None:
                way = [*new.branch()[::-1], *met.branch()[1:]]
                return way if side == 0 else way[::-1]
            side = 1 - side
        return None

    def _extend(self, tree: list[_Node], goal: FloatArray) -> _Node | None:
        """Grow a tree one step towards a configuration; return the new node."""
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
        """Grow a tree until it is at a configuration; None where something is in the way."""
        while not self.is_out_of_effort:
            new = self._extend(tree, goal)
            if new is None or np.max(np.abs(new.q - goal)) < 1e-12:
                return new
        return None

    def shortened(self, way: list[FloatArray], rng: np.random.Generator) -> FloatArray:
        """Cut corners of a free way where the shorter way is free."""
        path = [np.asarray(q) for q in way]
        self._left = max(self._left, 2 * _SHORTCUTS)
        for _ in range(_SHORTCUTS):
            i = 0
            while i + 2 < len(path):
                if self.is_free(path[i], path[i + 2]):
                    del path[i + 1]
                else:
                    i += 1
            if len(path) < 3:
                break
            # Between any two points of the way, not between its corners alone.
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
    """Return a short way to a free configuration for an arm within a margin or in contact.

    In each step the distances that are too small grow (by the tolerance of
    `CollisionModel.escape_trouble` at most may one shrink), and nothing else comes nearer than
    is kept.

    Parameters
    ----------
    model
        The arm and all it can hit.
    start
        rad, (k,).
    rng
        Source of randomness.

    Returns
    -------
    ndarray or None
        rad, (n, k), start included; n is 1 where the start is free. None where no way was found.
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
        before = np.array([each.distance for each in short])
        kept = np.array([each.kept for each in short])
        drawn = rng.standard_normal((12, len(chain)))
        tries = np.concatenate((heading[None], directions, drawn))
        # The direction in which each joint alone helps, all together.
        single = model.pair_distances(q + 1e-3 * np.eye(len(chain)), pairs) - before
        tries = np.concatenate((tries, (single / (kept - before + 1e-3)).sum(axis=1)[None]))
        lengths = np.array([model.travel(np.zeros(len(chain)), d) for d in tries])
        tries = tries[lengths > 1e-9] / lengths[lengths > 1e-9, None]
        steps = np.clip(q + WAY_OUT_STEP_M * tries, chain.lower, chain.upper)
        # A joint that stands outside its limits may stay there, and may come back.
        steps = np.where((q < chain.lower) | (q > chain.upper), q + WAY_OUT_STEP_M * tries, steps)
        after = model.pair_distances(steps, pairs)
        worst = np.min(np.minimum(after - before, kept - before), axis=1)
        gain = np.sum(np.minimum(after, kept) - np.minimum(before, kept), axis=1)
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
    """Leave out points of a way out, (n, k): the arm comes to rest at each that is kept."""
    kept, here, last = [way[0]], 0, len(way) - 1
    while here < last:
        there = last
        while there > here + 1 and model.escape_trouble(
            way[[here, there]], ends_free=there == last
        ):
            there = here + (there - here) // 2
        kept.append(way[there])
        here = there
    return np.array(kept)
