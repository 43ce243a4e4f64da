"""Chain, registrations and markers together: where each sensor should measure each marker.

The model of one observation (eq. 8 of Van Wyk et al., with the marker's position as a parameter)::

    p_N = inverse(T_R_N) f(q + joint_offsets, marker)

Parameters are one flat vector x, base units m and rad, in the order joint offsets (k),
registration of each sensor (6), position of each marker (3), and theta (m) of an `Extension` where
there is one. A registration is a correction C
applied to the robot's points on their way to the sensor, along and about the axes of the base R::

    inverse(T_R_N) = inverse(T_R_N of the reference) C,    C(p) = c + exp(r) (p - c) + t

with t = (x, y, z) and r = (rx, ry, rz), about the centroid c of that sensor's data, which keeps t
and r nearly uncorrelated. Everything is computed in the reference's base coordinates: distances
there equal distances in N.

*Pinned coordinates.* Turning joint 1 is the same as turning the registrations about its axis, and
turning joint k the same as turning the markers about its axis: no data can distinguish them. The
samplers use coordinates in which this is exact at any size: C' = C Rot_1(offset of joint 1) and
marker' = Rot_k(offset of joint k) marker. Predictions depend on C', marker' and the inner joints;
the outer two joints move nothing but the priors. `pinned` and `natural` convert. Displacements of
an extension turn with joint 1 like the arm they belong to, so this holds with an extension too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration.extension import Extension
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    transform,
)
from remaster_ros.types import FloatArray, Measurements

REGISTRATION_AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')


def predict_in_sensor(
    chain: SerialChain,
    measurements: Measurements,
    joint_offsets: FloatArray,
    T_R_N: FloatArray,
    markers: FloatArray,
) -> FloatArray:
    """Return where the sensors should measure the markers.

    Parameters
    ----------
    chain
        The nominal robot, k joints.
    measurements
        The observations to predict, n rows.
    joint_offsets
        Zero-offsets, rad, (k,).
    T_R_N
        Registration of each sensor, (sensors, 4, 4).
    markers
        Position of each marker in the tool frame, m, (markers, 3).

    Returns
    -------
    ndarray
        Marker positions in the frame N of the row's sensor, m, (n, 3).
    """
    points = chain.positions(measurements.q, markers[measurements.marker], joint_offsets)
    return apply(inverse(T_R_N)[measurements.sensor], points)


@dataclass(frozen=True, eq=False)
class Model:
    """The parameters' layout and the prediction with its derivative.

    Attributes
    ----------
    chain
        The nominal robot, k joints.
    sensor_names, marker_names
        In the order of the indices in `Measurements`.
    reference
        The registration T_R_N at (t, r) = 0 of each sensor, (sensors, 4, 4).
    centroid
        Point in R about which each sensor's correction turns, m, (sensors, 3).
    extension
        Further parameters, given for every row of the `Measurements`; None without any.
    """

    chain: SerialChain
    sensor_names: tuple[str, ...]
    marker_names: tuple[str, ...]
    reference: FloatArray
    centroid: FloatArray
    extension: Extension | None = None

    @property
    def joints(self) -> int:
        """Number of joints k."""
        return len(self.chain)

    @property
    def core(self) -> int:
        """Number of parameters without the extension's: offsets, registrations, markers."""
        return self.joints + 6 * len(self.sensor_names) + 3 * len(self.marker_names)

    @property
    def size(self) -> int:
        """Length of the parameter vector."""
        return self.core + (len(self.extension.names) if self.extension is not None else 0)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        names = list(self.chain.joint_names)
        for sensor in self.sensor_names:
            names += [f'registration.{sensor}.{axis}' for axis in REGISTRATION_AXES]
        for marker in self.marker_names:
            names += [f'marker.{marker}.{axis}' for axis in 'xyz']
        if self.extension is not None:
            names += [f'effect.{name}' for name in self.extension.names]
        return tuple(names)

    def registration(self, sensor: int) -> slice:
        """Return where the correction of a sensor lies in the vector."""
        start = self.joints + 6 * sensor
        return slice(start, start + 6)

    def marker(self, marker: int) -> slice:
        """Return where the position of a marker lies in the vector."""
        start = self.joints + 6 * len(self.sensor_names) + 3 * marker
        return slice(start, start + 3)

    def vector(self, joint_offsets: FloatArray, markers: FloatArray) -> FloatArray:
        """Assemble the vector of these offsets and markers at the references, theta0 included."""
        corrections = np.zeros(6 * len(self.sensor_names))
        theta0 = self.extension.theta0 if self.extension is not None else np.zeros(0)
        return np.concatenate((joint_offsets, corrections, np.ravel(markers), theta0))

    def offsets(self, x: FloatArray) -> FloatArray:
        """Return the joint offsets, rad, (..., k)."""
        return x[..., : self.joints]

    def markers(self, x: FloatArray) -> FloatArray:
        """Return the marker positions in T, m, (..., markers, 3)."""
        start = self.joints + 6 * len(self.sensor_names)
        part = x[..., start : self.core]
        return part.reshape(*x.shape[:-1], len(self.marker_names), 3)

    def theta(self, x: FloatArray) -> FloatArray:
        """Return the extension's parameters, (..., m)."""
        return x[..., self.core :]

    def corrections(self, x: FloatArray) -> FloatArray:
        """Return the corrections C as transforms, (..., sensors, 4, 4)."""
        end = self.joints + 6 * len(self.sensor_names)
        parts = x[..., self.joints : end].reshape(*x.shape[:-1], len(self.sensor_names), 6)
        turn = rotation_vector_to_matrix(parts[..., 3:])
        shift = self.centroid + parts[..., :3] - (turn @ self.centroid[..., None])[..., 0]
        return transform(turn, shift)

    def T_R_N(self, x: FloatArray) -> FloatArray:
        """Return the registrations, (..., sensors, 4, 4), of natural parameters (..., size)."""
        return inverse(self.corrections(x)) @ self.reference

    def with_corrections(self, x: FloatArray, corrections: FloatArray) -> FloatArray:
        """Return x with its registrations replaced by transforms C (..., sensors, 4, 4)."""
        shift = apply(corrections, self.centroid) - self.centroid
        turn = matrix_to_rotation_vector(corrections[..., :3, :3])
        parts = np.concatenate((shift, turn), axis=-1)
        result = x.copy()
        end = self.joints + 6 * len(self.sensor_names)
        result[..., self.joints : end] = parts.reshape(*x.shape[:-1], -1)
        return result

    def pinned(self, x: FloatArray) -> FloatArray:
        """Convert natural to pinned coordinates, (..., size)."""
        return self._turned(x, 1.0)

    def natural(self, z: FloatArray) -> FloatArray:
        """Convert pinned to natural coordinates, (..., size)."""
        return self._turned(z, -1.0)

    def _turned(self, x: FloatArray, sign: float) -> FloatArray:
        """Turn registrations with joint 1 and markers with joint k."""
        if not np.any(x[..., [0, self.joints - 1]]):
            # Nothing turns, as where neither joint has a prior.
            return x.copy()
        base = _rotation_about(*self.base_axis, sign * x[..., 0])
        result = self.with_corrections(x, self.corrections(x) @ base[..., None, :, :])
        tool = _rotation_about(*self.tool_axis, sign * x[..., self.joints - 1])
        markers = apply(tool[..., None, :, :], self.markers(x))
        start = self.joints + 6 * len(self.sensor_names)
        result[..., start : self.core] = markers.reshape(*x.shape[:-1], -1)
        return result

    @cached_property
    def extension_root(self) -> FloatArray:
        """W with W theta standard normal by the extension's prior, (rank, m)."""
        if self.extension is None:
            return np.zeros((0, 0))
        # In units of each parameter's own: those of rad and of m/s differ by ten decades.
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
        """Return the predicted markers in the references' base coordinates.

        Parameters
        ----------
        z
            Pinned parameters, (..., size).
        rows
            n observations, those of one sensor next to each other.

        Returns
        -------
        ndarray
            m, (..., n, 3).
        """
        turns, shifts = self._extended(z, rows)
        points = self.chain.positions(
            rows.q,
            self.markers(z)[..., rows.marker, :],
            self._inner_offsets(z)[..., None, :],
            turns,
        )
        points += shifts
        corrections = self.corrections(z)
        for sensor, span in rows.spans:
            turn = corrections[..., sensor, :3, :3]
            shift = corrections[..., sensor, None, :3, 3]
            points[..., span, :] = points[..., span, :] @ np.swapaxes(turn, -1, -2) + shift
        return points

    def jacobian(self, z: FloatArray, rows: Rows) -> FloatArray:
        """Return the derivative of `predict` by the pinned parameters, (n, 3, size).

        The columns of the outer two joints are zero.
        """
        derivative = self._derivative(self._inner_offsets(z), z, rows)
        derivative[..., [0, self.joints - 1]] = 0.0
        return derivative

    def natural_jacobian(self, x: FloatArray, rows: Rows) -> FloatArray:
        """Return the derivative of the prediction by the natural parameters, (n, 3, size)."""
        return self._derivative(self.offsets(x), x, rows)

    def inner_pose(self, z: FloatArray, rows: Rows) -> Pose:
        """Return where the arm stands in each row before registration, joints 1 and k at 0."""
        return self._pose(self._inner_offsets(z), z, rows)

    def _pose(self, offsets: FloatArray, x: FloatArray, rows: Rows) -> Pose:
        turns, shifts = self._extended(x, rows)
        shifts = shifts @ _rotation_about(*self.base_axis, offsets[0])[:3, :3].T
        angles = rows.q + offsets
        for joint, turn in turns.items():
            angles[..., joint] += turn
        frames = self.chain.frames(angles)
        tool = frames[..., -1, :, :] @ self.chain.T_fixed[-1]
        points = apply(tool, self.markers(x)[rows.marker])
        by_joints = self.chain.velocities(frames, points)
        # Joint 1 carries the displacements along.
        by_joints[..., 0] += np.cross(self.base_axis[1], shifts)
        return Pose(tool, points + shifts, self.chain.axes_in_base(frames), by_joints)

    def _inner_offsets(self, z: FloatArray) -> FloatArray:
        offsets = self.offsets(z).copy()
        offsets[..., [0, self.joints - 1]] = 0.0
        return offsets

    def _extended(self, x: FloatArray, rows: Rows) -> tuple[dict[int, FloatArray], FloatArray]:
        """Return the angles of joints, rad, and displacements, m, that theta adds to each row."""
        if self.extension is None:
            return {}, np.zeros(3)
        given, theta = self.extension, self.theta(x)
        return given.turns(theta, rows.source), given.shifts(theta, rows.source)

    def _derivative(self, offsets: FloatArray, x: FloatArray, rows: Rows) -> FloatArray:
        derivative = np.zeros((len(rows.q), 3, self.size))
        tool, points, _, by_joints = self._pose(offsets, x, rows)
        by_theta = None
        if self.extension is not None:
            base = _rotation_about(*self.base_axis, offsets[0])[:3, :3]
            # The joints themselves turn under the displacements.
            turned = by_joints.copy()
            turned[..., 0] -= np.cross(self.base_axis[1], self._extended(x, rows)[1] @ base.T)
            by_theta = self.extension.derivative(turned, base, rows.source)
        correction = self.corrections(x)
        for sensor, span in rows.spans:
            turn = correction[sensor, :3, :3]
            derivative[span, :, : self.joints] = turn @ by_joints[span]
            start = self.registration(sensor).start
            derivative[span, :, start : start + 3] = np.eye(3)
            vector = x[self.registration(sensor)][3:]
            # d(exp(r) v) = (J_l(r) dr) × exp(r) v: the arm after the turn, the left Jacobian of r.
            arms = (points[span] - self.centroid[sensor]) @ turn.T
            derivative[span, :, start + 3 : start + 6] = -_cross_matrix(arms) @ _left_jacobian(
                vector
            )
            by_marker = turn @ tool[span, :3, :3]
            for marker in range(len(self.marker_names)):
                seen = rows.marker[span] == marker
                derivative[span, :, self.marker(marker)] = by_marker * seen[:, None, None]
            if by_theta is not None:
                derivative[span, :, self.core :] = turn @ by_theta[span]
        return derivative


