"""Everything an effect may depend on, row by row, at the solution of the offsets model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from remaster_ros.calibration.dynamics import MotionColumns
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, SensorKind

GRAVITY = (0.0, 0.0, -9.81)
# A joint that moved less than this stays on the flank of its gears that it was on. One that slides
# has `SerialChain.per_radian` as much, in m, here and below.
STILL_RAD = 1e-4
# A joint that turns less than this in all stands still.
LEAST_TURN_RAD = 1e-2
# A joint with a range of more than this turns over: limits of ±180 degrees are just one turn.
MORE_THAN_A_TURN = 2.0 * np.pi + LEAST_TURN_RAD
# A driver known in a smaller share of the rows cannot be tested.
KNOWN_SHARE = 0.8
# Temperatures that vary less than this drive nothing that could be seen.
LEAST_WARMING_K = 0.2
# Rows of a block: frames and Jacobians of so many take some ten megabytes.
BLOCK_ROWS = 10_000


@dataclass(frozen=True, eq=False)
class Context:
    """Measurements and fitted model from which effects compute their columns: n rows, k joints."""

    chain: SerialChain  # The nominal robot
    # All rows; ``sensor`` and ``marker`` are indices into the names below
    measurements: Measurements
    # In the order of those indices
    sensor_names: tuple[str, ...]
    marker_names: tuple[str, ...]
    joint_offsets: FloatArray  # As fitted, rad, m of joints that slide, (k,)
    markers: FloatArray  # As fitted, in the tool frame, m, (markers, 3)
    T_R_N: FloatArray  # As fitted, (sensors, 4, 4)
    # Of the sensors; '' if it is unknown, () if it is of none
    sensor_kinds: tuple[Literal['', SensorKind], ...] = field(default=(), kw_only=True)
    timed: bool = field(default=True, kw_only=True)  # False if the rows' times only order them

    def __len__(self) -> int:
        """Return the number of rows n."""
        return len(self.measurements)

    @property
    def joints(self) -> int:
        """Number of joints k."""
        return len(self.chain)

    @property
    def sensor(self) -> IntArray:
        """Index of each row's sensor in `sensor_names`, (n,)."""
        return self.measurements.sensor

    @property
    def marker(self) -> IntArray:
        """Index of each row's marker in `marker_names`, (n,)."""
        return self.measurements.marker

    @cached_property
    def q(self) -> FloatArray:
        """Joint positions with the fitted zero-offsets added, rad or m, (n, k)."""
        return self.measurements.q + self.joint_offsets

    @cached_property
    def frames(self) -> FloatArray:
        """Pose of the frame after each joint in the robot base frame R, (n, k, 4, 4)."""
        return self.chain.frames(self.q)

    @cached_property
    def tool(self) -> FloatArray:
        """Pose of the tool frame in the robot base frame R, (n, 4, 4)."""
        return self.frames[:, -1] @ self.chain.T_fixed[-1]

    @cached_property
    def points(self) -> FloatArray:
        """Position of each row's marker by the model, in the robot base frame R, m, (n, 3)."""
        return apply(self.tool, self.markers[self.marker])

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivative of the marker's position in R by each joint, m/rad or m/m, (n, 3, k)."""
        return self.chain.position_jacobian(self.q, self.markers[self.marker])

    @cached_property
    def gravity_torque(self) -> FloatArray:
        """Gravity's torque about each joint, N m, or force along it, N, (n, k)."""
        return self.chain.gravity_torque(self.q, GRAVITY)

    @cached_property
    def gravity_moment(self) -> FloatArray:
        """Torque of gravity about each joint's origin, of all links it carries, N m, (n, k, 3).

        As a vector in the robot base frame R.
        """
        masses = self.chain.masses
        moments = masses[:, None] * apply(self.frames, self.chain.centers_of_mass)
        carried = np.cumsum(moments[:, ::-1], axis=1)[:, ::-1]
        mass = np.cumsum(masses[::-1])[::-1]
        arms = carried - mass[:, None] * self.frames[..., :3, 3]
        return np.cross(arms, np.array(GRAVITY))

    @cached_property
    def base_moment(self) -> FloatArray:
        """Torque of the whole arm's weight about the origin of the base frame R, N m, (n, 3)."""
        centers = apply(self.frames, self.chain.centers_of_mass)
        moment = np.sum(self.chain.masses[:, None] * centers, axis=1)
        return np.cross(moment, np.array(GRAVITY))

    @cached_property
    def has_gravity(self) -> bool:
        """Whether the URDF has link masses, so that gravity's torques are known."""
        return self.chain.has_inertials

    @cached_property
    def last_move(self) -> FloatArray:
        """Signed move of each joint to get here, q - from_q, rad or m, (n, k); 0 if unknown."""
        return np.nan_to_num(self.measurements.q - self.measurements.from_q, nan=0.0)

    @cached_property
    def approach(self) -> FloatArray:
        """Sign of each joint's last move, (n, k): +1 or -1; 0 before its first move.

        Moves of less than `STILL_RAD` (or its length for a slide) do not count: the sign of the
        previous row in time remains.
        """
        still = STILL_RAD * self.chain.per_radian
        sign = np.where(np.abs(self.last_move) > still, np.sign(self.last_move), 0.0)
        order = np.argsort(self.measurements.stamp_s, kind='stable')
        # The last row in time at or before each row at which the joint moved.
        moved = np.where(sign[order] != 0.0, np.arange(len(self))[:, None], -1)
        last = np.maximum.accumulate(moved, axis=0)
        kept = np.take_along_axis(sign[order], np.maximum(last, 0), axis=0)
        approach = np.zeros_like(sign)
        approach[order] = np.where(last >= 0, kept, 0.0)
        return approach

    @cached_property
    def has_approach(self) -> bool:
        """Whether `from_q` is known in at least `KNOWN_SHARE` of the rows; False without rows."""
        known = np.all(np.isfinite(self.measurements.from_q), axis=1)
        return bool(len(known) and np.mean(known) >= KNOWN_SHARE)

    @property
    def has_motion(self) -> bool:
        """Whether the measurements have joint velocities: the arm was measured in motion."""
        return self.measurements.velocity is not None

    @cached_property
    def motion(self) -> MotionColumns:
        """Rates, friction, inertia and swing in each row; only for a session that `has_motion`."""
        return MotionColumns.of(self.chain, self.measurements, self.joint_offsets)

    @cached_property
    def marker_velocity(self) -> FloatArray:
        """Velocity of each row's marker in the robot base frame R, m/s, (n, 3); 0 if unknown."""
        return np.einsum('nik,nk->ni', self.jacobian, self.motion.velocity)

    @cached_property
    def elapsed_s(self) -> FloatArray:
        """Time since the first row, s, (n,)."""
        return self.measurements.stamp_s - self.measurements.stamp_s.min()

    @cached_property
    def progress(self) -> FloatArray:
        """Rank of each row in time, scaled from 0 (the first) to 1 (the last), (n,).

        Rows of equal time have equal values.
        """
        _, rank = np.unique(self.elapsed_s, return_inverse=True)
        progress: FloatArray = rank / max(1, int(rank.max()))
        return progress

    @cached_property
    def has_time(self) -> bool:
        """Whether the rows' times are known and not all equal."""
        return self.timed and bool(np.ptp(self.elapsed_s) > 0.0)

    @cached_property
    def warming(self) -> FloatArray:
        """Temperature above the first known temperature, K, (n,); 0 if unknown."""
        given = self.measurements.temperature_c
        known = np.isfinite(given)
        if not known.any():
            return np.zeros(len(self))
        first = given[known][np.argmin(self.measurements.stamp_s[known])]
        return np.where(known, given - first, 0.0)

    def lagging_warming(self, lag_s: float) -> FloatArray:
        """Return `warming` delayed by a first-order lag, K, (n,); 0 at the first row.

        ``lag_s``: time constant, s. Unknown temperatures are interpolated over time.
        """
        if lag_s not in self._lagging:
            order = np.argsort(self.elapsed_s, kind='stable')
            known = order[np.isfinite(self.measurements.temperature_c[order])]
            time = self.elapsed_s[order]
            warm = np.interp(time, self.elapsed_s[known], self.warming[known])
            share = -np.expm1(-np.diff(time) / lag_s)
            slow = np.zeros(len(order))
            for i, part in enumerate(share.tolist()):
                slow[i + 1] = slow[i] + part * (0.5 * (warm[i] + warm[i + 1]) - slow[i])
            self._lagging[lag_s] = np.empty(len(order))
            self._lagging[lag_s][order] = slow
        return self._lagging[lag_s]

    @cached_property
    def _lagging(self) -> dict[float, FloatArray]:
        """Cache of `lagging_warming`: time constant, s -> values, K, (n,); {} at first."""
        return {}

    @cached_property
    def has_temperature(self) -> bool:
        """Whether the temperature is known in at least `KNOWN_SHARE` of the rows, and varies.

        It varies if its range is at least `LEAST_WARMING_K`.
        """
        known = np.isfinite(self.measurements.temperature_c)
        return bool(np.mean(known) >= KNOWN_SHARE and np.ptp(self.warming) >= LEAST_WARMING_K)

    @cached_property
    def sensor_turn(self) -> FloatArray:
        """Rotation from the frame N of each row's sensor to the base frame R, R_R_N, (n, 3, 3)."""
        return self.T_R_N[self.sensor, :3, :3]

    @cached_property
    def in_sensor(self) -> FloatArray:
        """Position of each row's marker by the model, in its sensor's frame N, m, (n, 3)."""
        shift = self.points - self.T_R_N[self.sensor, :3, 3]
        return np.einsum('nji,nj->ni', self.sensor_turn, shift)

    @cached_property
    def centers(self) -> FloatArray:
        """Mean modelled marker position of each sensor's rows, base frame R, m, (sensors, 3).

        Zeros for a sensor without rows.
        """
        points = self.chain.positions(
            self.measurements.q, self.markers[self.marker], self.joint_offsets
        )
        # No candidate uses the centre of a sensor without rows.
        seen = [points[self.seen_by(sensor)] for sensor in range(len(self.sensor_names))]
        return np.array([rows.mean(axis=0) if len(rows) else np.zeros(3) for rows in seen])

    @cached_property
    def range_m(self) -> FloatArray:
        """Distance of each row's marker by the model from its sensor, m, (n,)."""
        return np.linalg.norm(self.in_sensor, axis=1)

    def at(self, rows: IntArray) -> Context:
        """Return the context of some rows; ``rows``: their indices here, in the order wanted.

        Values that depend on other rows, too, such as the time since the first row, the
        approach or a sensor's centre, are those that the row has here.
        """
        return PartOfContext(
            self.chain,
            self.measurements.select(rows),
            self.sensor_names,
            self.marker_names,
            self.joint_offsets,
            self.markers,
            self.T_R_N,
            self,
            rows,
            timed=self.timed,
            sensor_kinds=self.sensor_kinds,
        )

    def blocks(self, rows: int = BLOCK_ROWS) -> Iterator[tuple[slice, Context]]:
        """Yield (slice of rows, its context) for blocks of at most `rows` rows, in order.

        If there are no more rows than that: one block, with this context itself. What a block
        computes is stored in its context, so memory does not grow with the rows.
        """
        if len(self) <= rows:
            yield slice(0, len(self)), self
            return
        for start in range(0, len(self), rows):
            where = slice(start, min(start + rows, len(self)))
            yield where, self.at(np.arange(where.start, where.stop))

    def sensors(self, *without: SensorKind) -> list[tuple[int, str]]:
        """Return (index, name) of all sensors except those of the kinds in ``without``."""
        kinds = self.sensor_kinds or ('',) * len(self.sensor_names)
        return [
            (index, name)
            for index, (name, kind) in enumerate(zip(self.sensor_names, kinds, strict=True))
            if kind not in without
        ]

    def seen_by(self, sensor: int) -> BoolArray:
        """Mask of the rows that a sensor measured, (n,); ``sensor``: its index."""
        return self.sensor == sensor

    @cached_property
    def to_fit(self) -> BoolArray:
        """Mask of the rows that are not held out for validation, (n,)."""
        return ~self.measurements.is_validation

    def turns_over(self, joint: int) -> bool:
        """Return whether a joint (1-based) turns, with limits more than a whole turn apart.

        Its errors then recur after a turn.
        """
        range_ = self.chain.upper[joint - 1] - self.chain.lower[joint - 1]
        return bool(range_ > MORE_THAN_A_TURN) and not self.slides(joint)

    def slides(self, joint: int) -> bool:
        """Return whether a joint (1-based) is prismatic."""
        return bool(self.chain.slides[joint - 1])

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Joints (1-based) whose range in the rows to fit exceeds `LEAST_TURN_RAD`.

        Of joints that slide the limit is `LEAST_TURN_RAD` times `SerialChain.per_radian`, m.
        """
        span = np.ptp(self.measurements.q[self.to_fit], axis=0)
        least = LEAST_TURN_RAD * self.chain.per_radian
        return tuple(int(joint) + 1 for joint in np.flatnonzero(span > least))

    @property
    def turning(self) -> tuple[int, ...]:
        """Revolute joints (1-based) among `moving`."""
        return tuple(joint for joint in self.moving if not self.slides(joint))

    def links(self) -> Sequence[int]:
        """Return the numbers j = 1 to k - 1 of the links between joint j and joint j + 1.

        Only their geometry matters: what is before joint 1 is part of the registration, what is
        behind the last joint part of the marker.
        """
        return range(1, self.joints)

    def joint_origin(self, joint: int) -> FloatArray:
        """Return the origin of a joint's (1-based) frame in the robot base frame R, m, (n, 3)."""
        return self.frames[:, joint - 1, :3, 3]

    def link_rotation(self, joint: int) -> FloatArray:
        """Return the rotation R_R_j of the link that joint j (1-based) moves, in R, (n, 3, 3)."""
        return self.frames[:, joint - 1, :3, :3]


