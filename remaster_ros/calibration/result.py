# SPDX-License-Identifier: Apache-2.0
"""Result of a fit: summary of the posterior, and the quantities that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from remaster_ros.calibration.comparison import Comparison, compared, predicted_rows
from remaster_ros.calibration.convergence import Diagnostics, SamplerInfo
from remaster_ros.calibration.dynamics import clocks_of, friction_at_rest
from remaster_ros.calibration.estimate import Estimate, Problem
from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.identifiability import Gauge, GaugeDirection, known_offsets
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.left_out import held_out_tests
from remaster_ros.calibration.metropolis import Chains
from remaster_ros.calibration.motion_proof import MotionProof, motion_proof
from remaster_ros.calibration.noise_check import NoiseCheck, check_noise
from remaster_ros.calibration.noise_estimate import NoiseEstimate, noise_estimates
from remaster_ros.calibration.orientation_accuracy import (
    OrientationInformation,
    orientation_information,
)
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.predictive_accuracy import Predictive
from remaster_ros.calibration.priors import DISPLACED, LARGEST_OFFSET
from remaster_ros.calibration.residual_structure import (
    ResidualStructure,
    StructureTest,
    errors_are_left,
    residual_structure,
)
from remaster_ros.calibration.robust_std import robust_std
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_to_rotation_vector
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Session

# Of an unknown angle, uniform over the turn; an unknown length is as much at `LEVER_M`.
UNKNOWN_STD = np.pi / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Orientations:
    """Result for measured orientations."""

    # Reason why orientations are not fitted, a sentence; the other fields are then empty. '' if
    # they are fitted
    why_not: str
    count: int = 0  # Number of fitted orientations
    # Noise by sensor, rad in place of the m of `NoiseEstimate`
    noise: Mapping[str, NoiseEstimate] = field(default_factory=dict)
    # Orientation of each body on the tool, (3, 3), and its standard deviation about the axes of T,
    # (3,); like the markers for offsets of 0 if these are not identifiable
    R_T_B: Mapping[str, FloatArray] = field(default_factory=dict)
    std_rad: Mapping[str, FloatArray] = field(default_factory=dict)
    information: OrientationInformation | None = None  # Information on the offsets

    def words(self, chain: SerialChain, std: FloatArray) -> str:
        """Effect of orientations on the offsets, a sentence; the reason if they are not fitted.

        ``std``: of the offsets by all data, rad or m, (k,); 0 for those that are held.
        """
        if self.why_not or self.information is None:
            return self.why_not
        noises = ' and '.join(
            f'{np.degrees(np.sqrt(noise.sigma_m**2 + (noise.pose_sigma_m or 0.0) ** 2)):.3f} deg '
            f'({sensor})'
            for sensor, noise in self.noise.items()
        )
        text = f'{self.count} orientations are fitted, too; their noise is {noises} per axis'
        is_fixed = std <= 0.0
        gain = np.where(is_fixed, 0.0, self.information.std_without / np.where(is_fixed, 1.0, std))
        joint = int(np.argmax(gain))
        if not np.isfinite(gain[joint]):
            return f'{text}; the positions alone do not determine {chain.joint_names[joint]}'
        scale, unit = chain.shown_scale[joint], chain.shown_units[joint]
        return (
            f'{text}; {chain.joint_names[joint]} is known to {scale * std[joint]:.4f} {unit} with '
            f'them, to {scale * self.information.std_without[joint]:.4f} by the positions alone, '
            'if the '
            'arm is exactly its drawing'
        )


@dataclass(frozen=True, eq=False)
class FitResult:
    """Posterior of a session and the quantities that follow from it.

    K joints, p sampled parameters.

    Attributes
    ----------
    session, chain
        Fitted session and nominal robot.
    joint_names
        k names.
    parameter_names
        p names: joints, ``registration.<sensor>.x`` … ``rz`` (corrections about the centroid of
        the sensor's data to a registration near the result, see `model`), ``marker.<name>.x``,
        ``noise.<sensor>.sigma``, and ``.pose_sigma`` and ``.frame_sigma`` if the noise has them.
        Fixed parameters are not included.
    draws
        (chains, draws, p); rad and m.
    trace
        Chains from their first state, thinned if long, (chains, records, p).
    joint_offset_draws
        rad, (chains, draws, k); zeros if a joint is held by the gauge (paper mode holds none).
    joint_offsets, joint_offsets_std, joint_offsets_interval95
        Posterior mean and std, rad, (k,), and 95 % interval, rad, (k, 2). A joint that neither
        data nor prior determine has mean 0, the std of a uniform rotation, and the whole turn.
    identifiable
        False if the data do not determine a joint's offset, (k,); true all the same if a prior
        determines it nearly as well as the data determine the others.
    why
        Parameters that the data alone cannot distinguish from the joint's offset; '' if the data
        determine the offset, k strings.
    gauge
        Every combination of parameters that the data do not determine.
    T_R_N, T_R_N_std_m, T_R_N_std_rad
        Registration of each sensor, (4, 4), with std of its translation and of its rotation along
        and about the axes of R, (3,) each; like all further results for offsets of 0 if these are
        not identifiable.
    marker_positions, marker_std_m
        Markers in T, m, (3,) each.
    noise
        Noise by sensor.
    residuals_after
        Measured minus modelled position in N for every row of the session, m, (n, 3).
    compare
        Returns the `comparison`: with effects in the model it is computed on demand.
    left_out
        (observation, reason) of every gross error.
    noise_checks
        For every sensor: whether noise explains the error after the fit.
    structure
        Structure of the residuals, and whether held-out poses differ; None with the paper's
        sampler, or with an extension.
    widening
        Factor of errors outside the model on the standard deviation and the interval of each
        joint's offset, (k,); 1 without such errors.
    theta_names
        Names of the extension's m parameters; empty without an extension.
    theta, theta_std
        Posterior mean and std of the extension's parameters, in their units, (m,).
    theta_draws
        (chains, draws, m).
    predictive
        Posterior as predictions use it.
    found
        Estimate whose posterior was sampled; None with the paper's sampler.
    orientations
        Result for measured orientations; None if none were measured.
    """

    session: Session
    # All rows of the session; ``sensor`` and ``marker`` are indices among those with rows, as in
    # `T_R_N` and `marker_positions`
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
    diagnostics: Diagnostics
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
        """Fit with all offsets held at zero, compared with this fit; computed once."""
        return self.compare()

    @property
    def clocks(self) -> Mapping[str, tuple[float, float]]:
        """Delay of each sensor's stamps against the joints', and its std, s, by name.

        {} if no parameters of motion were fitted (`clocks_of`).
        """
        return {} if self.found is None else clocks_of(self.found)

    @cached_property
    def motion_proof(self) -> MotionProof | None:
        """Held-out errors at standstill compared with those in motion; computed once.

        None if the session has no velocities, or too few held-out rows of either
        (`motion_proof`).
        """
        m = self.session.measurements
        if m.velocity is None:
            return None
        markers = np.array(list(self.session.markers.values()))[m.marker]
        jacobian = self.chain.position_jacobian(m.q, markers)
        speeds = np.einsum('nik,nk->ni', jacobian, np.nan_to_num(m.velocity))
        friction = np.zeros(len(m)) if self.found is None else friction_at_rest(self.found)
        return motion_proof(m, self.residuals_after, np.linalg.norm(speeds, axis=1), friction)

    @property
    def T_R_N_before(self) -> Mapping[str, FloatArray]:
        """Registrations T_R_N (4, 4), by sensor name, of the fit with all offsets held at zero."""
        return self.comparison.T_R_N_before

    @property
    def residuals_before(self) -> FloatArray:
        """Measured minus modelled position in N with all offsets held at zero, m, (n, 3)."""
        return self.comparison.residuals_before

    @property
    def accuracy(self) -> Mapping[str, Any]:
        """The three metrics before and after, by split ('optimization', 'validation').

        In the form of fit.json; see `Comparison`.
        """
        return self.comparison.accuracy

    @property
    def orientations_in_words(self) -> str:
        """Effect of measured orientations, a sentence; '' without orientations."""
        if self.orientations is None:
            return ''
        std = np.where(self.identifiable, self.joint_offsets_std / self.widening, 0.0)
        return self.orientations.words(self.chain, std)

    @property
    def other_errors(self) -> bool:
        """Whether noise checks or structure tests show errors beyond offsets and noise."""
        return errors_are_left(self.noise_checks, self.structure)

    @property
    def implausible(self) -> tuple[str, ...]:
        """Line for each joint whose offset is identifiable and above 5 degrees (`LARGEST_OFFSET`).

        For a joint that slides: above that times ``per_radian``, some 22 mm.
        """
        return tuple(
            f'{joint}: an offset of {amount} is more than a mastering is off by ({largest}); '
            'before it is used, check joint order, '
            'signs and units of the session, and that the URDF is that of this arm'
            for joint, amount, largest in self._too_large()
        )

    def _too_large(self) -> list[tuple[str, str, str]]:
        """Name, offset and limit as text of each joint with too large an identifiable offset."""
        limit, found = LARGEST_OFFSET * self.chain.per_radian, []
        for i in np.flatnonzero(self.identifiable & (np.abs(self.joint_offsets) > limit)).tolist():
            amount = self.chain.shown_offset(i, self.joint_offsets[i]).replace('deg', 'degrees')
            largest = f'{self.chain.shown_scale[i] * limit[i]:.0f}'
            found.append((self.joint_names[i], amount, largest))
        return found

    @property
    def displaced_markers(self) -> tuple[str, ...]:
        """Line for each marker off its stated position by over `DISPLACED` stated stds.

        () if the fit has no estimate.
        """
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
    """Draws of a sampler, with their posterior and gauge, from which a result is built."""

    posterior: Posterior  # Sampled posterior of parameters and noise
    # Pinned parameters, (chains, draws, size), and noise coordinates, (chains, draws, e)
    z: FloatArray
    eta: FloatArray
    z_mean: FloatArray  # Mean of z, with joints that are not identifiable at 0, (size,)
    moved: IntArray  # Indices of the sampled parameters, (m,)
    # Chains in natural units and in the order of `FitResult.parameter_names`, and the name of the
    # sampler
    run: Chains
    name: str
    precision: float | None  # Wanted precision; None if the number of draws was given
    gauge: Gauge  # Combinations that the data do not determine
    # Standard deviation of each joint's offset, rad, (k,), by quantities that the sampler holds
    # fixed and the session does not know exactly; added to that of the draws
    taken_as_known: FloatArray
    # Function to the pinned parameters of the fit with offsets at zero, (size,)
    z_before: Callable[[], FloatArray]
    left_out: tuple[tuple[int, str], ...]  # (row of the measurements, reason) of the gross errors
    mode: Mode | None = None  # Mode of the posterior; None if it was not computed
    # Change of the natural parameters by c causes outside the model, one standard deviation each,
    # (size, c); None if none are expected
    unmodelled: FloatArray | None = None
    found: Estimate | None = None  # Estimate with this posterior; None if it was not computed

    def widened(self, rng: np.random.Generator) -> Sampled:
        """Copy with random contributions of causes outside the model added to its draws ``z``.

        The mean over all draws stays the same. Itself if no such causes are expected.
        """
        if self.unmodelled is None:
            return self
        causes = rng.standard_normal((*self.z.shape[:-1], self.unmodelled.shape[1]))
        causes -= causes.mean(axis=(0, 1))
        model = self.posterior.model
        return replace(self, z=model.pinned(model.natural(self.z) + causes @ self.unmodelled.T))


def sampled_columns(
    posterior: Posterior, x: FloatArray, eta: FloatArray, moved: IntArray
) -> FloatArray:
    """Sampled quantities of draws, (..., p): parameters, sigmas, and common parts of the noise.

    ``x``: natural parameters, (..., size), of which those in ``moved`` (indices) were sampled;
    ``eta``: noise coordinates, (..., e). The noise is sigma of every channel, then pose_sigma
    and frame_sigma of the channels that have them.
    """
    noise = posterior.noise(eta)
    shared = posterior.noise_model.shared(noise)
    return np.concatenate((x[..., moved], noise.sigma, shared), axis=-1)


def _sampled_names(posterior: Posterior, moved: IntArray) -> tuple[str, ...]:
    """Names of the columns of `sampled_columns`, p strings.

    ``moved``: indices of the sampled parameters.
    """
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
    problem: Problem, sampled: Sampled, seconds: float | None, rng: np.random.Generator
) -> FitResult:
    """Summary of the draws: the result of a fit, with its tests.

    ``seconds``: computing time of the draws, None if it was not taken; ``rng``: for the
    widening of the draws and for the theoretical metric. The comparison with offsets at zero
    is computed when it is read.
    """
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
    radian = np.where(unfixed, model.chain.per_radian, 0.0)
    mean, std, interval = _offset_summary(flat[:, : model.joints], radian, sampled.taken_as_known)
    std_by_data = _offset_summary(
        by_data.z[..., : model.joints].reshape(-1, model.joints), radian, sampled.taken_as_known
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
    structure, widening, information = None, np.ones(model.joints), None
    if sampled.mode is not None and not model.has_causes:
        gross = np.concatenate([np.zeros(0, np.int64), *(check.gross for check in noise_checks)])
        of_points = sampled.mode.of_points
        held_out = held_out_tests(of_points, measurements, gross)
        structure = residual_structure(of_points, measurements)
        tests = (*structure.tests, *held_out)
        information = orientation_information(sampled.mode)
        if information is not None:
            tests += (StructureTest('orientation', True, information.p_value),)
        structure = replace(structure, tests=tests)
        if errors_are_left(noise_checks, structure):
            robust = robust_std(of_points, measurements)
            if information is not None and any(
                test.driver == 'orientation' for test in structure.found
            ):
                # Either positions or orientations are wrong; the data do not show which.
                robust = np.hypot(robust, information.shift)
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
    names, diagnostics = _sampled_names(posterior, sampled.moved), Diagnostics.of(sampled.run)

    def by_sensor(values: FloatArray) -> dict[str, FloatArray]:
        return dict(zip(problem.sensor_names, values, strict=True))

    # A generator for the comparison alone: the draws do not depend on whether it is computed.
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
        orientations=_orientations(posterior, sampled, information, x_after, x_draws),
        sampler=SamplerInfo.of(
            sampled.run,
            diagnostics,
            names,
            name=sampled.name,
            wanted=sampled.precision,
            seconds=seconds,
            weakest='' if sampled.mode is None else sampled.mode.weakest,
        ),
        diagnostics=diagnostics,
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
    information: OrientationInformation | None,
    x: FloatArray,
    x_draws: FloatArray,
) -> Orientations | None:
    """Orientations at natural x, (size,), with standard deviations of x_draws, (n, size).

    If none are fitted: only the reason why they were left out, or None without a reason.
    """
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
        information,
    )


def _offset_summary(
    draws: FloatArray, radian: FloatArray, taken_as_known: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (k,), std (k,) and 95 % interval (k, 2) of draws of offsets (n, k), rad or m.

    ``radian``: 0 for joints that are not held by the gauge, else the offset that counts as a
    radian, (k,); held joints have mean 0 and the std and interval of a whole turn.
    ``taken_as_known``: further std of each offset, added in squares, (k,).
    """
    undetermined = radian > 0.0
    mean = draws.mean(axis=0)
    std = np.hypot(draws.std(axis=0, ddof=1), taken_as_known)
    interval = np.quantile(draws, (0.025, 0.975), axis=0).T
    # 1.96 standard deviations to either side hold 95 %.
    half = np.hypot(interval - mean[:, None], 1.96 * taken_as_known[:, None])
    interval = mean[:, None] + half * (-1.0, 1.0)
    return (
        np.where(undetermined, 0.0, mean),
        np.where(undetermined, UNKNOWN_STD * radian, std),
        np.where(undetermined[:, None], np.outer(radian, (-np.pi, np.pi)), interval),
    )
