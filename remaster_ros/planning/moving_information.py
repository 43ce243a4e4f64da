# SPDX-License-Identifier: Apache-2.0
"""Information that measuring along curves gives about the joint offsets, before any motion.

Rows are those of a fit of a moving session (`calibration.dynamics`): means of the frames of a
tenth of a second, and the same parameters, with the same priors: offsets, registrations, markers,
clocks, lags, wind-up, inertia and the tool's modes. The noise of a row is the sensor's white noise
over the root of its frames, and an error of the sensor at a pose, which is common to its markers.

That error is the process of `calibration.path_noise`, over the tool's pose, at the lengths that a
fit begins with. While curves are chosen, those of different curves count as independent, so that
information adds up, and friction as a function of the speed; what is stated in the end counts all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from remaster_ros.calibration.dynamics import (
    CLOCK_STD_S,
    DRIFT_STD,
    LAG_STD_S,
    MODE_STD_S2,
    MODES,
    ROW_S,
    SOFTNESS_STD,
    WINDUP_STD_RAD,
    MotionColumns,
    dynamic_extension,
)
from remaster_ros.calibration.identifiability import find_gauge
from remaster_ros.calibration.path_noise import START_M, START_RAD, PathNoise
from remaster_ros.calibration.priors import prior_rows
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.trajectory import RAMP_S, Curve
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    expected_priors,
    expected_rows,
    nominal_model,
)
from remaster_ros.types import FloatArray, Priors

FRAMES_OF_ROW = 12
"""Frames of a row, of a camera of 120 Hz."""
SLOW_RAD_S = 0.01
"""Speed at which friction has 76 % of its full torque, while curves are chosen."""
SMOOTHNESS = 1
"""Index in `path_noise.ORDERS` of the process, 3/2: between those that a fit may find."""
OWN_M = 0.05e-3
"""Error of each marker by itself that curves are chosen for, per axis, m: it changes with the
tool's pose as the common one. Cell files have none, and real cameras some."""
UNKNOWN = 1e-10
"""Ridge on the information of a parameter, as a share of its own information."""


@dataclass(frozen=True, eq=False)
class MotionRows:
    """Joint positions, velocities and accelerations of a moving arm at n times, k joints."""

    seconds: FloatArray  # Times of their middles since the start of the motion, s, (n,)
    q: FloatArray  # rad or m, (n, k)
    velocity: FloatArray  # Per s
    acceleration: FloatArray  # Per s²

    @classmethod
    def of(cls, curve: Curve, begin_s: float = 0.0) -> MotionRows:
        """Rows at the middles of intervals of 0.1 s (`ROW_S`) along a curve.

        ``begin_s``: time at which the curve begins, added to the times, s. At least one row.
        """
        count = max(int(curve.duration_s / ROW_S), 1)
        t: FloatArray = ROW_S * (np.arange(count, dtype=np.float64) + 0.5)
        share, rate = np.transpose([curve.share(time_s) for time_s in t.tolist()])
        first, second = curve.spline.at(share, 1), curve.spline.at(share, 2)
        begins_s, ends_s = curve.kinks_s
        change = (t < begins_s).astype(float) - (t > ends_s)
        rate, ramp = rate[:, None], (change * curve.rate / RAMP_S)[:, None]
        return cls(
            begin_s + t,
            curve.spline.at(share),
            rate * first,
            rate**2 * second + ramp * first,
        )

    @classmethod
    def joined(cls, parts: Sequence[MotionRows]) -> MotionRows:
        """All rows of several motions, one after the other."""
        return cls(
            np.concatenate([part.seconds for part in parts]),
            np.concatenate([part.q for part in parts]),
            np.concatenate([part.velocity for part in parts]),
            np.concatenate([part.acceleration for part in parts]),
        )


