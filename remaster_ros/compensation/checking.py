# SPDX-License-Identifier: Apache-2.0
"""Detection of changes of an arm since its correction, from the same few poses day after day.

A check measures some eight poses. The registration of the sensor is fitted again each time, and
the effect of a change of each joint beyond that is compared. The correction's own error is the
same in all checks of the same poses; therefore each check is compared with the checks before it,
never with the correction alone, from which the difference is always significant.

Whether the mean of a series has changed, at an unknown check, with unknown mean and noise, is
decided by an e-process: its expected value is at most 1 as long as nothing has changed, and so it
ever exceeds 100 in at most one of 100 arms, however often it is evaluated [1]_. Noise with memory,
or a season, is a change too; so an alarm also requires a change that is certainly larger than what
matters at the tool.

References
----------
.. [1] G. Shafer, A. Shen, N. Vereshchagin, V. Vovk, "Test martingales, Bayes factors and
   p-values", Statistical Science, 2011.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import erfc, fdtri, stdtrit

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.registration import register_points
from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.drift import LONGEST_DAYS, drift
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import BoolArray, FloatArray

Verdict = Literal['unchanged', 'changed', 'setup_moved', 'unclear']
ALARM = 100.0
"""Evidence of an alarm: at most one arm in 100 ever has one without a change."""
TREND_EVIDENCE = 200.0
"""Evidence of a drift, and of a step that may be smaller than what matters. With two kinds, at
most one arm in a hundred ever has either without a change."""
DOUBT = 10.0
"""Evidence that asks for another check; so does a result beyond `BEYOND_STD` deviations."""
BEYOND_STD = 5.0
REPEATED_CHECKS = 2
"""Largest number of checks in a row that are asked for at once. A small change or a drift that
these do not decide is decided by the usual checks, as more checks on one day add little.
"""
SMALLEST_M = 1e-4
"""Smallest change at the tool that matters, m."""
POWER_STD = 3.09 + 1.645
"""Size in standard deviations of a change that is found in 95 % of cases, at 1 % of false alarms
over five joints."""
PRIOR_STD = 4.0
"""Prior std of a change, in standard deviations of a result. With 2 a change of 4 std is found
a check later, with 5 no sooner."""
BATCHES = 6
"""Number of batches from which the wander of a series is estimated; two means are taken off."""
LEAST_VISIBLE = 1e-3
"""Least share of a joint's motion that a moved sensor does not explain; below, it is invisible."""
SAME_RAD = float(np.radians(0.5))
"""Largest difference of configurations of one pose, rad: the correction's own error is constant
over such a distance, as it changes over some degrees."""
NAMING_ODDS = 20.0
"""Odds above which the better explanation is named alone; below, both are named."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Readings of one check of an arm: n marker positions, each with the reported joints."""

    q: FloatArray  # Reported joints, rad, m for prismatic joints, (n, k)
    # Names of sensor and marker of each reading, (n,)
    sensor: tuple[str, ...]
    marker: tuple[str, ...]
    position: FloatArray  # In the sensor's frame, m, (n, 3)
    when_s: float = np.nan  # Unix time of the check, s; NaN if unknown

    def merged(self, chain: SerialChain) -> Measured:
        """Return a copy with one mean reading for each pose, sensor and marker.

        They are in the order in which each combination first occurs.
        """
        rows: list[int] = []
        for row in range(len(self.q)):
            same = [
                rows[i] for i in np.flatnonzero(is_same_pose(chain, self.q[rows], self.q[row]))
            ]
            seen_by = self.sensor[row], self.marker[row]
            if seen_by not in [
                (self.sensor[same_row], self.marker[same_row]) for same_row in same
            ]:
                rows.append(row)
        sensor = tuple(self.sensor[row] for row in rows)
        marker = tuple(self.marker[row] for row in rows)
        first = Measured(self.q[rows], sensor, marker, self.position[rows], self.when_s)
        return self.as_before(first, chain)

    def as_before(self, first: Measured, chain: SerialChain) -> Measured:
        """Return a copy with the mean readings at the poses of the first check, in its order.

        ``first``: the first check, merged. Readings at other poses are left out.

        Raises
        ------
        InputError
            No reading of a pose of the first check by the same sensor and marker.
        """
        rows = []
        for i, (sensor, marker) in enumerate(zip(first.sensor, first.marker, strict=True)):
            same = [
                row
                for row in np.flatnonzero(is_same_pose(chain, self.q, first.q[i]))
                if (self.sensor[row], self.marker[row]) == (sensor, marker)
            ]
            if not same:
                at = ', '.join(chain.shown_offset(j, value) for j, value in enumerate(first.q[i]))
                raise InputError(
                    f'no reading of {marker} by {sensor} at the joints {at}, where the first '
                    'check has one: measure the same poses, or begin another history'
                )
            rows.append(same)
        position = np.array([self.position[same].mean(axis=0) for same in rows])
        q = np.array([self.q[same].mean(axis=0) for same in rows])
        return Measured(q, first.sensor, first.marker, position, self.when_s)


