"""What to command so that the tool comes to where the nominal robot would have it, and back.

The tool pose that is wanted is that of the *nominal* robot at the wanted joints. First the errors
of the joint angles are taken off, by fixed point; what lengths and tilts leave is taken off by
Newton steps on the full pose, with the nominal Jacobian. Near a singularity a pose is corrected
only along the directions in which the arm can move: each of them fades smoothly to nothing where
it needs too much joint motion. There the errors of the joint angles are still taken off.

What slides has metres for radians, and counts by `SerialChain.per_radian`.

A shift counts in levers of the arm: a small arm is no nearer to its singularities than a large one
of its shape. A direction of size s that fades below b takes off the share 3 u² − 2 u³ of an error
ε, u = s / b: its motion (3 u − 2 u²) ε / b has the curvature 4 ε / b³ over s, and s changes by no
more than one a radian of all k joints together. So what is added to an acceleration stays within
that of joints that go over a radian for b³ = 4 k ε: where errors are small, directions fade later.
None fades above `FADES_BELOW`, whatever the errors: a trajectory makes up for the rest by time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.compensation.arm_model import BLOCK_ROWS, ArmModel
from remaster_ros.kinematics.transforms import matrix_to_rotation_vector
from remaster_ros.types import BoolArray, FloatArray

# Shift of the tool for a radian below which a direction fades at the most, m/rad.
FADES_BELOW = 0.2
# The same of what seven joints do without their tool, in levers for a radian.
KEPT_BELOW = 0.2
# The fixed point converges by the largest slope of the terms, some hundredths; the pose by the
# square of the errors.
FIXED_POINT_STEPS = 2
NEWTON_STEPS = 2
# Back to the wanted joints: fixed point of the command, up to this, rad.
BACK_TO = 1e-12
MOST_STEPS_BACK = 60


@dataclass(frozen=True, eq=False)
class Correction:
    """What was done to n rows of wanted joint angles."""

    command: FloatArray  # What to command, rad, (n, k)
    # How far the tool remains from where it is wanted, if the model is right, (n,)
    residual_m: FloatArray
    residual_rad: FloatArray
    faded: BoolArray  # Rows near a singularity, in which not all of the pose is corrected, (n,)
    # Rows beyond the angles at which a curve was measured: its end value holds, (n,)
    outside_range: BoolArray


class Compensator:
    """A correction that is ready to use.

    Parameters
    ----------
    model
        The arm as it was found to be.
    """

    def __init__(self, model: ArmModel) -> None:
        self.model = model

    @cached_property
    def _typical(self) -> tuple[float, tuple[float, ...]]:
        """The longest lever, m, and how large errors are that joints leave all over the limits.

        Their mean square as a polynomial of the warming, three coefficients, levers² and rad².
        """
        model = self.model
        q = model.somewhere()
        target, jacobian = self._nominal(q)
        lever = float(np.linalg.norm(jacobian[:, :3], axis=1).max())
        errors = []
        for kelvin in (0.0, 1.0):
            warming = np.full(len(q), kelvin)
            command = self._angles_taken_off(q, warming)
            error = _pose_error(target, model._state(model.drivers(command, warming)).tool)
            errors.append(error / np.repeat((lever, 1.0), 3))
        cold, a_kelvin = errors[0], errors[1] - errors[0]
        parts = ((1.0, cold, cold), (2.0, cold, a_kelvin), (1.0, a_kelvin, a_kelvin))
        return lever, tuple(float(c * np.mean(np.sum(a * b, axis=1))) for c, a, b in parts)

    def _fades_below(self, warming: FloatArray) -> FloatArray:
        """Return the size of a direction below which it fades, in levers and rad, (n, 1)."""
        lever, parts = self._typical
        square = parts[0] + warming * (parts[1] + warming * parts[2])
        # No error is known to be smaller than what rounding leaves.
        typical = np.sqrt(np.maximum(square, np.finfo(float).eps ** 2))
        wide = np.cbrt(4.0 * self.model.joints * typical)
        return np.minimum(FADES_BELOW / lever, wide)[:, None]

    def _nominal(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the nominal tool poses, (n, 4, 4), and Jacobians in R, m and rad, (n, 6, k).

        Of a radian of each joint, or of what counts as one.
        """
        chain = self.model.chain
        frames = chain.frames(q)
        target = frames[:, -1] @ chain.T_fixed[-1]
        axes = chain.axes_in_base(frames) * ~chain.slides[:, None]
        shifts = chain.velocities(frames, target[:, :3, 3])
        return target, chain.per_radian * np.concatenate((shifts, axes.swapaxes(1, 2)), axis=1)

    def _angles_taken_off(self, wanted: FloatArray, warming: FloatArray) -> FloatArray:
        model, command = self.model, wanted.copy()
        for _ in range(FIXED_POINT_STEPS):
            command = wanted - model.added_angles(model.drivers(command, warming))
        return command

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the k joints, base to tip."""
        return self.model.chain.joint_names

    def command(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Return what to command so that the tool is where the nominal robot has it.

        Parameters
        ----------
        q
            Wanted joint angles, those of the nominal robot, rad, (..., k).
        temperature_c
            Of the arm, °C, one or one a row; None for that of the measurements.

        Returns
        -------
        ndarray
            rad, (..., k).
        """
        return self._rows(lambda rows, warm: self._solved(rows, warm)[0], q, temperature_c)

    def true(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Return the joint angles at which the nominal robot has its tool where the arm has it.

        The inverse of `command`: ``true(command(q))`` is q, also near singularities.

        Parameters
        ----------
        q, temperature_c
            Reported joint angles, rad, (..., k), and as in `command`.
        """

        def back(rows: FloatArray, warming: FloatArray) -> FloatArray:
            wanted = rows.copy()
            for _ in range(MOST_STEPS_BACK):
                step = rows - self._solved(wanted, warming)[0]
                wanted += step
                if np.abs(step).max(initial=0.0) < BACK_TO:
                    break
            return wanted

        return self._rows(back, q, temperature_c)

    def correct(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> Correction:
        """Return commands (n, k) with what remains, and which rows are faded or out of range."""
        wanted = self._checked(q).reshape(-1, self.model.joints)
        warming = self.model.warming(len(wanted), _given(temperature_c))
        parts = [self._solved(wanted[rows], warming[rows]) for rows in _blocks(len(wanted))] or [
            self._solved(wanted, warming)
        ]
        command, left, faded = (np.concatenate(part) for part in zip(*parts, strict=True))
        return Correction(
            command,
            np.linalg.norm(left[:, :3], axis=1),
            np.linalg.norm(left[:, 3:], axis=1),
            faded,
            self.model.outside(command),
        )

    def tool(self, q: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Return where the arm has its tool at reported joint angles, T_R_T, (..., 4, 4)."""
        q = self._checked(q)
        rows = q.reshape(-1, self.model.joints)
        found = self.model.state(rows, self._temperature(q, temperature_c)).tool
        return found.reshape(*q.shape[:-1], 4, 4)

    def uncertainty(
        self, q: ArrayLike, sensor: str | None = None, marker: str | None = None
    ) -> FloatArray:
        """Return the covariance of where the marker is, m², (..., 3, 3), along the axes of R.

        Of its place in the frame of the sensor, at wanted joint angles after correction, as the
        file's base frame and tool have it: uncertainty of offsets, causes, registration and marker
        together, widened as poses that were left out have shown. Where zero-offsets alone are
        corrected it is the mean square of the error: with the lengths and tilts left as drawn.

        Parameters
        ----------
        q
            rad, (..., k).
        sensor, marker
            Which of the file's; the first where None.
        """
        q = self._checked(q)
        spread = self.spread(q, sensor, marker)
        found: FloatArray = spread @ np.swapaxes(spread, -1, -2)
        return found

    def spread(
        self, q: ArrayLike, sensor: str | None = None, marker: str | None = None
    ) -> FloatArray:
        """Return L, (..., 3, r), with L L' the covariance of all rows together; see `uncertainty`.

        One column is one thing that is not known, and what it does to each row.
        """
        model = self.model
        q = self._checked(q)
        rows = q.reshape(-1, model.joints)
        sensor = next(iter(model.T_R_N)) if sensor is None else sensor
        marker = next(iter(model.markers)) if marker is None else marker
        root = model.widening * model.root if model.error_root is None else model.error_root
        parts = [
            model.derivative(model.state(rows[block]), sensor, marker) @ root.T
            for block in _blocks(len(rows))
        ]
        found = np.concatenate(parts) if parts else np.zeros((0, 3, len(root)))
        return found.reshape(*q.shape[:-1], 3, len(root))

    def _rows(
        self,
        solve: Callable[[FloatArray, FloatArray], FloatArray],
        q: ArrayLike,
        temperature_c: ArrayLike | None,
    ) -> FloatArray:
        q = self._checked(q)
        rows = q.reshape(-1, self.model.joints)
        warming = self.model.warming(len(rows), self._temperature(q, temperature_c))
        found = np.empty_like(rows)
        for block in _blocks(len(rows)):
            found[block] = solve(rows[block], warming[block])
        return found.reshape(q.shape)

    def _temperature(self, q: FloatArray, given: ArrayLike | None) -> FloatArray | None:
        if given is None:
            return None
        return np.broadcast_to(np.asarray(given, dtype=float), q.shape[:-1]).reshape(-1)

    def _checked(self, q: ArrayLike) -> FloatArray:
        q = np.asarray(q, dtype=float)
        if q.ndim == 0 or q.shape[-1] != self.model.joints:
            raise ValueError(f'q has shape {q.shape}; its last size must be {self.model.joints}')
        if not np.all(np.isfinite(q)):
            raise ValueError('a joint angle is not a finite number')
        return q

    def _solved(
        self, wanted: FloatArray, warming: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return commands (n, k), what is left of each pose (n, 6), and which rows are faded."""
        model, k, unit = self.model, self.model.joints, self.model.chain.per_radian
        in_levers = np.repeat((1.0 / self._typical[0], 1.0), 3)
        command = self._angles_taken_off(wanted, warming)
        target, jacobian = self._nominal(wanted)
        left, sizes, right = np.linalg.svd(in_levers[:, None] * jacobian, full_matrices=False)
        fade = _faded(sizes, self._fades_below(warming))
        # A direction of no size has nothing to divide by, and fades to nothing.
        factor = np.divide(fade, sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
        if k > 6:
            # It acts on all of the change, whose size is another than that of what it leaves.
            kept = _faded(sizes, KEPT_BELOW)
            command = wanted + unit * self._smallest((command - wanted) / unit, right, kept)
        for step in range(NEWTON_STEPS + 1):
            error = _pose_error(target, model._state(model.drivers(command, warming)).tool)
            if step == NEWTON_STEPS:
                break
            along = np.einsum('nij,ni->nj', left, in_levers * error) * factor
            command = command - unit * np.einsum('nij,ni->nj', right, along)
        return command, error, np.asarray(fade.min(axis=1) < 1.0)

    @staticmethod
    def _smallest(change: FloatArray, right: FloatArray, fade: FloatArray) -> FloatArray:
        """Return the part of changes (n, k) that moves the tool; at a singularity all of it.

        There the direction in which the arm moves without its tool is not distinguished from the
        one that has become singular: both have the same weight.
        """
        moving = np.einsum('nij,nj->ni', right, change)
        of_tool = np.einsum('nij,ni->nj', right, moving)
        of_itself = 1.0 - fade.min(axis=1)
        smallest: FloatArray = of_tool + of_itself[:, None] * (change - of_tool)
        return smallest


def _pose_error(target: FloatArray, reached: FloatArray) -> FloatArray:
    """Return how far poses are past their targets in R, m and rad (rotation vector), (n, 6)."""
    turn = reached[:, :3, :3] @ np.swapaxes(target[:, :3, :3], 1, 2)
    shift = reached[:, :3, 3] - target[:, :3, 3]
    return np.concatenate((shift, matrix_to_rotation_vector(turn)), axis=1)


def _faded(sizes: FloatArray, below: FloatArray | float) -> FloatArray:
    """Return the share of each direction that is taken off, by its size."""
    share = np.minimum(sizes / below, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def _blocks(rows: int) -> list[slice]:
    return [slice(start, start + BLOCK_ROWS) for start in range(0, rows, BLOCK_ROWS)]


def _given(temperature_c: ArrayLike | None) -> FloatArray | None:
    return None if temperature_c is None else np.asarray(temperature_c, dtype=float)