class MovingInformation:
    """Information of motions about p parameters, in a form that is quick to compute.

    Parameters
    ----------
    chain
        The nominal arm.
    sensors
        Their markers and expected noise.
    marker_std_m
        Prior of the markers' positions, per axis, m.
    middle
        A point of R amid the markers' places, m, (3,).
    own_m
        Error of each marker by itself, see `OWN_M`.

    Attributes
    ----------
    prior
        Information of the priors, (p, p).
    inner
        Indices of the joints between the first and the last, whose offsets any session determines.
    """

    def __init__(
        self,
        chain: SerialChain,
        sensors: Sequence[ExpectedSensor],
        marker_std_m: float,
        middle: FloatArray,
        own_m: float,
    ) -> None:
        self._chain, self._sensors, self._middle = chain, tuple(sensors), middle
        self._own_m = own_m
        names = list(dict.fromkeys(name for sensor in sensors for name in sensor.markers))
        places = {name: at for sensor in sensors for name, at in sensor.markers.items()}
        self._names, self._amid = names, np.mean(list(places.values()), axis=0)
        k, s = len(chain), len(sensors)
        self.inner = np.arange(1, k - 1) if k > 2 else np.arange(k)
        # Columns of offsets, registrations, markers, clocks, lags, wind-up, inertia and modes.
        per = chain.per_radian
        softness = SOFTNESS_STD * per**2 if chain.has_inertials else np.empty(0)
        std = np.concatenate(
            (
                np.full(k + 6 * s, np.inf),
                np.full(3 * len(names), marker_std_m),
                np.tile([CLOCK_STD_S, DRIFT_STD], s),
                np.full(k, LAG_STD_S),
                WINDUP_STD_RAD * per,
                softness,
                np.full(len(MODES), MODE_STD_S2),
            )
        )
        # The first joint's offset is one with the registrations.
        std[0] = 1e-9
        self.prior: FloatArray = np.diag(std**-2.0)

    def of(self, rows: MotionRows) -> FloatArray:
        """Information of the rows of one motion, (p, p), without that of the priors."""
        chain, n, k = self._chain, len(rows.q), len(self._chain)
        rates, nowhere = (rows.velocity, rows.acceleration), np.full_like(rows.q, np.nan)
        motion = MotionColumns(chain, rows.q, *rates, rows.seconds, nowhere)
        tool = motion.links.frames[:, -1] @ chain.T_fixed[-1]
        turn = tool[:, :3, :3]
        friction = np.tanh(rows.velocity / (SLOW_RAD_S * chain.per_radian))
        swing = motion.swing(self._amid)
        turning = [rows.velocity, friction]
        if chain.has_inertials:
            turning.append(motion.inertial_torque)
        process = process_along(tool)
        p, total = len(self.prior), np.zeros(self.prior.shape)
        for index, sensor in enumerate(self._sensors):
            markers = np.array(list(sensor.markers.values()))
            columns = np.zeros((n, len(markers), 3, p))
            at = k + 6 * index
            clock = k + 6 * len(self._sensors) + 3 * len(self._names)
            for number, (name, place) in enumerate(sensor.markers.items()):
                J = chain.position_jacobian(rows.q, place)
                jac = columns[:, number]
                jac[:, :, :k] = J
                jac[:, :, at : at + 3] = np.eye(3)
                arm = turn @ place + tool[:, :3, 3] - self._middle
                jac[:, :, at + 3 : at + 6] = np.cross(np.eye(3)[None], arm[:, None]).swapaxes(1, 2)
                of_marker = k + 6 * len(self._sensors) + 3 * self._names.index(name)
                jac[:, :, of_marker : of_marker + 3] = turn
                moved = np.einsum('nij,nj->ni', J, rows.velocity)
                jac[:, :, clock + 2 * index] = moved
                jac[:, :, clock + 2 * index + 1] = moved * rows.seconds[:, None]
                after = clock + 2 * len(self._sensors)
                for values in turning:
                    jac[:, :, after : after + k] = J * values[:, None, :]
                    after += k
                jac[:, :, after:] = swing
            total += _information(columns, sensor, process, self._own_m)
        return total

    def variance(self, information: FloatArray) -> float:
        """Mean variance of the offsets of the `inner` joints, by information and priors, rad².

        ``information``: sum of `of` over the motions, (p, p).
        """
        return float(np.mean(np.diag(_inverse(information + self.prior))[self.inner]))


def process_along(tool: FloatArray) -> FloatArray:
    """Correlations of a sensor's error between tool poses along a motion, (n, n).

    ``tool``: poses T_R_T, (n, 4, 4). They are of the random process by which a fit models an
    error that changes along a path (`calibration.path_noise`), with the correlation lengths
    that a fit begins with.
    """
    noise = PathNoise(
        tool[:, :3, 3],
        tool[:, :3, :3].reshape(-1, 9),
        share=np.ones(1),
        marker_share=np.zeros(1),
        length_m=np.array([START_M]),
        length_rad=np.array([START_RAD]),
        marker_scale=np.ones(1),
        order=np.array([SMOOTHNESS]),
    )
    return noise.of_frames(0, np.arange(len(tool)))


