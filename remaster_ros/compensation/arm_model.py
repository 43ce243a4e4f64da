# SPDX-License-Identifier: Apache-2.0
"""Calibrated model of an arm: pose of its tool at reported joint angles, with uncertainty.

With q the reported angles, δ the zero-offsets and τ gravity's torques at q + δ::

    true angle of joint j = q_j + δ_j + Σ terms of joint j
    tool = base turn · Π_j (T_j · shift_j · turn_j · Rot(axis_j, true angle_j)) · T_tool

A prismatic joint has metres in place of radians, the shift along its axis in place of Rot, and the
force along its axis, N, in place of gravity's torque.

T_j is the nominal origin of joint j. Shifts are in the frame of the link that the joint before
moves, turns in the joint's own frame, and both may grow with the temperature. A link whose bearing
gives way is turned about its joint's origin by gravity's moment across the joint's axis.

Terms driven by an angle take the reported angle; terms driven by a torque or a moment take that of
the nominal arm at q + δ.
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
# Number of configurations at which slopes are evaluated, and step of the finite differences, rad.
SAMPLED_ROWS, SLOPE_STEP = 500, 1e-6
# Rows that are computed at once: their frames and derivatives take some ten megabytes.
BLOCK_ROWS = 2_000


@dataclass(frozen=True, eq=False)
class Function:
    """Function of one driver (an angle, torque or temperature), linear in its coefficients."""

    driver: Driver  # Quantity on which the function depends
    form: Form  # Shape of the m features, one for each coefficient
    joint: int = -1  # Index of the joint whose angle or torque drives; -1 for other drivers
    order: int = 0  # Cycles per turn of a sine or cosine
    # Knots of splines, in the driver's unit; beyond the ends the end value holds
    knots: FloatArray = field(default_factory=lambda: np.zeros(0))
    degree: int = 0
    # Begin of the turn into which the driver is wrapped, rad; NaN for none (prismatic joint)
    turn_start: float = np.nan

    @property
    def size(self) -> int:
        """Number of coefficients m."""
        return len(self.knots) - self.degree - 1 if self.form == 'bspline' else 1

    def features(self, values: FloatArray) -> FloatArray:
        """Values of the m features at driver values (n,), (n, m).

        The function is their sum weighted by the coefficients. Splines first wrap the values
        into the turn at `turn_start`; beyond the first or last knot they hold the value of
        that end.
        """
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
        """Mask of the values beyond the ends of the splines, (n,); all False for other forms.

        The values of a joint that turns are first wrapped into the turn at `turn_start`.
        """
        if self.form != 'bspline':
            return np.zeros(len(values), dtype=bool)
        low, high = self.ends
        at, margin = self._in_turn(values), 1e-9 * (high - low)
        beyond: BoolArray = (at < low - margin) | (at > high + margin)
        return beyond

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest driver value, in its unit, at which the splines are defined.

        Meant for splines only (IndexError for forms without knots).
        """
        return float(self.knots[self.degree]), float(self.knots[-self.degree - 1])

    def _in_turn(self, values: FloatArray) -> FloatArray:
        """Values wrapped into the turn that begins at `turn_start`; unchanged if that is NaN."""
        if np.isnan(self.turn_start):
            return values
        found: FloatArray = self.turn_start + np.mod(values - self.turn_start, TURN)
        return found


@dataclass(frozen=True, eq=False)
class JointTerm:
    """Function of one driver that is added to the angle of a joint, besides its zero-offset."""

    joint: int  # Index of the joint
    effect: str  # The physical cause, as in discovery.json
    function: Function
    coefficients: FloatArray  # rad or m per unit of the features, (m,)


@dataclass(frozen=True, eq=False)
class BaseTerm:
    """Rotation of the whole arm about the origin of the robot base frame R, by one driver."""

    effect: str  # The physical cause
    # Function of one coefficient; with ``gravity_moment`` each axis of R has a moment of its own
    function: Function
    coefficients: FloatArray  # About x, y and z of R, rad per unit of the function, (3,)


Term = TypeVar('Term', JointTerm, BaseTerm)


