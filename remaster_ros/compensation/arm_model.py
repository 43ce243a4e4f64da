# SPDX-License-Identifier: Apache-2.0
"""The arm as it was found to be: where its tool is at reported joint angles, and how surely.

With q the reported angles, δ the zero-offsets and τ gravity's torques at q + δ::

    true angle of joint j = q_j + δ_j + Σ terms of joint j
    tool = base turn · Π_j (T_j · shift_j · turn_j · Rot(axis_j, true angle_j)) · T_tool

A joint that slides has metres for radians, the shift along its axis for Rot, and for gravity's
torque the force along it, N.

T_j is the nominal origin of joint j. Shifts are in the frame of the link that the joint before
moves, turns in the joint's own frame, and both may grow with the temperature. A link whose bearing
gives way is turned about its joint's origin by gravity's moment across the joint's axis.

Terms of an angle take the angle as it is reported; those of a torque or a moment take that of the
nominal arm at q + δ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
import scipy

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    rotation_vector_to_matrix,
    transform,
)
from remaster_ros.types import BoolArray, FloatArray

Driver = Literal['none', 'angle', 'gravity_torque', 'gravity_moment', 'temperature']
Form = Literal['constant', 'linear', 'quadratic', 'sin', 'cos', 'bspline']
GRAVITY = (0.0, 0.0, -9.81)
TURN = 2.0 * np.pi
# Rows at which slopes and errors are looked at, and slopes by steps of how much, rad.
LOOKED_AT, SLOPE_STEP = 500, 1e-6
# Rows of a block: frames and derivatives of so many take some ten megabytes.
BLOCK_ROWS = 2_000


@dataclass(frozen=True, eq=False)
class Function:
    """A function of one driver, linear in its coefficients."""

    # What it depends on; ``joint`` is the index of the joint whose angle or torque it is
    driver: Driver
    form: Form  # Of the m coefficients' m features
    joint: int = -1  # -1 where the driver belongs to none
    order: int = 0  # Of a sine or cosine: cycles per turn
    # Of splines, in the driver's unit; beyond the ends the end value holds
    knots: FloatArray = field(default_factory=lambda: np.zeros(0))
    degree: int = 0
    # The driver is brought to the turn that begins there, rad; NaN where it is not, as of a slide
    turn_start: float = np.nan

    @property
    def size(self) -> int:
        """Number of coefficients m."""
        return len(self.knots) - self.degree - 1 if self.form == 'bspline' else 1

    def features(self, values: FloatArray) -> FloatArray:
        """Return what a unit of each coefficient adds, (n, m), at values of the driver, (n,)."""
        if self.form == 'bspline':
            inside = np.clip(self._in_turn(values), *self.ends)
            found = scipy.interpolate.BSpline.design_matrix(inside, self.knots, self.degree)
            return np.asarray(found.toarray(), dtype=float)
        if self.form == 'constant':
            return np.ones((len(values), 1))
        if self.form == 'linear':
            return values[:, None]
        if self.form == 'quadratic':
            return values[:, None] ** 2
        wave = np.sin if self.form == 'sin' else np.cos
        return np.asarray(wave(self.order * values))[:, None]

    def outside(self, values: FloatArray) -> BoolArray:
        """Return where a value lies beyond the ends of splines, (n,)."""
        if self.form != 'bspline':
            return np.zeros(len(values), dtype=bool)
        low, high = self.ends
        at, margin = self._in_turn(values), 1e-9 * (high - low)
        beyond: BoolArray = (at < low - margin) | (at > high + margin)
        return beyond

    @property
    def ends(self) -> tuple[float, float]:
        """Between which values splines are defined."""
        return float(self.knots[self.degree]), float(self.knots[-self.degree - 1])

    def _in_turn(self, values: FloatArray) -> FloatArray:
        if np.isnan(self.turn_start):
            return values
        found: FloatArray = self.turn_start + np.mod(values - self.turn_start, TURN)
        return found


@dataclass(frozen=True, eq=False)
class JointTerm:
    """What adds to the angle of a joint beside its zero-offset."""

    joint: int  # Its index
    effect: str  # The physical cause, as in discovery.json
    # Of its driver, rad or m, (m,)
    function: Function
    coefficients: FloatArray


@dataclass(frozen=True, eq=False)
class BaseTerm:
    """What turns the whole arm about the origin of R."""

    effect: str  # The physical cause
    # Of one coefficient; of ``gravity_moment`` each axis of R has its own moment
    function: Function
    coefficients: FloatArray  # About x, y and z of R, rad per unit of the function, (3,)


Term = TypeVar('Term', JointTerm, BaseTerm)


@dataclass(frozen=True, eq=False)
class Geometry:
    """Shifts and turns of the joints' origins; the last row is the tool's."""

    shifts: FloatArray  # In the frame of the link that the joint before moves, m, (k + 1, 3)
    turns: FloatArray  # Rotation vectors in the joint's frame, rad, (k + 1, 3)

    @classmethod
    def none(cls, joints: int) -> Geometry:
        """Return that of the drawing."""
        return cls(np.zeros((joints + 1, 3)), np.zeros((joints + 1, 3)))

    @property
    def is_any(self) -> bool:
        """Whether it changes anything."""
        return bool(np.any(self.shifts) or np.any(self.turns))


@dataclass(frozen=True, eq=False)
class Drivers:
    """Values of the drivers in n rows."""

    q: FloatArray  # Reported angles, rad, (n, k)
    warming: FloatArray  # Temperature above that at which nothing has grown, K, (n,)
    torque: FloatArray  # Gravity's, N m or N, (n, k); zeros where no term takes it
    base_moment: FloatArray  # Gravity's about the origin of R, N m, (n, 3); likewise
    moment: FloatArray  # Gravity's on each link about its joint, N m, (n, k, 3); likewise

    def of(self, function: Function) -> FloatArray:
        """Return the value of a function's driver, (n,)."""
        if function.driver == 'angle':
            return self.q[:, function.joint]
        if function.driver == 'gravity_torque':
            return self.torque[:, function.joint]
        if function.driver == 'temperature':
            return self.warming
        return np.zeros(len(self.q))


