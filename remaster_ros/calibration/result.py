# SPDX-License-Identifier: Apache-2.0
"""What a fit gives: the posterior's summary, and everything that follows from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve

from remaster_ros.calibration.comparison import Comparison, compared, predicted_rows
from remaster_ros.calibration.convergence import SamplerInfo
from remaster_ros.calibration.dynamics import clocks_of
from remaster_ros.calibration.estimate import Estimate, Problem
from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.identifiability import Gauge, GaugeDirection, known_offsets
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.left_out import held_out_tests
from remaster_ros.calibration.metropolis import Chains
from remaster_ros.calibration.noise_check import NoiseCheck, check_noise
from remaster_ros.calibration.noise_estimate import NoiseEstimate, noise_estimates
from remaster_ros.calibration.orientation_accuracy import TurnsTell, what_turns_tell
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.predictive_accuracy import Predictive
from remaster_ros.calibration.priors import DISPLACED, LARGEST_OFFSET
from remaster_ros.calibration.residual_structure import (
    ResidualStructure,
    StructureTest,
    errors_are_left,
    residual_structure,
)
from remaster_ros.calibration.smooth_functions import (
    of_joint_angles,
    of_joint_times,
    of_links,
    of_position,
    of_time,
    spread_poses,
    whitened,
)
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_to_rotation_vector
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Session

# Standard deviations of the offsets that hold where the model leaves other errors out.
#
# What is left out is not only noise: it shifts the estimates. So smooth functions stand beside the
# model's columns (`smooth_functions`), each family with a Gaussian prior whose width is estimated:
# a discrepancy as Kennedy and O'Hagan (2001, doi:10.1111/1467-9868.00294) have it. The variance of
# an offset is then that of this larger model, plus the square of how far its estimate is from that
# of the model itself. A sandwich or a bootstrap by pose is no remedy: it holds for where the wrong
# model would end with more data of the same kind, not for the truth (figures: docs/statistics.md).


# Logarithms of the variances, in units of the noise's: where the search begins, the width of a
# weak prior about it, and how far it may go.
START, PRIOR_STD = -3.0, 10.0
RANGE = (-9.0, 6.0)
NOISE_RANGE = (-3.0, 3.0)


def robust_std(mode: Mode, measurements: Measurements) -> FloatArray:
    """Return the standard deviation of each joint's offset with a discrepancy, rad, (k,).

    0 for offsets that are held. Never below that of the model.

    ``mode``: of the posterior of the rows fitted; ``measurements``: that the rows were taken from.
    """
    posterior = mode.linearisation.posterior
    rows = spread_poses(posterior.rows)
    seconds = measurements.stamp_s[rows.source]
    links, tilts = of_links(mode, rows)
    families = {
        'position': of_position(rows),
        'time': of_time(rows, seconds),
        'joint_angle': of_joint_angles(mode, rows),
        'joint_time': of_joint_times(mode, rows, seconds),
        'link': links,
        'tilt': tilts,
    }
    white = whitened(mode, rows, families)
    f = len(posterior.free)
    parts = [white['model'].reshape(-1, f)]
    parts += [_unit(white[name]) for name in families]
    columns, errors = np.concatenate(parts, axis=1), white['errors'].ravel()
    size = np.array([part.shape[1] for part in parts[1:]])
    family = np.repeat(np.arange(len(size)), size)
    gram, pull = columns.T @ columns, columns.T @ errors
    square, count = float(errors @ errors), len(errors)
    prior = mode.linearisation.prior[:f, :f]

    def system(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the precision of all parameters and their scale for the log variances."""
        precision = gram / np.exp(logs[0])
        precision[:f, :f] += prior
        inner = np.arange(f, len(precision))
        precision[inner, inner] += np.exp(-logs[1:][family])
        scale = np.sqrt(np.diag(precision))
        return precision / np.outer(scale, scale), scale

    def cost(logs: FloatArray) -> float:
        """Return minus the log likelihood, the parameters integrated out."""
        scaled, scale = system(logs)
        root = cho_factor(scaled, lower=True)
        right = pull / scale / np.exp(logs[0])
        left = square / np.exp(logs[0]) - right @ cho_solve(root, right)
        determinant = np.sum(np.log(np.diag(root[0]))) + np.sum(np.log(scale))
        weak = np.sum(((logs[1:] - START) / PRIOR_STD) ** 2)
        return float(0.5 * (count * logs[0] + size @ logs[1:] + left + weak) + determinant)

    start = np.append(0.0, np.full(len(size), START))
    bounds = [NOISE_RANGE, *[RANGE] * len(size)]
    logs = scipy.optimize.minimize(cost, start, method='L-BFGS-B', bounds=bounds).x
    scaled, scale = system(logs)
    root = cho_factor(scaled, lower=True)
    shift = cho_solve(root, pull / scale / np.exp(logs[0])) / scale
    variance = np.diag(cho_solve(root, np.eye(len(scale)))) / scale**2
    joints = np.flatnonzero(posterior.free < posterior.model.joints)
    least = np.diag(mode.covariance)[joints]
    std = np.zeros(posterior.model.joints)
    std[posterior.free[joints]] = np.sqrt(np.maximum(variance[joints], least) + shift[joints] ** 2)
    return std