@dataclass(frozen=True, eq=False)
class Geometry:
    """Shifts and rotations of the k joint origins and the tool (last), constant or per kelvin."""

    shifts: FloatArray  # In the frame of the link that the joint before moves, m, (k + 1, 3)
    turns: FloatArray  # Rotation vectors in the joint's frame, rad, (k + 1, 3)

    @classmethod
    def none(cls, joints: int) -> Geometry:
        """Geometry of an arm of this number of joints without a change: all zeros."""
        return cls(np.zeros((joints + 1, 3)), np.zeros((joints + 1, 3)))

    @property
    def is_any(self) -> bool:
        """Whether any shift or rotation is not zero."""
        return bool(np.any(self.shifts) or np.any(self.turns))


@dataclass(frozen=True, eq=False)
class Drivers:
    """Values, in n rows, of the quantities on which terms depend: angles, temperature, torques."""

    q: FloatArray  # Reported angles, rad, (n, k)
    warming: FloatArray  # Temperature above the reference temperature, K, (n,)
    # Gravity's torque on each joint, N m or N, (n, k); its moment about the origin of R, N m,
    # (n, 3); and on each link about its joint, N m, (n, k, 3). Zeros if no term needs them
    torque: FloatArray
    base_moment: FloatArray
    moment: FloatArray

    def of(self, function: Function) -> FloatArray:
        """Values of the quantity that drives a function, (n,).

        0 for the driver 'none' and for 'gravity_moment', which has three values
        (`base_moment`).
        """
        if function.driver == 'angle':
            return self.q[:, function.joint]
        if function.driver == 'gravity_torque':
            return self.torque[:, function.joint]
        if function.driver == 'temperature':
            return self.warming
        return np.zeros(len(self.q))