@dataclass(frozen=True, eq=False)
class State:
    """Where the arm is in n rows."""

    drivers: Drivers  # Values of the drivers
    angles: FloatArray  # True joint angles, rad, (n, k)
    # Frame of each joint before and after its turn, in R, (n, k, 4, 4)
    before: FloatArray
    frames: FloatArray
    tool: FloatArray  # T_R_T, (n, 4, 4)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm of k joints as it was found to be."""

    # The nominal robot; its masses are those that the torques were computed with
    chain: SerialChain
    joint_offsets: FloatArray  # δ, rad, (k,)
    # see `JointTerm`, `BaseTerm`
    joint_terms: tuple[JointTerm, ...]
    base_terms: tuple[BaseTerm, ...]
    # Constant, and per kelvin
    geometry: Geometry
    growth: Geometry
    # Of each link's bearing across the joint's axis, rad/(N m), (k,)
    lateral_compliance: FloatArray
    reference_c: float  # Temperature at which nothing has grown, °C; NaN where nothing does
    mean_c: float  # That of the measurements, taken where none is given, °C
    T_R_N: Mapping[str, FloatArray]  # Registrations that belong to the offsets, by sensor
    markers: Mapping[str, FloatArray]  # Likewise, in T, m
    root: FloatArray  # U with U' U the covariance of `parameter_names`, (r, p)
    # How many times larger standard deviations were found on poses left out than in theory
    widening: float
    # E with E' E the second moments of the true parameters about these, (e, p), where more is
    # known to differ than the covariance says: what has no place in the correction
    error_root: FloatArray | None = None

    @classmethod
    def nominal(cls, chain: SerialChain) -> ArmModel:
        """Return the arm as drawn, with no sensor and no marker."""
        k = len(chain)
        return cls(
            chain=chain,
            joint_offsets=np.zeros(k),
            joint_terms=(),
            base_terms=(),
            geometry=Geometry.none(k),
            growth=Geometry.none(k),
            lateral_compliance=np.zeros(k),
            reference_c=np.nan,
            mean_c=np.nan,
            T_R_N={},
            markers={},
            root=np.zeros((0, 0)),
            widening=1.0,
        )

    @property
    def joints(self) -> int:
        """Number of joints k."""
        return len(self.chain)

    @property
    def grows(self) -> bool:
        """Whether anything depends on the temperature."""
        return self.growth.is_any or 'temperature' in self._needs

    @cached_property
    def _needs(self) -> set[str]:
        drivers: set[str] = {term.function.driver for term in self.joint_terms}
        drivers |= {term.function.driver for term in self.base_terms}
        return drivers | ({'lateral'} if np.any(self.lateral_compliance) else set())

    def warming(self, rows: int, temperature_c: FloatArray | float | None) -> FloatArray:
        """Return the temperature above the reference, K, (rows,)."""
        if not self.grows:
            return np.zeros(rows)
        given = self.mean_c if temperature_c is None else np.asarray(temperature_c, dtype=float)
        return np.broadcast_to(given - self.reference_c, (rows,))

    def drivers(self, q: FloatArray, warming: FloatArray) -> Drivers:
        """Return the values of the drivers at reported angles (n, k)."""
        n, k = q.shape
        torque, base, moment = np.zeros((n, k)), np.zeros((n, 3)), np.zeros((n, k, 3))
        if self._needs & {'gravity_torque', 'gravity_moment', 'lateral'}:
            chain = self.chain
            frames = chain.frames(q + self.joint_offsets)
            moments = chain.masses[:, None] * apply(frames, chain.centers_of_mass)
            base = np.cross(moments.sum(axis=1), GRAVITY)
            carried = np.cumsum(moments[:, ::-1], axis=1)[:, ::-1]
            mass = np.cumsum(chain.masses[::-1])[::-1]
            arms = carried - mass[:, None] * frames[..., :3, 3]
            moment = np.cross(arms, GRAVITY)
            force = mass[:, None] * np.array(GRAVITY)
            turning = np.where(chain.slides[:, None], force, moment)
            torque = np.sum(chain.axes_in_base(frames) * turning, axis=-1)
        return Drivers(q, warming, torque, base, moment)

    def added_angles(self, drivers: Drivers) -> FloatArray:
        """Return what offsets and terms add to the reported angles, rad, (n, k)."""
        added = np.tile(self.joint_offsets, (len(drivers.q), 1))
        for term in self.joint_terms:
            values = term.function.features(drivers.of(term.function))
            added[:, term.joint] += values @ term.coefficients
        return added

    def somewhere(self) -> FloatArray:
        """Return angles all over the limits, the same each time, rad, (n, k)."""
        low, high = self.chain.usual_range
        return np.random.default_rng(0).uniform(low, high, (LOOKED_AT, self.joints))

    def steepest(self) -> float:
        """Return by how much offsets and terms change with the reported angles at the most.

        Largest sum of a joint's changes, rad per rad, at angles all over the limits; what slides
        is counted by `SerialChain.per_radian`. Below 1 there is one command for each wanted angle,
        and the fixed point goes to it (Banach).
        """
        k, warming, unit = self.joints, np.zeros(LOOKED_AT), self.chain.per_radian
        q = self.somewhere()
        here = self.added_angles(self.drivers(q, warming))
        slopes = np.zeros((LOOKED_AT, k))
        for j in range(k):
            step = SLOPE_STEP * np.diag(unit)[j]
            there = self.added_angles(self.drivers(q + step, warming))
            slopes += np.abs(there - here) / unit / SLOPE_STEP
        return float(slopes.max())

    def state(self, q: FloatArray, temperature_c: FloatArray | float | None = None) -> State:
        """Return where the arm is at reported angles (n, k)."""
        return self._state(self.drivers(q, self.warming(len(q), temperature_c)))

    def rigid(self) -> SerialChain:
        """Return the arm with zero-offsets, lengths and tilts built in, for reported angles.

        It is at the temperature of the measurements, and nothing depends on its angles or torques.
        """
        origins = self._origins(self.warming(1, None)).reshape(-1, 4, 4)
        return replace(self.chain, T_fixed=origins).with_offsets(self.joint_offsets)

    def _state(self, drivers: Drivers) -> State:
        n, k = drivers.q.shape
        angles = drivers.q + self.added_angles(drivers)
        turned = self.chain.motions(angles)
        origins = self._origins(drivers.warming)
        before, frames = np.empty((n, k, 4, 4)), np.empty((n, k, 4, 4))
        frame = transform(rotation_vector_to_matrix(self._base_turn(drivers)), np.zeros(3))
        for j in range(k):
            before[:, j] = frame @ origins[..., j, :, :]
            frame = before[:, j] @ turned[:, j]
            if self.lateral_compliance[j] != 0.0:
                frame = frame.copy()
                turn = self.lateral_compliance[j] * self._lateral(drivers, frame, j)
                frame[:, :3, :3] = rotation_vector_to_matrix(turn) @ frame[:, :3, :3]
            frames[:, j] = frame
        return State(drivers, angles, before, frames, frame @ origins[..., k, :, :])

    def _origins(self, warming: FloatArray) -> FloatArray:
        """Return the joints' origins with shifts and turns, (k + 1, 4, 4) or (n, k + 1, 4, 4)."""
        shifts, turns = self.geometry.shifts, self.geometry.turns
        if self.growth.is_any:
            shifts = shifts + warming[:, None, None] * self.growth.shifts
            turns = turns + warming[:, None, None] * self.growth.turns
        drawn = self.chain.T_fixed
        rotation = drawn[:, :3, :3] @ rotation_vector_to_matrix(turns)
        return transform(rotation, drawn[:, :3, 3] + shifts)

    def _base_turn(self, drivers: Drivers) -> FloatArray:
        turn = np.zeros((len(drivers.q), 3))
        for term in self.base_terms:
            turn += self._base_features(drivers, term) * term.coefficients
        return turn

    @staticmethod
    def _base_features(drivers: Drivers, term: BaseTerm) -> FloatArray:
        """Return what a unit about each axis turns, rad, (n, 3)."""
        if term.function.driver == 'gravity_moment':
            return drivers.base_moment
        return np.repeat(term.function.features(drivers.of(term.function)), 3, axis=1)

    def _lateral(self, drivers: Drivers, frame: FloatArray, joint: int) -> FloatArray:
        own = frame[:, :3, :3] @ self.chain.axes[joint]
        moment = drivers.moment[:, joint]
        lateral: FloatArray = moment - np.sum(moment * own, axis=1)[:, None] * own
        return lateral

    def outside(self, q: FloatArray) -> BoolArray:
        """Return which rows lie beyond the range of a curve, (n,)."""
        drivers = self.drivers(q, np.zeros(len(q)))
        found = np.zeros(len(q), dtype=bool)
        for term in self.joint_terms:
            if term.function.driver != 'temperature':
                found |= term.function.outside(drivers.of(term.function))
        return found

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters whose covariance is known, in order."""
        joints = self.chain.joint_names
        origins = (*joints, 'tool')
        names = [f'joint_offset.{joint}' for joint in joints]
        for sensor in self.T_R_N:
            names += [f'registration.{sensor}.{axis}' for axis in ('x', 'y', 'z', *_TURNS)]
        for marker in self.markers:
            names += [f'marker.{marker}.{axis}' for axis in 'xyz']
        for i, term in enumerate(self.joint_terms):
            names += [f'joint_term.{i}.{j}' for j in range(term.function.size)]
        for i in range(len(self.base_terms)):
            names += [f'base_term.{i}.{axis}' for axis in 'xyz']
        for kind in ('geometry', 'growth'):
            for origin in origins:
                names += [f'{kind}.{origin}.{axis}' for axis in ('x', 'y', 'z', *_TURNS)]
        names += [f'lateral_compliance.{joint}' for joint in joints]
        return tuple(names)

    def registration(self, sensor: str) -> tuple[slice, slice]:
        """Return where shifts and turns of a registration stand among the parameters."""
        start = self.joints + 6 * list(self.T_R_N).index(sensor)
        return slice(start, start + 3), slice(start + 3, start + 6)

    def marker(self, marker: str) -> slice:
        """Return where a marker stands among the parameters."""
        start = self.joints + 6 * len(self.T_R_N) + 3 * list(self.markers).index(marker)
        return slice(start, start + 3)

    @cached_property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the parameters."""
        chain, units = (
            self.chain,
            {
                'marker': 'm',
                'lateral_compliance': 'rad/(N m)',
            },
        )
        found = []
        for name in self.parameter_names:
            kind, _, rest = name.partition('.')
            if kind in units:
                found.append(units[kind])
            elif kind == 'joint_offset':
                found.append(chain.units[chain.joint_names.index(rest)])
            elif kind == 'joint_term':
                term = self.joint_terms[int(rest.split('.')[0])]
                found.append(unit_of(term.function, chain, chain.units[term.joint]))
            elif kind == 'base_term':
                found.append(unit_of(self.base_terms[int(rest.split('.')[0])].function, chain))
            else:
                unit = 'rad' if rest.rpartition('.')[2] in _TURNS else 'm'
                found.append(f'{unit}/K' if kind == 'growth' else unit)
        return tuple(found)

    @cached_property
    def parameter_means(self) -> FloatArray:
        """Values of the parameters; those of the registrations are steps from `T_R_N`, and 0."""
        parts = [
            self.joint_offsets,
            np.zeros(6 * len(self.T_R_N)),
            *self.markers.values(),
            *(term.coefficients for term in self.joint_terms),
            *(term.coefficients for term in self.base_terms),
            *(
                np.concatenate((one.shifts, one.turns), axis=1).ravel()
                for one in (self.geometry, self.growth)
            ),
            self.lateral_compliance,
        ]
        return np.concatenate(parts)

    def moved(self, step: FloatArray) -> ArmModel:
        """Return the arm with its parameters moved, (p,)."""
        k, at = self.joints, 0

        def take(count: int) -> FloatArray:
            nonlocal at
            at += count
            return step[at - count : at]

        def origins(geometry: Geometry) -> Geometry:
            both = take(6 * (k + 1)).reshape(k + 1, 6)
            return Geometry(geometry.shifts + both[:, :3], geometry.turns + both[:, 3:])

        def terms(given: tuple[Term, ...]) -> tuple[Term, ...]:
            return tuple(
                replace(one, coefficients=one.coefficients + take(len(one.coefficients)))
                for one in given
            )

        # In the order of `parameter_names`.
        joint_offsets = self.joint_offsets + take(k)
        T_R_N = {}
        for sensor, T in self.T_R_N.items():
            shift, turn = take(3), take(3)
            T_R_N[sensor] = transform(rotation_vector_to_matrix(turn), shift) @ T
        return replace(
            self,
            joint_offsets=joint_offsets,
            T_R_N=T_R_N,
            markers={name: place + take(3) for name, place in self.markers.items()},
            joint_terms=terms(self.joint_terms),
            base_terms=terms(self.base_terms),
            geometry=origins(self.geometry),
            growth=origins(self.growth),
            lateral_compliance=self.lateral_compliance + take(k),
        )

    def derivative(self, state: State, sensor: str, marker: str) -> FloatArray:
        """Return the derivative of a marker's place, in R as `sensor` has it, (n, 3, p)."""
        n, k, drivers = len(state.angles), self.joints, state.drivers
        points = apply(state.tool, self.markers[marker])
        arms = points[:, None, :] - state.frames[..., :3, 3]
        by_joint = self.chain.velocities(state.frames, points)
        parts = [by_joint]
        for name in self.T_R_N:
            mine = np.zeros((n, 3, 6))
            if name == sensor:
                # The sensor further along is the arm further back.
                mine[:, :, :3] = -np.eye(3)
                mine[:, :, 3:] = -_turned(np.eye(3)[None], points)
            parts.append(mine)
        for name in self.markers:
            parts.append(state.tool[:, :3, :3] * (name == marker))
        for term in self.joint_terms:
            features = term.function.features(drivers.of(term.function))
            parts.append(by_joint[:, :, [term.joint]] * features[:, None, :])
        for base_term in self.base_terms:
            features = self._base_features(drivers, base_term)
            parts.append(_turned(np.eye(3)[None], points) * features[:, None, :])
        moved = np.zeros((n, 3, k + 1, 6))
        for j in range(k + 1):
            link = state.frames[:, j - 1] if j else self._base_frame(drivers)
            origin = state.before[:, j] if j < k else state.tool
            moved[:, :, j, :3] = link[:, :3, :3]
            moved[:, :, j, 3:] = _turned(origin[:, :3, :3], points - origin[:, :3, 3])
        of_origins = moved.reshape(n, 3, -1)
        parts += [of_origins, drivers.warming[:, None, None] * of_origins]
        lateral = [
            np.cross(self._lateral(drivers, state.frames[:, j], j), arms[:, j]) for j in range(k)
        ]
        parts.append(np.stack(lateral, axis=-1))
        return np.concatenate(parts, axis=2)

    def _base_frame(self, drivers: Drivers) -> FloatArray:
        return transform(rotation_vector_to_matrix(self._base_turn(drivers)), np.zeros(3))

    def in_sensor(self, state: State, sensor: str, marker: str) -> FloatArray:
        """Return where a sensor sees a marker, in its frame N, m, (n, 3)."""
        return apply(inverse(self.T_R_N[sensor]), apply(state.tool, self.markers[marker]))


_TURNS = ('rx', 'ry', 'rz')
_UNITS = {'gravity_moment': '(N m)', 'temperature': 'K'}


def unit_of(function: Function, chain: SerialChain, of: str = 'rad') -> str:
    """Return the unit of a function's coefficients; ``of``: that of what they add to."""
    if function.form not in ('linear', 'quadratic'):
        return of
    unit = _UNITS.get(function.driver, '')
    if function.driver == 'angle':
        unit = chain.units[function.joint]
    elif function.driver == 'gravity_torque':
        unit = chain.torque_units[function.joint]
    return f'{of}/{unit}{"^2" if function.form == "quadratic" else ""}'


def _turned(axes: FloatArray, arms: FloatArray) -> FloatArray:
    """Return what turning about the columns of rotations (n, 3, 3) does to arms (n, 3)."""
    return np.swapaxes(np.cross(np.swapaxes(axes, -1, -2), arms[:, None, :]), -1, -2)
