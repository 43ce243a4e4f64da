# SPDX-License-Identifier: Apache-2.0
"""Mode of a session's posterior: gauge fixed, gross errors left out, nothing sampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from remaster_ros.calibration.extension import Extension, Start
from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.identifiability import WEAK_ANGLE, Gauge, find_gauge
from remaster_ros.calibration.initial_guess import given_start, robust_start, with_bodies
from remaster_ros.calibration.laplace import Mode, find_mode, noise_mode
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.moved_since import moved_since
from remaster_ros.calibration.noise import NoiseModel
from remaster_ros.calibration.outliers import find_outliers
from remaster_ros.calibration.path_noise import PathNoise
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.priors import (
    Prior,
    base_prior,
    marker_prior,
    offset_prior,
    plausible_offsets,
)
from remaster_ros.errors import InputError, InsufficientDataError, MisfitError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import (
    BoolArray,
    FloatArray,
    IntArray,
    Measurements,
    Priors,
    Session,
)

# Least number of rows that determine a sensor's noise, and of poses that register it.
FEWEST_ROWS = 4
FEWEST_POSES = 3
# Sentence if the orientations of a session cannot be fitted; its positions are fitted without
# them.
NOT_FITTED = (
    'the orientations are not fitted: {}; check that the quaternions are in the order x, y, z, w '
    "and give the body's axes in the sensor's frame"
)
# Limits of chi-squared with 1 to 3 degrees of freedom at an error rate of 1 in 1,000 for a
# separate noise along the line of sight.
DIRECTION_LIMITS = {1: 10.828, 2: 13.816, 3: 16.266}


@dataclass(frozen=True, eq=False)
class Problem:
    """Data of a session to fit, reduced to the sensors and markers that occur in it."""

    session: Session  # The whole session
    chain: SerialChain  # The nominal robot
    # Sensors and markers with at least one row
    sensor_names: tuple[str, ...]
    marker_names: tuple[str, ...]
    # All rows in file order, ``sensor`` and ``marker`` being indices into these names
    measurements: Measurements
    # Nominal positions and their standard deviations, m, (markers, 3) and (markers,)
    markers: FloatArray
    marker_std_m: FloatArray
    fitted: IntArray  # Indices of the optimization rows
    priors: Priors  # Prior knowledge of offsets and registrations
    path_noise: PathNoise | None = None  # Errors along a path; None if there are none

    @classmethod
    def of(cls, session: Session, priors: Priors | None = None) -> Problem:
        """Reduce a session to its sensors and markers with rows, and check it.

        ``priors`` are prior knowledge besides the session's own; of the same marker or sensor they
        replace the session's.

        Raises
        ------
        InputError
            The URDF has another number of joints than the session, or a prior names a joint,
            marker or sensor that the session does not have, or has the wrong unit for its joint.
        InsufficientDataError
            The robot has one joint, there are no optimization rows, or a sensor has fewer than
            3 poses or 4 optimization rows.
        """
        chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
        given = session.measurements
        if given.q.shape[1:] != (len(chain),):
            raise InputError(
                f'the session has {given.q.shape[-1]} joints, '
                f'the URDF from {session.base_link} to {session.tip_link} has {len(chain)}'
            )
        if len(chain) < 2:
            raise InsufficientDataError(
                'the robot has one joint: its zero-offset and the registration cannot be separated'
            )
        fitted = np.flatnonzero(~given.is_validation)
        if len(fitted) == 0:
            raise InsufficientDataError(
                'the session has no optimization rows; record poses to fit, not only to validate'
            )
        sensors, sensor = np.unique(given.sensor, return_inverse=True)
        markers, marker = np.unique(given.marker, return_inverse=True)
        sensor_names = tuple(session.sensor_names[index] for index in sensors)
        marker_names = tuple(session.marker_names[index] for index in markers)
        for index, name in enumerate(sensor_names):
            rows = fitted[sensor[fitted] == index]
            poses = len(np.unique(given.pose[rows]))
            if poses < FEWEST_POSES:
                raise InsufficientDataError(
                    f"sensor '{name}' saw {counted(poses, 'pose')} to fit; at least "
                    f'{FEWEST_POSES} are needed to register it, and some thirty for good '
                    'zero-offsets'
                )
            if len(rows) < FEWEST_ROWS:
                raise InsufficientDataError(
                    f"sensor '{name}' has {len(rows)} optimization rows; at least {FEWEST_ROWS} "
                    'are needed to register it and to estimate its noise'
                )
        priors = Priors() if priors is None else priors
        for kind, named, names in (
            ('joint', priors.joint_offsets, chain.joint_names),
            ('marker', priors.markers, session.marker_names),
            ('sensor', priors.base, session.sensor_names),
        ):
            for name in named:
                if name not in names:
                    raise InputError(
                        f"there is a prior on {kind} '{name}', but the session has "
                        f'{", ".join(names)}; correct the name or leave it out'
                    )
        for name, slides in zip(chain.joint_names, chain.slides, strict=True):
            if name in priors.joint_offsets and slides != (name in priors.in_m):
                raise InputError(
                    f"the prior on joint '{name}' is {'an angle' if slides else 'a length'}, but "
                    f'that joint {"slides" if slides else "turns"}; write '
                    f'{"mean_mm and std_mm" if slides else "mean_deg and std_deg"}'
                )
        places = [
            priors.markers.get(name, (session.markers[name], session.marker_std_m))
            for name in marker_names
        ]
        return cls(
            session,
            chain,
            sensor_names,
            marker_names,
            replace(given, sensor=sensor.astype(np.int64), marker=marker.astype(np.int64)),
            np.array([place for place, _ in places], dtype=float),
            np.array([std for _, std in places], dtype=float),
            fitted,
            replace(priors, base={**session.base_prior, **priors.base}),
        )

    def marker_priors(self, model: Model) -> tuple[Prior, ...]:
        """Priors on the positions of all markers, in index order."""
        return tuple(
            marker_prior(model, index, self.markers[index], float(self.marker_std_m[index]))
            for index in range(len(self.markers))
        )

    def other_priors(self, model: Model) -> tuple[Prior, ...]:
        """Priors on registrations and offsets: only those that session or priors file state."""
        base = tuple(
            base_prior(model, index, self.priors.base[name])
            for index, name in enumerate(self.sensor_names)
            if name in self.priors.base
        )
        return base + tuple(
            offset_prior(model, self.chain.joint_names.index(name), *known)
            for name, known in self.priors.joint_offsets.items()
        )

    def plausibility(self, model: Model, free: IntArray) -> tuple[Prior, ...]:
        """Gaussian prior on the free joint offsets that have no stated one, in a tuple.

        It is `plausible_offsets`: about 0, std 5 degrees. If the model has effects found by
        discovery: about the offsets at which these were found, std ``step_std`` of the
        extension. () if all free offsets have a stated prior. ``free``: indices of parameters;
        those below k are joints.
        """
        unknown = [
            joint
            for joint, name in enumerate(self.chain.joint_names)
            if joint in free and name not in self.priors.joint_offsets
        ]
        return (plausible_offsets(model, unknown),) if unknown else ()

    def empty_model(self, extension: Extension | None = None) -> Model:
        """Model with reference registrations at identity, and an extension if one is given."""
        count = len(self.sensor_names)
        return Model(
            self.chain,
            self.sensor_names,
            self.marker_names,
            np.tile(np.eye(4), (count, 1, 1)),
            np.zeros((count, 3)),
            extension,
            on_tool=tuple(
                index
                for index, name in enumerate(self.sensor_names)
                if name in self.session.on_tool
            ),
            path_noise=self.path_noise,
        )


@dataclass(frozen=True, eq=False)
class Estimate:
    """Mode of the posterior with free offsets, and the rows it is based on."""

    problem: Problem
    model: Model
    gauge: Gauge  # Combinations of parameters that the data do not determine
    mode: Mode
    left_out: tuple[tuple[int, str], ...]  # (row of the measurements, reason) of the gross errors
    kept: IntArray  # Indices of the optimization rows that were fitted
    # Reason why measured orientations are not fitted, a sentence; '' if they are, or if none were
    # measured
    without_turns: str = ''

    @property
    def posterior(self) -> Posterior:
        """Posterior of which `mode` is the mode."""
        return self.mode.linearisation.posterior

    @cached_property
    def before(self) -> Mode:
        """Mode with all offsets at zero, registrations and markers fitted to the same rows.

        Raises InsufficientDataError if the search does not settle (`find_mode`).
        """
        return mode_at_offsets(self.mode, np.zeros(self.model.joints))


@one_thread
def estimate(problem: Problem, extension: Extension | None = None) -> Estimate:
    """Mode of a problem's posterior, with the parameters of an extension if one is given.

    Gross errors are left out. If orientations are measured and do not fit, the positions alone are
    fitted, and ``without_turns`` has the reason.

    Raises
    ------
    InsufficientDataError
        The data do not determine the parameters.
    MisfitError
        The data disagree with the model altogether: errors above a tenth of the points' extent,
        mirrored points, or more than a tenth of a sensor's rows gross.
    """
    measurements = problem.measurements
    empty = problem.empty_model(extension)
    start = None if extension is None else extension.start
    if start is not None:
        model, z = given_start(empty, measurements, problem.fitted, start)
    else:
        model, z = robust_start(
            empty,
            measurements,
            problem.fitted,
            problem.markers,
            float(np.max(problem.marker_std_m)),
            problem.marker_priors(empty)
            + problem.plausibility(empty, np.arange(len(problem.chain))),
        )
    model, z, without_turns = with_bodies(model, z, measurements, problem.fitted)
    try:
        found = _estimated(problem, model, z, start)
    except MisfitError as error:
        if not model.bodies:
            raise
        # Positions of another robot are refused here as well.
        found = _estimated(problem, replace(model, bodies=()), z[: model.markers_end], start)
        without_turns = NOT_FITTED.format(error.what)
    return replace(found, without_turns=without_turns)


def _estimated(problem: Problem, model: Model, z: FloatArray, start: Start | None) -> Estimate:
    """Mode from a solution z (size,) near it, without gross errors.

    ``start``: given solution whose gross rows are left out at first; None without one. ``z`` is
    changed in place: joints held by the gauge are set to 0. Raises InsufficientDataError and
    MisfitError as `estimate`.
    """
    measurements = problem.measurements
    priors = problem.marker_priors(model) + problem.other_priors(model)
    rows = model.rows(measurements, problem.fitted)
    gauge = find_gauge(model, model.natural(z), rows, priors)
    free = np.setdiff1d(np.arange(model.size), gauge.held)
    known = priors
    priors += problem.plausibility(model, free)
    z[gauge.held[gauge.held < model.joints]] = 0.0

    found: tuple[BoolArray, Mode] | None = None

    def fitted(keep: BoolArray) -> Mode:
        nonlocal found
        if found is not None and np.array_equal(found[0], keep):
            return found[1]
        # From the mode of the rows kept before: only the first search has far to go.
        guess = z if found is None else found[1].z
        # Of a reading, position and orientation are kept or neither.
        kept = model.rows_of_path(measurements, np.setdiff1d(rows.source, rows.source[~keep]))
        found = keep, find_mode(Posterior.of(model, kept, priors, free, guess))
        return found[1]

    def refit(keep: BoolArray) -> FloatArray:
        return rows.target - model.predict(fitted(keep).z, rows)

    errors = rows.target - model.predict(z, rows)
    gross = np.isin(rows.source, () if start is None else start.gross)
    try:
        judgement = find_outliers(rows, refit, errors, model.sensor_names, gross)
    except MisfitError as error:
        remedy = f'{error.remedy}{_moved(problem, rows, errors)}'
        raise MisfitError(error.what, remedy) from None
    _require_information(int(np.sum(~judgement.gross[: rows.points])), free, model)
    kept = np.setdiff1d(rows.source, rows.source[judgement.gross])
    mode = with_directions(fitted(~judgement.gross), stating_directions(measurements, kept))
    gauge = _judged_at(mode, gauge, known)
    why: dict[int, str] = {}
    for row in np.flatnonzero(judgement.gross):
        # Of a whole reading one half has the reason, or both.
        source = int(rows.source[row])
        why[source] = '; '.join(filter(None, (why.get(source), judgement.why[row])))
    return Estimate(
        problem,
        model,
        gauge,
        mode,
        tuple(sorted(why.items())),
        kept,
    )


def of_positions_alone(found: Estimate) -> Estimate:
    """Estimate by the positions only; the same estimate if it fits no orientations.

    The new estimate has no extension, even if the given one has. Raises as `estimate`.
    """
    if not found.model.bodies:
        return found
    session = found.problem.session.positions_alone()
    without = replace(found.problem.measurements, orientation=None)
    return estimate(replace(found.problem, session=session, measurements=without))


def stating_directions(measurements: Measurements, rows: IntArray) -> list[int]:
    """Sensors (indices) whose samples scatter differently along the line of sight and across it.

    Regression of the samples' variance on the share of each axis in the line of sight, tested at 1
    in 1,000; sensors with fewer than 4 readings of several samples are left out. ``rows``: indices
    of the measurements that count.
    """
    found = []
    for sensor in np.unique(measurements.sensor[rows]).tolist():
        sensor_rows = rows[
            (measurements.sensor[rows] == sensor) & (measurements.samples[rows] > 1)
        ]
        sensor_rows = sensor_rows[(measurements.std[sensor_rows] > 0.0).all(axis=1)]
        if len(sensor_rows) < FEWEST_ROWS:
            continue
        square = measurements.position[sensor_rows] ** 2
        # A point at the origin of the sensor's frame has no line of sight.
        length = np.maximum(square.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        share = (square / length).ravel()
        variance = (measurements.std[sensor_rows] ** 2).ravel()
        weight = np.repeat(measurements.samples[sensor_rows] - 1.0, 3)
        share -= np.average(share, weights=weight)
        variance -= np.average(variance, weights=weight)
        spread = weight @ share**2
        slope = weight @ (share * variance) / max(spread, np.finfo(float).tiny)
        # Samples that follow one another may be alike: their scatter shows how much they tell.
        scatter = weight @ (variance - slope * share) ** 2 / (len(share) - 2)
        if slope**2 * spread > DIRECTION_LIMITS[1] * scatter:
            found.append(sensor)
    return found


def with_directions(mode: Mode, stating: Sequence[int] = ()) -> Mode:
    """Mode with a separate noise along the line of sight for each sensor that shows one.

    One sensor after the other, by a likelihood-ratio test of the noise with the parameters
    integrated out. Its error rate is 1 in 1,000, less if a pose_sigma is zero. The same mode if no
    sensor does. ``stating``: sensors that have one without a test, as their samples show it.
    """
    posterior = mode.linearisation.posterior
    split: list[int] = []
    for sensor in range(len(posterior.noise_names)):
        noise_model = NoiseModel.of(posterior.rows, posterior.model.reference, [*split, sensor])
        tried = replace(posterior, reference=mode.z, noise_model=noise_model)
        # Twice the likelihood ratio is chi-squared, with as many degrees of freedom as the noise
        # has more parameters.
        more = tried.size - mode.linearisation.posterior.size
        try:
            other = noise_mode(tried)
            ratio = 2.0 * (other.log_evidence - mode.log_evidence)
            if sensor in stating or ratio > DIRECTION_LIMITS[more]:
                mode, split = find_mode(tried, other), [*split, sensor]
        except InsufficientDataError:
            continue
    return mode


def mode_at_offsets(mode: Mode, joint_offsets: FloatArray) -> Mode:
    """Mode of the same posterior with the joint offsets fixed at given values.

    ``mode``: of the fit with free offsets; ``joint_offsets``: rad or m, (k,). Raises
    InsufficientDataError if the search does not settle (`find_mode`).
    """
    posterior = mode.linearisation.posterior
    joints = posterior.model.joints
    natural = posterior.model.natural(mode.z)
    natural[:joints] = joint_offsets
    fixed_posterior = replace(
        posterior,
        free=posterior.free[posterior.free >= joints],
        reference=posterior.model.pinned(natural),
    )
    return find_mode(fixed_posterior)


def _judged_at(mode: Mode, gauge: Gauge, priors: Sequence[Prior]) -> Gauge:
    """Gauge found again at the mode if an offset is badly determined there, else the given gauge.

    Badly determined: a standard deviation above 0.2 degrees (`WEAK_ANGLE`), of a joint for
    which the given gauge has no reason in ``why``. The given gauge was found at the start,
    which may lie far from the mode along such a direction. The given one is returned as well
    if the new one would hold other parameters fixed.
    """
    posterior = mode.linearisation.posterior
    std = np.sqrt(np.diag(mode.covariance))
    if not any(
        width > WEAK_ANGLE * posterior.model.chain.per_radian[index]
        for index, width in zip(posterior.free, std, strict=True)
        if index < posterior.model.joints and not gauge.why[index]
    ):
        return gauge
    model = posterior.model
    found = find_gauge(model, model.natural(mode.z), posterior.rows, priors)
    return found if np.array_equal(found.held, gauge.held) else gauge


def _require_information(count: int, free: IntArray, model: Model) -> None:
    """Raise InsufficientDataError if ``count`` observations have fewer numbers than unknowns.

    Numbers are 3 for each observation; unknowns the free offsets and registrations (``free``:
    indices of parameters), and 3 for one marker, however many there are.
    """
    needed = int(np.sum(free < model.joints + 6 * len(model.sensor_names))) + 3
    if 3 * count < needed:
        raise InsufficientDataError(
            f'{count} observations of 3 coordinates for {len(free)} unknowns; '
            f'measure at least {-(-needed // 3)}, better ten times as many'
        )


def _moved(problem: Problem, rows: Rows, errors: FloatArray) -> str:
    """Text that says from which observation on a sensor's readings are shifted, and by how much.

    One clause for each sensor with a step in time (`moved_since`), each after '; ', to be
    added to another sentence; '' without any. ``errors``: measured minus modelled, m, (n, 3).
    """
    text = ''
    for sensor, span in rows.of_points.spans:
        moved = moved_since(problem.measurements, rows.source[span], errors[span])
        if moved is not None and moved.is_step:
            text += (
                f'; {problem.sensor_names[sensor]} is off by '
                f'{1e3 * np.linalg.norm(moved.shift):.1f} mm from about observation '
                f'{moved.observation} on: it, or its marker, was moved then; fasten both, and '
                'keep only what was measured before or since, or measure again'
            )
    return text