@dataclass(frozen=True, eq=False)
class State:
    """Joint angles, joint frames and tool pose of the calibrated arm in n rows."""

    drivers: Drivers
    angles: FloatArray  # True joint angles, rad, (n, k)
    # Frame of each joint before and after its turn, in R, (n, k, 4, 4)
    before: FloatArray
    frames: FloatArray
    tool: FloatArray  # T_R_T, (n, 4, 4)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Calibrated kinematics of an arm of k joints, with sensors, markers and covariance."""

    # The nominal robot, with the masses from which the torques were computed
    chain: SerialChain
    joint_offsets: FloatArray  # δ, rad, (k,)
    joint_terms: tuple[JointTerm, ...]
    base_terms: tuple[BaseTerm, ...]
    geometry: Geometry  # Constant changes of the origins
    growth: Geometry  # Changes of the origins per kelvin
    # Compliance of each link's bearing across the joint's axis, rad/(N m), (k,)
    lateral_compliance: FloatArray
    reference_c: float  # Temperature without growth, °C; NaN if nothing grows
    mean_c: float  # Mean temperature of the measurements, °C, used if none is given
    T_R_N: Mapping[str, FloatArray]  # Registrations that belong to the offsets, by sensor
    markers: Mapping[str, FloatArray]  # Positions in T that belong to the offsets, m, by marker
    root: FloatArray  # U with U' U the covariance of `parameter_names`, (r, p)
    # Factor by which standard deviations on poses left out were larger than in theory
    widening: float
    # E with E' E the second moments of the true parameters about these, (e, p); includes errors
    # that have no place in the correction. None if the covariance says all that is known
    error_root: FloatArray | None = None

    @classmethod
    def nominal(cls, chain: SerialChain) -> ArmModel:
        """The nominal arm, without sensors and markers."""
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
        """Whether any part of the model depends on the temperature."""
        return self.growth.is_any or 'temperature' in self._needs

    @cached_property
    def _needs(self) -> set[str]:
        """Names of the drivers of all terms; also 'lateral' if a bearing is compliant."""
        drivers: set[str] = {term.function.driver for term in self.joint_terms}
        drivers |= {term.function.driver for term in self.base_terms}
        return drivers | ({'lateral'} if np.any(self.lateral_compliance) else set())

    def warming(self, rows: int, temperature_c: FloatArray | float | None) -> FloatArray:
        """Temperature above the reference, K, (rows,).

        ``rows``: number of rows; ``temperature_c``: of the arm, °C, one number or (rows,);
        None for the mean temperature of the measurements. Zeros if nothing depends on the
        temperature.
        """
        if not self.grows:
            return np.zeros(rows)
        given = self.mean_c if temperature_c is None else np.asarray(temperature_c, dtype=float)
        return np.broadcast_to(given - self.reference_c, (rows,))

    def drivers(self, q: FloatArray, warming: FloatArray) -> Drivers:
        """Values of all drivers at reported joint angles q, rad or m, (n, k).

        Torques and moments are those of gravity on the nominal arm at q plus the zero-offsets;
        zeros if no term needs them. ``warming``: temperature above the reference, K, (n,).
        """
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
        """Sum of zero-offsets and terms, to be added to the reported angles, rad or m, (n, k)."""
        added = np.tile(self.joint_offsets, (len(drivers.q), 1))
        for term in self.joint_terms:
            values = term.function.features(drivers.of(term.function))
            added[:, term.joint] += values @ term.coefficients
        return added

    def sampled_angles(self) -> FloatArray:
        """Uniform random configurations within the limits, rad or m, (500, k), always the same.

        Limits of joints that turn are cut to ±pi.
        """
        low, high = self.chain.usual_range
        return np.random.default_rng(0).uniform(low, high, (SAMPLED_ROWS, self.joints))

    def largest_slope(self) -> float:
        """Largest row sum (infinity norm) of the Jacobian of `added_angles` by reported angles.

        At 500 sampled configurations and the reference temperature, rad per rad; a prismatic
        joint counts in units of `SerialChain.per_radian`. Below 1 there is one command for
        each wanted angle, to which the fixed-point iteration converges (Banach).
        """
        k, warming, unit = self.joints, np.zeros(SAMPLED_ROWS), self.chain.per_radian
        q = self.sampled_angles()
        here = self.added_angles(self.drivers(q, warming))
        slopes = np.zeros((SAMPLED_ROWS, k))
        for j in range(k):
            step = SLOPE_STEP * np.diag(unit)[j]
            there = self.added_angles(self.drivers(q + step, warming))
            slopes += np.abs(there - here) / unit / SLOPE_STEP
        return float(slopes.max())

    def state(self, q: FloatArray, temperature_c: FloatArray | float | None = None) -> State:
        """Joint angles, frames and tool pose of the arm at reported angles q, rad or m, (n, k).

        ``temperature_c``: °C, one number or (n,); None for the mean of the measurements.
        """
        return self._state(self.drivers(q, self.warming(len(q), temperature_c)))

    def rigid(self) -> SerialChain:
        """Serial chain with zero-offsets, lengths and tilts built in; it takes reported angles.

        Growth is that at the mean temperature of the measurements. Joint terms, base terms and
        compliance are left out.
        """
        origins = self._origins(self.warming(1, None)).reshape(-1, 4, 4)
        return replace(self.chain, T_fixed=origins).with_offsets(self.joint_offsets)

    def _state(self, drivers: Drivers) -> State:
        """State of the arm at n values of the drivers: angles with all terms, and frames.

        Frames of the joints and the tool are in the robot base frame R.
        """
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
        """Poses of the k joint origins and of the tool, each in the frame of the link before.

        (k + 1, 4, 4), nominal ones with shifts and rotations; (n, k + 1, 4, 4) if the arm
        grows with the temperature. ``warming``: temperature above the reference, K, (n,).
        """
        shifts, turns = self.geometry.shifts, self.geometry.turns
        if self.growth.is_any:
            shifts = shifts + warming[:, None, None] * self.growth.shifts
            turns = turns + warming[:, None, None] * self.growth.turns
        drawn = self.chain.T_fixed
        rotation = drawn[:, :3, :3] @ rotation_vector_to_matrix(turns)
        return transform(rotation, drawn[:, :3, 3] + shifts)

    def _base_turn(self, drivers: Drivers) -> FloatArray:
        """Rotation vector of the whole arm by all base terms, rad, (n, 3).

        About the axes of the robot base frame R.
        """
        turn = np.zeros((len(drivers.q), 3))
        for term in self.base_terms:
            turn += self._base_features(drivers, term) * term.coefficients
        return turn

    @staticmethod
    def _base_features(drivers: Drivers, term: BaseTerm) -> FloatArray:
        """Rotation of the base for a unit coefficient of a term about each axis, rad, (n, 3).

        Axes are those of the robot base frame R. For the driver 'gravity_moment': the moment
        about each axis, N m; for any other: the value of the term's function, the same for all
        three axes.
        """
        if term.function.driver == 'gravity_moment':
            return drivers.base_moment
        return np.repeat(term.function.features(drivers.of(term.function)), 3, axis=1)

    def _lateral(self, drivers: Drivers, frame: FloatArray, joint: int) -> FloatArray:
        """Gravity's moment about a joint, of all that it carries, without its part along the axis.

        N m, (n, 3), in the robot base frame R. ``frame``: of the joint in R, (n, 4, 4);
        ``joint``: index from 0.
        """
        axis = frame[:, :3, :3] @ self.chain.axes[joint]
        moment = drivers.moment[:, joint]
        lateral: FloatArray = moment - np.sum(moment * axis, axis=1)[:, None] * axis
        return lateral

    def outside(self, q: FloatArray) -> BoolArray:
        """Mask of the configurations at which the driver of a spline is beyond its knots, (n,).

        Of joint terms only, and not of those driven by the temperature. ``q``: reported
        angles, rad or m, (n, k).
        """
        drivers = self.drivers(q, np.zeros(len(q)))
        found = np.zeros(len(q), dtype=bool)
        for term in self.joint_terms:
            if term.function.driver != 'temperature':
                found |= term.function.outside(drivers.of(term.function))
        return found

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all p parameters, in the order of the columns of `root` and `error_root`.

        As 'joint_offset.JOINT', 'registration.SENSOR.rx', 'marker.MARKER.x', 'joint_term.0.0'.
        """
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
        """Slices of the parameters with shift (3) and rotation vector (3) of a sensor's pose.

        The pose is T_R_N, of the sensor frame N in the robot base frame R. Raises ValueError
        for an unknown sensor.
        """
        start = self.joints + 6 * list(self.T_R_N).index(sensor)
        return slice(start, start + 3), slice(start + 3, start + 6)

    def marker(self, marker: str) -> slice:
        """Slice of the parameters with a marker's position (3); ValueError for an unknown name."""
        start = self.joints + 6 * len(self.T_R_N) + 3 * list(self.markers).index(marker)
        return slice(start, start + 3)

    @cached_property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the parameters, in the order of `parameter_names`."""
        chain, units = (
            self.chain,
            {
                'marker': 'm',
                'lateral_compliance': 'rad/(N m)',
            },
        )
        found = []
        for name in self.parameter_names:
            kind, _, suffix = name.partition('.')
            if kind in units:
                found.append(units[kind])
            elif kind == 'joint_offset':
                found.append(chain.units[chain.joint_names.index(suffix)])
            elif kind == 'joint_term':
                term = self.joint_terms[int(suffix.split('.')[0])]
                found.append(unit_of(term.function, chain, chain.units[term.joint]))
            elif kind == 'base_term':
                found.append(unit_of(self.base_terms[int(suffix.split('.')[0])].function, chain))
            else:
                unit = 'rad' if suffix.rpartition('.')[2] in _TURNS else 'm'
                found.append(f'{unit}/K' if kind == 'growth' else unit)
        return tuple(found)

    @cached_property
    def parameter_means(self) -> FloatArray:
        """Values of the parameters, (p,), in the order of `parameter_names`.

        0 for registrations, whose parameters are steps from `T_R_N`.
        """
        parts = [
            self.joint_offsets,
            np.zeros(6 * len(self.T_R_N)),
            *self.markers.values(),
            *(term.coefficients for term in self.joint_terms),
            *(term.coefficients for term in self.base_terms),
            *(
                np.concatenate((geometry.shifts, geometry.turns), axis=1).ravel()
                for geometry in (self.geometry, self.growth)
            ),
            self.lateral_compliance,
        ]
        return np.concatenate(parts)

    def with_step(self, step: FloatArray) -> ArmModel:
        """Return a new model whose parameters are these plus a step (p,), as `parameter_names`.

        The pose T_R_N of a sensor is moved in the robot base frame R by shift and rotation
        vector: T_R_N becomes step T_R_N.
        """
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
                replace(term, coefficients=term.coefficients + take(len(term.coefficients)))
                for term in given
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
        """Derivative of a marker's position by all p parameters, (n, 3, p), m per unit.

        In the robot base frame R, for the marker as ``sensor`` measures it: the columns of a
        shift or rotation of this sensor are minus the motion of the marker by that shift or
        rotation of the arm. Columns of other sensors and markers are 0. Raises KeyError for an
        unknown marker.
        """
        n, k, drivers = len(state.angles), self.joints, state.drivers
        points = apply(state.tool, self.markers[marker])
        arms = points[:, None, :] - state.frames[..., :3, 3]
        by_joint = self.chain.velocities(state.frames, points)
        parts = [by_joint]
        for name in self.T_R_N:
            selection = np.zeros((n, 3, 6))
            if name == sensor:
                # A shift of the sensor moves the arm by the opposite in its frame.
                selection[:, :, :3] = -np.eye(3)
                selection[:, :, 3:] = -_displacements(np.eye(3)[None], points)
            parts.append(selection)
        for name in self.markers:
            parts.append(state.tool[:, :3, :3] * (name == marker))
        for term in self.joint_terms:
            features = term.function.features(drivers.of(term.function))
            parts.append(by_joint[:, :, [term.joint]] * features[:, None, :])
        for base_term in self.base_terms:
            features = self._base_features(drivers, base_term)
            parts.append(_displacements(np.eye(3)[None], points) * features[:, None, :])
        by_origins = np.zeros((n, 3, k + 1, 6))
        for j in range(k + 1):
            link = state.frames[:, j - 1] if j else self._base_frame(drivers)
            origin = state.before[:, j] if j < k else state.tool
            by_origins[:, :, j, :3] = link[:, :3, :3]
            by_origins[:, :, j, 3:] = _displacements(origin[:, :3, :3], points - origin[:, :3, 3])
        of_origins = by_origins.reshape(n, 3, -1)
        parts += [of_origins, drivers.warming[:, None, None] * of_origins]
        lateral = [
            np.cross(self._lateral(drivers, state.frames[:, j], j), arms[:, j]) for j in range(k)
        ]
        parts.append(np.stack(lateral, axis=-1))
        return np.concatenate(parts, axis=2)

    def _base_frame(self, drivers: Drivers) -> FloatArray:
        """Pose in the robot base frame R of the base, turned by all base terms, (n, 4, 4)."""
        return transform(rotation_vector_to_matrix(self._base_turn(drivers)), np.zeros(3))

    def in_sensor(self, state: State, sensor: str, marker: str) -> FloatArray:
        """Predicted position of a marker in the frame N of a sensor, m, (n, 3), without noise.

        Raises KeyError for an unknown sensor or marker.
        """
        return apply(inverse(self.T_R_N[sensor]), apply(state.tool, self.markers[marker]))


_TURNS = ('rx', 'ry', 'rz')
_UNITS = {'gravity_moment': '(N m)', 'temperature': 'K'}


def unit_of(function: Function, chain: SerialChain, unit_of_sum: str = 'rad') -> str:
    """Unit of a function's coefficients, such as 'rad/(N m)' or 'rad/K'.

    ``unit_of_sum``: unit of the quantity to which the function is added. The coefficients have
    this unit; those of a linear function, divided by the unit of its driver; those of a
    quadratic one, by the square of it.
    """
    if function.form not in ('linear', 'quadratic'):
        return unit_of_sum
    unit = _UNITS.get(function.driver, '')
    if function.driver == 'angle':
        unit = chain.units[function.joint]
    elif function.driver == 'gravity_torque':
        unit = chain.torque_units[function.joint]
    return f'{unit_of_sum}/{unit}{"^2" if function.form == "quadratic" else ""}'


def _displacements(axes: FloatArray, arms: FloatArray) -> FloatArray:
    """Displacement of points per radian of rotation about each of three axes, m, (n, 3, 3).

    ``axes``: the axes as columns, (n, 3, 3) or (1, 3, 3); ``arms``: vectors from the axes to
    the points, m, (n, 3). Column j belongs to axis j.
    """
    return np.swapaxes(np.cross(np.swapaxes(axes, -1, -2), arms[:, None, :]), -1, -2)
