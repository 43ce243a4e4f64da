# SPDX-License-Identifier: Apache-2.0
"""Commands that bring the tool to the pose that the nominal robot would have, and the inverse.

The wanted tool pose is that of the *nominal* robot at the wanted joints. Newton steps lead to it,
within a budget: no joint is changed by more than `MOST_RAD`, or by its own errors if these are
larger. Near a singularity the budget does not suffice, and the best pose on its bound is taken. Of
all changes that do equally well the smallest is made: seven joints change no more than they must.

Prismatic joints have metres in place of radians, and count by `SerialChain.per_radian`. A shift
counts in levers of the arm, so that a small arm is commanded as a large one of its shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.compensation.arm_model import BLOCK_ROWS, ArmModel
from remaster_ros.compensation.bounded_poses import nearest
from remaster_ros.kinematics.transforms import apply, matrix_to_rotation_vector
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Largest change of a joint, rad: zero-offsets are fractions of 2 degrees, and an arm with larger
# ones was dismounted or is another model.
MOST_RAD = float(np.deg2rad(2.0))
# Rounding error of the difference of command and wanted angle, rad.
ROUNDING_RAD = 1e-9
# Size of a tool in levers of its arm. If a pose is not corrected in full, a rotation counts by the
# shift at this distance: with 5 cm at a metre, tip and a marker 10 cm away err alike.
TOOL_SIZE = 0.05
# Fixed-point iterations before the Newton steps. Each reduces the error by the largest slope of
# the terms, some hundredths.
FIXED_POINT_STEPS = 2
# Largest residual of a pose that counts as corrected, m and rad: no sensor resolves less.
CORRECTED = 1e-5


@dataclass(frozen=True, eq=False)
class Correction:
    """Corrected joint commands for n rows of wanted angles, and the errors that they leave."""

    command: FloatArray  # Joint angles to command, rad, (n, k)
    # Remaining position and orientation error of the tool, if the model is right, (n,)
    residual_m: FloatArray
    residual_rad: FloatArray
    incomplete: BoolArray  # Mask of rows whose pose is not corrected in full, (n,)
    # Mask of rows beyond the angles at which a curve was measured: its end value holds, (n,)
    outside_range: BoolArray


class Compensator:
    """Computes corrected joint commands of a calibrated arm, and the inverse.

    Parameters
    ----------
    model
        The calibrated arm.
    most_rad
        Largest change of a joint, rad.
    """

    def __init__(self, model: ArmModel, most_rad: float = MOST_RAD) -> None:
        self.model, self.most_rad = model, most_rad

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the components of a pose error, (6,): 1 / lever for m, 0.05 for rad.

        The lever is the largest displacement of the tip per radian of a joint, m.
        """
        chain = self.model.chain
        frames = chain.frames(self.model.sampled_angles())
        tips = (frames[:, -1] @ chain.T_fixed[-1])[:, :3, 3]
        shifts = chain.per_radian * chain.velocities(frames, tips)
        lever = float(np.linalg.norm(shifts, axis=1).max())
        return np.repeat((1.0 / lever, TOOL_SIZE), 3)

    def angle_errors(self, q: FloatArray, warming: FloatArray | None = None) -> FloatArray:
        """Change of angles q (n, k) that removes the joint angles' errors alone, (n, k).

        rad or m; lengths, tilts and the base are not corrected. ``warming``: temperature above
        the reference, K, (n,); None for that of the model's mean temperature.
        """
        warming = self.model.warming(len(q), None) if warming is None else warming
        command = q
        for _ in range(FIXED_POINT_STEPS):
            command = q - self.model.added_angles(self.model.drivers(command, warming))
        return command - q

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the k joints, base to tip."""
        return self.model.chain.joint_names

    def command(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Joint angles to command so that the tool is where the nominal robot has it.

        Parameters
        ----------
        q
            Wanted joint angles, those of the nominal robot, rad, (..., k).
        temperature_c
            Temperature of the arm, °C, one or one for each row; None for that of the measurements.

        Returns
        -------
        ndarray
            rad, (..., k).

        Raises
        ------
        ValueError
            ``q`` has a wrong shape, or a number of it is not finite.
        """
        return self._rows(lambda rows, warm: self._solved(rows, warm)[0], q, temperature_c)

    def true(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Joint angles at which the nominal robot has its tool where the arm has it, (..., k).

        The inverse of `command`: ``true(command(q))`` is q, wherever a pose is corrected in
        full. Raises ValueError for a wrong shape or numbers that are not finite.

        Parameters
        ----------
        q, temperature_c
            Reported joint angles, rad, (..., k), and as in `command`.
        """
        return self._rows(lambda rows, warm: rows + self._way_back(rows, warm), q, temperature_c)

    def correct(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> Correction:
        """Commands (n, k) for wanted angles q (n, k), with the errors that remain.

        Also masks of the rows that are not corrected in full, and of those beyond the measured
        range of a curve. ``temperature_c``: °C, one or (n,); None for the mean of the
        measurements. Raises ValueError for another shape or numbers that are not finite.
        """
        wanted = self._checked(q).reshape(-1, self.model.joints)
        warming = self.model.warming(len(wanted), _given(temperature_c))
        command, error = np.empty_like(wanted), np.empty((len(wanted), 6))
        for rows in _blocks(len(wanted)):
            command[rows], error[rows] = self._solved(wanted[rows], warming[rows])
        return self.correction(command, error)

    def correction(self, command: FloatArray, error: FloatArray) -> Correction:
        """Commands that are corrected, with what they leave of the pose errors.

        ``command``: corrected joint angles, rad or m, (n, k); ``error``: of the tool after it,
        shift, m, and rotation vector, rad, (n, 6). A row is incomplete if more than 1e-5 m or
        rad (`CORRECTED`) is left.
        """
        shift, turn = (np.linalg.norm(part, axis=1) for part in np.split(error, 2, axis=1))
        incomplete = np.maximum(shift, turn) > CORRECTED
        return Correction(command, shift, turn, incomplete, self.model.outside(command))

    def tool(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Pose T_R_T of the calibrated arm's tool at reported joint angles (..., k), (..., 4, 4).

        ``temperature_c``: as in `command`. Raises ValueError for another shape or numbers that
        are not finite.
        """
        q = self._checked(q)
        rows = q.reshape(-1, self.model.joints)
        found = self.model.state(rows, self._temperature(q, temperature_c)).tool
        return found.reshape(*q.shape[:-1], 4, 4)

    def uncertainty(
        self,
        q: ArrayLike,
        sensor: str | None = None,
        marker: str | None = None,
        temperature_c: ArrayLike | None = None,
    ) -> FloatArray:
        """Mean square error of the marker's position, m², (..., 3, 3), along axes of the base R.

        The error is that in the frame of the sensor, at wanted joint angles after correction,
        with the base frame and tool of the file. It contains the uncertainty of offsets, other
        corrected effects, registration and marker, times the factor ``widening`` of the file
        (how much larger the errors at held-out poses are than expected), and the errors that
        the command leaves. If only zero-offsets are corrected, it contains lengths and tilts
        that stay nominal.

        Parameters
        ----------
        q
            Wanted joint angles, rad, (..., k).
        sensor, marker
            Names in the file; None for the first.
        temperature_c
            As in `command`.
        """
        q = self._checked(q)
        spread = self.spread(q, sensor, marker, temperature_c)
        found: FloatArray = spread @ np.swapaxes(spread, -1, -2)
        return found

    def spread(
        self,
        q: ArrayLike,
        sensor: str | None = None,
        marker: str | None = None,
        temperature_c: ArrayLike | None = None,
    ) -> FloatArray:
        """Square root L, m, (..., 3, r), of the mean square error of `uncertainty`, which is L L'.

        Each of the r columns is the effect of one independent error on the position in every
        row, so that the errors of different rows can be combined; the last one is the error
        that the commands leave. Arguments as of `uncertainty`.
        """
        model = self.model
        q = self._checked(q)
        rows = q.reshape(-1, model.joints)
        warming = model.warming(len(rows), self._temperature(q, temperature_c))
        sensor = next(iter(model.T_R_N)) if sensor is None else sensor
        marker = next(iter(model.markers)) if marker is None else marker
        root = model.widening * model.root if model.error_root is None else model.error_root
        place, found = model.markers[marker], np.zeros((len(rows), 3, len(root) + 1))
        for block in _blocks(len(rows)):
            state = model._state(model.drivers(rows[block], warming[block]))
            found[block, :, :-1] = model.derivative(state, sensor, marker) @ root.T
            command = self._solved(rows[block], warming[block])[0]
            wanted = model.chain.forward(rows[block])
            reached = model._state(model.drivers(command, warming[block])).tool
            found[block, :, -1] = apply(reached, place) - apply(wanted, place)
        return found.reshape(*q.shape[:-1], 3, len(root) + 1)

    def _rows(
        self,
        solve: Callable[[FloatArray, FloatArray], FloatArray],
        q: ArrayLike,
        temperature_c: ArrayLike | None,
    ) -> FloatArray:
        """Angles that ``solve`` returns for angles q, (..., k) each, in blocks of rows.

        ``solve``: function of angles (n, k) and temperatures above the reference, K, (n,),
        that returns angles (n, k); ``temperature_c``: °C, as in `command`. Raises ValueError
        for a wrong shape or numbers that are not finite.
        """
        q = self._checked(q)
        rows = q.reshape(-1, self.model.joints)
        warming = self.model.warming(len(rows), self._temperature(q, temperature_c))
        found = np.empty_like(rows)
        for block in _blocks(len(rows)):
            found[block] = solve(rows[block], warming[block])
        return found.reshape(q.shape)

    def _temperature(self, q: FloatArray, given: ArrayLike | None) -> FloatArray | None:
        """Temperatures, °C, broadcast to the rows of q, (rows,); None if none are given.

        Raises ValueError if they cannot be broadcast to q's shape without its last axis.
        """
        if given is None:
            return None
        return np.broadcast_to(np.asarray(given, dtype=float), q.shape[:-1]).reshape(-1)

    def _checked(self, q: ArrayLike) -> FloatArray:
        """Joint angles as an array of floats, (..., k).

        Raises ValueError for a wrong shape or numbers that are not finite.
        """
        q = np.asarray(q, dtype=float)
        if q.ndim == 0 or q.shape[-1] != self.model.joints:
            raise ValueError(f'q has shape {q.shape}; its last size must be {self.model.joints}')
        if not np.all(np.isfinite(q)):
            raise ValueError('a joint angle is not a finite number')
        return q

    def _solved(self, wanted: FloatArray, warming: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Commands (n, k), and the pose errors that they leave, m and rad, (n, 6).

        ``wanted``: joint angles, rad or m, (n, k); ``warming``: temperature above the
        reference, K, (n,). A joint is changed by ``most_rad`` at most, or, if the error of its
        angle (`angle_errors`) is larger, by as much as this error; what that cannot correct
        remains.
        """
        problem = PoseProblem(self, wanted, warming)
        budget = problem.budget
        change = nearest(problem.of_rows, problem.angle_change, (-budget, budget))
        return wanted + self.model.chain.per_radian * change, problem.remaining_error(change)

    def problem(self, q: FloatArray, temperature_c: float | None = None) -> PoseProblem:
        """Pose errors at wanted angles q, (n, k), as a function of joint changes.

        ``temperature_c``: of the arm, °C; None for the mean of the measurements.
        """
        return PoseProblem(self, q, self.model.warming(len(q), temperature_c))

    def _way_back(self, reported: FloatArray, warming: FloatArray) -> FloatArray:
        """Nominal robot's angles minus reported angles, rad or m, (n, k), for the same tool pose.

        ``warming``: temperature above the reference, K, (n,). A joint is changed by
        ``most_rad`` at most, or, if its offset and terms together are larger, by as much as
        these.
        """
        added = self.model.added_angles(self.model.drivers(reported, warming))
        added /= self.model.chain.per_radian
        budget = np.maximum(self.most_rad, np.abs(added))
        return self.nominal_within(reported, warming, (-budget, budget), added)

    def nominal_within(
        self,
        reported: FloatArray,
        warming: FloatArray,
        bounds: tuple[FloatArray, FloatArray],
        start: FloatArray,
    ) -> FloatArray:
        """Nominal robot's angles minus reported ones, rad or m, (n, k), within bounds.

        With it the nominal robot's tool pose is that of the arm at the reported angles, or, if
        the bounds do not allow this, the nearest. ``reported``: joint angles, rad or m, (n,
        k); ``warming``: temperature above the reference, K, (n,); ``bounds``: least and
        largest difference, in rad or `SerialChain.per_radian`, (n, k) each; ``start``: initial
        difference within the bounds, in that unit, (n, k).
        """
        model, unit, weights = self.model, self.model.chain.per_radian, self.weights
        state = model._state(model.drivers(reported, warming))
        # A command has no component in the null space of the tool's motion; so the way back has
        # none either.
        right = np.linalg.svd(self.jacobian(state.frames, state.tool), full_matrices=False)[2]
        idle = np.eye(model.joints) - right.swapaxes(1, 2) @ right

        def errors(change: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
            frames = model.chain.frames(reported[rows] + unit * change)
            tool = frames[:, -1] @ model.chain.T_fixed[-1]
            error = _pose_error(state.tool[rows], tool)
            return weights * error, weights[:, None] * self.jacobian(frames, tool)

        return unit * nearest(errors, start, bounds, idle)

    def jacobian(self, frames: FloatArray, tool: FloatArray) -> FloatArray:
        """Geometric Jacobian of the tool, shift, m, then rotation, rad, (n, 6, k).

        Along axes of the robot base frame R, per radian of each joint, or per
        `SerialChain.per_radian` if prismatic. ``frames``: of the joints in R, (n, k, 4, 4);
        ``tool``: pose of the tool in R, (n, 4, 4).
        """
        chain = self.model.chain
        axes = chain.axes_in_base(frames) * ~chain.slides[:, None]
        shifts = chain.velocities(frames, tool[:, :3, 3])
        return chain.per_radian * np.concatenate((shifts, axes.swapaxes(1, 2)), axis=1)


class PoseProblem:
    """Pose errors of the arm at n wanted angles as a function of changes of the joints.

    Changes count in radians, or in `SerialChain.per_radian` for prismatic joints; errors are
    weighted by `Compensator.weights`.
    """

    def __init__(self, compensator: Compensator, wanted: FloatArray, warming: FloatArray) -> None:
        self._compensator, self._model = compensator, compensator.model
        self.wanted, self._warming = wanted, warming
        self._target = self._model.chain.forward(wanted)
        # Change that removes the errors of the joint angles alone, and the largest change, (n, k)
        self.angle_change = (
            compensator.angle_errors(wanted, warming) / self._model.chain.per_radian
        )
        self.budget = np.maximum(compensator.most_rad, np.abs(self.angle_change))

    def of_rows(self, change: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Weighted errors (m, 6) and Jacobians (m, 6, k) of poses at joint changes (m, k).

        ``rows``: indices (m,) of the wanted angles that are changed.
        """
        model, weights = self._model, self._compensator.weights
        command = self.wanted[rows] + model.chain.per_radian * change
        state = model._state(model.drivers(command, self._warming[rows]))
        jacobian = self._compensator.jacobian(state.frames, state.tool)
        return weights * _pose_error(self._target[rows], state.tool), weights[:, None] * jacobian

    def errors(self, change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted errors (n, 6) and Jacobians (n, 6, k) at changes (n, k) of all rows."""
        return self.of_rows(change, np.arange(len(self.wanted)))

    def remaining_error(self, change: FloatArray) -> FloatArray:
        """Pose error after a change (n, k), unweighted: shift, m, rotation, rad, (n, 6)."""
        return self.errors(change)[0] / self._compensator.weights


def _pose_error(target: FloatArray, reached: FloatArray) -> FloatArray:
    """Error of poses ``reached`` against their targets, (n, 4, 4) each, m and rad, (n, 6).

    Shift of the origin, then rotation vector from the target to the pose reached, along axes
    of the robot base frame R.
    """
    turn = reached[:, :3, :3] @ np.swapaxes(target[:, :3, :3], 1, 2)
    shift = reached[:, :3, 3] - target[:, :3, 3]
    return np.concatenate((shift, matrix_to_rotation_vector(turn)), axis=1)


def _blocks(rows: int) -> list[slice]:
    """Consecutive slices of at most `BLOCK_ROWS` rows that cover this number of rows; [] for 0."""
    return [slice(start, start + BLOCK_ROWS) for start in range(0, rows, BLOCK_ROWS)]


def _given(temperature_c: ArrayLike | None) -> FloatArray | None:
    """Temperatures as an array; None if none are given."""
    return None if temperature_c is None else np.asarray(temperature_c, dtype=float)
