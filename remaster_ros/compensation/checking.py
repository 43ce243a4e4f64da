# SPDX-License-Identifier: Apache-2.0
"""Has an arm changed since its correction was measured? From the same few poses, day after day.

A check measures some eight poses. Where base and sensor stand is fitted again each time, and what
a change of one joint would do beside that is compared. The correction's own error is the same in
all checks of the same poses, so that each is compared with the checks before it, never with the
correction alone: that difference is significant without end.

Whether the mean of a series has changed, at a check that is not known, with a mean and a noise
that are not known, is told by an e-process: its mean is at most 1 as long as nothing has changed,
and so it ever exceeds 100 in at most one of 100 arms, however often it is looked at [1]_. Noise
that remembers, or a season, is a change too; so an alarm also takes a change that is certainly
larger than what matters at the tool.

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
"""Evidence of an alarm: at most one arm in so many ever has one without a change."""
TOLD = 200.0
"""Evidence of a drift, and of a step that may be less than what matters: two of them, and at most
one arm in a hundred ever has either without a change."""
DOUBT = 10.0
"""Evidence, and `BEYOND` standard deviations of a single result, that ask for another check."""
BEYOND = 5.0
AT_ONCE = 2
"""So many checks in a row are asked for at once. What these do not decide, a small change or a
drift, the usual checks do: what is the same all day becomes no better by more checks of it.
"""
SMALLEST_M = 1e-4
"""What matters at the tool."""
POWER_STD = 3.09 + 1.645
"""Standard deviations of a change found in 95 %, at 1 % of false alarms over five joints."""
PRIOR_STD = 4.0
"""Of a change, in standard deviations of a result: what can be found at all. With 2 a change of 4
std is found a check later, with 5 no sooner."""
BATCHES = 6
"""Batches that the wander of a series is told from: two of their numbers are the means."""
SEEN = 1e-3
"""A joint whose marker moves by less than this share beside a moved sensor is not seen."""
SAME_RAD = float(np.radians(0.5))
"""So near are the configurations of one pose: the correction's own error changes over some
degrees."""
TELLING = 20.0
"""Odds by which one explanation beats another that is named beside it where they are less."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A check: n readings of k joints."""

    q: FloatArray  # Reported joints, rad, m of joints that slide, (n, k)
    # Names, (n,)
    sensor: tuple[str, ...]
    marker: tuple[str, ...]
    position: FloatArray  # In the sensor's frame, m, (n, 3)
    when_s: float = np.nan  # Unix time of the check; NaN where it is not known

    def merged(self, chain: SerialChain) -> Measured:
        """Return the mean of the readings of each pose by each sensor of each marker."""
        rows: list[int] = []
        for row in range(len(self.q)):
            same = [rows[i] for i in np.flatnonzero(together(chain, self.q[rows], self.q[row]))]
            seen_by = self.sensor[row], self.marker[row]
            if seen_by not in [(self.sensor[one], self.marker[one]) for one in same]:
                rows.append(row)
        sensor = tuple(self.sensor[row] for row in rows)
        marker = tuple(self.marker[row] for row in rows)
        first = Measured(self.q[rows], sensor, marker, self.position[rows], self.when_s)
        return self.as_before(first, chain)

    def as_before(self, first: Measured, chain: SerialChain) -> Measured:
        """Return the readings of the poses of the first check, in its order.

        Raises
        ------
        InputError
            One of them is missing.
        """
        rows = []
        for i, (sensor, marker) in enumerate(zip(first.sensor, first.marker, strict=True)):
            same = [
                row
                for row in np.flatnonzero(together(chain, self.q, first.q[i]))
                if (self.sensor[row], self.marker[row]) == (sensor, marker)
            ]
            if not same:
                at = ', '.join(chain.shown_offset(j, one) for j, one in enumerate(first.q[i]))
                raise InputError(
                    f'no reading of {marker} by {sensor} at the joints {at}, where the first '
                    'check has one: measure the same poses, or begin another history'
                )
            rows.append(same)
        position = np.array([self.position[same].mean(axis=0) for same in rows])
        q = np.array([self.q[same].mean(axis=0) for same in rows])
        return Measured(q, first.sensor, first.marker, position, self.when_s)