def _information(
    columns: FloatArray, sensor: ExpectedSensor, process: FloatArray, own_m: float
) -> FloatArray:
    """Information of rows of a sensor about p parameters, (p, p).

    ``columns``: derivatives of the markers, (n, markers, 3, p); ``process``: correlations
    between rows of the errors that change along the motion, (n, n): one that all markers
    share, and one of each marker by itself; ``own_m``: standard deviation of the latter, per
    axis, m.
    """
    n, count, _, p = columns.shape
    white = sensor.sigma_m**2 / FRAMES_OF_ROW
    mean = columns.mean(axis=1)
    frame = sensor.frame_sigma_m**2 / FRAMES_OF_ROW
    common = sensor.pose_sigma_m**2 + own_m**2 / count
    found = np.zeros((p, p))
    for part, field, variance in (
        (mean, common, white / count + frame),
        (columns - mean[:, None], own_m**2, white),
    ):
        flat = part.reshape(n, -1)
        if field > 0.0:
            factor = np.linalg.cholesky(field * process + variance * np.eye(n))
            flat = solve_triangular(factor, flat, lower=True, check_finite=False)
            variance = 1.0
        flat = flat.reshape(-1, p)
        found += flat.T @ flat / variance
    return found


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix (p, p) of parameters of any units, their covariance.

    With a ridge (`UNKNOWN`), so that a singular matrix gives large variances.
    """
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * np.outer(unit, unit) + UNKNOWN * np.eye(len(unit))
    return np.asarray(np.linalg.inv(scaled) * np.outer(unit, unit))


@dataclass(frozen=True)
class MovingExpected:
    """Expected precision of a fit of motions."""

    joint_std: Mapping[str, float | None]  # rad or m, by name; None if not identifiable
    joint_rms: float  # Root mean square of those identifiable, rad
    tool_rms: float  # RMS 3-D error of the predicted markers along the motions, m


def expected_along(
    chain: SerialChain,
    rows: MotionRows,
    sensors: Sequence[ExpectedSensor],
    marker_std_m: float,
    priors: Priors,
    own_m: float = 0.0,
) -> MovingExpected:
    """Expected precision of a fit of all rows of motions, with errors correlated along the path.

    ``rows``: of all motions; ``marker_std_m``: prior of the markers' positions, per axis, m;
    ``priors``: of offsets and registrations; ``own_m``: error of each marker by itself, see
    `OWN_M`. Raises InsufficientDataError if the rows do not determine the parameters.
    """
    n = len(rows.q)
    model, x = nominal_model(chain, rows.q, sensors, priors)
    prior_list = expected_priors(model, x, marker_std_m, priors)
    measurements = expected_measurements(model, rows.q, np.arange(n), sensors)
    at = measurements.configuration
    measurements = replace(
        measurements,
        velocity=rows.velocity[at],
        acceleration=rows.acceleration[at],
        stamp_s=rows.seconds[at],
    )
    fitted = expected_rows(model, x, measurements, sensors)
    gauge = find_gauge(model, x, fitted, prior_list)
    free = np.setdiff1d(np.arange(model.size), gauge.held)
    extension = dynamic_extension(chain, measurements, model.sensor_names, model.markers(x))
    moving = replace(model, extension=extension)
    natural = np.concatenate((x, extension.theta0))
    kept = np.concatenate((free, np.arange(model.size, moving.size)))
    columns = moving.natural_jacobian(natural, fitted)[:, :, kept]
    by_x = prior_rows(model, prior_list, x, natural=True)[1][:, free]
    information = block_diag(by_x.T @ by_x, extension.prior_precision)
    tool = chain.forward(rows.q)
    process = process_along(tool)
    for index, span in fitted.spans:
        sensor = sensors[index]
        ordered = columns[span][np.argsort(fitted.source[span])]
        ordered = ordered.reshape(n, len(sensor.markers), 3, -1)
        information += _information(ordered, sensor, process, own_m)
    covariance = _inverse(information)
    std = np.sqrt(np.diag(covariance))
    identifiable = {
        joint: int(np.searchsorted(free, joint))
        for joint in range(len(chain))
        if not gauge.why[joint]
    }
    joint_std = {
        name: float(std[identifiable[joint]]) if joint in identifiable else None
        for joint, name in enumerate(chain.joint_names)
    }
    free_slice = slice(0, len(free))
    flat = columns[:, :, free_slice].reshape(-1, len(free))
    tool_square = np.sum(covariance[free_slice, free_slice] * (flat.T @ flat)) / len(columns)
    known = [
        value / unit
        for value, unit in zip(joint_std.values(), chain.per_radian)
        if value is not None
    ]
    rms = float(np.sqrt(np.mean(np.square(known)))) if known else float('nan')
    return MovingExpected(joint_std, rms, float(np.sqrt(tool_square)))
