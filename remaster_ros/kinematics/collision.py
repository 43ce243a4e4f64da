# SPDX-License-Identifier: Apache-2.0
"""Whether a configuration, or the whole way between two, is free of collisions, with clearance.

The arm is a set of convex `bodies`; so are the obstacles, and the floor is a plane. Bounding
capsules, all at once in NumPy, exclude most pairs; what they cannot exclude is measured by coal
(distances between convex shapes; negative where they overlap).

Clearance covers what is not known yet. Each joint's zero-offset is unknown by ``unknown_offset``
(1 degree unless stated), independently of the others: two bodies may be nearer to each other than
the model has it by unknown_offset · √(Σ lever²), summed over the joints between the two. A lever
is the largest distance of the outer body from the joint's axis at that configuration; for the
floor only its horizontal part counts, and a vertical axis has none. A joint that slides has the
lever 0.25 m (`serial_chain.LEVER_M`): so far it may be off for each radian of unknown_offset. A
fixed margin comes on top:

    kept = margin + unknown_offset · √(Σ lever²)

The margin includes half a step of a swept path: a path is checked so finely that no body moves by
more than 10 mm relative to another from one check to the next, so that it is nowhere nearer than
5 mm less than at the checks.

Not checked are, by this rule: bodies of one link; links next to each other, which their joint
keeps apart, or several that slide and turn on one line, as a SCARA's do (tools and markers are
checked against the link before theirs); two bodies of the arm
that overlap as modelled in 95 % of sampled configurations; and a body that overlaps an obstacle
or the floor in every one. Bodies that come nearer than what is kept in 95 % of the configurations
(all of them for obstacles and floor), but do not overlap, are kept from touching only. `left_out`
names them all. The base itself touches the floor.
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
"""No two bodies move by more relative to each other between two checks of a path, m."""
HALF_STEP_M = STEP_M / 2
ESCAPE_STEP_M = 0.002
"""The same on a way out, m."""
ESCAPE_TOLERANCE_M = 1e-4
"""How much nearer what is too near may come from one check of a way out to the next, m."""

_STRIDE = 8
_LIMIT_TOLERANCE = 1e-6  # rad or m


def arm_bodies(chain: SerialChain, given: Sequence[Body], link_radius: float) -> list[Body]:
    """Add a capsule along each link that has no body: from its joint to the next one, or the tip.

    What leads a joint that slides is added, too: where the base has no body, a rail along all of
    the way of a first joint; else a rod that slides with the joint's link, as long as its way.

    Parameters
    ----------
    chain
        The arm.
    given
        What is known of the arm, its tool and its markers.
    link_radius
        Radius of the capsules, m.
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
    """The arm with its tool and markers, the obstacles and the floor around it.

    Parameters
    ----------
    chain
        The arm.
    bodies
        Everything; see `arm_bodies`. Bodies on link 0 stand still.
    floor_z
        Height of the floor in R, m; None where there is none to hit.
    margin
        Fixed part of the clearance, m; at least half a step of a swept path, 5 mm.
    unknown_offset
        What a joint's zero-offset may be off by, rad; of one that slides see above.
    link_radius
        Of the capsules that stand for the links in the line of sight, m.

    Attributes
    ----------
    chain
        The arm.
    bodies
        All bodies, by link.
    left_out
        The pairs that are not checked, or only for contact, and why.
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

    # Single configurations and paths

    def trouble(self, q: ArrayLike, extra: float = 0.0) -> str:
        """Return what is too near at a configuration, rad, (k,); '' where it is free.

        `extra` is kept on top of the clearance, m.
        """
        found = self.shortfalls(np.asarray(q, dtype=float)[None], extra)
        if not found:
            return ''
        return self.describe(min(found, key=lambda short: short.distance - short.kept))

    def path_trouble(self, waypoints: ArrayLike, extra: float = 0.0) -> str:
        """Return what is wrong on the way along configurations (n, k), straight in joint space.

        Parameters
        ----------
        waypoints
            rad, (n, k), n >= 1.
        extra
            Kept on top of the clearance, m.

        Returns
        -------
        str
            '' where every point of the way is within the joint limits and free.
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
        """Return what is wrong with a way out (n, k) of a margin or a contact; '' for nothing.

        What is too near at its start never comes nearer on the way (by more than 0.1 mm from one
        check to the next), everything else stays as far as is kept, the end is free (with
        `ends_free`), and no joint leaves its limits.

        ``waypoints``: rad, (n, k), n >= 1.
        """
        q = np.asarray(waypoints, dtype=float)
        if not np.all(np.isfinite(q)):
            return 'a joint angle of the path is not finite'
        outside = np.maximum(self.chain.lower - q, q - self.chain.upper)
        further = outside - np.maximum(outside[0], 0.0)
        if np.max(further) > _LIMIT_TOLERANCE:
            return self._limit_trouble(q)
        parts = [q[:1]]
        for a, b in pairwise(q):
            steps = max(1, ceil(self.travel(a, b) / ESCAPE_STEP_M))
            parts.append(a + np.arange(1, steps + 1)[:, None] / steps * (b - a))
        q = np.concatenate(parts)
        found = self.shortfalls(q)
        at = [{short.pair: short for short in found if short.index == i} for i in range(len(q))]
        first = at[0]
        for i, now in enumerate(at):
            for pair, short in now.items():
                if pair not in first:
                    return f'on the way out, {self.describe(short)}'
                before = at[i - 1].get(pair) if i else short
                if before is None or short.distance < before.distance - ESCAPE_TOLERANCE_M:
                    return f'on the way out it comes nearer: {self.describe(short)}'
        if ends_free and at[-1]:
            return f'at the end of the way out, {self.describe(next(iter(at[-1].values())))}'
        return ''

    def travel(self, start: FloatArray, end: FloatArray) -> float:
        """Bound how far any point of the arm moves between configurations, m, or relatively."""
        return float((self._pairs.levers @ np.abs(end - start)).max(initial=0.0))

    def pair_distances(self, q: FloatArray, pairs: IntArray) -> FloatArray:
        """Return the distances of pairs (p,) (see `Shortfall`) at configurations (n, k), m."""
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
        """Return why configurations (m, k) are not free, or '', (m,)."""
        q = np.asarray(q, dtype=float).reshape(-1, len(self.chain))
        reasons = np.full(len(q), '', dtype=f'U{len(OBSTACLE)}')
        for short in self.shortfalls(q, extra, first=True):
            reasons[short.index] = self._pairs.category(short.pair)
        return reasons

    def free_mask(self, q: ArrayLike, extra: float = 0.0) -> BoolArray:
        """Return which configurations (m, k) are free, (m,)."""
        return self.reasons(q, extra) == ''

    def hides(self, q: ArrayLike, marker_T: ArrayLike, sensor_R: ArrayLike) -> BoolArray:
        """Return whether a link stands between marker and sensor; see `LinkCapsules.hides`."""
        return self._sight.hides(q, marker_T, sensor_R)

    @cached_property
    def extent_points(self) -> tuple[FloatArray, ...]:
        """For each joint, points in the frame after it that enclose what it carries, (n_i, 3).

        Their hull contains the link, and on the last one tool and markers: of everything that
        moves with the link one of them is the fastest.
        """
        extents = []
        for link in range(1, len(self.chain) + 1):
            own = [body.outline for body in self.bodies if body.link == link]
            extents.append(enclosing_points(np.concatenate(own or [np.zeros((1, 3))])))
        return tuple(extents)

    def shortfalls(
        self, q: FloatArray, extra: float = 0.0, *, first: bool = False
    ) -> list[Shortfall]:
        """Return every pair that is nearer than is kept at configurations (n, k).

        With `first` one of each configuration is enough.
        """
        return self._pairs.examine(self._pairs.place(q), extra, first=first)[0]

    def describe(self, short: Shortfall) -> str:
        """Return a shortfall as text."""
        inner, outer = self._pairs.names(short.pair)
        kept = f'{1e3 * short.kept:.0f} mm is kept'
        if short.distance < 0.0:
            return f'{outer} reaches {-1e3 * short.distance:.0f} mm into {inner}, {kept}'
        return f'{outer} {1e3 * short.distance:.0f} mm from {inner}, {kept}'

    def _limit_trouble(self, q: FloatArray) -> str:
        """Return which waypoint (n, k) is outside the joint limits; '' for none."""
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

    # Swept paths

    def _sweep(self, start: FloatArray, end: FloatArray, extra: float) -> Shortfall | None:
        """Return something that is too near on the straight way in joint space."""
        travel = self._pairs.levers @ np.abs(end - start)
        steps = max(1, ceil(float(travel.max(initial=0.0)) / STEP_M))
        grid = np.unique(np.append(np.arange(0, steps, _STRIDE), steps))
        share = np.arange(steps + 1) / steps
        q = start + share[:, None] * (end - start)
        # Most ways that are not free show it at one of these.
        found, _ = self._pairs.examine(
            self._pairs.place(q[[steps // 2, steps // 4, -1]]), extra, one=True
        )
        if found:
            return found[0]
        found, distances = self._pairs.examine(self._pairs.place(q[grid]), extra, one=True)
        if found:
            return found[0]
        # Where neither end of an interval excludes a pair, all of the interval is looked at.
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
        """Check some steps (m,) of a way (n, k): the pairs (m, P) that are open there."""
        placed = self._pairs.place(q[inside])
        bounds = self._pairs.lower_bounds(placed)
        rows, pairs, kept, decided = self._pairs.candidates(placed, bounds, is_open, extra)
        if decided.any():
            n = int(np.argmax(decided))
            row, pair = int(rows[n]), int(pairs[n])
            return Shortfall(row, pair, float(bounds[row, pair]), float(kept[n]))
        most = self._pairs.most_kept + self._pairs.on_top(extra)
        beyond = np.full(len(per_step), -1.0)
        for n in range(len(rows)):
            row, pair = int(rows[n]), int(pairs[n])
            if inside[row] < beyond[pair]:
                continue
            distance = self._pairs.measure(placed, row, pair)
            if distance < kept[n]:
                return Shortfall(row, pair, distance, float(kept[n]))
            # So many steps further it cannot have come nearer than what is kept at most.
            beyond[pair] = inside[row] + (distance - most[pair]) / max(per_step[pair], 1e-12)
        return None
