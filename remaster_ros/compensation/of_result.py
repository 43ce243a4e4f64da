# SPDX-License-Identifier: Apache-2.0
"""Calibrated arm from a fit and the candidates of a discovery.

Where a candidate of `discovery.effects` goes in the model follows from its place, driver and form,
not from its name: a new effect is corrected as well if its place, driver and form are among these.
Effects that do not belong to the arm, or that depend on quantities that no controller knows (the
time, the approach direction), are listed with a remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import UNSET, Struct, UnsetType
from scipy.spatial.transform import Rotation

from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.noise_estimate import noise_estimates
from remaster_ros.calibration.predictions import predict
from remaster_ros.calibration.predictive_accuracy import Predictive
from remaster_ros.calibration.records import Quaternion, Triple
from remaster_ros.calibration.result import FitResult
from remaster_ros.compensation.arm_model import (
    ArmModel,
    BaseTerm,
    Driver,
    Form,
    Function,
    Geometry,
    JointTerm,
)
from remaster_ros.compensation.export import check_first
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.splines import DEGREE, Curve
from remaster_ros.discovery.geometry_model import GeometryModel
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.thinning import of_spread_poses
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse, matrix_to_rotation_vector
from remaster_ros.types import FloatArray, Measurements

# Iterations of `_as_predicted`, each of which leaves only the second order of the difference.
EXACT_STEPS = 2
_DRIVERS: dict[str, Driver] = {
    'own_angle': 'angle',
    'angle': 'angle',
    'own_place': 'angle',
    'place': 'angle',
    'gravity_torque': 'gravity_torque',
    'gravity_force': 'gravity_torque',
    'temperature': 'temperature',
}
_OF_MEASUREMENT = 'it is an error of the measurement and not of the arm'
_OF_GUIDE = 'compensation.json has no term for a carriage that leaves its way or turns along it'
_NOT_TOLD = (
    'it depends on what no controller is told (time, the last move, what happened once, on which '
    'side the base lies)'
)


@dataclass(frozen=True)
class Slot:
    """Place of some coefficients in an `ArmModel`: a term, an origin or a compliance."""

    kind: str  # ``joint``, ``base``, ``geometry``, ``growth`` or ``lateral``
    joint: int = -1  # Index of the joint; k for the tool
    # Effect and function of a term; '' and None for the other kinds
    effect: str = ''
    function: Function | None = None


class NotCorrected(Struct, frozen=True):
    """An effect that a correction leaves, as compensation.json has it."""

    effect: str  # Name in discovery.json
    joints: tuple[int, ...]
    size_mm: float  # RMS displacement of the marker over the rows of the session, mm
    why: str  # Reason, a sentence
    instead: str  # Remedy, a sentence


class Mount(Struct, frozen=True):
    """Sensor on the tool, as compensation.json has it: its marker, and its rotation if known."""

    marker: str  # Marker at the origin of the sensor
    rotation_xyzw: Quaternion | UnsetType = UNSET
    std_rad: Triple | UnsetType = UNSET


@dataclass(frozen=True, eq=False)
class CorrectedArm:
    """Model of a corrected arm, and the effects that are not in it."""

    model: ArmModel
    # Whether each joint's offset is identifiable, and why not, as in `FitResult`
    identifiable: tuple[bool, ...]
    why: tuple[str, ...]
    # Least and largest reported angle of each joint in the rows fitted, rad or m, (k, 2)
    ranges: FloatArray
    not_corrected: tuple[NotCorrected, ...] = ()
    notes: tuple[str, ...] = ()
    # Sensors on the tool with their rotations; {} if none is known
    mounts: Mapping[str, Mount] = field(default_factory=dict)


def arm_of_offsets(
    fit: FitResult,
    widening: float,
    notes: Sequence[str] = (),
    geometry: CorrectedArm | None = None,
) -> CorrectedArm:
    """Arm with the zero-offsets of a fit; offsets that are not identifiable are 0.

    Registrations (sensor poses) and markers are the most likely ones given these offsets: with
    an offset set to 0, those that are correlated with it change. ``widening``: factor on the
    standard deviations; ``notes``: added to those of the arm; ``geometry``: arm with all link
    lengths and axis tilts as well (`arm_of_geometry`), against which the expected error is
    computed, since real lengths and axes are never exactly nominal; None: the expected error
    is the posterior's.
    """
    described = _described(fit, [], np.zeros(0), None, widening)
    model = described.model
    k, root = model.joints, model.root
    offsets = np.where(fit.identifiable, fit.joint_offsets, 0.0)
    if np.any(offsets != model.joint_offsets):
        projection = np.linalg.pinv(root[:, :k], rcond=1e-9)
        step = root.T @ (projection.T @ (offsets - model.joint_offsets))
        residual_root = root - root[:, :k] @ (projection @ root)
        residual_root[:, :k] = 0.0
        model = replace(model.with_step(step), joint_offsets=offsets, root=residual_root)
        if fit.found is not None:
            model = _as_predicted(model, fit, fit.found.problem, [])
        model = replace(model, root=root)
    if geometry is not None:
        model = replace(model, error_root=_second_moments_about(model, geometry.model))
    return replace(described, model=model, notes=(*described.notes, *notes))


def _second_moments_about(loaded: ArmModel, known: ArmModel) -> FloatArray:
    """Root E, (e, p), of the second moments E' E of the true parameters about those of ``loaded``.

    ``known``: posterior of the true parameters, of mean m and covariance C, widened; the
    moments are C + (m - loaded) (m - loaded)'.
    """
    difference = known.parameter_means - loaded.parameter_means
    for sensor, T_R_N in loaded.T_R_N.items():
        step = known.T_R_N[sensor] @ inverse(T_R_N)
        shift, turn = loaded.registration(sensor)
        difference[shift], difference[turn] = step[:3, 3], matrix_to_rotation_vector(step[:3, :3])
    return np.vstack((known.widening * known.root, difference))


def arm_of_geometry(
    fit: FitResult,
    geometry: GeometryModel,
    measurements: Measurements,
) -> CorrectedArm:
    """Arm with all link lengths and axis tilts of a fit, and the zero-offsets fitted with them.

    ``geometry``: model of the lengths and tilts; the arm has the mode and the covariance of
    its posterior; ``measurements``: those that were fitted; their indices count the sensors
    and markers that occur in them.
    """
    mode = geometry.mode
    posterior = mode.linearisation.posterior
    root = np.zeros((len(posterior.free), posterior.model.size))
    root[:, posterior.free] = np.linalg.cholesky(mode.covariance).T
    # Sigma points: on either side of the mode, with the covariance of the posterior.
    reach = np.sqrt(len(root) - 0.5)
    draws = mode.z + np.concatenate((reach * root, -reach * root))
    # No errors of the measurement are beside the members of a fit.
    noise = posterior.noise(np.tile(mode.eta, (1, 2, 1)))
    sigma = posterior.noise_model.total_noise(noise)
    geometry_fit = replace(
        fit,
        predictive=Predictive(posterior.model, mode.z, draws, sigma.reshape(-1, *sigma.shape[2:])),
        noise=noise_estimates(posterior, noise),
    )
    widening = predict(geometry_fit, measurements).widening
    theta = posterior.model.theta(posterior.model.natural(mode.z))
    return _described(geometry_fit, geometry.members, theta, None, widening)


def arm_of_effects(
    fit: FitResult, candidates: Sequence[Candidate], data: Residuals
) -> CorrectedArm:
    """Arm with the effects of a discovery, from a sampled fit; its predictions are not widened.

    Parameters
    ----------
    fit
        Fit with the candidates' parameters as ``theta``.
    candidates
        Candidates of the model, in that order.
    data
        Residuals in which the effects were sought.
    """
    return _described(fit, candidates, fit.theta, data, 1.0)


def mounts_of(fit: FitResult, model: ArmModel) -> dict[str, Mount]:
    """Marker and rotation of each sensor on the tool, by its name; {} without such sensors.

    The rotation R_T_C is the mean over the fitted rows, computed with ``model``, the arm of
    the correction: the rotation of the fit belongs to all its zero-offsets, of which a
    correction lacks those that are not identifiable. Its standard deviations are the fit's.
    The rotation is unset if the fit has none of that sensor.
    """
    session, found, m = fit.session, fit.orientations, fit.measurements
    left_out = [observation for observation, _ in fit.left_out]
    mounts = {}
    for sensor in sorted(session.on_tool):
        marker = session.sensors[sensor]
        mounts[sensor] = Mount(marker)
        # Bodies have the sensor's name behind the marker's where several sensors measure one.
        names = marker, f'{marker}.{sensor}'
        body = next((name for name in names if found is not None and name in found.R_T_B), '')
        if body and found is not None and m.orientation is not None:
            rows = (m.sensor == session.sensor_names.index(sensor)) & ~m.is_validation
            rows &= ~np.isin(m.observation, left_out) & np.isfinite(m.orientation).all(axis=1)
            R_R_T = model.state(m.q[rows]).tool[:, :3, :3]
            R_R_C = (
                model.T_R_N[sensor][:3, :3] @ Rotation.from_quat(m.orientation[rows]).as_matrix()
            )
            R_T_C = Rotation.from_matrix(np.swapaxes(R_R_T, 1, 2) @ R_R_C).mean()
            x, y, z, w = R_T_C.as_quat().tolist()
            about_x, about_y, about_z = np.asarray(found.std_rad[body]).tolist()
            mounts[sensor] = Mount(marker, (x, y, z, w), (about_x, about_y, about_z))
    return mounts


def _described(
    fit: FitResult,
    candidates: Sequence[Candidate],
    theta: FloatArray,
    data: Residuals | None,
    widening: float,
) -> CorrectedArm:
    """Arm of a fit with the candidates and their parameters ``theta``, one after the other.

    Candidates without a place in the arm are left out, and listed as not corrected, unless
    ``data``, the residuals in which they were sought, is None. ``widening``: factor on
    standard deviations.
    """
    chain = fit.chain
    slots: dict[Slot, int] = {}
    maps: list[tuple[Slot, slice, FloatArray]] = []
    uncorrected: list[tuple[Candidate, slice]] = []
    start = 0
    for candidate in candidates:
        parameters = slice(start, start + candidate.size)
        start += candidate.size
        found = None if candidate.of_measurement else list(slots_of(candidate, chain))
        if not found:
            uncorrected.append((candidate, parameters))
            continue
        for slot, matrix in found:
            slots.setdefault(slot, len(matrix))
            maps.append((slot, parameters, matrix))
    # The file has the terms of one joint after those of another, and counts parameters so.
    slots = dict(sorted(slots.items(), key=lambda item: item[0].joint))
    draws, mean = _draws(fit)
    values = {slot: np.zeros(size) for slot, size in slots.items()}
    spread = {slot: np.zeros((len(draws), size)) for slot, size in slots.items()}
    theta_draws = fit.predictive.model.theta(fit.predictive.draws)
    for slot, parameters, matrix in maps:
        values[slot] += matrix @ theta[parameters]
        spread[slot] += theta_draws[:, parameters] @ matrix.T
    measurements = fit.session.measurements
    model = _model(chain, fit, values, _temperatures(measurements), widening)
    columns = _in_order(model, slots, spread, len(draws))
    every = np.concatenate((draws, columns), axis=1)
    every = (every - every.mean(axis=0)) / np.sqrt(max(1, len(every) - 1))
    root = np.asarray(np.linalg.qr(every, 'r'))
    fitted = measurements.q[~measurements.is_validation]
    model = replace(model, root=root, joint_offsets=mean)
    if candidates and fit.found is not None:
        # What has no place in the arm bends nothing of it: backlash no less than a sensor's scale.
        model = _as_predicted(
            model, fit, fit.found.problem, [parameters for _, parameters in uncorrected]
        )
    return CorrectedArm(
        model,
        tuple(bool(known) for known in fit.identifiable),
        tuple(fit.why),
        np.stack((fitted.min(axis=0), fitted.max(axis=0)), axis=1),
        tuple(_not_corrected(uncorrected, theta, data)) if data is not None else (),
        tuple(check_first(fit)),
    )


def _as_predicted(
    model: ArmModel, fit: FitResult, problem: Problem, without: Sequence[slice]
) -> ArmModel:
    """Arm whose parameters are adapted so that it predicts the fitted rows as the fit does.

    ``without``: slices of the fit's further parameters that count as 0. The fit is linear in
    lengths, tilts and other effects, about the zero-offsets found without effects; the arm is
    not, and its offsets, base and marker do not absorb what the fit's do. The difference d of the
    predictions is removed within the posterior's uncertainty: a step C J' d / σ² with its
    covariance C. If the data determine everything, C is (J' J / σ²)⁻¹, and J C J' is σ² in all
    its directions. Where the fit absorbs what the arm does not, it is more, and the step is
    J⁺ d: no more than the difference is removed.
    """
    z = fit.predictive.after.copy()
    for parameters in without:
        z[fit.predictive.model.core :][parameters] = 0.0
    rows = of_spread_poses(problem.measurements, problem.fitted)
    m = problem.measurements.select(rows)
    expected = predicted_rows(problem, fit.predictive.model, z)[rows]
    # The posterior is that of all rows; what poses have in common only adds to it.
    variance = min(noise.sigma_m for noise in fit.noise.values()) ** 2
    variance *= len(rows) / len(problem.fitted)
    for _ in range(EXACT_STEPS):
        # Where it is unknown the fit has no growth.
        known = np.isfinite(m.temperature_c)
        state = model.state(m.q, np.where(known, m.temperature_c, model.reference_c))
        error, parts = np.empty((len(rows), 3)), np.empty((len(rows), 3, len(model.root)))
        for i, sensor in enumerate(model.T_R_N):
            for j, marker in enumerate(model.markers):
                seen = (m.sensor == i) & (m.marker == j)
                if seen.any():
                    turn = model.T_R_N[sensor][:3, :3]
                    off = expected - model.in_sensor(state, sensor, marker)
                    error[seen] = off[seen] @ turn.T
                    parts[seen] = (model.derivative(state, sensor, marker) @ model.root.T)[seen]
        spread = parts.reshape(-1, len(model.root))
        sizes, directions = np.linalg.eigh(spread.T @ spread)
        along = directions.T @ (spread.T @ error.ravel())
        step = directions @ (along / np.maximum(sizes, variance))
        model = model.with_step(model.root.T @ step)
    return model


def _draws(fit: FitResult) -> tuple[FloatArray, FloatArray]:
    """Posterior draws of offsets, registrations and markers, (draws, p); mean offsets, (k,).

    Registrations are steps (shift and rotation vector) from their mean, in the robot base
    frame R. Offsets whose mean is exactly 0 are 0 in all draws.
    """
    model, z = fit.predictive.model, fit.predictive.draws.copy()
    # Offsets that the gauge fixes are exactly zero.
    fixed = np.flatnonzero(fit.predictive.after[: model.joints] == 0.0)
    z[:, fixed] = 0.0
    x, mean = model.natural(z), model.natural(fit.predictive.after)
    steps = model.T_R_N(x) @ inverse(model.T_R_N(mean))
    turns = matrix_to_rotation_vector(steps[..., :3, :3])
    registrations = np.concatenate((steps[..., :3, 3], turns), axis=-1)
    parts = (
        model.offsets(x),
        registrations.reshape(len(x), -1),
        model.markers(x).reshape(len(x), -1),
    )
    return np.concatenate(parts, axis=1), model.offsets(mean)


def _model(
    chain: SerialChain,
    fit: FitResult,
    values: Mapping[Slot, FloatArray],
    temperatures: tuple[float, float],
    widening: float,
) -> ArmModel:
    """Model of the arm with coefficients in their slots; all zero-offsets 0, no covariance.

    Registrations and markers are the fit's. ``temperatures``: reference and mean, °C.
    """
    joints = len(chain)
    found = fit.predictive.model
    x = found.natural(fit.predictive.after)
    geometry, growth = Geometry.none(joints), Geometry.none(joints)
    lateral = np.zeros(joints)
    joint_terms, base_terms = [], []
    for slot, value in values.items():
        if slot.function is not None and slot.kind == 'joint':
            joint_terms.append(JointTerm(slot.joint, slot.effect, slot.function, value))
        elif slot.function is not None:
            base_terms.append(BaseTerm(slot.effect, slot.function, value))
        elif slot.kind == 'lateral':
            lateral[slot.joint] = value[0]
        else:
            target = geometry if slot.kind == 'geometry' else growth
            target.shifts[slot.joint] = value[:3]
            target.turns[slot.joint] = value[3:]
    return ArmModel(
        chain=chain,
        joint_offsets=np.zeros(joints),
        joint_terms=tuple(joint_terms),
        base_terms=tuple(base_terms),
        geometry=geometry,
        growth=growth,
        lateral_compliance=lateral,
        reference_c=temperatures[0],
        mean_c=temperatures[1],
        T_R_N=dict(zip(found.sensor_names, found.T_R_N(x), strict=True)),
        markers=dict(zip(found.marker_names, found.markers(x), strict=True)),
        root=np.zeros((0, 0)),
        widening=widening,
    )


def _in_order(
    model: ArmModel, slots: Mapping[Slot, int], spread: Mapping[Slot, FloatArray], count: int
) -> FloatArray:
    """Draws of all coefficients of terms, origins and compliances, in the model's order.

    (count, p), 0 for unused ones; p without offsets, registrations and markers. ``slots``:
    number of coefficients of each; ``spread``: draws of each, (count, that number).
    """
    joints = model.joints
    parts = [spread[slot] for slot in slots if slot.kind == 'joint']
    parts += [spread[slot] for slot in slots if slot.kind == 'base']
    for kind in ('geometry', 'growth'):
        for joint in range(joints + 1):
            parts.append(spread.get(Slot(kind, joint), np.zeros((count, 6))))
    for joint in range(joints):
        parts.append(spread.get(Slot('lateral', joint), np.zeros((count, 1))))
    return np.concatenate(parts, axis=1)


def _temperatures(measurements: Measurements) -> tuple[float, float]:
    """First known temperature, and mean of the rows fitted, °C; NaN, NaN if none is known.

    The first one is by time, as in `Context.warming`. If no row fitted has a temperature, the
    mean is that of all rows.
    """
    known = np.isfinite(measurements.temperature_c)
    if not known.any():
        return np.nan, np.nan
    given = measurements.temperature_c[known]
    fitted = measurements.temperature_c[known & ~measurements.is_validation]
    first = given[np.argmin(measurements.stamp_s[known])]
    return float(first), float(fitted.mean() if len(fitted) else given.mean())


def slots_of(candidate: Candidate, chain: SerialChain) -> Iterator[tuple[Slot, FloatArray]]:
    """Yield the slots of a candidate in an `ArmModel`; nothing if the arm has no place for it.

    Each slot comes with the matrix from the candidate's m parameters to its coefficients,
    (coefficients, m).
    """
    if candidate.changes is not None:
        # The arm is as it was after the change.
        if not candidate.ends:
            yield from slots_of(candidate.changes, chain)
    elif candidate.model_change is not None:
        change = candidate.model_change
        yield Slot('geometry', change.joint), np.concatenate((change.shifts, change.turns), 1).T
    elif candidate.place == 'joint_angle':
        joint = candidate.joints[0] - 1
        for function, matrix in _functions(candidate, joint):
            yield Slot('joint', joint, candidate.name, function), matrix
    elif candidate.place in ('link_translation', 'link_rotation') and candidate.form == 'linear':
        yield from _of_links(candidate, chain)
    elif candidate.place == 'base_rotation' and not candidate.happened:
        yield from _of_base(candidate)


def _of_links(candidate: Candidate, chain: SerialChain) -> Iterator[tuple[Slot, FloatArray]]:
    """Yield slots and matrices of a candidate of a link; nothing if it has no place in the model.

    A soft bearing across the axis, or shifts, turns and lengths that grow with the temperature.
    """
    zeros = np.zeros((3, candidate.size))
    if candidate.driver == 'gravity_moment' and candidate.size == 1:
        yield Slot('lateral', candidate.joints[0] - 1), np.ones((1, 1))
    if candidate.driver != 'temperature':
        return
    if candidate.size == 1:
        # A length that grows, of one link or of all.
        for link in candidate.joints or range(len(chain) + 1):
            vector = chain.T_fixed[link][:3, 3]
            yield Slot('growth', link), np.concatenate((vector, np.zeros(3)))[:, None]
    elif candidate.size == 3 and candidate.place == 'link_translation':
        yield Slot('growth', candidate.joints[0]), np.concatenate((np.eye(3), zeros))
    elif candidate.size == 3:
        link = candidate.joints[0]
        yield Slot('growth', link), np.concatenate((zeros, chain.T_fixed[link][:3, :3].T))


def _of_base(candidate: Candidate) -> Iterator[tuple[Slot, FloatArray]]:
    """Yield the slots of a candidate that turns the base, each with a matrix to coefficients.

    A slot is a term of an `ArmModel`; the matrix leads from the candidate's m parameters to the
    term's coefficients, (coefficients, m). Nothing if no term has the candidate's driver and
    form.
    """
    if candidate.driver == 'gravity_moment' and candidate.form == 'linear':
        axes = {'isotropic': np.ones((3, 1)), 'by axis': np.eye(3)[:, :2]}
        if candidate.variant in axes:
            function = Function('gravity_moment', 'linear')
            yield Slot('base', -1, candidate.name, function), axes[candidate.variant]
        return
    # Of each feature a parameter for every axis of R, next to each other.
    for function, matrix in _functions(
        replace(candidate, parameters=candidate.parameters[::3]), 0
    ):
        if len(matrix) == 1:
            every: FloatArray = np.kron(matrix, np.eye(3)).astype(float)
            yield Slot('base', -1, candidate.name, function), every


def _functions(candidate: Candidate, joint: int) -> Iterator[tuple[Function, FloatArray]]:
    """Yield functions of a candidate, each with the matrix from its parameters to coefficients.

    Nothing for a driver or form that no correction has. ``joint``: index from 0 of the joint
    that drives if the name of the candidate's driver contains no joint.
    """
    if candidate.happened:
        # The arm is as it was after what happened.
        if candidate.form == 'step':
            yield Function('none', 'constant'), np.ones((1, candidate.size))
        return
    stem, _, given = candidate.driver.partition('_of_joint_')
    driver = _DRIVERS.get(stem)
    if driver is None:
        return
    driver_joint = -1 if driver == 'temperature' else int(given) - 1 if given else joint
    if candidate.form in ('linear', 'quadratic') and candidate.size == 1:
        form: Form = 'quadratic' if candidate.form == 'quadratic' else 'linear'
        yield Function(driver, form, driver_joint), np.ones((1, 1))
    elif candidate.form == 'sin/cos':
        orders = [int(part) for part in candidate.variant.split('+')] if candidate.variant else [1]
        if candidate.size == 2 * len(orders):
            # Sine and cosine of each order, in this order.
            for i, order in enumerate(orders):
                yield Function(driver, 'sin', driver_joint, order), np.eye(candidate.size)[[2 * i]]
                yield (
                    Function(driver, 'cos', driver_joint, order),
                    np.eye(candidate.size)[[2 * i + 1]],
                )
    elif candidate.curve is not None and candidate.size == len(candidate.curve.places):
        yield _splines(candidate.curve, driver, driver_joint)


def _splines(curve: Curve, driver: Driver, joint: int) -> tuple[Function, FloatArray]:
    """Function of a curve as splines, and the matrix from its free heights to all coefficients.

    Free are the heights of all splines but one, which follows from the zero mean of the curve.
    ``joint``: index from 0 of the joint whose angle or torque drives; -1 for other drivers.
    """
    heights = curve.heights
    if curve.closed:
        # The last splines are the first ones of the next turn.
        heights = np.concatenate((heights, heights[:DEGREE]))
    function = Function(
        driver, 'bspline', joint, knots=curve.knots, degree=DEGREE, turn_start=curve.start
    )
    return function, heights


def _not_corrected(
    candidates: Sequence[tuple[Candidate, slice]], theta: FloatArray, data: Residuals
) -> Iterator[NotCorrected]:
    """Yield the effects that are not corrected, each with its size, the reason and the remedy.

    Candidates with the same name, joints and reason are summed to one effect; effects that
    round to 0.000 mm RMS are left out. ``candidates``: with their slices of ``theta``, their
    parameters; ``data``: residuals in which they were sought.
    """
    by_effect: dict[tuple[str, tuple[int, ...], str], FloatArray] = {}
    remedies = {}
    for candidate, where in candidates:
        of_measurement = candidate.of_measurement or candidate.place == 'marker'
        along_a_guide = candidate.driver == 'own_place' and candidate.place != 'joint_angle'
        why = _OF_MEASUREMENT if of_measurement else _OF_GUIDE if along_a_guide else _NOT_TOLD
        key = candidate.name, candidate.joints, why
        displacement = data.columns([candidate]) @ theta[where]
        by_effect[key] = by_effect[key] + displacement if key in by_effect else displacement
        remedies[key] = EFFECTS[candidate.name].remedy_of(candidate)
    for (name, joints, why), displacement in by_effect.items():
        size_mm = 1e3 * float(np.sqrt(np.mean(np.sum(displacement**2, axis=-1))))
        if round(size_mm, 3) == 0.0:
            # It shows as nothing wherever it is listed.
            continue
        reported = EFFECTS[name].reported_as or name
        yield NotCorrected(reported, joints, size_mm, why, remedies[name, joints, why])
