# SPDX-License-Identifier: Apache-2.0
"""Model of the observations: chain, registrations and markers give the reading of each sensor.

The model of one observation (eq. 8 of Van Wyk et al., with the marker's position as a parameter)::

  p_N = inverse(T_R_N) f(q + joint_offsets, marker)

Parameters are one flat vector x, base units m and rad, in the order joint offsets (k),
registration of each sensor (6), position of each marker (3), rotation of each body (3) whose
orientation is fitted, and theta (m) of an `Extension` if there is one. A registration is a
correction C of the robot's points before they are transformed to the sensor, along and about the
axes of the base R::

  inverse(T_R_N) = inverse(T_R_N of the reference) C,    C(p) = c + exp(r) (p - c) + t

with t = (x, y, z) and r = (rx, ry, rz), about the centroid c of that sensor's data, so that t and
r are nearly uncorrelated. All predictions are in the reference's base coordinates: distances there
equal distances in N.

*Orientations.* If a sensor measures the orientation of a body, R_N_B, the model is::

  R_N_B = R_R_N' R_R_T(q + joint_offsets) R_T_B,    R_T_B = exp(b) R_T_B of the reference

The orientation of the body on the tool, b, is unknown like its position. The prediction of such a
row is the rotation vector from the measured to the modelled orientation, along the axes of R, so
that minus the prediction is the error. A camera on the tool that measures a board is the same arm:
the board is the sensor's frame N, the camera's frame C the body. Its reading is the board's origin
l in C, at the position T_R_T (marker + R_T_C l) of the arm, which the model puts at the origin of
N. The noise is in C: so the board's origin is compared, not the camera's position in front of the
board, in which noise of the orientation is multiplied by the distance.

*Pinned coordinates.* A rotation of joint 1 is the same as a rotation of the registrations about
its axis, and a rotation of joint k the same as one of markers and bodies about its axis: no data
can distinguish them, orientations no more than positions. The samplers use coordinates in which
this is exact for rotations of any size: C' = C Rot_1(offset of joint 1), marker' = Rot_k(offset of
joint k) marker and R_T_B' = Rot_k(offset of joint k) R_T_B. Predictions depend on C', marker',
R_T_B' and the inner joints; the outer two joints change only the priors. `pinned` and `natural`
convert. Displacements of an extension turn with joint 1 like the arm, so that the coordinates are
exact with an extension too. If an outer joint slides, Rot is the shift along it, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration.extension import Extension
from remaster_ros.calibration.grouped_rows import Bodies, Rows
from remaster_ros.calibration.path_noise import PathNoise
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    transform,
)
from remaster_ros.types import FloatArray, IntArray, Measurements

REGISTRATION_AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')


@dataclass(frozen=True, eq=False)
class Model:
    """Model of the observations: layout of its parameters, prediction and derivative."""

    chain: SerialChain  # The nominal robot, k joints
    # Names in the order of the indices in `Measurements`
    sensor_names: tuple[str, ...]
    marker_names: tuple[str, ...]
    reference: FloatArray  # The registration T_R_N at (t, r) = 0 of each sensor, (sensors, 4, 4)
    centroid: FloatArray  # Point in R about which each sensor's correction turns, m, (sensors, 3)
    # Effects with parameters of their own, for every row of the `Measurements`; None without
    # effects. An extension has displacements but no rotations: with one no orientation is fitted.
    extension: Extension | None = None
    bodies: Bodies = ()  # (sensor, marker) of every body whose orientation is fitted
    # R_T_B at b = 0 of each body, (bodies, 3, 3)
    body_reference: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    # Sensors on the tool, whose readings are positions of their target in the sensor's own frame
    on_tool: tuple[int, ...] = ()
    path_noise: PathNoise | None = None  # Of errors along a path; None of an arm that stood still

    @property
    def joints(self) -> int:
        """Number of joints k."""
        return len(self.chain)

    @property
    def has_causes(self) -> bool:
        """Whether the extension has parameters that are causes of error, not only of motion."""
        return self.extension is not None and not self.extension.of_motion

    @property
    def core(self) -> int:
        """Number of parameters before those of the extension: offsets to bodies' rotations."""
        return self.markers_end + 3 * len(self.bodies)

    @property
    def markers_end(self) -> int:
        """Index behind the markers' parameters, where those of the bodies begin."""
        return self.joints + 6 * len(self.sensor_names) + 3 * len(self.marker_names)

    @property
    def size(self) -> int:
        """Length of the parameter vector, the extension included."""
        return self.core + (len(self.extension.names) if self.extension is not None else 0)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order, (size) strings.

        Joint names, 'registration.<sensor>.x' to 'rz', 'marker.<marker>.x', 'body.<body>.rx' and
        'effect.<name>'.
        """
        names = list(self.chain.joint_names)
        for sensor in self.sensor_names:
            names += [f'registration.{sensor}.{axis}' for axis in REGISTRATION_AXES]
        for marker in self.marker_names:
            names += [f'marker.{marker}.{axis}' for axis in 'xyz']
        for body in self.body_names:
            names += [f'body.{body}.{axis}' for axis in REGISTRATION_AXES[3:]]
        if self.extension is not None:
            names += [f'effect.{name}' for name in self.extension.names]
        return tuple(names)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies: marker, with the sensor if several sensors measure the marker."""
        markers = [marker for _, marker in self.bodies]
        return tuple(
            self.marker_names[marker]
            if markers.count(marker) == 1
            else f'{self.marker_names[marker]}.{self.sensor_names[sensor]}'
            for sensor, marker in self.bodies
        )

    def rows(self, measurements: Measurements, rows: IntArray) -> Rows:
        """Given rows (indices), sorted by `Rows.of`, with orientations if these are fitted."""
        return Rows.with_turns(measurements, rows, self.reference, self.bodies, self.on_tool)

    def rows_of_path(self, measurements: Measurements, rows: IntArray) -> Rows:
        """Given rows (indices) as `rows`, with errors correlated along the path, if any."""
        return self.rows(measurements, rows).along_path(self.path_noise)

    def registration(self, sensor: int) -> slice:
        """Slice of a sensor's correction (x, y, z, rx, ry, rz), by its index, in the vector."""
        start = self.joints + 6 * sensor
        return slice(start, start + 6)

    def marker(self, marker: int) -> slice:
        """Slice of a marker's position in the parameter vector."""
        start = self.joints + 6 * len(self.sensor_names) + 3 * marker
        return slice(start, start + 3)

    def body(self, body: int) -> slice:
        """Slice of a body's rotation vector, by its index in ``bodies``, in the vector."""
        start = self.markers_end + 3 * body
        return slice(start, start + 3)

    def vector(self, joint_offsets: FloatArray, markers: FloatArray) -> FloatArray:
        """Parameter vector (size,) of joint offsets (k,) and markers (markers, 3).

        Registrations and orientations of bodies are at their references (corrections 0), theta
        is at theta0.
        """
        corrections = np.zeros(6 * len(self.sensor_names))
        theta0 = self.extension.theta0 if self.extension is not None else np.zeros(0)
        turns = np.zeros(3 * len(self.bodies))
        return np.concatenate((joint_offsets, corrections, np.ravel(markers), turns, theta0))

    def offsets(self, x: FloatArray) -> FloatArray:
        """Joint offsets, rad or m, (..., k), of parameters x (..., size); a view."""
        return x[..., : self.joints]

    def markers(self, x: FloatArray) -> FloatArray:
        """Marker positions in the tool frame T, m, (..., markers, 3), a view of x (..., size).

        For pinned parameters these are the pinned positions: moved with joint k (`pinned`).
        """
        start = self.joints + 6 * len(self.sensor_names)
        part = x[..., start : self.markers_end]
        return part.reshape(*x.shape[:-1], len(self.marker_names), 3)

    def R_T_B(self, x: FloatArray) -> FloatArray:
        """Orientations of the bodies on the tool, R_T_B, (..., bodies, 3, 3), of natural x."""
        turns = x[..., self.markers_end : self.core]
        turns = turns.reshape(*x.shape[:-1], len(self.bodies), 3)
        return np.asarray(rotation_vector_to_matrix(turns) @ self.body_reference)

    def theta(self, x: FloatArray) -> FloatArray:
        """Parameters of the extension, (..., m), of parameters x (..., size); a view."""
        return x[..., self.core :]

    def corrections(self, x: FloatArray) -> FloatArray:
        """Corrections C of the registrations as transforms of points in R, (..., sensors, 4, 4).

        From (x, y, z, rx, ry, rz) of each sensor, about its centroid; ``x``: (..., size).
        """
        end = self.joints + 6 * len(self.sensor_names)
        parts = x[..., self.joints : end].reshape(*x.shape[:-1], len(self.sensor_names), 6)
        turn = rotation_vector_to_matrix(parts[..., 3:])
        shift = self.centroid + parts[..., :3] - (turn @ self.centroid[..., None])[..., 0]
        return transform(turn, shift)

    def T_R_N(self, x: FloatArray) -> FloatArray:
        """Registrations T_R_N, (..., sensors, 4, 4), of natural parameters (..., size)."""
        return inverse(self.corrections(x)) @ self.reference

    def with_corrections(self, x: FloatArray, corrections: FloatArray) -> FloatArray:
        """Copy of natural parameters x (..., size) with the corrections C, (..., sensors, 4, 4).

        C: transforms of points in R, see `corrections`.
        """
        shift = apply(corrections, self.centroid) - self.centroid
        turn = matrix_to_rotation_vector(corrections[..., :3, :3])
        parts = np.concatenate((shift, turn), axis=-1)
        result = x.copy()
        end = self.joints + 6 * len(self.sensor_names)
        result[..., self.joints : end] = parts.reshape(*x.shape[:-1], -1)
        return result

    def pinned(self, x: FloatArray) -> FloatArray:
        """Pinned coordinates (..., size) of natural ones, a copy with the same offsets.

        Registrations take up the motion of joint 1, markers and bodies that of joint k.
        """
        return self._turned(x, 1.0)

    def natural(self, z: FloatArray) -> FloatArray:
        """Natural coordinates (..., size) of pinned ones, a copy; the inverse of `pinned`."""
        return self._turned(z, -1.0)

    def _turned(self, x: FloatArray, sign: float) -> FloatArray:
        """Parameters with registrations moved with joint 1, and markers and bodies with joint k.

        ``sign``: 1.0 to pin, -1.0 for the inverse.
        """
        if not np.any(x[..., [0, self.joints - 1]]):
            # Nothing turns, as where neither joint has a prior.
            return x.copy()
        base = self._transform_of_first_joint(sign * x[..., 0])
        result = self.with_corrections(x, self.corrections(x) @ base[..., None, :, :])
        last = sign * x[..., self.joints - 1]
        tool = _transform_about_axis(*self.tool_axis, last, bool(self.chain.slides[-1]))
        markers = apply(tool[..., None, :, :], self.markers(x))
        start = self.joints + 6 * len(self.sensor_names)
        result[..., start : self.markers_end] = markers.reshape(*x.shape[:-1], -1)
        if self.bodies:
            turned = tool[..., None, :3, :3] @ self.R_T_B(x)
            turns = matrix_to_rotation_vector(turned @ np.swapaxes(self.body_reference, -1, -2))
            result[..., self.markers_end : self.core] = turns.reshape(*x.shape[:-1], -1)
        return result

    def _transform_of_first_joint(self, amount: FloatArray) -> FloatArray:
        """Transform in R by joint 1 moving by an amount (...), rad or m, (..., 4, 4)."""
        return _transform_about_axis(*self.base_axis, amount, bool(self.chain.slides[0]))

    @cached_property
    def extension_root(self) -> FloatArray:
        """Matrix W, (rank, m): W theta is standard normal by the extension's prior."""
        if self.extension is None:
            return np.zeros((0, 0))
        # Each parameter in units of its prior: rad and m/s differ by ten powers of ten.
        precision = self.extension.prior_precision
        unit = np.sqrt(np.diag(precision))
        unit = np.where(unit > 0.0, unit, 1.0)
        values, vectors = np.linalg.eigh(precision / np.outer(unit, unit))
        kept = values > 1e-12 * values.max(initial=0.0)
        root: FloatArray = np.sqrt(values[kept])[:, None] * vectors[:, kept].T * unit
        return root

    @cached_property
    def base_axis(self) -> tuple[FloatArray, FloatArray]:
        """Axis of joint 1 in R: a point on it, m, (3,), and its unit direction, (3,)."""
        first = self.chain.T_fixed[0]
        return first[:3, 3], first[:3, :3] @ self.chain.axes[0]

    @cached_property
    def tool_axis(self) -> tuple[FloatArray, FloatArray]:
        """Axis of joint k in T: a point on it, m, (3,), and its unit direction, (3,)."""
        last = inverse(self.chain.T_fixed[-1])
        return last[:3, 3], last[:3, :3] @ self.chain.axes[-1]

    def predict(self, z: FloatArray, rows: Rows) -> FloatArray:
        """Predicted observations in base R by the reference registrations, (..., n, 3).

        Of a position, m: the marker, or, of a sensor on the tool, the origin of its target. Of
        an orientation: the rotation vector from the measured to the modelled one, rad. Errors
        are ``rows.target`` less the prediction. ``z``: pinned parameters (see the module),
        (..., size); ``rows``: n rows, those of one sensor consecutive.
        """
        turns, shifts = self._extended(z, rows)
        count, offsets = rows.points, self._inner_offsets(z)
        points = self.chain.positions(
            rows.q[:count],
            self._places(z, rows)[..., :count, :],
            offsets[..., None, :],
            turns,
        )
        points += shifts
        corrections = self.corrections(z)
        for sensor, span in rows.spans:
            if sensor >= len(self.sensor_names):
                continue
            turn = corrections[..., sensor, :3, :3]
            shift = corrections[..., sensor, None, :3, 3]
            points[..., span, :] = points[..., span, :] @ np.swapaxes(turn, -1, -2) + shift
        if rows.turned is None:
            return points
        return np.concatenate((points, self._turns(z, offsets, rows, corrections)), axis=-2)

    def seen(self, z: FloatArray, rows: Rows) -> FloatArray:
        """Predicted positions as the sensors see them, in R by the references, m, (..., n, 3).

        For a sensor on the tool: the measured position less the error (``rows.target`` less
        `predict`), so that measured less this is the error of the arm. A predicted position of
        the sensor itself would have the noise of its orientation times the distance. ``z``:
        pinned parameters, (..., size); ``rows``: n rows, of positions only.
        """
        predicted = self.predict(z, rows)
        return predicted if rows.lever is None else predicted + (rows.measured - rows.target)

    def _places(self, z: FloatArray, rows: Rows) -> FloatArray:
        """Points on the tool whose positions the rows measure, in the tool frame, m, (..., n, 3).

        The marker, and for a sensor on the tool the point that it measured.
        """
        places = self.markers(z)[..., rows.marker, :]
        if rows.lever is not None:
            assert rows.body is not None
            places = places + (self.R_T_B(z)[..., rows.body, :, :] @ rows.lever[..., None])[..., 0]
        return places

    def _turns(
        self, x: FloatArray, offsets: FloatArray, rows: Rows, corrections: FloatArray
    ) -> FloatArray:
        """Rotation vectors from measured to modelled orientations, rad, (..., r, 3), in R.

        Of the r rows with orientations; `offsets`: (..., k), `corrections`: (..., sensors, 4, 4).
        """
        assert rows.turned is not None
        assert rows.body is not None
        start = rows.points
        R_T_B = self.R_T_B(x)[..., rows.body[start:], :, :]
        # Two directions of the body, from its origin: as fast as points are.
        first, second = R_T_B[..., 0], R_T_B[..., 1]
        ends = np.stack((first, second, 0.0 * first))
        ends = self.chain.positions(rows.q[start:], ends, offsets[..., None, :])
        first, second = ends[0] - ends[2], ends[1] - ends[2]
        R_R_B = np.stack((first, second, np.cross(first, second)), axis=-1)
        for index, span in rows.spans:
            if index >= len(self.sensor_names):
                turn = corrections[..., self._sensor(rows, index), None, :3, :3]
                part = slice(span.start - start, span.stop - start)
                R_R_B[..., part, :, :] = turn @ R_R_B[..., part, :, :]
        return _rotation_vector(R_R_B @ np.swapaxes(rows.turned, -1, -2))

    def _sensor(self, rows: Rows, index: int) -> int:
        """Index of the sensor of a span of rows, by the span's index.

        Spans of positions have the index of their sensor; those of orientations come behind them.
        """
        count = len(self.sensor_names)
        return index if index < count else rows.turning[index - count]

    def jacobian(self, z: FloatArray, rows: Rows) -> FloatArray:
        """Derivative of `predict` by the pinned parameters, (n, 3, size); ``z``: (size,).

        The columns of the outer two joints are zero.
        """
        derivative = self._derivative(self._inner_offsets(z), z, rows)
        derivative[..., [0, self.joints - 1]] = 0.0
        return derivative

    def natural_jacobian(self, x: FloatArray, rows: Rows) -> FloatArray:
        """Derivative of `predict` by the natural parameters x (size,), (n, 3, size), in SI units.

        Natural ones are those before `pinned`: joints 1 and k have columns of their own.
        """
        return self._derivative(self.offsets(x), x, rows)

    def inner_pose(self, z: FloatArray, rows: Rows) -> Pose:
        """Pose of the arm in each row before registration, with joints 1 and k at 0."""
        return self._pose(self._inner_offsets(z), z, rows)

    def _pose(self, offsets: FloatArray, x: FloatArray, rows: Rows) -> Pose:
        """Pose of the arm in each row by offsets (k,) and parameters x (size,), with effects."""
        turns, shifts = self._extended(x, rows)
        shifts = shifts @ self._transform_of_first_joint(offsets[0])[:3, :3].T
        angles = rows.q + offsets
        for joint, turn in turns.items():
            angles[..., joint] += turn
        frames = self.chain.frames(angles)
        tool = frames[..., -1, :, :] @ self.chain.T_fixed[-1]
        points = apply(tool, self._places(x, rows))
        by_joints = self.chain.velocities(frames, points)
        # Displacements turn with joint 1.
        if not self.chain.slides[0]:
            by_joints[..., 0] += np.cross(self.base_axis[1], shifts)
        return Pose(tool, points + shifts, self.chain.axes_in_base(frames), by_joints)

    def _inner_offsets(self, z: FloatArray) -> FloatArray:
        """Joint offsets of z, a copy with those of joints 1 and k set to 0, (..., k).

        In rad or m; ``z``: pinned parameters, (..., size).
        """
        offsets = self.offsets(z).copy()
        offsets[..., [0, self.joints - 1]] = 0.0
        return offsets

    def _extended(self, x: FloatArray, rows: Rows) -> tuple[dict[int, FloatArray], FloatArray]:
        """Motion by the extension at parameters x (..., size): added joint angles, displacements.

        Angles: joint index -> rad (m for a slide), (..., n); displacements in R, m, (..., n,
        3). {} and zeros (3,) without an extension.
        """
        if self.extension is None:
            return {}, np.zeros(3)
        given, theta = self.extension, self.theta(x)
        return given.turns(theta, rows.source), given.shifts(theta, rows.source)

    def _derivative(self, offsets: FloatArray, x: FloatArray, rows: Rows) -> FloatArray:
        """Derivative of `predict` by all parameters at given offsets (k,), (n, 3, size).

        ``x``: all other parameters, (size,).
        """
        derivative = np.zeros((len(rows.q), 3, self.size))
        tool, points, axes, by_joints = self._pose(offsets, x, rows)
        base, turned = self._transform_of_first_joint(offsets[0])[:3, :3], by_joints
        if self.extension is not None and not self.chain.slides[0]:
            # The joints themselves turn under the displacements.
            turned = by_joints.copy()
            turned[..., 0] -= np.cross(self.base_axis[1], self._extended(x, rows)[1] @ base.T)
        correction = self.corrections(x)
        for index, span in rows.spans:
            sensor = self._sensor(rows, index)
            turn = correction[sensor, :3, :3]
            start = self.registration(sensor).start
            # d(exp(r) v) = (J_l(r) dr) × exp(r) v: the arm after the turn, the left Jacobian of r.
            by_turn = _left_jacobian(x[self.registration(sensor)][3:])
            if index != sensor:
                # A joint that slides turns nothing.
                turning = axes[span] * ~self.chain.slides[:, None]
                derivative[span, :, : self.joints] = turn @ np.swapaxes(turning, 1, 2)
                derivative[span, :, start + 3 : start + 6] = by_turn
                self._by_bodies(derivative, x, rows, span, turn @ tool[span, :3, :3])
                continue
            derivative[span, :, : self.joints] = turn @ by_joints[span]
            derivative[span, :, start : start + 3] = np.eye(3)
            arms = (points[span] - self.centroid[sensor]) @ turn.T
            derivative[span, :, start + 3 : start + 6] = -_cross_matrix(arms) @ by_turn
            by_marker = turn @ tool[span, :3, :3]
            for marker in range(len(self.marker_names)):
                seen = rows.marker[span] == marker
                derivative[span, :, self.marker(marker)] = by_marker * seen[:, None, None]
            if rows.lever is not None and np.any(rows.lever[span]):
                assert rows.body is not None
                lever = self.R_T_B(x)[rows.body[span]] @ rows.lever[span][..., None]
                arms = -by_marker @ _cross_matrix(lever[..., 0])
                self._by_bodies(derivative, x, rows, span, arms)
            if self.extension is not None:
                by_theta = derivative[span, :, self.core :]
                self.extension.derivative(
                    turn @ turned[span], turn @ base, rows.source[span], by_theta
                )
        if rows.turned is not None:
            # d log(exp(w) exp(v)) = J_l(v)⁻¹ w for a small turn w.
            end = rows.points
            turns = self._turns(x, offsets, rows, correction)
            derivative[end:] = _inverse_left_jacobian(turns) @ derivative[end:]
        return derivative

    def _by_bodies(
        self, derivative: FloatArray, x: FloatArray, rows: Rows, span: slice, by_turn: FloatArray
    ) -> None:
        """Write the derivative of rows by the bodies' rotations into ``derivative`` (n, 3, size).

        ``span``: the rows; ``by_turn``: their derivative by a small rotation of the body in T,
        (rows of the span, 3, 3).
        """
        assert rows.body is not None
        for body in range(len(self.bodies)):
            of_body = (rows.body[span] == body)[:, None, None]
            derivative[span, :, self.body(body)] = (
                by_turn @ _left_jacobian(x[self.body(body)]) * of_body
            )


