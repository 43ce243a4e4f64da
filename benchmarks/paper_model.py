# SPDX-License-Identifier: Apache-2.0
"""The paper's posterior, eq. 8 and 15 of Van Wyk et al., written a second time.

Shares no code with the product's posterior: kinematics by Rodrigues' formula on points, residuals
row by row, no linearisation, no sums prepared beforehand. NumPy or JAX, whichever module is given
as ``xp``; any number of states at once. A state is, in the paper's units, x, y, z (mm), alpha,
beta, gamma (deg), the offsets of joints 2 to 7 (deg), and sigma (mm). Joint 1 is held at zero: its
offset is a turn of the sensor, which no sampler could ever finish sampling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import common  # noqa: F401  its folder of helpers
import numpy as np
from worlds.paper_experiment import CHAIN

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.laplace import Mode, find_mode
from remaster_ros.calibration.model import Model
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.types import FloatArray, Session

NAMES = ('x', 'y', 'z', 'alpha', 'beta', 'gamma', *CHAIN.joint_names[1:], 'sigma')
DIMENSION = len(NAMES)
_UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class PaperModel:
    """The data of one sensor and the density of the states given them.

    Attributes
    ----------
    q
        rad, (n, k).
    measured
        m, in the sensor's frame N, (n, 3).
    marker
        In the tool frame, m, (3,).
    T_N_R
        Initial registration, (4, 4).
    """

    q: FloatArray
    measured: FloatArray
    marker: FloatArray
    T_N_R: FloatArray

    @classmethod
    def of(cls, session: Session) -> PaperModel:
        """Take the optimization rows of a session of one sensor; register by all of them."""
        rows = session.measurements.select(~session.measurements.is_validation)
        (marker,) = session.markers.values()
        nominal = CHAIN.positions(rows.q, marker)
        return cls(rows.q, rows.position, marker, rigid_fit(nominal, rows.position))

    def errors(self, states: Any, xp: Any = np) -> Any:
        """Return measured minus modelled positions in N, mm, of states (..., 13), (..., n, 3)."""
        radians = np.pi / 180.0 * states[..., 3:12, None]
        sine, cosine = xp.sin(radians), xp.cos(radians)
        x, y, z = self.marker
        for joint in range(len(CHAIN) - 1, -1, -1):
            x, y, z = _moved(self.fixed[joint + 1], x, y, z)
            s, c = self.sine[joint], self.cosine[joint]
            if joint > 0:
                # Of q + offset, by the addition theorem.
                s_offset, c_offset = sine[..., 2 + joint, :], cosine[..., 2 + joint, :]
                s, c = s * c_offset + c * s_offset, c * c_offset - s * s_offset
            x, y, z = _turned(self.axes[joint], s, c, x, y, z)
        x, y, z = _moved(self.fixed[0], x, y, z)
        # T*: Rz(alpha) Ry(beta) Rx(gamma), the turn about x first.
        for axis, column in enumerate((2, 1, 0)):
            s, c = sine[..., column, :], cosine[..., column, :]
            x, y, z = _turned(_UNIT[axis], s, c, x, y, z)
        points = zip((x, y, z), self.measured_mm)
        return xp.stack(
            [far - 1e3 * p - states[..., i, None] for i, (p, far) in enumerate(points)], axis=-1
        )

    @cached_property
    def fixed(self) -> list[tuple[FloatArray | None, list[float]]]:
        """Rotation (None where there is none) and shift between joints; the first leads to N."""
        transforms = [self.T_N_R @ CHAIN.T_fixed[0], *CHAIN.T_fixed[1:]]
        turns = [None if np.array_equal(T[:3, :3], np.eye(3)) else T[:3, :3] for T in transforms]
        return [(turn, T[:3, 3].tolist()) for turn, T in zip(turns, transforms)]

    @cached_property
    def axes(self) -> list[tuple[float, ...]]:
        """The joints' axes as plain numbers."""
        return [tuple(axis) for axis in CHAIN.axes.tolist()]

    @cached_property
    def sine(self) -> FloatArray:
        """Of the reported angles, (k, n)."""
        return np.sin(self.q).T.copy()

    @cached_property
    def cosine(self) -> FloatArray:
        """Of the reported angles, (k, n)."""
        return np.cos(self.q).T.copy()

    @cached_property
    def measured_mm(self) -> FloatArray:
        """(3, n)."""
        return 1e3 * self.measured.T

    def log_density(self, states: Any, xp: Any = np, power: int = 1) -> Any:
        """Return the log density of states (..., 13) by their own measure, (...).

        ``power`` 1 is the prior 1 / sigma d sigma, eq. 14; eq. 16 samples ``power`` 2 in d sigma.
        """
        sigma = states[..., -1]
        errors = self.errors(states, xp)
        safe = xp.where(sigma > 0.0, sigma, 1.0)
        cost = xp.einsum('...ni,...ni->...', errors, errors)
        exponent = 3 * len(self.q) + power
        value = -exponent * xp.log(safe) - cost / (2.0 * safe**2)
        return xp.where(sigma > 0.0, value, -xp.inf)

    def state_of(
        self, T_N_R: FloatArray, joint_offsets: FloatArray, sigma: FloatArray
    ) -> FloatArray:
        """Return states (..., 13) of T_N_R (..., 4, 4), offsets (..., k), sigma (...); SI."""
        correction = T_N_R @ inverse(self.T_N_R)
        turn = correction[..., :3, :3]
        alpha = np.arctan2(turn[..., 1, 0], turn[..., 0, 0])
        beta = -np.arcsin(turn[..., 2, 0])
        gamma = np.arctan2(turn[..., 2, 1], turn[..., 2, 2])
        angles = np.stack((alpha, beta, gamma), axis=-1)
        return np.concatenate(
            (
                1e3 * correction[..., :3, 3],
                np.degrees(angles),
                np.degrees(joint_offsets[..., 1:]),
                1e3 * sigma[..., None],
            ),
            axis=-1,
        )

    def peak(self) -> tuple[FloatArray, FloatArray]:
        """Return the mode in (theta, log sigma) and the covariance there, (13,) and (13, 13).

        Gauss-Newton with numerical derivatives, from zero.
        """
        theta = np.zeros(DIMENSION - 1)
        step = 1e-3
        for _ in range(20):
            moved = np.concatenate(
                (theta + step * np.eye(12), theta - step * np.eye(12), theta[None])
            )
            errors = self.errors(np.column_stack((moved, np.ones(25)))).reshape(25, -1)
            jacobian = (errors[:12] - errors[12:24]).T / (2.0 * step)
            theta = theta - np.linalg.lstsq(jacobian, errors[24], rcond=None)[0]
        m = errors.shape[1]
        sigma = np.sqrt(np.sum(errors[24] ** 2) / (m - 12))
        covariance = np.zeros((DIMENSION, DIMENSION))
        covariance[:12, :12] = sigma**2 * np.linalg.inv(jacobian.T @ jacobian)
        covariance[12, 12] = 0.5 / (m - 12)
        return np.append(theta, np.log(sigma)), covariance