def _unit(columns: FloatArray) -> FloatArray:
    """Return columns (n, 3, c), but those of zeros, as (3 n, c) with a mean square of 1 a row."""
    flat = columns.reshape(-1, columns.shape[2])
    length = np.linalg.norm(flat, axis=0)
    kept = length > 1e-9 * np.max(length)
    unit: FloatArray = flat[:, kept] / length[kept] * np.sqrt(len(columns))
    return unit


# Of an unknown angle, uniform over the turn; an unknown length is as much at `LEVER_M`.
UNKNOWN_STD = np.pi / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Orientations:
    """What came of the orientations that were measured."""

    # Why they are not fitted, a sentence; '' where they are, and the rest is empty otherwise
    why_not: str
    count: int = 0  # How many were fitted
    # By sensor, rad where `NoiseEstimate` has m
    noise: Mapping[str, NoiseEstimate] = field(default_factory=dict)
    # How each body stands on the tool, (3, 3), and its standard deviation about the axes of T,
    # (3,); like the markers for offsets of 0 where they are not identifiable
    R_T_B: Mapping[str, FloatArray] = field(default_factory=dict)
    std_rad: Mapping[str, FloatArray] = field(default_factory=dict)
    tell: TurnsTell | None = None  # What they tell of the offsets

    def words(self, chain: SerialChain, std: FloatArray) -> str:
        """Return what orientations did to offsets with these std (k,), a sentence."""
        if self.why_not or self.tell is None:
            return self.why_not
        noises = ' and '.join(
            f'{np.degrees(np.sqrt(one.sigma_m**2 + (one.pose_sigma_m or 0.0) ** 2)):.3f} deg '
            f'({sensor})'
            for sensor, one in self.noise.items()
        )
        text = f'{self.count} orientations are fitted, too; their noise is {noises} per axis'
        held = std <= 0.0
        gain = np.where(held, 0.0, self.tell.std_without / np.where(held, 1.0, std))
        joint = int(np.argmax(gain))
        if not np.isfinite(gain[joint]):
            return f'{text}; the positions alone do not determine {chain.joint_names[joint]}'
        scale, unit = chain.shown_scale[joint], chain.shown_units[joint]
        return (
            f'{text}; {chain.joint_names[joint]} is known to {scale * std[joint]:.4f} {unit} with '
            f'them, to {scale * self.tell.std_without[joint]:.4f} by the positions alone, if the '
            'arm is exactly its drawing'
        )


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
        ``noise.<sensor>.sigma`` and ``.pose_sigma`` and
        ``.frame_sigma`` where it has them. What is held fixed is not among them.
    draws
        (chains, draws, p); rad and m.
    trace
        The chains from their first state, thinned where long, (chains, records, p).
    joint_offset_draws
        rad, (chains, draws, k); zeros where a joint is held by the gauge (paper mode holds none).
    joint_offsets, joint_offsets_std, joint_offsets_interval95
        Posterior mean and std, rad, (k,), and 95 % interval, rad, (k, 2). A joint that neither
        data nor prior determine has mean 0, the std of a uniform turn, and the whole turn.
    identifiable
        False where the data do not determine a joint's offset, (k,); true all the same where a
        prior determines it nearly as well as the data determine the others.
    why
        What the data alone do not distinguish it from; '' where they do, k strings.
    gauge
        Every combination of parameters that the data do not determine.
    T_R_N, T_R_N_std_m, T_R_N_std_rad
        Registration of each sensor, (4, 4), with std of its translation and of its rotation
        along and about the axes of R, (3,) each; like all of the rest for offsets of 0 where
        they are not identifiable.
    marker_positions, marker_std_m
        Markers in T, m, (3,) each.
    noise
        By sensor.
    residuals_after
        Measured minus modelled position in N for every row of the session, m, (n, 3).
    compare
        Returns the `comparison`: where there are further effects it is made when asked for.
    left_out
        (observation, reason) of every gross error.
    noise_checks
        Of every sensor: is what the fit leaves what noise explains?
    structure
        What the residuals follow, and whether held-out poses differ; None where the sampler is
        the paper's, or with an extension.
    widening
        How many times the standard deviation and the interval of each joint's offset are those of
        the model, because of errors that it leaves out, (k,); 1 where there are none.
    theta_names
        Of the extension's m parameters; empty without one.
    theta, theta_std
        Their posterior mean and std, in their units, (m,).
    theta_draws
        (chains, draws, m).
    predictive
        The posterior as predictions take it.
    found
        The estimate whose posterior was sampled; None where the sampler is the paper's.
    orientations
        What came of measured orientations; None where none were measured.
    """

    session: Session
    # All its rows, ``sensor`` and ``marker`` counted among those that have any, as in `T_R_N` and
    # `marker_positions`
    measurements: Measurements
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
    residuals_after: FloatArray
    compare: Callable[[], Comparison]
    left_out: tuple[tuple[int, str], ...]
    noise_checks: tuple[NoiseCheck, ...]
    structure: ResidualStructure | None
    widening: FloatArray
    theta_names: tuple[str, ...]
    theta: FloatArray
    theta_std: FloatArray
    theta_draws: FloatArray
    predictive: Predictive
    found: Estimate | None = None
    orientations: Orientations | None = None

    @property
    def comparison(self) -> Comparison:
        """The same fit with all offsets held at zero beside this one."""
        return self.compare()

    @property
    def clocks(self) -> Mapping[str, tuple[float, float]]:
        """How late each sensor's stamps are beside the joints', and std, s; {} if none moved."""
        return {} if self.found is None else clocks_of(self.found)

    @property
    def T_R_N_before(self) -> Mapping[str, FloatArray]:
        """Registrations of the same fit with all offsets held at zero."""
        return self.comparison.T_R_N_before

    @property
    def residuals_before(self) -> FloatArray:
        """Measured minus modelled position in N with all offsets held at zero, m, (n, 3)."""
        return self.comparison.residuals_before

    @property
    def accuracy(self) -> Mapping[str, Any]:
        """The three metrics as fit.json has them."""
        return self.comparison.accuracy

    @property
    def orientations_in_words(self) -> str:
        """What measured orientations did, a sentence; '' where there are none."""
        if self.orientations is None:
            return ''
        std = np.where(self.identifiable, self.joint_offsets_std / self.widening, 0.0)
        return self.orientations.words(self.chain, std)

    @property
    def other_errors(self) -> bool:
        """Whether errors that are neither offsets nor noise are known to be left."""
        return errors_are_left(self.noise_checks, self.structure)

    @property
    def implausible(self) -> tuple[str, ...]:
        """A line for each joint whose offset is identifiable and too large for a mastering."""
        return tuple(
            f'{joint}: an offset of {amount} is more than a mastering is off by ({largest}); '
            'before it is used, check joint order, '
            'signs and units of the session, and that the URDF is that of this arm'
            for joint, amount, largest in self._too_large()
        )

    def _too_large(self) -> list[tuple[str, str, str]]:
        """Return the joints whose known offset is too large, with it and the limit as text."""
        limit, found = LARGEST_OFFSET * self.chain.per_radian, []
        for i in np.flatnonzero(self.identifiable & (np.abs(self.joint_offsets) > limit)).tolist():
            amount = self.chain.shown_offset(i, self.joint_offsets[i]).replace('deg', 'degrees')
            largest = f'{self.chain.shown_scale[i] * limit[i]:.0f}'
            found.append((self.joint_names[i], amount, largest))
        return found

    @property
    def displaced_markers(self) -> tuple[str, ...]:
        """A line for each marker that is not where it was stated to be, as well as it was."""
        if self.found is None:
            return ()
        problem, link = self.found.problem, self.session.tip_link
        lines = []
        for name, stated, std in zip(
            problem.marker_names, problem.markers, problem.marker_std_m, strict=True
        ):
            off = float(np.linalg.norm(self.marker_positions[name] - stated))
            if off > DISPLACED * std:
                lines.append(
                    f'{the("marker", name)}: the fit has it {1e3 * off:.1f} mm from its stated '
                    f'place, {off / std:.1f} times what that is stated to be known to '
                    f'({1e3 * std:.3g} mm). Check the place, its unit, and that {link} is the '
                    'link that carries it; or state how well the place is known (marker_std_m)'
                )
        return tuple(lines)


@dataclass(frozen=True, eq=False)
class Sampled:
    """What a sampler hands over to `build_result`."""

    posterior: Posterior  # Whose parameters and noise were sampled
    # Pinned parameters, (chains, draws, size), and noise coordinates, (chains, draws, e)
    z: FloatArray
    eta: FloatArray
    z_mean: FloatArray  # Mean of z, joints that are not identifiable at 0, (size,)
    moved: IntArray  # Indices of the sampled parameters, (m,)
    # The chains, in natural units and in the order of `FitResult.parameter_names`, and which
    # sampler it was
    run: Chains
    name: str
    precision: float | None  # That was asked for; None where a number of draws was
    gauge: Gauge  # What the data do not determine
    # Standard deviation, rad, of what the sampler took as known exactly and the session does not,
    # in each joint's offset, (k,); it is added to that of the draws
    taken_as_known: FloatArray
    # Returns the pinned parameters of the fit with offsets at zero, (size,)
    z_before: Callable[[], FloatArray]
    left_out: tuple[tuple[int, str], ...]  # (row of the measurements, reason) of the gross errors
    mode: Mode | None = None  # Of the posterior; None where it was not sought
    # How c causes outside the model move the natural parameters, one standard deviation of each,
    # (size, c); None where none are expected
    unmodelled: FloatArray | None = None
    found: Estimate | None = None  # Whose posterior it is; None where it was not sought

    def widened(self, rng: np.random.Generator) -> Sampled:
        """Return the same with the draws moved by causes outside the model."""
        if self.unmodelled is None:
            return self
        causes = rng.standard_normal((*self.z.shape[:-1], self.unmodelled.shape[1]))
        causes -= causes.mean(axis=(0, 1))
        model = self.posterior.model
        return replace(self, z=model.pinned(model.natural(self.z) + causes @ self.unmodelled.T))


def sampled_columns(
    posterior: Posterior, x: FloatArray, eta: FloatArray, moved: IntArray
) -> FloatArray:
    """Return natural parameters x (..., size) and noise eta (..., e) as chains of a fit, (..., p).

    The moved parameters, every channel's sigma, and what their rows share where that is known.
    """
    noise = posterior.noise(eta)
    shared = posterior.noise_model.shared(noise)
    return np.concatenate((x[..., moved], noise.sigma, shared), axis=-1)


def _sampled_names(posterior: Posterior, moved: IntArray) -> tuple[str, ...]:
    """Return the names of `sampled_columns`."""
    model, noise_model = posterior.model, posterior.noise_model
    noises = [
        '.'.join(filter(None, ('noise', posterior.noise_names[channel.sensor], channel.direction)))
        for channel in noise_model.channels
    ]
    return (
        *(model.names[index] for index in moved),
        *(f'{noise}.sigma' for noise in noises),
        *(f'{noises[index]}.pose_sigma' for index in noise_model.separable),
        *(f'{noises[index]}.frame_sigma' for index in noise_model.framed),
    )


def build_result(
    problem: Problem, sampled: Sampled, seconds: float, rng: np.random.Generator
) -> FitResult:
    """Summarise the draws; ``seconds`` is how long they took, ``rng`` for section V-C."""
    posterior, gauge, measurements = sampled.posterior, sampled.gauge, problem.measurements
    model = posterior.model
    # In pinned coordinates any value of a joint that is not identifiable fits as well as 0.
    unfixed = np.isin(np.arange(model.joints), gauge.held)
    # Causes outside the model move parameters, but hardly the predictions.
    by_data, sampled = sampled, sampled.widened(rng)
    z = sampled.z.copy()
    z[..., np.flatnonzero(unfixed)] = 0.0
    flat = z.reshape(-1, model.size)
    x_after = model.natural(sampled.z_mean)
    predicted_after = predicted_rows(problem, model, sampled.z_mean)
    held = np.where(unfixed, model.chain.per_radian, 0.0)
    mean, std, interval = _offset_summary(flat[:, : model.joints], held, sampled.taken_as_known)
    std_by_data = _offset_summary(
        by_data.z[..., : model.joints].reshape(-1, model.joints), held, sampled.taken_as_known
    )[1]
    T_R_N, markers = model.T_R_N(x_after), model.markers(x_after)
    x_draws = model.natural(flat)
    T_draws = model.T_R_N(x_draws)
    turns = matrix_to_rotation_vector(T_draws[..., :3, :3] @ np.swapaxes(T_R_N[:, :3, :3], -1, -2))
    left_rows = np.array([row for row, _ in sampled.left_out], dtype=np.int64)
    left_out = measurements.observation[left_rows]
    residuals_after = measurements.position - predicted_after
    noise_checks = check_noise(
        measurements,
        problem.sensor_names,
        residuals_after,
        left_out,
        parameters=len(sampled.moved) - 3 * len(model.bodies),
    )
    structure, widening, tell = None, np.ones(model.joints), None
    if sampled.mode is not None and not model.has_causes:
        gross = np.concatenate([np.zeros(0, np.int64), *(check.gross for check in noise_checks)])
        of_points = sampled.mode.of_points
        held_out = held_out_tests(of_points, measurements, gross)
        structure = residual_structure(of_points, measurements)
        tests = (*structure.tests, *held_out)
        tell = what_turns_tell(sampled.mode)
        if tell is not None:
            tests += (StructureTest('orientation', True, tell.p_value),)
        structure = replace(structure, tests=tests)
        if errors_are_left(noise_checks, structure):
            robust = robust_std(of_points, measurements)
            if tell is not None and any(test.driver == 'orientation' for test in structure.found):
                # One of the two is wrong, and nothing tells which.
                robust = np.hypot(robust, tell.shift)
            widening = np.where(unfixed, 1.0, np.maximum(1.0, robust / std))
    identifiable, why = known_offsets(problem.chain, gauge.why, std_by_data, widening * std)
    noise = posterior.noise(sampled.eta)
    noises = noise_estimates(posterior, noise)
    total_noise = posterior.noise_model.total_noise(noise)
    predictive = Predictive(
        model=model,
        after=sampled.z_mean,
        draws=by_data.z.reshape(-1, model.size),
        sigma=total_noise.reshape(-1, *total_noise.shape[2:]),
    )
    names = _sampled_names(posterior, sampled.moved)

    def by_sensor(values: FloatArray) -> dict[str, FloatArray]:
        return dict(zip(problem.sensor_names, values, strict=True))

    # Its own generator: draws are the same whether or not it is asked for.
    (own_rng,) = rng.spawn(1)

    @cache
    def compare() -> Comparison:
        kept = np.setdiff1d(problem.fitted, left_rows)
        after = sampled.z_mean
        return compared(problem, kept, sampled.z_before(), after, predictive, own_rng)

    def by_marker(values: FloatArray) -> dict[str, FloatArray]:
        return dict(zip(problem.marker_names, values, strict=True))

    return FitResult(
        session=problem.session,
        measurements=measurements,
        chain=problem.chain,
        joint_names=problem.chain.joint_names,
        parameter_names=names,
        draws=sampled.run.draws,
        trace=sampled.run.trace,
        joint_offset_draws=model.offsets(sampled.z),
        joint_offsets=mean,
        joint_offsets_std=widening * std,
        joint_offsets_interval95=mean[:, None] + widening[:, None] * (interval - mean[:, None]),
        identifiable=identifiable,
        why=why,
        gauge=gauge.directions,
        T_R_N=by_sensor(T_R_N),
        T_R_N_std_m=by_sensor(T_draws[..., :3, 3].std(axis=0, ddof=1)),
        T_R_N_std_rad=by_sensor(turns.std(axis=0, ddof=1)),
        marker_positions=by_marker(markers),
        marker_std_m=by_marker(model.markers(x_draws).std(axis=0, ddof=1)),
        noise={name: noises[name] for name in problem.sensor_names},
        orientations=_orientations(posterior, sampled, tell, x_after, x_draws),
        sampler=SamplerInfo.of(
            sampled.run,
            names,
            name=sampled.name,
            wanted=sampled.precision,
            seconds=seconds,
            weakest='' if sampled.mode is None else sampled.mode.weakest,
        ),
        residuals_after=residuals_after,
        compare=compare,
        left_out=tuple(zip(left_out.tolist(), (why for _, why in sampled.left_out), strict=True)),
        noise_checks=noise_checks,
        structure=structure,
        widening=widening,
        theta_names=model.extension.names if model.extension is not None else (),
        theta=model.theta(sampled.z_mean),
        theta_std=model.theta(flat).std(axis=0, ddof=1),
        theta_draws=model.theta(sampled.z),
        predictive=predictive,
        found=sampled.found,
    )


def _orientations(
    posterior: Posterior,
    sampled: Sampled,
    tell: TurnsTell | None,
    x: FloatArray,
    x_draws: FloatArray,
) -> Orientations | None:
    """Return what came of the orientations at natural x (size,) and of draws (n, size)."""
    model = posterior.model
    if not model.bodies:
        why_not = '' if sampled.found is None else sampled.found.without_turns
        return Orientations(why_not) if why_not else None
    noises = noise_estimates(posterior, posterior.noise(sampled.eta))
    count = len(model.sensor_names)
    names = {
        model.sensor_names[s]: name
        for s, name in zip(posterior.rows.turning, posterior.noise_names[count:], strict=True)
    }
    middle = model.R_T_B(x)
    turns = matrix_to_rotation_vector(model.R_T_B(x_draws) @ np.swapaxes(middle, -1, -2))
    return Orientations(
        '',
        len(posterior.rows) - posterior.rows.points,
        {sensor: noises[name] for sensor, name in names.items()},
        dict(zip(model.body_names, middle, strict=True)),
        dict(zip(model.body_names, turns.std(axis=0, ddof=1), strict=True)),
        tell,
    )


def _offset_summary(
    draws: FloatArray, held: FloatArray, taken_as_known: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean (k,), std (k,) and 95 % interval (k, 2) of offsets (n, k), rad or m.

    Of joints that are not identifiable, where ``held`` is what counts as a radian and not 0, they
    are 0 and those of the whole turn.
    """
    unfixed = held > 0.0
    mean = draws.mean(axis=0)
    std = np.hypot(draws.std(axis=0, ddof=1), taken_as_known)
    interval = np.quantile(draws, (0.025, 0.975), axis=0).T
    # 1.96 standard deviations to either side hold 95 %.
    half = np.hypot(interval - mean[:, None], 1.96 * taken_as_known[:, None])
    interval = mean[:, None] + half * (-1.0, 1.0)
    return (
        np.where(unfixed, 0.0, mean),
        np.where(unfixed, UNKNOWN_STD * held, std),
        np.where(unfixed[:, None], np.outer(held, (-np.pi, np.pi)), interval),
    )
