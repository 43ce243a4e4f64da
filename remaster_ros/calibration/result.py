"""What a fit gives: the posterior's summary, and everything that follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from remaster_ros.calibration.accuracy import accuracy_of
from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.identifiability import Gauge, GaugeDirection
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.noise_check import NoiseCheck, check_noise
from remaster_ros.calibration.predictive_accuracy import Predictive
from remaster_ros.calibration.sampler_info import SamplerInfo
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, inverse, matrix_to_rotation_vector
from remaster_ros.types import BoolArray, FloatArray, IntArray, Session

# An offset that a prior tells counts as known up to so many times what the data leave the others.
AS_GOOD_AS_SEEN = 2.0
# A mastering is off by tenths of a degree. More is a joint that has lost it, or joints, signs or a
# robot model that are not those of the arm that was measured.
LARGEST_OFFSET = np.radians(5.0)
# Of an angle that nothing is known of: uniform over the turn.
UNKNOWN_STD = np.pi / np.sqrt(3.0)


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of one sensor per axis, m: posterior means, and the std of ``sigma_m``.

    ``pose_sigma_m`` is None where no pose has two rows: ``sigma_m`` then holds both parts. Where
    the noise along the line of sight differs, these are root mean squares over the three axes, and
    ``directions`` has the noise 'along' and 'across'; otherwise it is empty.
    """

    sigma_m: float
    std_m: float
    pose_sigma_m: float | None
    pose_sigma_std_m: float | None
    directions: Mapping[str, NoiseEstimate] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FitResult:
    """The posterior of a session and what follows from it; k joints, p sampled parameters.

    Attributes
    ----------
    session, chain
        What was fitted, on which nominal robot.
    joint_names
        k names.
    parameter_names
        p names: joints, ``registration.<sensor>.x`` … ``rz`` (corrections about the centroid of
        the sensor's data to a registration near the result, see `model`), ``marker.<name>.x``,
        ``noise.<sensor>.sigma`` and ``.pose_sigma``. What is held fixed is not among them.
    draws
        (chains, draws, p); rad and m.
    trace
        The chains from their first state, thinned where long, (chains, records, p).
    joint_offset_draws
        rad, (chains, draws, k); zeros where a joint is held by the gauge (paper mode holds none).
    joint_offsets, joint_offsets_std, joint_offsets_interval95
        Posterior mean and std, rad, (k,), and 95 % interval, rad, (k, 2). A joint that neither
        data nor prior tell has mean 0, the std of a uniform turn, and the whole turn.
    identifiable
        False where the data cannot tell a joint's offset, (k,); true all the same where a prior
        tells it nearly as well as the data tell the others.
    why
        What the data alone cannot tell it from; '' where they can, k strings.
    gauge
        Every combination of parameters that the data cannot see.
    T_R_N, T_R_N_std_m, T_R_N_std_rad
        Registration of each sensor, (4, 4), with std of its translation and of its rotation
        along and about the axes of R, (3,) each; like all of the rest for offsets of 0 where
        nothing tells them.
    marker_positions, marker_std_m
        Markers in T, m, (3,) each.
    noise
        By sensor.
    T_R_N_before, marker_positions_before
        The same fit with all offsets held at zero.
    residuals_before, residuals_after
        Measured minus modelled position in N for every row of the session, m, (n, 3).
    accuracy
        The three metrics as fit.json has them.
    left_out
        (observation, reason) of every gross error.
    noise_checks
        Of every sensor: is what the fit leaves what noise explains?
    theta_names, theta_units
        Of the extension's m parameters; empty without one.
    theta, theta_std
        Posterior mean and std in these units, (m,).
    theta_draws
        (chains, draws, m).
    """

    session: Session
    chain: SerialChain
    joint_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    draws: FloatArray
    trace: FloatArray
    joint_offset_draws: FloatArray
    joint_offsets: FloatArray
    joint_offsets_std: FloatArray
    joint_offsets_interval95: FloatArray
    identifiable: BoolArray
    why: tuple[str, ...]
    gauge: tuple[GaugeDirection, ...]
    T_R_N: Mapping[str, FloatArray]
    T_R_N_std_m: Mapping[str, FloatArray]
    T_R_N_std_rad: Mapping[str, FloatArray]
    marker_positions: Mapping[str, FloatArray]
    marker_std_m: Mapping[str, FloatArray]
    noise: Mapping[str, NoiseEstimate]
    sampler: SamplerInfo
    T_R_N_before: Mapping[str, FloatArray]
    marker_positions_before: Mapping[str, FloatArray]
    residuals_before: FloatArray
    residuals_after: FloatArray
    accuracy: Mapping[str, Any]
    left_out: tuple[tuple[int, str], ...]
    noise_checks: tuple[NoiseCheck, ...]
    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    theta: FloatArray
    theta_std: FloatArray
    theta_draws: FloatArray

    @property
    def implausible(self) -> tuple[str, ...]:
        """A line for each joint whose offset is told, and too large for one of mastering."""
        return tuple(
            f'{joint}: an offset of {np.degrees(offset):.2f} degrees is more than a mastering is '
            f'off by ({np.degrees(LARGEST_OFFSET):.0f}); before it is used, check joint order, '
            'signs and units of the session, and that the URDF is that of this arm'
            for joint, offset, known in zip(
                self.joint_names, self.joint_offsets, self.identifiable, strict=True
            )
            if known and abs(offset) > LARGEST_OFFSET
        )