def is_same_pose(chain: SerialChain, q: FloatArray, place: FloatArray) -> BoolArray:
    """Mask of the configurations q (n, k) within 0.5 degrees (`SAME_RAD`) of ``place``, (n,).

    ``place``: a configuration, (k,). Every joint has to be that near; a prismatic joint within
    0.5 degrees, in rad, times ``per_radian``.
    """
    difference: FloatArray = np.abs(q - place) / chain.per_radian
    return np.asarray(difference.max(axis=1) <= SAME_RAD)


@dataclass(frozen=True, eq=False)
class CheckResiduals:
    """Residuals of a check after the sensors' poses are fitted; effects of joints and markers."""

    residuals: FloatArray  # Errors that a moved sensor cannot explain, m, (3 n,)
    # Effect on the residuals of a radian (metre) of each joint, (3 n, k), and of a metre of each
    # marker, (3 n, 3 m)
    joints: FloatArray
    tool: FloatArray
    # Effect of one standard deviation of each uncertain parameter of the correction, (3 n, r)
    unsure: FloatArray
    freedom: int  # Degrees of freedom of the residuals
    lever_m: FloatArray  # RMS displacement of the markers per radian of each joint, m, (k,)
    T_R_N: Mapping[str, FloatArray]  # Registration of each sensor


def seen(model: ArmModel, measured: Measured) -> CheckResiduals:
    """Residuals of a check against the correction's model, with the sensors registered again.

    Raises InsufficientDataError if there are too few poses to register the sensors, or fewer
    degrees of freedom are left than the arm has joints.
    """
    n, k = measured.q.shape
    state = model.state(measured.q)
    errors, points = np.zeros((n, 3)), np.zeros((n, 3))
    derivative = np.zeros((n, 3, len(model.parameter_names)))
    sensors, markers = list(dict.fromkeys(measured.sensor)), list(dict.fromkeys(measured.marker))
    frames, T_R_N = [], {}
    for marker in markers:
        selection = np.array([name == marker for name in measured.marker])
        points[selection] = apply(state.tool[selection], model.markers[marker])
    for sensor in sensors:
        selection = np.array([name == sensor for name in measured.sensor])
        for marker in markers:
            both = selection & [name == marker for name in measured.marker]
            derivative[both] = model.derivative(state, sensor, marker)[both]
        T_R_N[sensor], _ = register_points(points[selection], measured.position[selection])
        errors[selection] = apply(T_R_N[sensor], measured.position[selection]) - points[selection]
        frame = np.zeros((n, 3, 6))
        frame[selection] = rigid_motions(points[selection])
        frames.append(frame)
    rigid = np.concatenate(frames, axis=2).reshape(3 * n, -1)
    basis = np.linalg.svd(rigid, full_matrices=False)
    taken = basis[0][:, basis[1] > 1e-9 * basis[1][0]]
    freedom = 3 * n - taken.shape[1]
    if freedom < k:
        raise InsufficientDataError(
            f'{counted(n, "reading")}: too few to tell where the sensors stand and what has '
            'changed; measure eight poses'
        )

    def projected(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - taken @ (taken.T @ columns))

    columns = projected(derivative.reshape(3 * n, -1))
    return CheckResiduals(
        projected(errors.ravel()),
        columns[:, :k],
        np.concatenate([columns[:, model.marker(marker)] for marker in markers], axis=1),
        model.widening * (columns @ model.root.T),
        freedom,
        np.sqrt(np.mean(np.sum(derivative[:, :, :k] ** 2, axis=1), axis=0)),
        T_R_N,
    )


def rigid_motions(points: FloatArray) -> FloatArray:
    """Displacements of points (n, 3) by unit shifts and rotations, (n, 3, 6).

    Columns: shifts along x, y, z, then rotations about the x, y, z axes through the origin (m
    per rad), in the frame of the points.
    """
    turns = np.cross(np.eye(3), points[:, None, :]).swapaxes(1, 2)
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    return np.concatenate((shifts, turns), axis=2)


