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
    """Measurements and fitted model on which effects may depend: n rows, k joints."""

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
        """Sensor index, (n,)."""
        return self.measurements.sensor

    @property
    def marker(self) -> IntArray:
        """Marker index, (n,)."""
        return self.measurements.marker

    @cached_property
    def q(self) -> FloatArray:
        """Joint positions with the zero-offsets, rad or m, (n, k)."""
        return self.measurements.q + self.joint_offsets

    @cached_property
    def frames(self) -> FloatArray:
        """Frame after each joint in R, (n, k, 4, 4)."""
        return self.chain.frames(self.q)

    @cached_property
    def tool(self) -> FloatArray:
        """Tool frame in R, (n, 4, 4)."""
        return self.frames[:, -1] @ self.chain.T_fixed[-1]

    @cached_property
    def points(self) -> FloatArray:
        """Modelled markers in R, m, (n, 3)."""
        return apply(self.tool, self.markers[self.marker])

    @cached_property
    def jacobian(self) -> FloatArray:
        """Velocity of the marker by each joint, m/rad or m/m, (n, 3, k)."""
        return self.chain.position_jacobian(self.q, self.markers[self.marker])

    @cached_property
    def gravity_torque(self) -> FloatArray:
        """Gravity's torque about each joint, N m, or force along it, N, (n, k)."""
        return self.chain.gravity_torque(self.q, GRAVITY)

    @cached_property
    def gravity_moment(self) -> FloatArray:
        """Gravity's moment about each joint of all links it carries, N m, (n, k, 3)."""
        masses = self.chain.masses
        moments = masses[:, None] * apply(self.frames, self.chain.centers_of_mass)
        carried = np.cumsum(moments[:, ::-1], axis=1)[:, ::-1]
        mass = np.cumsum(masses[::-1])[::-1]
        arms = carried - mass[:, None] * self.frames[..., :3, 3]
        return np.cross(arms, np.array(GRAVITY))

    @cached_property
    def base_moment(self) -> FloatArray:
        """Gravity's moment of the whole arm about the origin of R, N m, (n, 3)."""
        centers = apply(self.frames, self.chain.centers_of_mass)
        moment = np.sum(self.chain.masses[:, None] * centers, axis=1)
        return np.cross(moment, np.array(GRAVITY))

    @cached_property
    def has_gravity(self) -> bool:
        """Whether the URDF has link masses."""
        return self.chain.has_inertials

    @cached_property
    def last_move(self) -> FloatArray:
        """Signed move of each joint to get here, q - from_q, rad or m, (n, k); 0 if unknown."""
        return np.nan_to_num(self.measurements.q - self.measurements.from_q, nan=0.0)

    @cached_property
    def approach(self) -> FloatArray:
        """Sign of each joint's last move that was a move at all, (n, k); 0 before the first."""
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
        """Whether the arm moved during the measurements."""
        return self.measurements.velocity is not None

    @cached_property
    def motion(self) -> MotionColumns:
        """Functions of the rows' motion, of a session that `has_motion`."""
        return MotionColumns.of(self.chain, self.measurements, self.joint_offsets)

    @cached_property
    def marker_velocity(self) -> FloatArray:
        """Velocity of the marker in R by the joints' velocities, m/s, (n, 3); 0 if unknown."""
        return np.einsum('nik,nk->ni', self.jacobian, self.motion.velocity)

    @cached_property
    def elapsed_s(self) -> FloatArray:
        """Time since the first row, s, (n,)."""
        return self.measurements.stamp_s - self.measurements.stamp_s.min()

    @cached_property
    def progress(self) -> FloatArray:
        """Place of each row in the order of time, from 0 (the first) to 1 (the last), (n,)."""
        _, rank = np.unique(self.elapsed_s, return_inverse=True)
        progress: FloatArray = rank / max(1, int(rank.max()))
        return progress

    @cached_property
    def has_time(self) -> bool:
        """Whether the rows' times are known and lie apart."""
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
        """Return `warming` through a first-order lag, from the first row on, K, (n,)."""
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
        return {}

    @cached_property
    def has_temperature(self) -> bool:
        """Whether the temperature is known and varies."""
        known = np.isfinite(self.measurements.temperature_c)
        return bool(np.mean(known) >= KNOWN_SHARE and np.ptp(self.warming) >= LEAST_WARMING_K)

    @cached_property
    def sensor_turn(self) -> FloatArray:
        """Rotation of the row's sensor frame, R_R_N, (n, 3, 3)."""
        return self.T_R_N[self.sensor, :3, :3]

    @cached_property
    def in_sensor(self) -> FloatArray:
        """Modelled markers in the frame N of the row's sensor, m, (n, 3)."""
        shift = self.points - self.T_R_N[self.sensor, :3, 3]
        return np.einsum('nji,nj->ni', self.sensor_turn, shift)

    @cached_property
    def centers(self) -> FloatArray:
        """Mean of the modelled markers of each sensor's rows, in R, m, (sensors, 3)."""
        points = self.chain.positions(
            self.measurements.q, self.markers[self.marker], self.joint_offsets
        )
        # No candidate uses the centre of a sensor without rows.
        seen = [points[self.seen_by(sensor)] for sensor in range(len(self.sensor_names))]
        return np.array([rows.mean(axis=0) if len(rows) else np.zeros(3) for rows in seen])

    @cached_property
    def range_m(self) -> FloatArray:
        """Distance from the row's sensor, m, (n,)."""
        return np.linalg.norm(self.in_sensor, axis=1)

    def at(self, rows: IntArray) -> Context:
        """Return the context of some rows; ``rows``: their indices here, in the order wanted.

        Every value is that which the row has here, also where it depends on other rows: time
        since the first row, the move before, a sensor's centre.
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
        """Yield slices of at most `rows` rows with their contexts; all rows at once if few.

        What a block computes goes with it, so memory does not grow with the rows.
        """
        if len(self) <= rows:
            yield slice(0, len(self)), self
            return
        for start in range(0, len(self), rows):
            where = slice(start, min(start + rows, len(self)))
            yield where, self.at(np.arange(where.start, where.stop))

    def sensors(self, *without: SensorKind) -> list[tuple[int, str]]:
        """Return index and name of the sensors whose kind is none of these."""
        kinds = self.sensor_kinds or ('',) * len(self.sensor_names)
        return [
            (index, name)
            for index, (name, kind) in enumerate(zip(self.sensor_names, kinds, strict=True))
            if kind not in without
        ]

    def seen_by(self, sensor: int) -> BoolArray:
        """Return whether a sensor measured each row, (n,)."""
        return self.sensor == sensor

    @cached_property
    def to_fit(self) -> BoolArray:
        """Which rows are not held out, (n,)."""
        return ~self.measurements.is_validation

    def turns_over(self, joint: int) -> bool:
        """Return whether a revolute joint (1-based) turns past a whole turn: errors recur."""
        range_ = self.chain.upper[joint - 1] - self.chain.lower[joint - 1]
        return bool(range_ > MORE_THAN_A_TURN) and not self.slides(joint)

    def slides(self, joint: int) -> bool:
        """Return whether a joint (1-based) slides."""
        return bool(self.chain.slides[joint - 1])

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Joints (1-based) that moved by more than `LEAST_TURN_RAD` in the rows to fit."""
        span = np.ptp(self.measurements.q[self.to_fit], axis=0)
        least = LEAST_TURN_RAD * self.chain.per_radian
        return tuple(int(joint) + 1 for joint in np.flatnonzero(span > least))

    @property
    def turning(self) -> tuple[int, ...]:
        """Revolute joints (1-based) among `moving`."""
        return tuple(joint for joint in self.moving if not self.slides(joint))

    def links(self) -> Sequence[int]:
        """Return the links, 1-based, whose geometry can matter: from joint j to joint j + 1.

        What lies before joint 1 is part of the registration, behind the last joint of the marker.
        """
        return range(1, self.joints)

    def joint_origin(self, joint: int) -> FloatArray:
        """Return the origin of a joint (1-based) in R, m, (n, 3)."""
        return self.frames[:, joint - 1, :3, 3]

    def link_rotation(self, joint: int) -> FloatArray:
        """Return the rotation of the link moved by a joint (1-based) in R, (n, 3, 3)."""
        return self.frames[:, joint - 1, :3, :3]


@dataclass(frozen=True, eq=False)
class PartOfContext(Context):
    """Some rows of a context; values that depend on several rows are those of all of it."""

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
        """Time since the first row of the whole, s, (n,)."""
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
        """Temperature above the first known one of the whole, K, (n,)."""
        return self.whole.warming[self.rows]

    def lagging_warming(self, lag_s: float) -> FloatArray:
        """`Context.lagging_warming` of the whole context in these rows, K, (n,)."""
        return self.whole.lagging_warming(lag_s)[self.rows]

    @cached_property
    def has_temperature(self) -> bool:
        """Whether the whole context has temperatures."""
        return self.whole.has_temperature

    @cached_property
    def centers(self) -> FloatArray:
        """`Context.centers` of the whole context, m, (sensors, 3)."""
        return self.whole.centers

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """`Context.moving` of the whole context."""
        return self.whole.moving