@dataclass(frozen=True, eq=False)
class Sampled:
    """What a sampler hands over to `build_result`.

    Attributes
    ----------
    model
        Whose parameters were sampled.
    z
        Pinned parameters, (chains, draws, size).
    z_mean
        Its mean, joints that nothing tells at 0, (size,).
    sigma, pose_sigma
        Noise of each sensor, m, (chains, draws, sensors).
    total_noise
        Both together, along and across the line of sight, m, (chains, draws, sensors, 2).
    trace, draws
        What moved, in the order of ``names`` and in readable units, (chains, ..., p).
    names
        p names.
    separable
        Sensor indices with a pose_sigma of their own.
    name, acceptance_rate
        Of the sampler.
    by_direction
        sigma and pose_sigma, m, (chains, draws) each, by sensor and 'along' or 'across'; only of
        the sensors whose noise differs between the two.
    precision
        That was asked for; None where a number of draws was.
    log_density_error, checked
        See `SamplerInfo`.
    gauge
        What the data cannot see.
    unfixed
        True for joints that neither the data nor a prior tell, (k,).
    taken_as_known
        Standard deviation, rad, of what the sampler took as known exactly and the session does
        not, in each joint's offset, (k,); it is added to that of the draws.
    z_before
        Pinned parameters of the fit with offsets at zero, (size,).
    left_out
        (row of the measurements, reason) of the gross errors.
    """

    model: Model
    z: FloatArray
    z_mean: FloatArray
    sigma: FloatArray
    pose_sigma: FloatArray
    total_noise: FloatArray
    trace: FloatArray
    draws: FloatArray
    names: tuple[str, ...]
    separable: tuple[int, ...]
    name: str
    acceptance_rate: float
    gauge: Gauge
    unfixed: BoolArray
    taken_as_known: FloatArray
    z_before: FloatArray
    left_out: tuple[tuple[int, str], ...]
    by_direction: Mapping[tuple[int, str], tuple[FloatArray, FloatArray]] = field(
        default_factory=dict
    )
    precision: float | None = None
    log_density_error: float = float('nan')
    checked: int = 0


