# SPDX-License-Identifier: Apache-2.0
"""Pairs of bodies that must not touch: which pairs exist, their clearances and distances.

A pair is two bodies, or a body and the floor (its inner body is -1). The rules are in `collision`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.bodies import Body
from remaster_ros.kinematics.convex_distances import ConvexDistances
from remaster_ros.kinematics.line_of_sight import segment_distance
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.types import BoolArray, FloatArray, IntArray

SELF_COLLISION = 'self-collision'
FLOOR = 'hits the floor'
OBSTACLE = 'hits an obstacle'

RESERVE_M = 0.002
"""Clearance that a planner adds, m, so that an arm slightly off its path is still free."""

_SAMPLES = 300
_MOST = 0.95


@dataclass(frozen=True)
class Shortfall:
    """Pair of bodies that is nearer to each other than its clearance at a configuration."""

    index: int  # Of the configuration
    pair: int
    distance: float  # m, negative if the bodies overlap
    kept: float  # The clearance, m


@dataclass(frozen=True)
class Placed:
    """Poses of base and links, and ends of the bodies' capsules, at n configurations."""

    frames: FloatArray  # Of base and links, (n, k + 1, 4, 4)
    # Ends of the bodies' capsules in R, m, (n, B, 3)
    a: FloatArray
    b: FloatArray