def together(chain: SerialChain, q: FloatArray, place: FloatArray) -> BoolArray:
    """Return which configurations (n, k) are of the same pose as one, (n,)."""
    apart: FloatArray = np.abs(q - place) / chain.per_radian
    return np.asarray(apart.max(axis=1) <= SAME_RAD)


@dataclass(frozen=True, eq=False)
class Seen:
    """What a check says beside where its sensors stand."""

    rest: FloatArray  # Errors that a moved sensor cannot explain, m, (3 n,)
    # What a radian of each joint (a metre where it slides), and a metre of each marker, adds,
    # (3 n, k), (3 n, 3 m)
    joints: FloatArray
    tool: FloatArray
    # What one standard deviation of each thing not known of the correction adds, (3 n, r)
    unsure: FloatArray
    freedom: int  # How many numbers of the rest are free
    lever_m: FloatArray  # How far a radian of each joint moves the markers, RMS, m, (k,)
    T_R_N: Mapping[str, FloatArray]  # Where each sensor stands


def seen(model: ArmModel, measured: Measured) -> Seen:
    """Compare a check with the correction's model.

    Raises InsufficientDataError: too few poses to fit where the sensors stand.
    """
    n, k = measured.q.shape
    state = model.state(measured.q)
    errors, points = np.zeros((n, 3)), np.zeros((n, 3))
    derivative = np.zeros((n, 3, len(model.parameter_names)))
    sensors, markers = list(dict.fromkeys(measured.sensor)), list(dict.fromkeys(measured.marker))
    frames, T_R_N = [], {}
    for marker in markers:
        mine = np.array([one == marker for one in measured.marker])
        points[mine] = apply(state.tool[mine], model.markers[marker])
    for sensor in sensors:
        mine = np.array([one == sensor for one in measured.sensor])
        for marker in markers:
            both = mine & [one == marker for one in measured.marker]
            derivative[both] = model.derivative(state, sensor, marker)[both]
        T_R_N[sensor], _ = register_points(points[mine], measured.position[mine])
        errors[mine] = apply(T_R_N[sensor], measured.position[mine]) - points[mine]
        frame = np.zeros((n, 3, 6))
        frame[mine] = rigid_motions(points[mine])
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

    def rest_of(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - taken @ (taken.T @ columns))

    columns = rest_of(derivative.reshape(3 * n, -1))
    return Seen(
        rest_of(errors.ravel()),
        columns[:, :k],
        np.concatenate([columns[:, model.marker(marker)] for marker in markers], axis=1),
        model.widening * (columns @ model.root.T),
        freedom,
        np.sqrt(np.mean(np.sum(derivative[:, :, :k] ** 2, axis=1), axis=0)),
        T_R_N,
    )


def rigid_motions(points: FloatArray) -> FloatArray:
    """Return what shifts and turns of a sensor do to points (n, 3), (n, 3, 6)."""
    turns = np.cross(np.eye(3), points[:, None, :]).swapaxes(1, 2)
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    return np.concatenate((shifts, turns), axis=2)


def detectable_m(joints: FloatArray, lever_m: FloatArray, noise_m: float) -> FloatArray:
    """Return the smallest change of each joint that one check finds, m at the tool, (k,).

    NaN where a moved sensor looks the same.
    """
    information = np.sum(joints**2, axis=0)
    is_seen = _is_seen(joints, lever_m)
    sizes = np.full(len(lever_m), np.nan)
    sizes[is_seen] = POWER_STD * noise_m * (lever_m / np.sqrt(information))[is_seen]
    return sizes