def build_result(
    problem: Problem, sampled: Sampled, seconds: float, rng: np.random.Generator
) -> FitResult:
    """Summarise the draws; ``seconds`` is how long they took, ``rng`` for section V-C."""
    model, measurements = sampled.model, problem.measurements
    joints = model.joints
    # In pinned coordinates any value of a joint that nothing tells fits as well as 0.
    z = sampled.z.copy()
    z[..., np.flatnonzero(sampled.unfixed)] = 0.0
    flat = z.reshape(-1, model.size)
    x_after, x_before = model.natural(sampled.z_mean), model.natural(sampled.z_before)
    predicted_before = predicted_rows(problem, model, sampled.z_before)
    predicted_after = predicted_rows(problem, model, sampled.z_mean)

    offset_draws = sampled.z[..., :joints]
    pooled = flat[:, :joints]
    mean, std = pooled.mean(axis=0), pooled.std(axis=0, ddof=1)
    interval = np.quantile(pooled, (0.025, 0.975), axis=0).T
    more = sampled.taken_as_known
    std = np.hypot(std, more)
    # 1.96 standard deviations to either side hold 95 %.
    half = np.hypot(interval - mean[:, None], 1.96 * more[:, None])
    interval = mean[:, None] + half * (-1.0, 1.0)
    mean = np.where(sampled.unfixed, 0.0, mean)
    std = np.where(sampled.unfixed, UNKNOWN_STD, std)
    interval = np.where(sampled.unfixed[:, None], (-np.pi, np.pi), interval)

    T_R_N = model.T_R_N(x_after)
    x_draws = model.natural(flat)
    T_draws = model.T_R_N(x_draws)
    turns = matrix_to_rotation_vector(T_draws[..., :3, :3] @ np.swapaxes(T_R_N[:, :3, :3], -1, -2))
    sensors, markers = problem.sensor_names, problem.marker_names
    marker_draws = model.markers(x_draws)
    left_rows = np.array([row for row, _ in sampled.left_out], dtype=np.int64)
    residuals_after = measurements.position - predicted_after
    return FitResult(
        session=problem.session,
        chain=problem.chain,
        joint_names=problem.chain.joint_names,
        parameter_names=sampled.names,
        draws=sampled.draws,
        trace=sampled.trace,
        joint_offset_draws=offset_draws,
        joint_offsets=mean,
        joint_offsets_std=std,
        joint_offsets_interval95=interval,
        identifiable=_identifiable(sampled.gauge.why, std),
        why=sampled.gauge.why,
        gauge=sampled.gauge.directions,
        T_R_N=dict(zip(sensors, T_R_N, strict=True)),
        T_R_N_std_m=dict(zip(sensors, T_draws[..., :3, 3].std(axis=0, ddof=1), strict=True)),
        T_R_N_std_rad=dict(zip(sensors, turns.std(axis=0, ddof=1), strict=True)),
        marker_positions=dict(zip(markers, model.markers(x_after), strict=True)),
        marker_std_m=dict(zip(markers, marker_draws.std(axis=0, ddof=1), strict=True)),
        noise=_noise(sampled, sensors),
        sampler=SamplerInfo.of(
            sampled.draws,
            sampled.names,
            name=sampled.name,
            acceptance_rate=sampled.acceptance_rate,
            wanted=sampled.precision,
            log_density_error=sampled.log_density_error,
            checked=sampled.checked,
            seconds=seconds,
        ),
        T_R_N_before=dict(zip(sensors, model.T_R_N(x_before), strict=True)),
        marker_positions_before=dict(zip(markers, model.markers(x_before), strict=True)),
        residuals_before=measurements.position - predicted_before,
        residuals_after=residuals_after,
        accuracy=_accuracy(problem, sampled, predicted_before, predicted_after, left_rows, rng),
        left_out=tuple((int(measurements.observation[row]), why) for row, why in sampled.left_out),
        noise_checks=check_noise(
            measurements,
            sensors,
            residuals_after,
            measurements.observation[left_rows],
            parameters=sum(not name.startswith('noise.') for name in sampled.names),
        ),
        theta_names=model.extension.names if model.extension is not None else (),
        theta_units=model.extension.units if model.extension is not None else (),
        theta=model.theta(sampled.z_mean),
        theta_std=model.theta(flat).std(axis=0, ddof=1),
        theta_draws=model.theta(sampled.z),
    )


def _identifiable(why: tuple[str, ...], std: FloatArray) -> BoolArray:
    """Tell which offsets (k,) the data tell, or a prior nearly as well as they tell the others."""
    seen = np.array([not text for text in why])
    if not seen.any():
        return seen
    known: BoolArray = std <= AS_GOOD_AS_SEEN * np.median(std[seen])
    return seen | known


def predicted_rows(problem: Problem, model: Model, z: FloatArray) -> FloatArray:
    """Return where the sensors should see the markers of all rows by pinned z, (n, 3)."""
    measurements = problem.measurements
    rows = Rows.of(measurements, np.arange(len(measurements)), model.reference)
    predicted = np.empty((len(measurements), 3))
    predicted[rows.source] = model.predict(z, rows)
    return apply(inverse(model.reference)[measurements.sensor], predicted)


def _noise(sampled: Sampled, sensors: tuple[str, ...]) -> dict[str, NoiseEstimate]:
    noise = {}
    for index, name in enumerate(sensors):
        known = index in sampled.separable
        noise[name] = replace(
            _noise_estimate(sampled.sigma[..., index], sampled.pose_sigma[..., index], known),
            directions={
                direction: _noise_estimate(*draws, known)
                for (sensor, direction), draws in sampled.by_direction.items()
                if sensor == index
            },
        )
    return noise


def _noise_estimate(sigma: FloatArray, pose: FloatArray, known: bool) -> NoiseEstimate:
    return NoiseEstimate(
        sigma_m=float(sigma.mean()),
        std_m=float(sigma.std(ddof=1)),
        pose_sigma_m=float(pose.mean()) if known else None,
        pose_sigma_std_m=float(pose.std(ddof=1)) if known else None,
    )


def _accuracy(
    problem: Problem,
    sampled: Sampled,
    predicted_before: FloatArray,
    predicted_after: FloatArray,
    left_rows: IntArray,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Compute the metrics on the fitted rows and on all of the validation rows."""
    predictive = Predictive(
        model=sampled.model,
        before=sampled.z_before,
        after=sampled.z_mean,
        draws=sampled.z.reshape(-1, sampled.model.size),
        sigma=sampled.total_noise.reshape(-1, *sampled.total_noise.shape[2:]),
    )
    splits = {
        'optimization': np.setdiff1d(problem.fitted, left_rows),
        'validation': np.flatnonzero(problem.measurements.is_validation),
    }
    return accuracy_of(
        problem.measurements, splits, predicted_before, predicted_after, predictive, rng
    )