class Pose(NamedTuple):
    """Tool poses, points, joint axes and the points' Jacobian in n rows, in the base R."""

    tool: FloatArray  # T_R_T, (n, 4, 4)
    points: FloatArray  # Markers, displaced by an extension, m, (n, 3)
    axes: FloatArray  # Directions of the joints, (n, k, 3)
    by_joints: FloatArray  # Derivative of the points by the joint angles, m/rad or m/m, (n, 3, k)


def _transform_about_axis(
    point: FloatArray, axis: FloatArray, amount: FloatArray, slides: bool
) -> FloatArray:
    """Rotation by an angle (...) about an axis, or shift by an amount (...) along it, (..., 4, 4).

    ``point``: on the axis, m, (3,); ``slides``: whether the amount is a shift, m.
    """
    vector = np.asarray(amount)[..., None] * axis
    if slides:
        return transform(np.eye(3), vector)
    turn = rotation_vector_to_matrix(vector)
    return transform(turn, point - turn @ point)


def _cross_matrix(vectors: FloatArray) -> FloatArray:
    """Matrices K (..., 3, 3) with K w = v × w."""
    return np.swapaxes(np.cross(vectors[..., None, :], np.eye(3)), -1, -2)


def _left_jacobian(vector: FloatArray) -> FloatArray:
    """Left Jacobian (3, 3) of a rotation vector (3,), rad: its change to a rotation on its left.

    exp(r + dr) = exp(J dr) exp(r) to first order.
    """
    angle = float(np.linalg.norm(vector))
    K = _cross_matrix(vector)
    if angle < 1e-4:
        return np.eye(3) + K / 2.0 + K @ K / 6.0
    first = (1.0 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + first * K + second * K @ K


def _rotation_vector(rotation: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3); faster than SciPy's.

    Angles up to half a turn; rotations within about 1e-3 rad of that are converted by
    `matrix_to_rotation_vector`.
    """
    skew = rotation - np.swapaxes(rotation, -1, -2)
    axis = 0.5 * np.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), axis=-1)
    sine = np.linalg.norm(axis, axis=-1)
    cosine = 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0)
    has_axis = sine > 1e-9
    vector: FloatArray = (
        axis
        * np.where(has_axis, np.arctan2(sine, cosine) / np.where(has_axis, sine, 1.0), 1.0)[
            ..., None
        ]
    )
    opposite = (cosine < 0.0) & (sine < 1e-3)
    if np.any(opposite):
        vector[opposite] = matrix_to_rotation_vector(rotation[opposite])
    return vector


def _inverse_left_jacobian(vectors: FloatArray) -> FloatArray:
    """Inverses (n, 3, 3) of the left Jacobians of rotation vectors (n, 3), rad."""
    angle = np.linalg.norm(vectors, axis=-1)
    K = _cross_matrix(vectors)
    small_angle = angle < 1e-4
    half = 0.5 * np.where(small_angle, 1.0, angle)
    # (1 - x cot x) / (2 x)² with x half the angle; its series begins with 1/12.
    weight = np.where(small_angle, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    inverted: FloatArray = np.eye(3) - 0.5 * K + weight[:, None, None] * (K @ K)
    return inverted