class Pose(NamedTuple):
    """Where an arm stands in n rows, in its base R.

    Attributes
    ----------
    tool
        T_R_T, (n, 4, 4).
    points
        Markers, displaced by an extension, m, (n, 3).
    axes
        Directions of the joints, (n, k, 3).
    by_joints
        Derivative of the points by the joint angles, m/rad, (n, 3, k).
    """

    tool: FloatArray
    points: FloatArray
    axes: FloatArray
    by_joints: FloatArray


def _rotation_about(point: FloatArray, axis: FloatArray, angle: FloatArray) -> FloatArray:
    """Return the transform that turns by an angle (...) about an axis, (..., 4, 4)."""
    turn = rotation_vector_to_matrix(np.asarray(angle)[..., None] * axis)
    return transform(turn, point - turn @ point)


def _cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the matrices K with K w = v × w, (..., 3, 3)."""
    return np.swapaxes(np.cross(vectors[..., None, :], np.eye(3)), -1, -2)


def _left_jacobian(vector: FloatArray) -> FloatArray:
    """Return what turns a change of a rotation vector into a small rotation on its left."""
    angle = float(np.linalg.norm(vector))
    K = _cross_matrix(vector)
    if angle < 1e-4:
        return np.eye(3) + K / 2.0 + K @ K / 6.0
    first = (1.0 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + first * K + second * K @ K
