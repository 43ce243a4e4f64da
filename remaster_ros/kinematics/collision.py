# SPDX-License-Identifier: Apache-2.0
"""Collision checks, with clearance, of configurations and of straight paths in joint space.

The arm is a set of convex `bodies`; so are the obstacles, and the floor is a plane. Bounding
capsules, all at once in NumPy, exclude most pairs; the distances of the others are computed by
coal (distances between convex shapes; negative if they overlap).

Clearance covers unknown zero-offsets. Each joint's zero-offset is unknown by ``unknown_offset``
(1 degree unless stated), independently of the others: two bodies may be nearer to each other than
in the model by unknown_offset · √(Σ lever²), summed over the joints between the two. A lever is
the largest distance of the outer body from the joint's axis at that configuration; for the floor
only its horizontal part counts, and a vertical axis has none. A prismatic joint has the lever
0.25 m (`serial_chain.LEVER_M`). A fixed margin is added:

    clearance = margin + unknown_offset · √(Σ lever²)

The margin includes half a step of a swept path: a path is checked so finely that no body moves by
more than 10 mm relative to another between two checks, so that the distance is nowhere less than
at the checks minus 5 mm.

By this rule some pairs are not checked: bodies of one link; links next to each other, which their
joint separates, or several that move along and about one line, as a SCARA's do (tools and markers
are checked against the link before theirs); two bodies of the arm whose models overlap in 95 % of
sampled configurations; and a body that overlaps an obstacle or the floor in all of them. Pairs
that are nearer than the clearance in 95 % of the configurations (all of them for obstacles and
floor), but do not overlap, are checked for contact only. `left_out` names all these pairs. The
base itself touches the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from math import ceil, degrees, radians

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError
from remaster_ros.kinematics.bodies import Body, capsule, enclosing_points
from remaster_ros.kinematics.body_pairs import OBSTACLE, BodyPairs, Shortfall
from remaster_ros.kinematics.line_of_sight import LinkCapsules
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import BoolArray, FloatArray, IntArray

STEP_M = 0.01
"""Largest motion of two bodies relative to each other between two checks of a path, m."""
HALF_STEP_M = STEP_M / 2
ESCAPE_STEP_M = 0.002
"""Largest such motion on an escape path, m."""
ESCAPE_TOLERANCE_M = 1e-4
"""Largest decrease of a violated distance between two checks of an escape path, m."""

_STRIDE = 8
_LIMIT_TOLERANCE = 1e-6  # rad or m


def arm_bodies(chain: SerialChain, given: Sequence[Body], link_radius: float) -> list[Body]:
    """Return the given bodies, with a capsule along each link that has no body.

    A capsule goes from the link's joint to the next one, or to the tip. The guide of a prismatic
    joint is added as well: of a first joint a rail along its whole travel, if the base has no
    body; of a later joint a rod that moves with its link, as long as its travel, if the link has
    no body.

    ``given``: known bodies of the arm, its tool and markers, of which only those with the role
    'link' count as a link's body; ``link_radius``: of the capsules, m.
    """
    covered = {body.link for body in given if body.role == 'link'}
    bodies = list(given)
    for link in range(len(chain) + 1):
        if link not in covered:
            name = 'the base' if link == 0 else f'the link of {chain.joint_names[link - 1]}'
            end = chain.T_fixed[link][:3, 3]
            bodies.append(Body(name, link, capsule(np.zeros(3), end, link_radius)))
    for joint in np.flatnonzero(chain.slides):
        carrier, axis = (0 if joint == 0 else int(joint) + 1), chain.axes[joint]
        if carrier in covered:
            continue
        if joint == 0:
            name, T = 'the rail', chain.T_fixed[0]
            ends = apply(T, np.outer((chain.lower[0], chain.upper[0]), axis))
        else:
            name = f'the rod of {chain.joint_names[joint]}'
            ends = -np.outer((chain.lower[joint], chain.upper[joint]), axis)
        bodies.append(Body(name, carrier, capsule(ends[0], ends[1], link_radius)))
    return bodies


class CollisionModel:
    """Collision checks, with clearance, of an arm with tool, markers, obstacles and floor.

    Parameters
    ----------
    chain
        The arm.
    bodies
        All bodies; see `arm_bodies`. Bodies on link 0 stand still.
    floor_z
        Height of the floor in R, m; None for no floor.
    margin
        Fixed part of the clearance, m; at least half a step of a swept path, 5 mm.
    unknown_offset
        Bound of a joint's unknown zero-offset, rad; see the module for prismatic joints.
    link_radius
        Radius of the capsules that stand for the links in the line of sight, m.

    Attributes
    ----------
    chain
        The arm.
    bodies
        All bodies, by link.
    left_out
        A line for each pair that is not checked, or for contact only.
    """

    def __init__(
        self,
        chain: SerialChain,
        bodies: Sequence[Body],
        *,
        floor_z: float | None = 0.0,
        margin: float = 0.008,
        unknown_offset: float = radians(1.0),
        link_radius: float = 0.075,
    ) -> None:
        if not HALF_STEP_M <= margin < np.inf:
            raise InputError(
                f'collision: the clearance is {margin} m; at least {HALF_STEP_M} m are needed, '
                'half a step of a swept path'
            )
        if not 0.0 <= unknown_offset < np.pi / 4:
            raise InputError(
                f'collision: the unknown offset is {degrees(unknown_offset):g} deg; it must be '
                'from 0 to 45 deg'
            )
        outside = [body.name for body in bodies if not 0 <= body.link <= len(chain)]
        if outside:
            raise InputError(f'collision: {outside[0]} is fastened to no link of the arm')
        self.chain, self.floor_z = chain, floor_z
        self.margin, self.unknown_offset = margin, unknown_offset
        self._sight = LinkCapsules(chain, link_radius)
        self.bodies = tuple(sorted(bodies, key=lambda body: body.link))
        self._pairs = BodyPairs(chain, self.bodies, floor_z, margin, unknown_offset)
        self.left_out = self._pairs.left_out

    def trouble(self, q: ArrayLike, extra: float = 0.0) -> str:
        """Return the worst violation of the clearance at q (k,) as text; '' if it is free.

        q: rad or m; joint limits are not checked. ``extra``: added to the clearance, m.
        """
        found = self.shortfalls(np.asarray(q, dtype=float)[None], extra)
        if not found:
            return ''
        return self.describe(min(found, key=lambda short: short.distance - short.kept))

    def path_trouble(self, waypoints: ArrayLike, extra: float = 0.0) -> str:
        """Obstruction of a path, as text; '' if it is free and within the joint limits.

        ``waypoints``: configurations, straight in joint space between each two, rad, (n, k),
        n >= 1; ``extra``: added to the clearance, m.

        Raises ValueError for waypoints of another shape.
        """
        q = np.asarray(waypoints, dtype=float)
        if q.ndim != 2 or q.shape[1] != len(self.chain) or not len(q):
            raise ValueError(f'a path of shape {q.shape}; it must be (n, {len(self.chain)})')
        if not np.all(np.isfinite(q)):
            return 'a joint angle of the path is not finite'
        limits = self._limit_trouble(q)
        if limits:
            return limits
        if len(q) == 1:
            return self.trouble(q[0], extra)
        for start, end in pairwise(q):
            found = self._sweep(start, end, extra)
            if found is not None:
                return f'on the way, {self.describe(found)}'
        return ''

    def escape_trouble(self, waypoints: ArrayLike, *, ends_free: bool = True) -> str:
        """Return why a path is no escape from a violated clearance, as text; '' if it is one.

        Pairs whose clearance is violated at the start never come nearer on the way (by more than
        0.1 mm between two checks), all others keep their clearance, the end is free (if
        `ends_free`), and no joint goes beyond its limits, or further beyond than at the start.
        ``waypoints``: rad or m, (n, k), n >= 1.
        """
        q = np.asarray(waypoints, dtype=float)
        if not np.all(np.isfinite(q)):
            return 'a joint angle of the path is not finite'
        outside = np.maximum(self.chain.lower - q, q - self.chain.upper)
        excess = outside - np.maximum(outside[0], 0.0)
        if np.max(excess) > _LIMIT_TOLERANCE:
            return self._limit_trouble(q)
        parts = [q[:1]]
        for a, b in pairwise(q):
            steps = max(1, ceil(self.travel(a, b) / ESCAPE_STEP_M))
            parts.append(a + np.arange(1, steps + 1)[:, None] / steps * (b - a))
        q = np.concatenate(parts)
        found = self.shortfalls(q)
        at = [{short.pair: short for short in found if short.index == i} for i in range(len(q))]
        at_start = at[0]
        for i, now in enumerate(at):
            for pair, short in now.items():
                if pair not in at_start:
                    return f'on the way out, {self.describe(short)}'
                previous = at[i - 1].get(pair) if i else short
                if previous is None or short.distance < previous.distance - ESCAPE_TOLERANCE_M:
                    return f'on the way out it comes nearer: {self.describe(short)}'
        if ends_free and at[-1]:
            return f'at the end of the way out, {self.describe(next(iter(at[-1].values())))}'
        return ''

    def travel(self, start: FloatArray, end: FloatArray) -> float:
        """Upper bound on the relative motion of any pair of bodies between configurations, m.

        ``start``, ``end``: rad or m, (k,). 0 without pairs.
        """
        return float((self._pairs.levers @ np.abs(end - start)).max(initial=0.0))

    def pair_distances(self, q: FloatArray, pairs: IntArray) -> FloatArray:
        """Return the distances of pairs (p,), by index, at configurations (n, k), m, (n, p).

        Negative if the bodies overlap.
        """
        placed = self._pairs.place(q)
        bounds = self._pairs.lower_bounds(placed)
        for column in pairs:
            rows = np.arange(len(q))
            decided = self._pairs.measure_cheap(placed, rows, np.full(len(q), column), bounds)
            for row in rows[~decided]:
                bounds[row, column] = self._pairs.measure(placed, int(row), int(column))
        return bounds[:, pairs]

    def reasons(
        self, q: ArrayLike, extra: float = 0.0
    ) -> np.ndarray[tuple[int], np.dtype[np.str_]]:
        """Return a category of collision for each configuration (m, k), '' if it is free, (m,).

        The categories are those of `body_pairs`, of any violated pair; joint limits are not
        checked. ``extra``: added to the clearance, m.
        """
        q = np.asarray(q, dtype=float).reshape(-1, len(self.chain))
        reasons = np.full(len(q), '', dtype=f'U{len(OBSTACLE)}')
        for short in self.shortfalls(q, extra, first=True):
            reasons[short.index] = self._pairs.category(short.pair)
        return reasons

    def free_mask(self, q: ArrayLike, extra: float = 0.0) -> BoolArray:
        """Whether each configuration (m, k), rad or m, is free, (m,); see `reasons`.

        ``extra``: added to the clearance, m. Joint limits are not checked.
        """
        return self.reasons(q, extra) == ''

    def hides(self, q: ArrayLike, marker_T: ArrayLike, sensor_R: ArrayLike) -> BoolArray:
        """Return whether a link of the arm hides a marker from a sensor, (...).

        ``q``: joint angles, rad, (..., k); ``marker_T``: marker in the tool frame, m, (3,);
        ``sensor_R``: the sensor's origin in R, m, (3,).
        """
        return self._sight.hides(q, marker_T, sensor_R)

    @cached_property
    def extent_points(self) -> tuple[FloatArray, ...]:
        """Points that enclose all bodies of each link, in its frame, m, k arrays (n_i, 3).

        Their hull contains the link, for the last joint also tool and markers: when the link
        moves, one of these points is the fastest of it.
        """
        extents = []
        for link in range(1, len(self.chain) + 1):
            outlines = [body.outline for body in self.bodies if body.link == link]
            extents.append(enclosing_points(np.concatenate(outlines or [np.zeros((1, 3))])))
        return tuple(extents)

    def shortfalls(
        self, q: FloatArray, extra: float = 0.0, *, first: bool = False
    ) -> list[Shortfall]:
        """Return the pairs that violate their clearance at configurations (n, k).

        With `first`, one pair of each configuration at most; ``extra``: added to the clearance, m.
        """
        return self._pairs.examine(self._pairs.place(q), extra, first=first)[0]

    def describe(self, short: Shortfall) -> str:
        """Return a shortfall as text: bodies, distance or depth, and clearance, in mm."""
        inner, outer = self._pairs.names(short.pair)
        kept = f'{1e3 * short.kept:.0f} mm is kept'
        if short.distance < 0.0:
            return f'{outer} reaches {-1e3 * short.distance:.0f} mm into {inner}, {kept}'
        return f'{outer} {1e3 * short.distance:.0f} mm from {inner}, {kept}'

    def _limit_trouble(self, q: FloatArray) -> str:
        """Return as text the joint furthest outside its limits over waypoints (n, k), and where.

        '' if none is outside by more than `_LIMIT_TOLERANCE`.
        """
        chain = self.chain
        over = np.maximum(chain.lower - q, q - chain.upper)
        if np.max(over) <= _LIMIT_TOLERANCE:
            return ''
        row, number = np.unravel_index(int(np.argmax(over)), over.shape)
        joint = int(number)
        at, low, high = (
            chain.shown_offset(joint, value)
            for value in (q[row, joint], chain.lower[joint], chain.upper[joint])
        )
        return f'{chain.joint_names[joint]} at {at}, its limits are {low.split()[0]} to {high}'

    def _sweep(self, start: FloatArray, end: FloatArray, extra: float) -> Shortfall | None:
        """Return a pair nearer than its clearance on a straight path; None if there is none.

        Checked in steps in which no body moves by more than `STEP_M` relative to another.
        ``start``, ``end``: rad or m, (k,), both checked as well; ``extra``: added to the
        clearance, m. The pair is any, not the first on the path; its `index` has no meaning.
        """
        travel = self._pairs.levers @ np.abs(end - start)
        steps = max(1, ceil(float(travel.max(initial=0.0)) / STEP_M))
        grid = np.unique(np.append(np.arange(0, steps, _STRIDE), steps))
        share = np.arange(steps + 1) / steps
        q = start + share[:, None] * (end - start)
        # Most paths that are not free collide at one of these.
        found, _ = self._pairs.examine(
            self._pairs.place(q[[steps // 2, steps // 4, -1]]), extra, one=True
        )
        if found:
            return found[0]
        found, distances = self._pairs.examine(self._pairs.place(q[grid]), extra, one=True)
        if found:
            return found[0]
        # If the ends of an interval do not exclude a pair, every step of the interval is checked.
        least = distances[:-1] + distances[1:] - np.diff(grid)[:, None] / steps * travel
        is_open = least / 2 < self._pairs.most_kept + self._pairs.on_top(extra - HALF_STEP_M)
        open_ones = np.flatnonzero(is_open.any(axis=1))
        inside = [np.arange(grid[row] + 1, grid[row + 1]) for row in open_ones]
        if not sum(map(len, inside)):
            return None
        which = is_open[np.repeat(open_ones, [len(part) for part in inside])]
        return self._look_closely(q, np.concatenate(inside), which, travel / steps, extra)

    def _look_closely(
        self,
        q: FloatArray,
        inside: IntArray,
        is_open: BoolArray,
        per_step: FloatArray,
        extra: float,
    ) -> Shortfall | None:
        """Return a pair nearer than its clearance at some steps of a path q (n, k), or None.

        Any one, not the first or worst; its `index` counts within `inside`. A pair far enough away
        at a step is not measured again until it could have come near. Nothing is changed in place.
        ``inside``: indices of steps of q, ascending, (m,); ``is_open``: pairs to check at each,
        (m, P); ``per_step``: upper bound on the change of each pair's distance in a step, m, (P,);
        ``extra``: added to the clearance of each pair that is not for contact only, m.
        """
        placed = self._pairs.place(q[inside])
        bounds = self._pairs.lower_bounds(placed)
        rows, pairs, kept, decided = self._pairs.candidates(placed, bounds, is_open, extra)
        if decided.any():
            n = int(np.argmax(decided))
            row, pair = int(rows[n]), int(pairs[n])
            return Shortfall(row, pair, float(bounds[row, pair]), float(kept[n]))
        most_kept = self._pairs.most_kept + self._pairs.on_top(extra)
        clear_until = np.full(len(per_step), -1.0)
        for n in range(len(rows)):
            row, pair = int(rows[n]), int(pairs[n])
            if inside[row] < clear_until[pair]:
                continue
            distance = self._pairs.measure(placed, row, pair)
            if distance < kept[n]:
                return Shortfall(row, pair, distance, float(kept[n]))
            # Up to this step the pair cannot come nearer than its largest clearance.
            clear_until[pair] = inside[row] + (distance - most_kept[pair]) / max(
                per_step[pair], 1e-12
            )
        return None
