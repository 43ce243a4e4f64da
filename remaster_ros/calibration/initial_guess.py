# SPDX-License-Identifier: Apache-2.0
"""First solution, robust against a few gross outliers and badly known markers.

Closed-form starts (registration by points; registration and markers together as one linear
problem), each refined by damped Gauss–Newton steps on a Cauchy cost; the best one is returned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from remaster_ros.calibration.extension import Start
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.noise import MEDIAN_LENGTH, RESOLUTION_M
from remaster_ros.calibration.priors import TIGHTEST_PRIOR, UNCALIBRATED_ERROR_M, Prior, prior_rows
from remaster_ros.calibration.registration import register_points
from remaster_ros.errors import InsufficientDataError, MisfitError
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray, IntArray, Measurements

# Errors beyond this many robust standard deviations lose their weight in the start.
CAUCHY_WIDTH = 2.5
# Largest number of rows of a sensor in the start.
LARGEST_START = 5000
# Errors above this share of the points' extent mean that the model is that of another robot.
LARGEST_RELATIVE_ERROR = 0.1
# A sensor is mirrored if its errors are above the first share of the points' extent, and below the
# second share of themselves when its points are mirrored back.
LEAST_MIRRORED, MIRRORED = 0.03, 0.3
# Least number of orientations that determine a body's rotation on the tool and their noise;
# largest median difference from the robot, rad, of orientations of this body: mastering errors are
# smaller.
FEWEST_TURNS = 4
LARGEST_TURN = np.radians(10.0)


def robust_start(
    model: Model,
    measurements: Measurements,
    rows: IntArray,
    nominal_markers: FloatArray,
    marker_std_m: float,
    priors: Sequence[Prior],
) -> tuple[Model, FloatArray]:
    """Find a solution near the mode.

    ``model``: only its chain and names are used; ``measurements, rows``: the observations, and the
    rows to fit; ``nominal_markers, marker_std_m``: markers in the tool frame, m, (markers, 3), and
    their std; ``priors``: priors on the markers.

    Returns the model with its reference registrations at the solution, and the pinned parameters
    there, the outer joints at 0, (size,). Raises InsufficientDataError if the points of a sensor
    do not fix a registration, MisfitError if they are not those of this robot.
    """
    everything, rows = rows, _some_rows(measurements, rows)
    start, z = closest_start(model, measurements, rows, nominal_markers, marker_std_m, priors)
    sorted_rows = Rows.of(measurements, rows, start.reference)
    predicted = start.predict(z, sorted_rows)
    _require_right_hand(start, sorted_rows, predicted)
    _require_likeness(start, sorted_rows, sorted_rows.target - predicted)
    moved = referenced(model, measurements, everything, start.T_R_N(z))
    return moved, moved.vector(start.offsets(z), start.markers(z))


def given_start(
    model: Model, measurements: Measurements, rows: IntArray, start: Start
) -> tuple[Model, FloatArray]:
    """Model with a known solution's registrations as reference, and parameters there, (size,).

    The parameters are the pinned coordinates (`Model.pinned`) of the solution's zero-offsets
    and markers. Corrections of a sensor's registration turn about the median of the sensor's
    positions in ``rows``, the indices of the measurements to fit.
    """
    moved = referenced(model, measurements, rows, start.T_R_N)
    return moved, moved.pinned(moved.vector(start.joint_offsets, start.markers))


def closest_start(
    model: Model,
    measurements: Measurements,
    rows: IntArray,
    nominal_markers: FloatArray,
    marker_std_m: float,
    priors: Sequence[Prior],
) -> tuple[Model, FloatArray]:
    """Better of two robust fits, by the spread of errors, however far the data are from the robot.

    One fit begins with the markers at nominal, one with those of `_linear_markers`. Arguments
    as of `robust_start`. Returns the model with the registrations at the fit's start as
    reference, and the fitted parameters in pinned coordinates (`Model.pinned`), (size,): the
    outer joints at 0, registrations as corrections of the reference. Raises
    InsufficientDataError if a sensor's points do not fix a registration; never MisfitError.
    """
    chain = model.chain
    tool = chain.forward(measurements.q[rows])
    sensor, marker = measurements.sensor[rows], measurements.marker[rows]
    measured = measurements.position[rows]
    candidates = []
    for markers in (
        nominal_markers,
        _linear_markers(tool, sensor, marker, measured, nominal_markers, marker_std_m),
    ):
        points = apply(tool, markers[marker])
        reference = np.array(
            [
                register(points[sensor == index], measured[sensor == index], name)
                for index, name in enumerate(model.sensor_names)
            ]
        )
        start = referenced(model, measurements, rows, reference)
        sorted_rows = Rows.of(measurements, rows, reference)
        z = start.vector(np.zeros(len(chain)), markers)
        z, cost = _refined(start, sorted_rows, priors, z)
        candidates.append((cost, start, z))
    _, start, z = min(candidates, key=lambda candidate: candidate[0])
    return start, z


def with_bodies(
    model: Model, z: FloatArray, measurements: Measurements, rows: IntArray
) -> tuple[Model, FloatArray, str]:
    """Model that fits measured orientations of bodies, with its pinned parameters and a reason.

    A body is a pair of sensor and marker with enough measured orientations; ``z`` is extended
    by its rotation, at 0. ``model, z``: near the mode by the positions; ``measurements,
    rows``: the observations, and the rows to fit. The reason is a sentence if orientations
    were measured and cannot be fitted, else ''; without bodies model and z are unchanged, as
    for a model with an extension.
    """
    if measurements.orientation is None or model.extension is not None:
        return model, z, ''
    seen = rows[np.isfinite(measurements.orientation[rows]).all(axis=1)]
    x = model.natural(z)
    R_R_N = model.T_R_N(x)[measurements.sensor[seen], :3, :3]
    R_R_B = R_R_N @ Rotation.from_quat(measurements.orientation[seen]).as_matrix()
    R_R_T = model.chain.forward(measurements.q[seen], model.offsets(x))[:, :3, :3]
    R_T_B = Rotation.from_matrix(np.swapaxes(R_R_T, 1, 2) @ R_R_B)
    bodies, turns = [], []
    which = np.stack((measurements.sensor[seen], measurements.marker[seen]), axis=1)
    for sensor, marker in np.unique(which, axis=0).tolist():
        selection = np.all(which == (sensor, marker), axis=1)
        count = int(selection.sum())
        if count < FEWEST_TURNS:
            continue
        middle, deviation = _median_rotation(R_T_B[selection])
        if deviation > LARGEST_TURN:
            name = model.sensor_names[sensor]
            why = (
                f"the orientations are not fitted: half of those of '{name}' are more than "
                f'{np.degrees(deviation):.0f} degrees from the robot model; check that the '
                "quaternions are in the order x, y, z, w and give the body's axes in the sensor's "
                'frame'
            )
            return model, z, why
        bodies.append((sensor, marker))
        turns.append(middle)
    if not bodies:
        few = f'the orientations are not fitted: fewer than {FEWEST_TURNS} of each body'
        return model, z, few if len(seen) else ''
    turned = replace(model, bodies=tuple(bodies), body_reference=np.array(turns))
    return turned, np.concatenate((z, np.zeros(3 * len(bodies)))), ''


def _median_rotation(turns: Rotation) -> tuple[FloatArray, float]:
    """Median of n rotations, (3, 3), and the median of their angles from it, rad.

    The mean weighted by the inverse angles, iterated (Weiszfeld 1937, on rotations Hartley,
    Aftab and Trumpf 2011, doi:10.1109/CVPR.2011.5995745), is insensitive to some gross errors.
    """
    weight = np.ones(len(turns))
    for _ in range(30):
        middle = turns.mean(weight)
        angle = (middle.inv() * turns).magnitude()
        weight = 1.0 / np.maximum(angle, RESOLUTION_M)
    return np.asarray(middle.as_matrix()), float(np.median(angle))


def _some_rows(measurements: Measurements, rows: IntArray) -> IntArray:
    """Indices of rows, ascending; evenly spread ones of a sensor with more than 5,000."""
    chosen = []
    for sensor in np.unique(measurements.sensor[rows]):
        sensor_rows = rows[measurements.sensor[rows] == sensor]
        count = min(len(sensor_rows), LARGEST_START)
        chosen.append(sensor_rows[np.linspace(0, len(sensor_rows) - 1, count).astype(np.int64)])
    return np.sort(np.concatenate(chosen))


def register(points_R: FloatArray, points_N: FloatArray, sensor: str) -> FloatArray:
    """T_R_N (4, 4) of one sensor by least squares from pairs of points, m, (n, 3) each.

    ``sensor``: its name, for the message. Raises InsufficientDataError for fewer than three
    points, or points on a line.
    """
    try:
        return register_points(points_R, points_N)[0]
    except InsufficientDataError as error:
        raise InsufficientDataError(f"sensor '{sensor}': {error}") from error


def referenced(
    model: Model, measurements: Measurements, rows: IntArray, reference: FloatArray
) -> Model:
    """Copy of the model with registrations T_R_N (sensors, 4, 4) as reference.

    Each is centred on the median of its sensor's positions in ``rows`` (indices).
    """
    centroid = []
    for index, T_R_N in enumerate(reference):
        sensor_rows = rows[measurements.sensor[rows] == index]
        centroid.append(apply(T_R_N, np.median(measurements.position[sensor_rows], axis=0)))
    return replace(model, reference=reference, centroid=np.array(centroid))


def _require_right_hand(model: Model, rows: Rows, predicted: FloatArray) -> None:
    """Raise MisfitError if a sensor's points agree with the robot only when mirrored.

    That is if the RMS error after the best rotation is over 3 % of the points' extent, and
    that of the mirrored points under 30 % of that error. ``predicted``: modelled positions, in
    the coordinates of `Rows.target`, m, (n, 3).
    """
    for sensor, span in rows.spans:
        measured, modelled = rows.target[span], predicted[span]
        measured, modelled = measured - measured.mean(axis=0), modelled - modelled.mean(axis=0)
        left, singular, right = np.linalg.svd(modelled.T @ measured)
        # Sum of squares after the best rotation, and after that of the mirrored points.
        total_square = np.sum(measured**2) + np.sum(modelled**2)
        sign = np.linalg.det(left @ right) * np.array([1.0, -1.0])
        squares = total_square - 2.0 * (singular[0] + singular[1] + sign * singular[2])
        proper, mirrored = np.sqrt(np.maximum(squares, 0.0) / len(measured))
        extent = np.sqrt(np.mean(np.sum(modelled**2, axis=1)))
        if proper > LEAST_MIRRORED * extent and mirrored < MIRRORED * proper:
            raise MisfitError(
                f"sensor '{model.sensor_names[sensor]}': its points are mirrored: they agree with "
                f'the robot within {mirrored * 1e3:.1f} mm with one axis turned round, and within '
                f'{proper * 1e3:.1f} mm as they are',
                'give x, y, z of a right-handed frame',
            )


def _require_likeness(model: Model, rows: Rows, errors: FloatArray) -> None:
    """Raise MisfitError if a sensor's robust error exceeds a tenth of its points' extent.

    Causes: wrong units, joints or markers. ``errors``: measured minus modelled, m, (n, 3).
    """
    spread = robust_spread(errors, rows)
    for error, (sensor, span) in zip(spread, rows.spans, strict=True):
        extent = np.median(np.linalg.norm(rows.target[span] - model.centroid[sensor], axis=1))
        if error > LARGEST_RELATIVE_ERROR * extent:
            # Without its further effects the same model has been fitted to the same rows before.
            remedy = (
                'check units, joint order and signs, the URDF, and which marker was measured'
                if model.extension is None
                else 'the sizes found for its further effects do not hold; fit without them'
            )
            raise MisfitError(
                f"sensor '{model.sensor_names[sensor]}': the robot model leaves errors of "
                f'{error * 1e3:.0f} mm in points {extent * 1e3:.0f} mm apart',
                remedy,
            )


def _linear_markers(
    tool: FloatArray,
    sensor: IntArray,
    marker: IntArray,
    measured: FloatArray,
    nominal: FloatArray,
    marker_std_m: float,
) -> FloatArray:
    """Marker positions in the tool frame, m, (markers, 3), without any registration.

    With any 3×3 matrix G in the place of the sensor's rotation, tool · marker = G p + t is linear
    in marker, G and t together: one least-squares problem without a start. Rows that disagree lose
    their weight in six repetitions. ``tool``: T_R_T, (n, 4, 4); ``sensor, marker``: indices, (n,);
    ``measured``: m, (n, 3); ``nominal``: positions, m, with ``marker_std_m`` per axis.
    """
    sensors, markers = int(sensor.max()) + 1, len(nominal)
    design = np.zeros((len(measured), 3, 12 * sensors + 3 * markers))
    for index in range(sensors):
        selection, start = sensor == index, 12 * index
        centred = measured[selection] - measured[selection].mean(axis=0)
        turned = np.einsum('ab,nc->nabc', -np.eye(3), centred)
        design[selection, :, start : start + 9] = turned.reshape(-1, 3, 9)
        design[selection, :, start + 9 : start + 12] = -np.eye(3)
    for index in range(markers):
        selection, start = marker == index, 12 * sensors + 3 * index
        design[selection, :, start : start + 3] = tool[selection, :3, :3]
    # Unknown marker = nominal + shift, the shift known to be small.
    target = -apply(tool, nominal[marker])
    root = np.ones(len(measured))
    pull = np.zeros((3 * markers, design.shape[2]))
    pull[:, 12 * sensors :] = np.eye(3 * markers) * (
        UNCALIBRATED_ERROR_M / max(marker_std_m, TIGHTEST_PRIOR)
    )
    for _ in range(6):
        weighted = (design * root[:, None, None]).reshape(-1, design.shape[2])
        matrix = np.concatenate((weighted, pull))
        right = np.concatenate(((target * root[:, None]).ravel(), np.zeros(3 * markers)))
        solution = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=float)
        length = np.linalg.norm(design @ solution - target, axis=1)
        scale = CAUCHY_WIDTH * (np.median(length) / MEDIAN_LENGTH + RESOLUTION_M)
        root = 1.0 / np.hypot(1.0, length / scale)
    return nominal + solution[12 * sensors :].reshape(-1, 3)


def _refined(
    model: Model, rows: Rows, priors: Sequence[Prior], z: FloatArray
) -> tuple[FloatArray, float]:
    """Minimise a Cauchy cost by damped Gauss–Newton steps from z; return solution and cost.

    The returned cost is the sum over the rows of the log of their sensor's robust spread. The
    outer two joints stay at 0, as in pinned coordinates the data do not depend on them. The
    extension's parameters stay as they are. ``z``: pinned parameters, (size,), not changed in
    place.
    """
    free = np.setdiff1d(np.arange(model.core), (0, model.joints - 1))
    least_damping = 1e-6
    sizes = [span.stop - span.start for _, span in rows.spans]
    errors = rows.target - model.predict(z, rows)
    spread = robust_spread(errors, rows)
    for _ in range(60):
        scale = np.repeat(spread, sizes)
        weight = 1.0 / (1.0 + _squares(errors) / (CAUCHY_WIDTH * scale) ** 2) / scale**2
        derivative = model.jacobian(z, rows)[:, :, free]
        residual, by_z = prior_rows(model, priors, z)
        weighted = (derivative * weight[:, None, None]).reshape(-1, len(free))
        H = weighted.T @ derivative.reshape(-1, len(free)) + by_z[:, free].T @ by_z[:, free]
        g = weighted.T @ errors.ravel() - by_z[:, free].T @ residual
        diagonal = np.diag(H) + 1e-9 * np.max(np.diag(H))
        cost = _cost(errors, scale, residual)
        for damping in least_damping * 10.0 ** np.arange(12):
            step = np.linalg.solve(H + damping * np.diag(diagonal), g)
            trial = z.copy()
            trial[free] += step
            trial_errors = rows.target - model.predict(trial, rows)
            if _cost(trial_errors, scale, prior_rows(model, priors, trial)[0]) < cost:
                break
        else:
            break
        z, errors, least_damping = trial, trial_errors, max(damping / 10.0, 1e-12)
        before, spread = spread, robust_spread(errors, rows)
        settled = np.all(np.abs(spread - before) < 1e-3 * before)
        if settled and np.sqrt(step @ H @ step) < 1e-2 * np.sqrt(len(step)):
            break
    return z, float(np.dot(sizes, np.log(spread)))


def _squares(errors: FloatArray) -> FloatArray:
    """Squared lengths of errors (n, 3), (n,)."""
    return np.einsum('ni,ni->n', errors, errors)


def robust_spread(errors: FloatArray, rows: Rows) -> FloatArray:
    """Robust standard deviation per axis of each sensor's errors, m, in order of ``rows.spans``.

    The median length over 1.538 (`MEDIAN_LENGTH`), plus 0.1 µm (`RESOLUTION_M`). ``errors``: m,
    (n, 3); of orientations rad.
    """
    length = np.sqrt(_squares(errors))
    return np.array([np.median(length[s]) / MEDIAN_LENGTH + RESOLUTION_M for _, s in rows.spans])


def _cost(errors: FloatArray, scale: FloatArray, prior_residual: FloatArray) -> float:
    """Cauchy cost of errors (n, 3), plus half the sum of squares of the priors' residuals (m,).

    ``scale``: robust standard deviation of each row's errors, (n,).
    """
    width = CAUCHY_WIDTH**2
    data = 0.5 * width * np.sum(np.log1p(_squares(errors) / (width * scale**2)))
    return float(data + 0.5 * prior_residual @ prior_residual)