def detectable_m(joints: FloatArray, lever_m: FloatArray, noise_m: float) -> FloatArray:
    """Smallest change of each joint that one check finds, m at the tool, (k,).

    Found in 95 % of cases at 1 % of false alarms (`POWER_STD`). NaN if a moved sensor has the
    same effect. ``joints``: effects of a radian of each joint on the readings, as in
    `CheckResiduals`, m, (3 n, k); ``lever_m``: as there, (k,); ``noise_m``: of a reading per
    axis, m.
    """
    information = np.sum(joints**2, axis=0)
    is_seen = _is_seen(joints, lever_m)
    sizes = np.full(len(lever_m), np.nan)
    sizes[is_seen] = POWER_STD * noise_m * (lever_m / np.sqrt(information))[is_seen]
    return sizes


def _is_seen(joints: FloatArray, lever_m: FloatArray) -> BoolArray:
    """Mask of the joints whose effect differs from that of a moved sensor, (k,).

    At least 0.001 of the joint's motion of the markers remains after the sensors are fitted
    (`LEAST_VISIBLE`). ``joints``, ``lever_m``: as in `CheckResiduals`.
    """
    found: BoolArray = np.sum(joints**2, axis=0) > LEAST_VISIBLE**2 * lever_m**2 * (
        len(joints) / 3
    )
    return found


@dataclass(frozen=True)
class Change:
    """Likeliest step of the mean of a series of T results: size, place, uncertainty, evidence."""

    evidence: float  # Value of the e-process
    at: int  # Index of the first result after the likeliest change; 0 if there is none to name
    # Size of that change, its standard deviation and half of its 95 % interval; the latter two
    # are infinite if there are too few results
    size: float
    std: float
    half: float