def product_mode(session: Session) -> Mode:
    """Return the product's posterior of the same model: no common part, the marker as known."""
    found = estimate(Problem.of(replace(session, marker_std_m=0.0)))
    return find_mode(found.posterior.with_independent_rows())


def product_states(model: PaperModel, mode: Mode, points: FloatArray) -> FloatArray:
    """Return states (..., 13) of the product's points (..., d)."""
    posterior = mode.linearisation.posterior
    arm: Model = posterior.model
    x = arm.natural(posterior.parameters(points))
    noise = posterior.noise(points[..., len(posterior.free) :])
    sigma = posterior.noise_model.sensor_noise(noise).sigma
    return model.state_of(inverse(arm.T_R_N(x)[..., 0, :, :]), arm.offsets(x), sigma[..., 0])


def rigid_fit(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the transform that takes points (n, 3) closest to others (Kabsch 1976)."""
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - aim).T @ (source - middle))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, aim - turn @ middle
    return T


def _moved(
    fixed: tuple[FloatArray | None, list[float]], x: Any, y: Any, z: Any
) -> tuple[Any, Any, Any]:
    turn, shift = fixed
    if turn is None:
        return x + shift[0], y + shift[1], z + shift[2]
    rows = [turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z + shift[i] for i in range(3)]
    return rows[0], rows[1], rows[2]


def _turned(
    axis: tuple[float, ...], s: Any, c: Any, x: Any, y: Any, z: Any
) -> tuple[Any, Any, Any]:
    """Turn points about an axis of unit length; about x, y and z without the general formula."""
    ax, ay, az = axis
    if ax == ay == 0.0:
        s = s * az
        return c * x - s * y, s * x + c * y, z
    if ax == az == 0.0:
        s = s * ay
        return c * x + s * z, y, c * z - s * x
    if ay == az == 0.0:
        s = s * ax
        return x, c * y - s * z, s * y + c * z
    along = (1.0 - c) * (ax * x + ay * y + az * z)
    return (
        c * x + s * (ay * z - az * y) + ax * along,
        c * y + s * (az * x - ax * z) + ay * along,
        c * z + s * (ax * y - ay * x) + az * along,
    )