class BodyPairs:
    """Pairs of bodies to check for collisions: arm, tool, markers, obstacles and floor.

    ``bodies``: all, by link; ``floor_z``: height of the floor in R, m; None for no floor;
    ``margin``: fixed part of the clearance, m; ``unknown_offset``: bound of a joint's unknown
    zero-offset, rad; of a prismatic joint `LEVER_M` times as much, in m.
    Attributes: ``inner, outer``: indices of the two bodies of each pair, (P,); inner is -1 for the
    floor; ``is_floor``: pairs with the floor, (P,); ``contact_only``: pairs without clearance,
    (P,); ``levers``: upper bounds on the motion of the outer body relative to the inner one per
    radian or metre of each joint, (P, k); ``most_kept``: largest clearance of each pair, m, (P,);
    ``left_out``: a line for each pair that is not checked, or for contact only.
    """

    def __init__(
        self,
        chain: SerialChain,
        bodies: Sequence[Body],
        floor_z: float | None,
        margin: float,
        unknown_offset: float,
    ) -> None:
        self.chain, self.bodies, self.floor_z = chain, tuple(bodies), floor_z
        self.margin = margin
        # rad, or m of a joint that slides, (k,)
        self._unknown = unknown_offset * chain.per_radian
        self.left_out: tuple[str, ...] = ()
        self._link = np.array([body.link for body in self.bodies], dtype=np.int64)
        ends = [body.capsule for body in self.bodies]
        self._a = np.array([a for a, _, _ in ends]).reshape(-1, 3)
        self._b = np.array([b for _, b, _ in ends]).reshape(-1, 3)
        self._radius = np.array([radius for _, _, radius in ends])
        self._convex = ConvexDistances([(body.shape, body.T_link_body) for body in self.bodies])
        self._reach = self._reaches()
        self._set_pairs(*self._possible_pairs())
        self._apply_rule()

    def _possible_pairs(self) -> tuple[IntArray, IntArray]:
        """Return body indices (inner, outer), (P,) each, of all pairs that a joint can move.

        Inner is nearer to the base, or -1 for the floor. Left out are two links of the arm next to
        each other, or with joints between them that all act along one line (`_on_one_line`).
        """
        inner, outer = [], []
        for j, second in enumerate(self.bodies):
            if second.link == 0:
                continue
            for i, first in enumerate(self.bodies[:j]):
                joints = range(first.link, second.link)
                adjacent = {first.role, second.role} == {'link'} and self._on_one_line(joints)
                if first.link < second.link and not adjacent:
                    inner.append(i)
                    outer.append(j)
            if self.floor_z is not None:
                inner.append(-1)
                outer.append(j)
        return np.array(inner, dtype=np.int64), np.array(outer, dtype=np.int64)

    def _on_one_line(self, joints: Sequence[int]) -> bool:
        """Whether the joints between two links all move along and about one common line.

        True for fewer than two joints; False for several of which none is prismatic.
        ``joints``: indices from 0.
        """
        if len(joints) < 2:
            return True
        if not any(self.chain.slides[joint] for joint in joints):
            return False
        frames = self.chain.frames(np.zeros(len(self.chain)))
        axes = self.chain.axes_in_base(frames)[joints]
        steps = np.diff(frames[joints, :3, 3], axis=0)
        off = np.cross(np.vstack((axes[1:], steps)), axes[0])
        return bool(np.max(np.linalg.norm(off, axis=1)) < 1e-9)

    def _set_pairs(
        self, inner: IntArray, outer: IntArray, contact_only: BoolArray | None = None
    ) -> None:
        """Set the attributes of the pairs (see the class): bodies, levers, largest clearances.

        ``inner, outer``: indices of the bodies of each pair, inner -1 for the floor, (P,);
        ``contact_only``: mask, (P,), None for no such pair.
        """
        self.inner, self.outer = inner, outer
        self.is_floor = inner < 0
        shapes = [body.shape for body in self.bodies]
        links = np.where(self.is_floor, 0, self._link[inner] if len(self._link) else 0)
        # A box that stands still is used itself: its capsule would be far larger.
        is_box = np.array([b.link == 0 and b.shape.kind == 'box' for b in self.bodies], dtype=bool)
        self._is_box = ~self.is_floor & is_box[inner]
        is_capsule = np.array([shape.is_its_capsule for shape in shapes], dtype=bool)
        self._is_exact = ~self.is_floor & is_capsule[inner] & is_capsule[outer]
        joints = np.arange(1, len(self.chain) + 1)
        between = joints > links[:, None]
        # A first joint with a vertical axis moves nothing up or down.
        upright = abs((self.chain.T_fixed[0][:3, :3] @ self.chain.axes[0])[2]) > 1 - 1e-12
        if upright and not self.chain.slides[0]:
            between[self.is_floor, 0] = False
        self._between = between & (joints <= self._link[outer][:, None])
        self.levers = np.where(self._between, self._reach[outer], 0.0)
        self.contact_only = (
            np.zeros(len(inner), dtype=bool) if contact_only is None else contact_only
        )
        self.most_kept = np.where(
            self.contact_only,
            0.0,
            self.margin + np.linalg.norm(self.levers * self._unknown, axis=1),
        )
        self._kinds = (
            np.flatnonzero(self.is_floor),
            np.flatnonzero(self._is_box),
            np.flatnonzero(~self.is_floor & ~self._is_box),
        )

    def _apply_rule(self) -> None:
        """Remove pairs that overlap by construction; check those always near for contact only.

        Over `_SAMPLES` random configurations: a pair is removed if it overlaps in 95 % of them
        (`_MOST`), and checked for contact only if it is nearer than its clearance plus
        `RESERVE_M` in 95 %; for a pair with floor or obstacle in all instead of 95 %. Each
        such pair gets a line in `left_out`.
        """
        low = np.where(np.isfinite(self.chain.lower), self.chain.lower, -np.pi)
        high = np.where(np.isfinite(self.chain.upper), self.chain.upper, np.pi)
        q = low + np.random.default_rng(0).random((_SAMPLES, len(self.chain))) * (high - low)
        touching, near_count = np.zeros(len(self.inner)), np.zeros(len(self.inner))
        # With the planner's reserve, so that it does not reject all configurations of such a pair.
        for short in self.examine(self.place(q), RESERVE_M)[0]:
            near_count[short.pair] += 1
            touching[short.pair] += short.distance < 0.0
        is_self = np.array(
            [self.category(pair) == SELF_COLLISION for pair in range(len(near_count))]
        )
        share = np.where(is_self, _MOST, 1.0) * _SAMPLES
        out, contact_only = touching >= share, near_count >= share
        for pair in np.flatnonzero(out | contact_only):
            inner, outer = self.names(int(pair))
            how = 'overlap by construction, not checked' if out[pair] else 'checked for contact'
            self.left_out += (f'{inner} and {outer}: {how}',)
        self._set_pairs(self.inner[~out], self.outer[~out], contact_only[~out])

    def category(self, pair: int) -> str:
        """Return the category of a collision of a pair: with itself, the floor or an obstacle.

        One of `SELF_COLLISION`, `FLOOR`, `OBSTACLE`; ``pair``: index of the pair, from 0.
        """
        if self.is_floor[pair]:
            return FLOOR
        inner = self.bodies[self.inner[pair]]
        return OBSTACLE if inner.role == 'obstacle' else SELF_COLLISION

    def names(self, pair: int) -> tuple[str, str]:
        """Return the names of the inner and the outer body of a pair, given by its index.

        The inner name is 'the floor' for a pair with the floor.
        """
        inner = 'the floor' if self.is_floor[pair] else self.bodies[self.inner[pair]].name
        return inner, self.bodies[self.outer[pair]].name

    def _reaches(self) -> FloatArray:
        """Upper bound on each body's motion per radian or metre of each joint, m, (B, k).

        For a revolute joint the distance from its axis over all configurations, for a prismatic 1.
        """
        chain = self.chain
        travel = np.where(chain.slides, np.maximum(np.abs(chain.lower), np.abs(chain.upper)), 0.0)
        reach = np.zeros((len(self.bodies), len(chain)))
        for b, body in enumerate(self.bodies):
            far = 0.0
            points = body.outline
            for joint in range(body.link - 1, -1, -1):
                # A body that another joint rotates keeps its distance to that joint's origin.
                axis = chain.axes[joint]
                across = np.linalg.norm(points - (points @ axis)[:, None] * axis, axis=1)
                reach[b, joint] = 1.0 if chain.slides[joint] else far + across.max()
                far += np.linalg.norm(points, axis=1).max() + travel[joint]
                points = chain.T_fixed[joint][None, :3, 3]
        return reach

    def place(self, q: FloatArray) -> Placed:
        """Return the poses of the bodies at configurations (n, k), rad or m, limits unchecked."""
        frames = np.empty((len(q), len(self.chain) + 1, 4, 4))
        frames[:, 0] = np.eye(4)
        frames[:, 1:] = self.chain.frames(q)
        links = frames[:, self._link]
        return Placed(frames, apply(links, self._a), apply(links, self._b))

    def lower_bounds(self, placed: Placed) -> FloatArray:
        """Return lower bounds on the distance of each pair, m, (n, P), by capsules around bodies.

        Negative if the capsules overlap; exact for spheres and capsules.
        """
        a, b, radius = placed.a, placed.b, self._radius
        bounds = np.empty((len(a), len(self.inner)))
        floor, boxes, capsules = self._kinds
        if len(floor):
            bodies = self.outer[floor]
            lowest = np.minimum(a[:, bodies, 2], b[:, bodies, 2]) - radius[bodies]
            bounds[:, floor] = lowest - (self.floor_z or 0.0)
        for i in np.unique(self.inner[boxes]):
            pairs = boxes[self.inner[boxes] == i]
            bodies = self.outer[pairs]
            T = inverse(self.bodies[i].T_link_body)
            ends = np.stack((apply(T, a[:, bodies]), apply(T, b[:, bodies])))
            half = self.bodies[i].shape.points.max(axis=0)
            gaps = np.maximum(ends.min(axis=0) - half, -half - ends.max(axis=0))
            bounds[:, pairs] = np.linalg.norm(np.maximum(gaps, 0.0), axis=-1) - radius[bodies]
        if len(capsules):
            i, j = self.inner[capsules], self.outer[capsules]
            distances = segment_distance(a[:, i], b[:, i], a[:, j], b[:, j])
            bounds[:, capsules] = distances - radius[i] - radius[j]
        return bounds

    def kept(self, placed: Placed, rows: IntArray, pairs: IntArray) -> FloatArray:
        """Return the clearance of each of c pairs at a configuration, m, (c,).

        It is margin + unknown_offset · √(Σ lever²) over the joints between the two bodies, at most
        `most_kept`. ``rows``, ``pairs``: indices of the configuration and of the pair, (c,) each.
        """
        frames = placed.frames[rows, 1:]
        axes = self.chain.axes_in_base(frames)
        bodies = self.outer[pairs]
        ends = np.stack((placed.a[rows, bodies], placed.b[rows, bodies]), axis=1)
        arms = np.cross(axes[:, None], ends[:, :, None] - frames[:, None, :, :3, 3])
        on_floor = self.is_floor[pairs]
        level = np.sqrt(np.maximum(0.0, 1.0 - axes[..., 2] ** 2))
        radius = self._radius[bodies][:, None]
        levers = np.where(
            on_floor[:, None],
            np.abs(arms[..., 2]).max(axis=1) + radius * level,
            np.linalg.norm(arms, axis=-1).max(axis=1) + radius,
        )
        sliding = np.where(on_floor[:, None], np.abs(axes[..., 2]), 1.0)
        levers = np.where(self.chain.slides, sliding, levers)
        levers = np.where(self._between[pairs], levers, 0.0)
        kept = self.margin + np.linalg.norm(levers * self._unknown, axis=1)
        # Limited to the bound: the capsule around a body is wider than the body.
        return np.minimum(kept, self.most_kept[pairs])

    def on_top(self, extra: float) -> FloatArray:
        """Return the addition to the clearance of each pair, m, (P,).

        ``extra``: the addition, m; 0 for pairs that are checked for contact only.
        """
        return np.where(self.contact_only, 0.0, extra)

    def measure(self, placed: Placed, row: int, pair: int) -> float:
        """Return the distance of two bodies at configuration `row`, m, negative if they overlap.

        ``row``, ``pair``: indices; not for a pair with the floor.
        """
        inner, outer = int(self.inner[pair]), int(self.outer[pair])
        frames = placed.frames[row]
        return self._convex.distance(
            inner, frames[self._link[inner]], outer, frames[self._link[outer]]
        )

    def measure_cheap(
        self, placed: Placed, rows: IntArray, pairs: IntArray, bounds: FloatArray
    ) -> BoolArray:
        """Write exact distances that need no call of coal into `bounds`; return their mask, (c,).

        ``rows``, ``pairs``: indices of the configuration and of the pair, (c,) each; ``bounds``:
        of `lower_bounds`, m, (n, P), changed in place. The mask is True for pairs with the floor,
        and for pairs of spheres and capsules, whose bounds are exact already.
        """
        on_floor = self.is_floor[pairs]
        for pair in np.unique(pairs[on_floor]):
            at = rows[pairs == pair]
            outer = int(self.outer[pair])
            shape = self.bodies[outer].shape
            T = placed.frames[at, self._link[outer]] @ self.bodies[outer].T_link_body
            lowest = np.min(T[:, 2, :3] @ shape.points.T, axis=1) + T[:, 2, 3]
            lowest = lowest - shape.ball - shape.disc * np.hypot(T[:, 2, 0], T[:, 2, 1])
            bounds[at, pair] = lowest - (self.floor_z or 0.0)
        return on_floor | self._is_exact[pairs]

    def candidates(
        self, placed: Placed, bounds: FloatArray, is_open: BoolArray | None, extra: float
    ) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
        """Return possible violations: configuration, pair, clearance, whether certain, (c,) each.

        Configurations and pairs are indices. A violation is certain if the distance is exact
        without coal (`measure_cheap`; such distances are written into `bounds`); the others
        are nearer than the clearance by their lower bound only. ``bounds``: of `lower_bounds`,
        (n, P); ``is_open``: mask of the pairs to consider, (n, P), None for all; ``extra``:
        added to the clearance, m.
        """
        on_top = self.on_top(extra)
        may = bounds < self.most_kept + on_top
        rows, pairs = np.nonzero(may if is_open is None else may & is_open)
        if not len(rows):
            return rows, pairs, np.empty(0), np.empty(0, dtype=bool)
        kept = self.kept(placed, rows, pairs) + on_top[pairs]
        is_short = bounds[rows, pairs] < kept
        rows, pairs, kept = rows[is_short], pairs[is_short], kept[is_short]
        decided = self.measure_cheap(placed, rows, pairs, bounds)
        is_short = bounds[rows, pairs] < kept
        return rows[is_short], pairs[is_short], kept[is_short], decided[is_short]

    def examine(
        self, placed: Placed, extra: float, *, first: bool = False, one: bool = False
    ) -> tuple[list[Shortfall], FloatArray]:
        """Return the pairs nearer than their clearance, and a distance of each pair, m, (n, P).

        The distances are exact for the returned pairs, else exact or lower bounds. ``placed``: the
        bodies at n configurations; ``extra``: added to the clearance, m; ``first``: return at most
        one pair of each configuration, not always the worst; ``one``: return at most one in all.
        """
        bounds = self.lower_bounds(placed)
        rows, pairs, kept, decided = self.candidates(placed, bounds, None, extra)
        found: list[Shortfall] = []
        done: set[int] = set()
        # Certain violations first, then likely ones: the others cost more.
        for n in np.lexsort((bounds[rows, pairs] - kept, self.is_floor[pairs], ~decided)):
            row, pair = int(rows[n]), int(pairs[n])
            if first and row in done:
                continue
            if not decided[n]:
                bounds[row, pair] = self.measure(placed, row, pair)
            if bounds[row, pair] < kept[n]:
                found.append(Shortfall(row, pair, float(bounds[row, pair]), float(kept[n])))
                done.add(row)
                if one:
                    break
        return found, bounds