def bayes_factors(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Bayes factors for a step of the mean at each place of a series, against no step.

    Both means and the variance are integrated out under their invariant priors; the size of
    the step has a normal prior of `PRIOR_STD` standard deviations of a result. ``x``: series,
    (…, T), T >= 2. Returns the factors, the sizes of the steps, and the sums of squared
    residuals about the two means, (…, T - 1) each, for a step before result 1, 2, ….
    """
    T = x.shape[-1]
    j = np.arange(1.0, T)
    before = np.cumsum(x, axis=-1)[..., :-1] / j
    mean = x.mean(axis=-1, keepdims=True)
    size = (mean * T - before * j) / (T - j) - before
    squares = np.sum((x - mean) ** 2, axis=-1, keepdims=True)
    v = 1.0 / j + 1.0 / (T - j)
    wide = v + PRIOR_STD**2
    # Equal results to the last bit have no scatter, and no change.
    share = np.divide(size**2, squares, out=np.zeros_like(size), where=squares > 0.0)
    residual_squares = np.maximum(squares - size**2 / v, 0.0)
    kept = np.maximum(1.0 - share * (1.0 / v - 1.0 / wide), 1e-300)
    return np.sqrt(v / wide) * kept ** (-0.5 * (T - 1.0)), size, residual_squares


def evidence(x: FloatArray) -> FloatArray:
    """Evidence (e-process) for a step of the mean of series (…, T), against no step, (…).

    Sum of the Bayes factors for a step after result j = 1 … T - 1, times its prior 1 / (j (j +
    1)). The rest of the prior, 1 / T, is for a step still to come, with the factor 1. For
    fewer than two results the evidence is 1.
    """
    T = x.shape[-1]
    if T < 2:
        return np.ones(x.shape[:-1])
    j = np.arange(1.0, T)
    odds = bayes_factors(x)[0]
    return np.asarray(1.0 / T + np.sum(odds / (j * (j + 1.0)), axis=-1))


def change(x: FloatArray) -> Change:
    """Likeliest step of the mean of a series (T,), T >= 1, with the evidence for any step.

    For one result: its value is the size, the evidence is 1. Standard deviation and half
    interval are infinite for fewer than three results.
    """
    T = len(x)
    if T < 2:
        return Change(1.0, 0, float(x[-1]), np.inf, np.inf)
    odds, sizes, residual_squares = bayes_factors(x)
    j = np.arange(1.0, T)
    best = int(np.argmax(odds / (j * (j + 1.0))))
    if T < 3:
        return Change(float(evidence(x)), best + 1, float(sizes[best]), np.inf, np.inf)
    v = 1.0 / j[best] + 1.0 / (T - j[best])
    std = float(np.sqrt(v * residual_squares[best] / (T - 2.0)))
    half = max(float(stdtrit(T - 2.0, 0.975)) * std, wander(x, best + 1))
    return Change(float(evidence(x)), best + 1, float(sizes[best]), std, half)


def step(x: FloatArray, at: int) -> tuple[float, float]:
    """Mean of a series (T,) from index ``at`` on minus the mean before it, and its std.

    ``at``: 1 to T - 1. The std of this difference is infinite for two results.
    """
    T = len(x)
    deviations = np.concatenate((x[:at] - x[:at].mean(), x[at:] - x[at:].mean()))
    variance = float(deviations @ deviations) / (T - 2.0) if T > 2 else np.inf
    std = float(np.sqrt(variance * (1.0 / at + 1.0 / (T - at))))
    return float(x[at:].mean() - x[:at].mean()), std


def wander(x: FloatArray, at: int) -> float:
    """Half of the 95 % interval of the size of a step before result ``at``, with autocorrelation.

    Batch means: the deviations from the means before and after the step are averaged in
    batches of consecutive results, so that slow changes of the series (T,) widen the interval.
    0 for fewer than six results (`BATCHES`).
    """
    T = len(x)
    deviations = np.concatenate((x[:at] - x[:at].mean(), x[at:] - x[at:].mean()))
    size = max(1, min(at, T - at, T // BATCHES))
    count = T // size
    if count < BATCHES:
        return 0.0
    means = deviations[T - count * size :].reshape(count, size).mean(axis=1)
    variance = np.sum(means**2) / (count - 2.0) * size
    std = float(np.sqrt(variance * (1.0 / at + 1.0 / (T - at))))
    return float(stdtrit(count - 2.0, 0.975)) * std


@dataclass(frozen=True)
class JointCheck:
    """Change of one joint by all checks so far, with its uncertainty and the evidence.

    Change, std: rad, or m for a prismatic joint; the detectable change: m at the tool; the
    lever: m per rad.

    If a joint or a marker is named as changed, ``change`` is that from the checks before the
    change to those since; otherwise that from the mean of all earlier checks to the newest one. A
    single check is compared with the correction's model. If a moved sensor has the same effect,
    all but the lever is NaN, and the evidence is 1.
    """

    change: float
    std: float
    detectable_m: float
    lever_m: float
    evidence: float


@dataclass(frozen=True)
class Trend:
    """Drift or step that is certain, but not certainly larger than what matters."""

    kind: Literal['drift', 'step']
    joints: tuple[int, ...]  # Indices of the joints that may have changed
    tool: bool  # Whether the marker may have moved instead
    # Size of the change at the tool since the first check that has it, and half of its 95 %
    # interval, m
    size_m: float
    half_m: float
    since: int  # Index of that check
    span: float  # Duration in days, or in checks if the times are unknown


@dataclass(frozen=True)
class CheckResult:
    """Verdict of all checks of an arm so far, with the change of each joint."""

    verdict: Verdict  # Verdict after the newest check
    evidence: float  # Mean of the e-process over joints and markers
    joints: tuple[JointCheck, ...]  # One for each joint, base to tip
    # Indices of the joints that may have changed; several if the data do not distinguish them
    changed: tuple[int, ...]
    since: int | None  # Index of the first check after the change; None if none is named
    tool_moved: bool  # Whether a marker moved on the tool, rather than a joint
    # RMS displacement of the markers in the sensors' registration since the check before (for the
    # first check: since the session of the correction), m
    moved_m: float
    again: bool  # Whether to check again at once
    noise_m: float  # Noise of a reading per axis, m
    # Change of each joint in each check, at the tool, m, (T, k), if that joint alone has changed,
    # or in addition to the joints that are named
    series_m: FloatArray
    # A certain change that is no alarm; None if there is none
    trend: Trend | None = None
    in_days: bool = False  # Whether the times of all checks are known
    # Time until the next check, in days, or in checks if the times are unknown
    next_in: float = 1.0
    drifts: bool = False  # Whether the change was gradual
    when_s: float = np.nan  # Unix time of the newest check, s; NaN if unknown


def judge(
    model: ArmModel, checks: Sequence[Measured], smallest_m: float = SMALLEST_M
) -> CheckResult:
    """Compare an arm's checks, and decide whether the arm, a marker or a sensor has changed.

    Raises InsufficientDataError if a check has too few poses (`seen`).

    Parameters
    ----------
    model
        Model of the correction.
    checks
        Checks of the same poses in the same order, oldest first, at least one; see
        `Measured.as_before`.
    smallest_m
        Smallest change at the tool that matters, m.
    """
    residuals_of_checks = [seen(model, entry) for entry in checks]
    last, T = residuals_of_checks[-1], len(residuals_of_checks)
    levers = last.lever_m
    information = np.sum(last.joints**2, axis=0)
    is_seen = _is_seen(last.joints, levers)
    x_m = _series(residuals_of_checks)
    counts = np.concatenate((is_seen, np.ones(last.tool.shape[1], bool)))
    found = [change(x_m[:, i]) for i in range(x_m.shape[1])]
    total = float(np.mean([entry.evidence for entry, counted in zip(found, counts) if counted]))
    best = max(np.flatnonzero(counts), key=lambda i: found[i].evidence)
    at = found[best].at
    noise = _noise(residuals_of_checks, at if total > DOUBT else 0)
    std = noise / np.sqrt(np.where(is_seen, information, np.inf))
    smallest = detectable_m(last.joints, levers, noise)
    before = residuals_of_checks[-2].T_R_N if T > 1 else model.T_R_N
    moved, moved_is = _moved(before, last, checks[-1], noise, max(T - 1, 1), smallest_m)
    clear = abs(found[best].size) - found[best].half > smallest_m
    days, in_days = _days(checks)
    lines = [drift(x_m[:, i], days) for i in range(x_m.shape[1])]
    of_lines = float(np.mean([entry.evidence for entry, counted in zip(lines, counts) if counted]))
    line = lines[max(np.flatnonzero(counts), key=lambda i: lines[i].evidence)]
    drifts = of_lines >= TREND_EVIDENCE and of_lines > total and abs(line.size) > line.half
    if drifts:
        weights, at = line.weights, min(line.at + 1, T - 1)
        noise = _scatter(
            np.array([entry.residuals for entry in residuals_of_checks]), days, line.at
        )
        noise /= np.sqrt(last.freedom)
        std = noise / np.sqrt(np.where(is_seen, information, np.inf))
        smallest = detectable_m(last.joints, levers, noise)
        clear = abs(line.size) - line.half > smallest_m
    else:
        weights = _before_and_after(T, at)
    asked = REPEATED_CHECKS < T and all(
        _is_doubtful(residuals_of_checks[:until], x_m[:until], counts, is_seen, smallest_m)
        for until in range(T - REPEATED_CHECKS, T)
    )
    verdict: Verdict = 'setup_moved' if moved_is else 'unchanged'
    named: tuple[int, ...] = ()
    tool = False
    again = False
    trend: Trend | None = None
    next_in = float(np.median(np.diff(days))) if T > 1 else 1.0
    if (drifts or total >= ALARM) and clear:
        named, tool = _changed_joints(residuals_of_checks, weights, noise, is_seen)
        # A joint and the marker that look alike: nobody is told to correct the arm for that.
        verdict = 'unclear' if tool and named else 'setup_moved' if tool else 'changed'
    elif drifts:
        trend = Trend(
            'drift',
            *_changed_joints(residuals_of_checks, weights, noise, is_seen),
            abs(line.size),
            line.half,
            at,
            line.days,
        )
        if abs(line.size) + line.half > smallest_m:
            verdict = 'unclear'
        # Half of the time until it may matter; not before the next of the usual checks.
        next_in = max(next_in, min(0.5 * line.days_left(smallest_m), LONGEST_DAYS))
    elif total >= TREND_EVIDENCE:
        step_of = found[best]
        trend = Trend(
            'step',
            *_changed_joints(residuals_of_checks, weights, noise, is_seen),
            abs(step_of.size),
            step_of.half,
            at,
            float(days[-1] - days[at]),
        )
        if abs(step_of.size) + step_of.half > smallest_m:
            verdict = 'unclear'
    elif _is_doubtful(residuals_of_checks, x_m, counts, is_seen, smallest_m):
        verdict, again = 'unclear', not asked
    if named or tool:
        # What has changed is taken out of the others, which would show a part of it.
        taken = last.joints[:, list(named[:1])] if named else last.tool
        other_series = _series([_projected(entry, taken) for entry in residuals_of_checks])
        kept = np.isin(np.arange(x_m.shape[1]), named[:1])
        x_m = np.where(kept, x_m, other_series)
        found = [change(x_m[:, i]) for i in range(x_m.shape[1])]
    # Where nothing is named, the newest check against all before it: no place is chosen.
    place = at if named or tool else T - 1
    if drifts and (named or tool):
        about = days, line.at
        sizes = [(float(weights @ x), _scatter(x, *about) * _length(weights)) for x in x_m.T]
    else:
        sizes = [step(x, place) if T > 1 else (float(x[0]), np.inf) for x in x_m.T]
    return CheckResult(
        verdict,
        total,
        tuple(
            JointCheck(
                sizes[i][0] / levers[i] if is_seen[i] else np.nan,
                (sizes[i][1] / levers[i] if T > 2 else float(std[i])) if is_seen[i] else np.nan,
                float(smallest[i]),
                float(levers[i]),
                found[i].evidence if is_seen[i] else 1.0,
            )
            for i in range(len(levers))
        ),
        named,
        at if named or tool else None,
        tool,
        moved,
        again,
        noise,
        x_m[:, : len(levers)],
        trend,
        in_days,
        next_in,
        drifts,
        checks[-1].when_s,
    )


def _days(checks: Sequence[Measured]) -> tuple[FloatArray, bool]:
    """Times of the checks, days since the first, (T,), and True; if not all are known, 0, 1, 2, ….

    If a time is missing, or is not later than the one before, the checks are numbered instead,
    and the second value is False.
    """
    when = np.array([check.when_s for check in checks])
    if np.isfinite(when).all() and np.all(np.diff(when) > 0.0):
        return (when - when[0]) / 86_400.0, True
    return np.arange(float(len(checks))), False


def _before_and_after(T: int, at: int) -> FloatArray:
    """Weights (T,) that give the mean of results from ``at`` on less the mean of those before.

    For ``at`` 0: the mean of all.
    """
    weights = np.full(T, 1.0 / (T - at))
    weights[:at] = -1.0 / at if at else 0.0
    return weights


def _scatter(values: FloatArray, days: FloatArray, at: int) -> float:
    """Standard deviation of results about a constant with a ramp that begins at index ``at``.

    ``values``: results, (T,), or n series of them, (T, n), of which it is the root of the sum
    of the variances; ``days``: times of the results, over which the ramp is linear, (T,), T >
    2.
    """
    line = np.maximum(0.0, days - days[at])
    basis = np.linalg.qr(np.stack((np.ones(len(days)), line), axis=1))[0]
    deviations = values - basis @ (basis.T @ values)
    return float(np.sqrt(np.sum(deviations**2) / (len(days) - 2.0)))


def _length(weights: FloatArray) -> float:
    """Euclidean norm of weights."""
    return float(np.linalg.norm(weights))


def _projected(check: CheckResiduals, taken: FloatArray) -> CheckResiduals:
    """Copy of a check with residuals and effects orthogonal to the columns ``taken``, (3 n, c)."""
    basis = np.linalg.qr(taken)[0]

    def projected(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - basis @ (basis.T @ columns))

    return replace(
        check,
        residuals=projected(check.residuals),
        joints=projected(check.joints),
        tool=projected(check.tool),
    )


def _series(residuals_of_checks: Sequence[CheckResiduals]) -> FloatArray:
    """Sizes of changes fitted to the residuals of each of T checks, m, (T, k + 3 m).

    First of each of k joints, as if it alone had changed, m at the tool; then x, y and z of
    each of m markers on the tool, all fitted together. By least squares, each with its sign.
    """
    rows = [
        (
            *(_single_column_sizes(check.joints, check.residuals) * check.lever_m),
            *np.linalg.lstsq(check.tool, check.residuals)[0],
        )
        for check in residuals_of_checks
    ]
    return np.array(rows)


def _single_column_sizes(columns: FloatArray, residuals: FloatArray) -> FloatArray:
    """Least-squares coefficient of each column (n, k) fitted by itself to residuals (n,), (k,).

    0 for a column of rounding errors: its square is below 1e-18 of the largest.
    """
    squares = np.sum(columns**2, axis=0)
    is_any = squares > 1e-18 * np.max(squares)
    return np.divide(columns.T @ residuals, squares, out=np.zeros_like(squares), where=is_any)


def _noise(residuals_of_checks: Sequence[CheckResiduals], at: int) -> float:
    """Noise of a reading per axis, m, from the scatter of the residuals of repeated checks.

    About two means: of the checks before index ``at``, and of those from it on; about one mean
    if ``at`` is 0. If neither part has two checks: RMS residual, which also contains the
    errors that the correction leaves.
    """
    rests, freedom = (
        np.array([check.residuals for check in residuals_of_checks]),
        residuals_of_checks[-1].freedom,
    )
    parts = [part for part in (rests[:at], rests[at:]) if len(part)]
    squares = sum(float(np.sum((part - part.mean(axis=0)) ** 2)) for part in parts)
    if len(rests) == len(parts):
        return float(np.sqrt(np.sum(rests**2) / len(rests) / freedom))
    return float(np.sqrt(squares / (len(rests) - len(parts)) / freedom))


def _moved(
    before: Mapping[str, FloatArray],
    last: CheckResiduals,
    measured: Measured,
    noise: float,
    residuals_of_checks: int,
    smallest_m: float,
) -> tuple[float, bool]:
    """RMS displacement of the markers, m, that new sensor poses make, and whether sensors moved.

    Over the readings ``measured`` of the newest check ``last``; ``before``: earlier T_R_N by
    sensor; a sensor without one counts as unmoved. Moved: the RMS is more than ``smallest_m``,
    and the sum of squares more than ``noise`` (of a reading per axis, m) explains at 5 standard
    deviations (`BEYOND_STD`). ``residuals_of_checks``: number of checks, which times
    ``last.freedom`` counts as the degrees of freedom of ``noise``.
    """
    shift = np.zeros_like(measured.position)
    for sensor, T in last.T_R_N.items():
        selection = np.array([name == sensor for name in measured.sensor])
        place = measured.position[selection]
        shift[selection] = apply(T, place) - apply(before.get(sensor, T), place)
    squares, size = float(np.sum(shift**2)), float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
    # Two fits of six numbers a sensor each, and a noise that is estimated from so many checks.
    count = 6.0 * len(last.T_R_N)
    limit = count * float(
        fdtri(
            count, float(residuals_of_checks * last.freedom), 1.0 - erfc(BEYOND_STD / np.sqrt(2.0))
        )
    )
    return size, size > smallest_m and squares > 2.0 * noise**2 * limit


def _is_doubtful(
    residuals_of_checks: Sequence[CheckResiduals],
    x_m: FloatArray,
    counts: BoolArray,
    is_seen: BoolArray,
    smallest_m: float,
) -> bool:
    """Whether these checks, without an alarm, require another check.

    Evidence above 10 (`DOUBT`) for a change that may matter, or a newest check that is
    outlying (`_is_outlying`). ``x_m``: sizes of changes as of `_series`, (T, k + 3 m);
    ``counts``: mask of the columns of ``x_m`` to consider; ``is_seen``: mask of joints whose
    effect no moved sensor can have, (k,); ``smallest_m``: smallest change at the tool that
    matters, m.
    """
    found = [change(x_m[:, i]) for i in np.flatnonzero(counts)]
    best = max(found, key=lambda estimate: estimate.evidence)
    small = abs(best.size) + best.half < smallest_m
    doubted = float(np.mean([estimate.evidence for estimate in found])) > DOUBT and not small
    return doubted or _is_outlying(residuals_of_checks, x_m, counts, is_seen)


def _is_outlying(
    residuals_of_checks: Sequence[CheckResiduals],
    x_m: FloatArray,
    counts: BoolArray,
    is_seen: BoolArray,
) -> bool:
    """Whether a change in the newest check is over 5 standard deviations (`BEYOND_STD`).

    With four checks or more: the size of any considered change, from its mean over the earlier
    checks. With fewer: the change of one joint, or of all markers, fitted to the difference of
    the newest residuals from the earlier mean; for a single check, of one joint, fitted to its
    residuals. Arguments as of `_is_doubtful`.
    """
    last, T = residuals_of_checks[-1], len(residuals_of_checks)
    if T > 3:
        # Of few checks the scatter may be small by chance, but not below the noise of a reading.
        scatter = x_m[:-1].std(axis=0, ddof=1)
        squares = np.where(is_seen, np.sum(last.joints**2, axis=0), np.inf)
        of_tool = np.sqrt(np.diag(np.linalg.inv(last.tool.T @ last.tool)))
        floor = _noise(residuals_of_checks[:-1], 0) * np.concatenate(
            (last.lever_m / np.sqrt(squares), of_tool)
        )
        std = np.maximum(scatter, floor) * np.sqrt(1.0 + 1.0 / (T - 1.0))
        deviation = np.abs(x_m[-1] - x_m[:-1].mean(axis=0))
        return bool(np.any(deviation[counts] > BEYOND_STD * std[counts]))
    # Too few for a scatter: what one joint, or a marker, leaves of the difference is the noise.
    step = last.residuals - (
        np.mean([check.residuals for check in residuals_of_checks[:-1]], axis=0) if T > 1 else 0.0
    )
    joints = last.joints[:, is_seen]
    squares = np.sum(joints**2, axis=0)
    size = joints.T @ step / squares
    residual_variance = np.maximum(step @ step - size**2 * squares, 0.0) / (last.freedom - 1)
    variance = residual_variance / squares
    if T < 2:
        variance += np.sum((joints.T @ last.unsure / squares[:, None]) ** 2, axis=1)
    if np.any(size**2 > BEYOND_STD**2 * variance):
        return True
    moved = last.tool @ np.linalg.lstsq(last.tool, step)[0]
    count = last.tool.shape[1]
    left_of_all = float(np.sum((step - moved) ** 2)) / (last.freedom - count)
    return T > 1 and float(moved @ moved) > BEYOND_STD**2 * count * left_of_all


def _changed_joints(
    residuals_of_checks: Sequence[CheckResiduals],
    weights: FloatArray,
    noise: float,
    is_seen: BoolArray,
) -> tuple[tuple[int, ...], bool]:
    """Indices of the joints that may have changed, and whether a marker may have moved instead.

    Each joint, and the markers, are an explanation of the change of the residuals; returned
    are those whose odds against the best one are within 20 (`NAMING_ODDS`). ``weights``: (T,),
    factors with which the residuals of the T checks are summed to their change; ``noise``: of
    a reading per axis, m; ``is_seen``: mask of joints whose effect no moved sensor can have,
    (k,).
    """
    step = weights @ np.array([entry.residuals for entry in residuals_of_checks])
    variance = noise**2 * float(weights @ weights)
    last = residuals_of_checks[-1]
    squares = np.where(is_seen, np.sum(last.joints**2, axis=0), np.inf)
    gains = 0.5 * (last.joints.T @ step) ** 2 / squares / variance
    shift = np.linalg.lstsq(last.tool, step)[0]
    # Two more numbers explain more by chance: Schwarz's price of them.
    tool = 0.5 * float(np.sum((last.tool @ shift) ** 2)) / variance - np.log(len(step))
    top = max(float(gains.max()), tool)
    named = np.flatnonzero(gains > top - np.log(NAMING_ODDS))
    return tuple(int(entry) for entry in named), bool(tool > top - np.log(NAMING_ODDS))


def chosen_poses(
    model: ArmModel,
    q: FloatArray,
    sensor: str,
    marker: str,
    count: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Choose the configurations in which the smallest change of any joint is seen best.

    Configurations are exchanged one by one as long as the least information on a joint,
    divided by the square of its lever, grows. ``q``: candidates, rad, (c, k), c >= count;
    ``sensor, marker``: names of the measuring sensor and of its marker; ``count``: number of
    configurations; ``rng``: draws the initial ones, in five tries.

    Returns the indices of the chosen rows of `q`, ascending, (count,), and the smallest change
    of each joint that is found with a noise of 1 m per axis, m at the tool, (k,), NaN if a
    moved sensor has the same effect.
    """
    k = q.shape[1]
    state = model.state(q)
    D = model.derivative(state, sensor, marker)[:, :, :k]
    points = apply(state.tool, model.markers[marker])
    F = rigid_motions(points)
    levers = np.sqrt(np.mean(np.sum(D**2, axis=1), axis=0))
    DD = np.sum(D**2, axis=1)
    FD, FF = np.swapaxes(F, 1, 2) @ D, np.swapaxes(F, 1, 2) @ F

    def information(dd: FloatArray, fd: FloatArray, ff: FloatArray) -> FloatArray:
        taken = np.einsum('...ij,...ij->...j', fd, np.linalg.solve(ff, fd))
        return np.asarray(np.maximum(dd - taken, 0.0) / levers**2)

    everything = information(DD.sum(axis=0), FD.sum(axis=0), FF.sum(axis=0))
    able = everything > LEAST_VISIBLE**2 * 3 * len(q)
    ridge = 1e-9 * np.eye(6)
    best, score = np.arange(count), -1.0
    for _ in range(5):
        rows = rng.choice(len(q), count, replace=False)
        value = -1.0
        while True:
            before = value
            for slot in range(count):
                other_rows = np.delete(rows, slot)
                least = information(
                    DD[other_rows].sum(axis=0) + DD,
                    FD[other_rows].sum(axis=0) + FD,
                    FF[other_rows].sum(axis=0) + FF + ridge,
                )[:, able].min(axis=1)
                least[other_rows] = -1.0
                rows[slot], value = int(np.argmax(least)), float(least.max())
            if value <= before * (1.0 + 1e-6):
                break
        if value > score:
            best, score = rows.copy(), value
    ff = FF[best].sum(axis=0) + ridge
    found = information(DD[best].sum(axis=0), FD[best].sum(axis=0), ff)
    sizes = np.where(able, POWER_STD / np.sqrt(np.where(able, found, 1.0)), np.nan)
    return np.sort(best), sizes