@dataclass(frozen=True, eq=False)
class PartOfContext(Context):
    """Some rows of a larger context; values that depend on other rows are taken from that."""

    # The context, and which of its rows these are, (n,)
    whole: Context
    rows: IntArray

    @cached_property
    def approach(self) -> FloatArray:
        """`Context.approach` of the whole context in these rows, (n, k)."""
        return self.whole.approach[self.rows]

    @cached_property
    def has_approach(self) -> bool:
        """`Context.has_approach` of the whole context."""
        return self.whole.has_approach

    @cached_property
    def motion(self) -> MotionColumns:
        """`Context.motion` of the whole context in these rows."""
        return self.whole.motion.at(self.rows)

    @cached_property
    def elapsed_s(self) -> FloatArray:
        """Time since the first row of the whole context, s, (n,)."""
        return self.whole.elapsed_s[self.rows]

    @cached_property
    def progress(self) -> FloatArray:
        """`Context.progress` of the whole context in these rows, (n,)."""
        return self.whole.progress[self.rows]

    @cached_property
    def has_time(self) -> bool:
        """`Context.has_time` of the whole context."""
        return self.whole.has_time

    @cached_property
    def warming(self) -> FloatArray:
        """`Context.warming` of the whole context in these rows, K, (n,)."""
        return self.whole.warming[self.rows]

    def lagging_warming(self, lag_s: float) -> FloatArray:
        """`Context.lagging_warming` of the whole context in these rows, K, (n,)."""
        return self.whole.lagging_warming(lag_s)[self.rows]

    @cached_property
    def has_temperature(self) -> bool:
        """`Context.has_temperature` of the whole context."""
        return self.whole.has_temperature

    @cached_property
    def centers(self) -> FloatArray:
        """`Context.centers` of the whole context, m, (sensors, 3)."""
        return self.whole.centers

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """`Context.moving` of the whole context."""
        return self.whole.moving