def _is_seen(joints: FloatArray, lever_m: FloatArray) -> BoolArray:
    """Whether a joint does more than a moved sensor would, (k,)."""
    found: BoolArray = np.sum(joints**2, axis=0) > SEEN**2 * lever_m**2 * (len(joints) / 3)
    return found


@dataclass(frozen=True)
class Change:
    """Whether the mean of a series of T results has changed."""

    evidence: float  # Of the e-process
    at: int  # The first result after the change; 0 where there is none to name
    # Of the change where it is most likely, its standard deviation and half of its 95 % interval;
    # infinite where two results do not tell
    size: float
    std: float
    half: float


def bayes_factors(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return for each place of a change the odds for it, its size, and the scatter that it leaves.

    Both means and the variance are integrated out under their invariant priors; the size of the
    change has a normal prior of `PRIOR_STD` standard deviations of a result.

    ``x``: series, (…, T), T >= 2.
    Returns odds, size, left: (…, T - 1) each, for a change before result 1, 2, …; `left` is a sum
    of squares.
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
    left = np.maximum(squares - size**2 / v, 0.0)
    kept = np.maximum(1.0 - share * (1.0 / v - 1.0 / wide), 1e-300)
    return np.sqrt(v / wide) * kept ** (-0.5 * (T - 1.0)), size, left


def evidence(x: FloatArray) -> FloatArray:
    """Return the e-process of series (…, T): the mean of the odds for a change at each place.

    The place has the prior 1 / (j (j + 1)); 1 / T is left for a change that is still to come.
    """
    T = x.shape[-1]
    if T < 2:
        return np.ones(x.shape[:-1])
    j = np.arange(1.0, T)
    odds = bayes_factors(x)[0]
    return np.asarray(1.0 / T + np.sum(odds / (j * (j + 1.0)), axis=-1))


def change(x: FloatArray) -> Change:
    """Return where a series (T,) has changed, and by how much."""
    T = len(x)
    if T < 2:
        return Change(1.0, 0, float(x[-1]), np.inf, np.inf)
    odds, sizes, left = bayes_factors(x)
    j = np.arange(1.0, T)
    best = int(np.argmax(odds / (j * (j + 1.0))))
    if T < 3:
        return Change(float(evidence(x)), best + 1, float(sizes[best]), np.inf, np.inf)
    v = 1.0 / j[best] + 1.0 / (T - j[best])
    std = float(np.sqrt(v * left[best] / (T - 2.0)))
    half = max(float(stdtrit(T - 2.0, 0.975)) * std, wander(x, best + 1))
    return Change(float(evidence(x)), best + 1, float(sizes[best]), std, half)


def step(x: FloatArray, at: int) -> tuple[float, float]:
    """Return the change of the mean of a series (T,) before result `at`, and its std."""
    T = len(x)
    left = np.concatenate((x[:at] - x[:at].mean(), x[at:] - x[at:].mean()))
    variance = float(left @ left) / (T - 2.0) if T > 2 else np.inf
    std = float(np.sqrt(variance * (1.0 / at + 1.0 / (T - at))))
    return float(x[at:].mean() - x[:at].mean()), std


def wander(x: FloatArray, at: int) -> float:
    """Return half of the 95 % interval of a change before result `at`, by how the series wanders.

    Means of results that follow one another differ by more than their scatter says where days
    resemble one another, or with a season: batch means, of a sixth of the series at most.
    """
    T = len(x)
    left = np.concatenate((x[:at] - x[:at].mean(), x[at:] - x[at:].mean()))
    size = max(1, min(at, T - at, T // BATCHES))
    count = T // size
    if count < BATCHES:
        return 0.0
    means = left[T - count * size :].reshape(count, size).mean(axis=1)
    variance = np.sum(means**2) / (count - 2.0) * size
    std = float(np.sqrt(variance * (1.0 / at + 1.0 / (T - at))))
    return float(stdtrit(count - 2.0, 0.975)) * std


@dataclass(frozen=True)
class JointCheck:
    """What is known of one joint; angles in rad, m of a joint that slides, of the tool in m.

    The change is that since the check that is named, or that of the newest check. All but the
    lever is NaN where a moved sensor looks the same, and the evidence 1.
    """

    change: float
    std: float
    detectable_m: float
    lever_m: float
    evidence: float


@dataclass(frozen=True)
class Trend:
    """A change that is certain, and not certainly larger than what matters."""

    kind: Literal['drift', 'step']
    joints: tuple[int, ...]  # Indices of those that it may be of
    tool: bool  # Whether it may be the marker's
    # Of the change at the tool since the first check that has it, m: half is that of its 95 %
    # interval
    size_m: float
    half_m: float
    since: int  # Index of that check
    span: float  # In days, or in checks where the times are not known


@dataclass(frozen=True)
class Checked:
    """What all checks so far say."""

    verdict: Verdict  # Of the newest check, with all before it
    evidence: float  # Mean over joints and markers, of the e-process
    joints: tuple[JointCheck, ...]  # One of each joint, base to tip
    # Indices of the joints that the change may be of; they look alike where there are several
    changed: tuple[int, ...]
    since: int | None  # Index of the first check after the change; None where none is named
    tool_moved: bool  # A marker moved on the tool, rather than a joint
    # By how much the sensors see the markers elsewhere than in the check before (the session of
    # the correction, for the first), RMS
    moved_m: float
    again: bool  # Whether to check again at once
    noise_m: float  # Of a reading, per axis
    # What each check says of each joint, at the tool, m, (T, k): where it alone has changed, or
    # beside what is named
    series_m: FloatArray
    # What is certain and no alarm; None where nothing is
    trend: Trend | None = None
    in_days: bool = False  # Whether the times of all checks are known
    # From the newest check to the next, in days, or in checks where the times are not known
    next_in: float = 1.0
    drifts: bool = False  # Whether what has changed did so little by little
    when_s: float = np.nan  # Unix time of the newest check; NaN where it is not known


def judge(model: ArmModel, checks: Sequence[Measured], smallest_m: float = SMALLEST_M) -> Checked:
    """Judge the newest of an arm's checks.

    Parameters
    ----------
    model
        Of the correction.
    checks
        Of the same poses, oldest first; see `Measured.as_before`.
    smallest_m
        Changes of the tool that matter.
    """
    looks = [seen(model, one) for one in checks]
    last, T = looks[-1], len(looks)
    levers = last.lever_m
    information = np.sum(last.joints**2, axis=0)
    is_seen = _is_seen(last.joints, levers)
    x_m = _series(looks)
    counts = np.concatenate((is_seen, np.ones(last.tool.shape[1], bool)))
    found = [change(x_m[:, i]) for i in range(x_m.shape[1])]
    total = float(np.mean([one.evidence for one, counted in zip(found, counts) if counted]))
    best = max(np.flatnonzero(counts), key=lambda i: found[i].evidence)
    at = found[best].at
    noise = _noise(looks, at if total > DOUBT else 0)
    std = noise / np.sqrt(np.where(is_seen, information, np.inf))
    smallest = detectable_m(last.joints, levers, noise)
    before = looks[-2].T_R_N if T > 1 else model.T_R_N
    moved, moved_is = _moved(before, last, checks[-1], noise, max(T - 1, 1), smallest_m)
    clear = abs(found[best].size) - found[best].half > smallest_m
    days, in_days = _days(checks)
    lines = [drift(x_m[:, i], days) for i in range(x_m.shape[1])]
    of_lines = float(np.mean([one.evidence for one, counted in zip(lines, counts) if counted]))
    line = lines[max(np.flatnonzero(counts), key=lambda i: lines[i].evidence)]
    drifts = of_lines >= TOLD and of_lines > total and abs(line.size) > line.half
    if drifts:
        weights, at = line.weights, min(line.at + 1, T - 1)
        noise = _scatter(np.array([one.rest for one in looks]), days, line.at)
        noise /= np.sqrt(last.freedom)
        std = noise / np.sqrt(np.where(is_seen, information, np.inf))
        smallest = detectable_m(last.joints, levers, noise)
        clear = abs(line.size) - line.half > smallest_m
    else:
        weights = _before_and_after(T, at)
    asked = AT_ONCE < T and all(
        _is_doubtful(looks[:until], x_m[:until], counts, is_seen, smallest_m)
        for until in range(T - AT_ONCE, T)
    )
    verdict: Verdict = 'setup_moved' if moved_is else 'unchanged'
    named: tuple[int, ...] = ()
    tool = False
    again = False
    trend: Trend | None = None
    next_in = float(np.median(np.diff(days))) if T > 1 else 1.0
    if (drifts or total >= ALARM) and clear:
        named, tool = _named(looks, weights, noise, is_seen)
        # A joint and the marker that look alike: nobody is told to correct the arm for that.
        verdict = 'unclear' if tool and named else 'setup_moved' if tool else 'changed'
    elif drifts:
        trend = Trend(
            'drift',
            *_named(looks, weights, noise, is_seen),
            abs(line.size),
            line.half,
            at,
            line.days,
        )
        if abs(line.size) + line.half > smallest_m:
            verdict = 'unclear'
        # Half of the time until it may matter; not before the next of the usual checks.
        next_in = max(next_in, min(0.5 * line.days_left(smallest_m), LONGEST_DAYS))
    elif total >= TOLD:
        step_of = found[best]
        trend = Trend(
            'step',
            *_named(looks, weights, noise, is_seen),
            abs(step_of.size),
            step_of.half,
            at,
            float(days[-1] - days[at]),
        )
        if abs(step_of.size) + step_of.half > smallest_m:
            verdict = 'unclear'
    elif _is_doubtful(looks, x_m, counts, is_seen, smallest_m):
        verdict, again = 'unclear', not asked
    if named or tool:
        # What has changed is taken out of the others, which would show a part of it.
        taken = last.joints[:, list(named[:1])] if named else last.tool
        others = _series([_without(one, taken) for one in looks])
        kept = np.isin(np.arange(x_m.shape[1]), named[:1])
        x_m = np.where(kept, x_m, others)
        found = [change(x_m[:, i]) for i in range(x_m.shape[1])]
    # Where nothing is named, the newest check against all before it: no place is chosen.
    place = at if named or tool else T - 1
    if drifts and (named or tool):
        about = days, line.at
        sizes = [(float(weights @ x), _scatter(x, *about) * _length(weights)) for x in x_m.T]
    else:
        sizes = [step(x, place) if T > 1 else (float(x[0]), np.inf) for x in x_m.T]
    return Checked(
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
    """Return when checks were made, days since the first, (T,), and whether that is known.

    Where a time is missing, or none is later than the one before, they are numbered.
    """
    when = np.array([one.when_s for one in checks])
    if np.isfinite(when).all() and np.all(np.diff(when) > 0.0):
        return (when - when[0]) / 86_400.0, True
    return np.arange(float(len(checks))), False


def _before_and_after(T: int, at: int) -> FloatArray:
    """Return weights whose sum with results is the change of their mean before one, (T,)."""
    weights = np.full(T, 1.0 / (T - at))
    weights[:at] = -1.0 / at if at else 0.0
    return weights


def _scatter(values: FloatArray, days: FloatArray, at: int) -> float:
    """Return the scatter of results (T,) or (T, n) about drifts from one check on."""
    line = np.maximum(0.0, days - days[at])
    basis = np.linalg.qr(np.stack((np.ones(len(days)), line), axis=1))[0]
    left = values - basis @ (basis.T @ values)
    return float(np.sqrt(np.sum(left**2) / (len(days) - 2.0)))


def _length(weights: FloatArray) -> float:
    return float(np.linalg.norm(weights))


def _without(one: Seen, taken: FloatArray) -> Seen:
    """Return a check in which what some columns explain is not seen."""
    basis = np.linalg.qr(taken)[0]

    def rest_of(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - basis @ (basis.T @ columns))

    return replace(one, rest=rest_of(one.rest), joints=rest_of(one.joints), tool=rest_of(one.tool))


def _series(looks: Sequence[Seen]) -> FloatArray:
    """Return results of joints, where each alone has changed, and of markers, m, (T, k + 3 m)."""
    rows = [
        (*(_alone(one.joints, one.rest) * one.lever_m), *np.linalg.lstsq(one.tool, one.rest)[0])
        for one in looks
    ]
    return np.array(rows)


def _alone(columns: FloatArray, rest: FloatArray) -> FloatArray:
    """Return the size of each column where it alone explains the rest; 0 where it is rounding."""
    squares = np.sum(columns**2, axis=0)
    is_any = squares > 1e-18 * np.max(squares)
    return np.divide(columns.T @ rest, squares, out=np.zeros_like(squares), where=is_any)


def _noise(looks: Sequence[Seen], at: int) -> float:
    """Return the noise of a reading per axis, m: the scatter of checks without a change at one.

    Of a single check it is what the correction leaves, its own error included.
    """
    rests, freedom = np.array([one.rest for one in looks]), looks[-1].freedom
    parts = [part for part in (rests[:at], rests[at:]) if len(part)]
    squares = sum(float(np.sum((part - part.mean(axis=0)) ** 2)) for part in parts)
    if len(rests) == len(parts):
        return float(np.sqrt(np.sum(rests**2) / len(rests) / freedom))
    return float(np.sqrt(squares / (len(rests) - len(parts)) / freedom))


def _moved(
    before: Mapping[str, FloatArray],
    last: Seen,
    measured: Measured,
    noise: float,
    looks: int,
    smallest_m: float,
) -> tuple[float, bool]:
    """Return by how much the sensors see the markers elsewhere, RMS, m, and whether they moved."""
    shift = np.zeros_like(measured.position)
    for sensor, T in last.T_R_N.items():
        mine = np.array([one == sensor for one in measured.sensor])
        place = measured.position[mine]
        shift[mine] = apply(T, place) - apply(before.get(sensor, T), place)
    squares, size = float(np.sum(shift**2)), float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
    # Two fits of six numbers a sensor each, and a noise that is estimated from so many checks.
    count = 6.0 * len(last.T_R_N)
    limit = count * float(
        fdtri(count, float(looks * last.freedom), 1.0 - erfc(BEYOND / np.sqrt(2.0)))
    )
    return size, size > smallest_m and squares > 2.0 * noise**2 * limit


def _is_doubtful(
    looks: Sequence[Seen],
    x_m: FloatArray,
    counts: BoolArray,
    is_seen: BoolArray,
    smallest_m: float,
) -> bool:
    """Whether these checks ask for another one, where they are no alarm."""
    found = [change(x_m[:, i]) for i in np.flatnonzero(counts)]
    best = max(found, key=lambda one: one.evidence)
    small = abs(best.size) + best.half < smallest_m
    doubted = float(np.mean([one.evidence for one in found])) > DOUBT and not small
    return doubted or _single(looks, x_m, counts, is_seen)


def _single(looks: Sequence[Seen], x_m: FloatArray, counts: BoolArray, is_seen: BoolArray) -> bool:
    """Whether the newest result is far from those before it, or the first from the correction."""
    last, T = looks[-1], len(looks)
    if T > 3:
        # Of few checks the scatter may be small by chance, but not below the noise of a reading.
        scatter = x_m[:-1].std(axis=0, ddof=1)
        squares = np.where(is_seen, np.sum(last.joints**2, axis=0), np.inf)
        of_tool = np.sqrt(np.diag(np.linalg.inv(last.tool.T @ last.tool)))
        floor = _noise(looks[:-1], 0) * np.concatenate((last.lever_m / np.sqrt(squares), of_tool))
        std = np.maximum(scatter, floor) * np.sqrt(1.0 + 1.0 / (T - 1.0))
        off = np.abs(x_m[-1] - x_m[:-1].mean(axis=0))
        return bool(np.any(off[counts] > BEYOND * std[counts]))
    # Too few for a scatter: what one joint, or a marker, leaves of the difference is the noise.
    step = last.rest - (np.mean([one.rest for one in looks[:-1]], axis=0) if T > 1 else 0.0)
    joints = last.joints[:, is_seen]
    squares = np.sum(joints**2, axis=0)
    size = joints.T @ step / squares
    left = np.maximum(step @ step - size**2 * squares, 0.0) / (last.freedom - 1)
    variance = left / squares
    if T < 2:
        variance += np.sum((joints.T @ last.unsure / squares[:, None]) ** 2, axis=1)
    if np.any(size**2 > BEYOND**2 * variance):
        return True
    moved = last.tool @ np.linalg.lstsq(last.tool, step)[0]
    count = last.tool.shape[1]
    left_of_all = float(np.sum((step - moved) ** 2)) / (last.freedom - count)
    return T > 1 and float(moved @ moved) > BEYOND**2 * count * left_of_all


def _named(
    looks: Sequence[Seen], weights: FloatArray, noise: float, is_seen: BoolArray
) -> tuple[tuple[int, ...], bool]:
    """Return the joints that a change may be of, and whether it may be a marker's.

    ``weights``: (T,); the change of the readings is the sum of weights times checks.
    """
    step = weights @ np.array([one.rest for one in looks])
    variance = noise**2 * float(weights @ weights)
    last = looks[-1]
    squares = np.where(is_seen, np.sum(last.joints**2, axis=0), np.inf)
    gains = 0.5 * (last.joints.T @ step) ** 2 / squares / variance
    shift = np.linalg.lstsq(last.tool, step)[0]
    # Two more numbers explain more by chance: Schwarz's price of them.
    tool = 0.5 * float(np.sum((last.tool @ shift) ** 2)) / variance - np.log(len(step))
    top = max(float(gains.max()), tool)
    named = np.flatnonzero(gains > top - np.log(TELLING))
    return tuple(int(one) for one in named), bool(tool > top - np.log(TELLING))


def chosen_poses(
    model: ArmModel,
    q: FloatArray,
    sensor: str,
    marker: str,
    count: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Choose the configurations in which the smallest change of any joint is seen best.

    Configurations are exchanged one by one, as long as the least information on a joint, divided
    by the square of its lever, grows.

    ``q``: to choose from, rad, (c, k), c >= count; ``sensor, marker``: what is measured by what;
    ``count``: how many; ``rng``: draws the first ones, of five tries.
    Returns rows, sizes: of `q`, (count,); the smallest change of each joint that is found with a
    noise of 1 m per axis, m at the tool, (k,), NaN where a moved sensor looks the same.
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
    able = everything > SEEN**2 * 3 * len(q)
    ridge = 1e-9 * np.eye(6)
    best, score = np.arange(count), -1.0
    for _ in range(5):
        rows = rng.choice(len(q), count, replace=False)
        value = -1.0
        while True:
            before = value
            for slot in range(count):
                others = np.delete(rows, slot)
                least = information(
                    DD[others].sum(axis=0) + DD,
                    FD[others].sum(axis=0) + FD,
                    FF[others].sum(axis=0) + FF + ridge,
                )[:, able].min(axis=1)
                least[others] = -1.0
                rows[slot], value = int(np.argmax(least)), float(least.max())
            if value <= before * (1.0 + 1e-6):
                break
        if value > score:
            best, score = rows.copy(), value
    ff = FF[best].sum(axis=0) + ridge
    found = information(DD[best].sum(axis=0), FD[best].sum(axis=0), ff)
    sizes = np.where(able, POWER_STD / np.sqrt(np.where(able, found, 1.0)), np.nan)
    return np.sort(best), sizes
