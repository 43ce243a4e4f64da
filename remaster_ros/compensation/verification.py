# SPDX-License-Identifier: Apache-2.0
"""Whether a correction acts exactly once.

Last result: the errors that remain, from poses with known targets.

A marker is measured at the pose to which the arm went for wanted joint angles w, those of the
nominal robot. Four states predict its position exactly: the correction acts (its command of w),
does not (w), acts twice, or with the wrong sign. A further state, ``other``: each joint has a
share of its own.

*Absolute*: from the rows with the correction on, base and marker fitted again. *Toggle*: from the
differences on - off of one configuration; it sees only what is switched, not what the controller
has in addition. A state is called if its odds are `ODDS` against each of the others, and neither
``other`` nor a single joint in another state, if these rows can tell it, is more likely, nor any
such joint more likely by `ODDS`; ``other``, if its odds are `ODDS`. The noise is unknown:
likelihoods are integrated over its logarithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.registration import register_points
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import BoolArray, FloatArray, IntArray

Verdict = Literal['in_use', 'not_in_use', 'twice', 'wrong_sign', 'other', 'unclear']
STATES: Mapping[Verdict, float] = {
    'in_use': 1.0,
    'not_in_use': 0.0,
    'twice': 2.0,
    'wrong_sign': -1.0,
}
ODDS = 1000.0
# Prior std of a joint's share under `other`: the states' shares differ by 1 to 3.
SHARE_STD = 2.0
# Noise over which likelihoods are integrated, m: from a tenth of the best tracker's to ten times a
# poor camera's, in steps of a tenth.
SIGMAS = np.geomspace(1e-6, 1e-2, 98)
# Expected log odds with which the odds of 1000 are exceeded in 97.5 % of cases: their variance is
# twice their mean, m - 2 sqrt(2 m) = log 1000.
ENOUGH = float((np.sqrt(2.0) + np.sqrt(2.0 + np.log(ODDS))) ** 2)
MOST_POSES = 1000
# Gauss–Newton steps for the shares: displacements are linear in them to some per cent.
STEPS = 3
# Standard deviations, two-sided, that correspond to odds of 1000.
BEYOND_STD = 3.3


@dataclass(frozen=True, eq=False)
class Visits:
    """Marker positions measured at wanted joint angles, with a correction on or off, n rows."""

    wanted: FloatArray  # Angles of the nominal robot, rad, (n, k)
    on: BoolArray  # Whether the correction was on, (n,)
    configuration: IntArray  # Index of the configuration, which may be visited on and off, (n,)
    # Names of sensor and marker of each row, (n,)
    sensor: tuple[str, ...]
    marker: tuple[str, ...]
    position: FloatArray  # In the sensor's frame, m, (n, 3)


@dataclass(frozen=True)
class Estimate:
    """Share of the correction that acts, its posterior standard deviation, and its state."""

    share: float
    std: float
    verdict: Verdict


@dataclass(frozen=True)
class Mean:
    """Mean distance of the marker from its wanted position, and its 95 % interval, mm."""

    mean_mm: float
    interval95_mm: tuple[float, float]


@dataclass(frozen=True)
class VerificationResult:
    """Verdict whether a correction acts, acts twice or not, with shares, errors and noise."""

    verdict: Verdict  # State by the absolute estimate
    toggle: Estimate | None  # None without configurations that were visited on and off
    absolute: Estimate  # From the rows with the correction on
    joints: Mapping[str, Estimate]  # Absolute estimate of each joint, by name
    # Errors from the wanted positions, base and marker fitted to each; None for too few rows
    error_on: Mean
    error_off: Mean | None
    # RMS residual of the rows with the correction on, corrected for the fit of base and marker
    remains_mm: float
    # RMS noise of one row, from the differences on - off less the best share of the predicted
    # displacement; None without toggles
    noise_mm: float | None
    # Number of poses that would decide an unclear verdict; None if it is clear or none would
    poses: int | None


def verify(compensator: Compensator, visits: Visits) -> VerificationResult:
    """Decide whether a correction acts on an arm: once, not, twice, or with the wrong sign.

    Raises
    ------
    InsufficientDataError
        Too few rows with the correction on to fit base and marker again and have over 3 numbers
        left.
    """
    on = _ProjectedRows(compensator, visits, np.flatnonzero(visits.on))
    off_rows = np.flatnonzero(~visits.on)
    spread = 3 * len(visits.on[visits.on]) - on.base_columns
    if spread <= 3:
        raise InsufficientDataError(
            f'{counted(int(visits.on.sum()), "row")} with the correction on: too few to tell '
            'base, marker and what acts of the correction; measure ten poses'
        )
    absolute, joints, rivals = _absolute(on)
    toggle, noise = _toggle(compensator, visits)
    off = None
    if len(off_rows) and 3 * len(off_rows) > on.base_columns + 3:
        off = _ProjectedRows(compensator, visits, off_rows).error()
    residual = on.projected(on.measured - on.at['in_use'])
    poses = None
    if absolute.verdict == 'unclear':
        poses = _poses(on, rivals)
    return VerificationResult(
        absolute.verdict,
        toggle,
        absolute,
        dict(zip(compensator.joint_names, joints, strict=True)),
        on.error(),
        off,
        1e3 * float(np.sqrt(3.0 * residual @ residual / len(residual))),
        noise,
        poses,
    )


class _ProjectedRows:
    """Measured and predicted marker positions in the base frame R, with a correction on or off."""

    def __init__(self, compensator: Compensator, visits: Visits, rows: IntArray) -> None:
        self.compensator, self.model = compensator, compensator.model
        self.wanted = visits.wanted[rows]
        self.markers = [visits.marker[row] for row in rows]
        sensors = [visits.sensor[row] for row in rows]
        self.places = np.array([self.model.markers[name] for name in self.markers])
        self.command = compensator.command(self.wanted)
        self.commands = commands(compensator, self.wanted)
        self.at = {state: self.seen(q).ravel() for state, q in self.commands.items()}
        nominal = apply(self.model.chain.forward(self.wanted), self.places)
        measured = np.empty((len(rows), 3))
        tool = self.model.chain.forward(self.wanted)[:, :3, :3]
        columns = []
        for sensor in dict.fromkeys(sensors):
            selection = np.array([label == sensor for label in sensors])
            T, _ = register_points(nominal[selection], visits.position[rows][selection])
            measured[selection] = apply(T, visits.position[rows][selection])
            frame = np.zeros((len(rows), 3, 6))
            frame[selection, :, :3] = np.eye(3)
            frame[selection, :, 3:] = np.cross(np.eye(3), nominal[selection][:, None, :]).swapaxes(
                1, 2
            )
            columns.append(frame)
        for marker in dict.fromkeys(self.markers):
            selection = np.array([label == marker for label in self.markers])
            columns.append(tool * selection[:, None, None])
        self.nominal, self.measured = nominal, measured.ravel()
        free = np.concatenate(columns, axis=2).reshape(3 * len(rows), -1)
        vectors, sizes, _ = np.linalg.svd(free)
        self.base_columns = int(np.sum(sizes > 1e-9 * sizes[0]))
        self._complement = vectors[:, self.base_columns :]

    def seen(self, q: FloatArray) -> FloatArray:
        """Predicted positions of the markers at commanded angles (n, k), m, (n, 3).

        By the model of the corrected arm, in the robot base frame R.
        """
        return apply(self.compensator.tool(q), self.places)

    def projected(self, columns: FloatArray) -> FloatArray:
        """Part of position errors, m, (3 n, …), that a fit of base and markers cannot absorb.

        ``columns``: x, y, z of each row in the robot base frame R. As coordinates in an
        orthonormal basis of the complement of that fit, (d, …).
        """
        found: FloatArray = self._complement.T @ columns
        return found

    def moves(self, q: FloatArray) -> FloatArray:
        """Displacements of the markers by the whole correction of each single joint, m, (3 n, k).

        To first order at angles ``q``, (n, k).
        """
        change = self.command - self.wanted
        return (self._derivative(q)[:, :, : self.model.joints] * change[:, None, :]).reshape(
            3 * len(q), -1
        )

    def unsure(self, q: FloatArray) -> FloatArray:
        """Displacements of markers by one std of each uncertain parameter, m, (3 n, r).

        One column for each of r independent errors of the parameters, at commanded angles
        ``q``, (n, k); widened as poses that were left out have shown.
        """
        spread = self.model.widening * (self._derivative(q) @ self.model.root.T)
        return spread.reshape(3 * len(q), -1)

    def _derivative(self, q: FloatArray) -> FloatArray:
        """Derivative of the markers' positions by the p parameters at ``q``, (n, 3, p).

        Shifts of sensors count as those of the first one.
        """
        sensor, state = next(iter(self.model.T_R_N)), self.model.state(q)
        found = np.zeros((len(q), 3, len(self.model.parameter_names)))
        for marker in dict.fromkeys(self.markers):
            selection = np.array([name == marker for name in self.markers])
            found[selection] = self.model.derivative(state, sensor, marker)[selection]
        return found

    def error(self) -> Mean:
        """Mean distance of markers from wanted positions, mm, base and markers fitted again."""
        errors = self._complement @ self.projected(self.measured - self.nominal.ravel())
        return _mean(np.linalg.norm(errors.reshape(-1, 3), axis=1))


def commands(compensator: Compensator, wanted: FloatArray) -> dict[Verdict, FloatArray]:
    """Angles that reach the joints for wanted ones (n, k), by state of the correction.

    rad or m, (n, k). States: 'in_use' (the command), 'not_in_use' (wanted), 'twice' and
    'wrong_sign'.
    """
    once = compensator.command(wanted)
    return {
        'in_use': once,
        'not_in_use': wanted,
        'twice': compensator.command(once),
        'wrong_sign': 2.0 * wanted - once,
    }


def _mean(errors: FloatArray) -> Mean:
    """Mean of error lengths (n,), m, and its 95 % interval, in mm.

    The interval begins at 0 at least; it is infinite at the top for one error.
    """
    mean = float(errors.mean())
    half = 1.96 * float(errors.std(ddof=1)) / np.sqrt(len(errors)) if len(errors) > 1 else np.inf
    return Mean(1e3 * mean, (1e3 * max(0.0, mean - half), 1e3 * (mean + half)))


def _log_likelihood(residual: FloatArray, columns: FloatArray) -> FloatArray:
    """Log density of a residual (d,) for each noise level σ in `SIGMAS`, but for a constant.

    Its covariance is σ² plus that of standard normal coefficients of ``columns`` (d, m).
    """
    vectors, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    along = vectors.T @ residual
    outside_squares = max(0.0, float(residual @ residual - along @ along))
    var = SIGMAS[:, None] ** 2
    wide = var + sizes**2
    d, m = len(residual), len(sizes)
    found: FloatArray = -0.5 * (
        np.sum(along**2 / wide + np.log(wide), axis=1)
        + outside_squares / SIGMAS**2
        + 2.0 * (d - m) * np.log(SIGMAS)
    )
    return found


def _integrated(values: FloatArray) -> float:
    """Logarithm of the mean likelihood over the noise levels `SIGMAS`, from log ones at each."""
    top = values.max()
    return float(top + np.log(np.mean(np.exp(values - top))))


def _absolute(side: _ProjectedRows) -> tuple[Estimate, list[Estimate], list[FloatArray]]:
    """Estimate of the share of the whole correction that acts, that of each joint, and rivals.

    From rows with the correction on. Rivals: displacements, projected, from the best state to
    each alternative (another state, or one joint in another state) that odds of 1000 (`ODDS`)
    do not exclude; with any the verdict is 'unclear'.
    """
    states, other = {}, {}
    for state, q in side.commands.items():
        residual = side.projected(side.measured - side.at[state])
        unsure = side.projected(side.unsure(q))
        moves = SHARE_STD * side.projected(side.moves(q))
        states[state] = _integrated(_log_likelihood(residual, unsure))
        other[state] = _log_likelihood(residual, np.hstack((unsure, moves)))
    best = max(states, key=lambda state: states[state])
    sigma = float(SIGMAS[np.argmax(other[best])])
    rivals = [
        side.projected(side.at[state] - side.at[best])
        for state, value in states.items()
        if state != best and states[best] - value < np.log(ODDS)
    ]
    rivals += _single_joint_alternatives(side, best, sigma, states[best])
    verdict = _decided(states, _integrated(other[best]))
    if verdict == best and rivals:
        verdict = 'unclear'
    share, std = _shares(side, best, sigma, whole=True)
    joint_shares, stds = _shares(side, best, sigma, whole=False)
    joints = [
        Estimate(float(joint_share), float(s), _state_of_share(float(joint_share), float(s)))
        for joint_share, s in zip(joint_shares, stds, strict=True)
    ]
    return Estimate(float(share[0]), float(std[0]), verdict), joints, rivals


def _single_joint_alternatives(
    side: _ProjectedRows, best: Verdict, sigma: float, evidence: float
) -> list[FloatArray]:
    """Projected displacements, (d,) each, if one joint is in another state than the rest.

    Listed are alternatives that explain the rows better than ``best`` itself, if these rows were
    expected to distinguish them from it, and any with odds of 1000 (`ODDS`) against it. ``best``:
    state of the correction; ``sigma``: noise of a reading per axis, m; ``evidence``: log evidence
    of ``best``.
    """
    unsure = side.projected(side.unsure(side.commands[best]))
    residual = side.projected(side.measured - side.at[best])
    moves = side.projected(side.moves(side.commands[best]))
    found = []
    for move in moves.T:
        for share in STATES.values():
            step = (share - STATES[best]) * move
            odds = _integrated(_log_likelihood(residual - step, unsure)) - evidence
            # Of what can be told, one in a thousand is on the wrong side of even odds. Log odds m
            # are expected with the variance 2 m: those of a wrong alternative exceed log 1000 in
            # 1e-4 of cases at most, whatever m is.
            told = _expected(step, unsure, sigma) > ENOUGH
            if odds > (0.0 if told else np.log(ODDS)):
                found.append(step)
    return found


def _expected(step: FloatArray, unsure: FloatArray, sigma: float) -> float:
    """Expected log odds between two states whose predictions differ by a step, m, (d,).

    step' C^-1 step / 2, C = sigma² + unsure unsure'. ``unsure``: displacements by one standard
    deviation of each of r uncertain parameters, m, (d, r), in the coordinates of the step
    (`_ProjectedRows.projected`); ``sigma``: noise of a reading per axis, m.
    """
    covariance = sigma**2 * np.eye(len(step)) + unsure @ unsure.T
    return 0.5 * float(step @ np.linalg.solve(covariance, step))


def _decided(states: Mapping[Verdict, float], other: float) -> Verdict:
    """State with the best log evidence if its odds are over 1000, else 'other' or 'unclear'.

    'other' if free shares for each joint explain the rows better by such odds (`ODDS`).
    ``states``: log evidence of each state; ``other``: that of free shares.
    """
    first, second = sorted(states, key=lambda state: states[state], reverse=True)[:2]
    if other - states[first] > np.log(ODDS):
        return 'other'
    if states[first] - states[second] > np.log(ODDS) and other < states[first]:
        return first
    return 'unclear'


def _shares(
    side: _ProjectedRows, start: Verdict, sigma: float, whole: bool
) -> tuple[FloatArray, FloatArray]:
    """Shares of the correction that act, and their standard deviations, (1,) or (k,) each.

    ``whole``: one share for all joints, else one for each; ``start``: state to begin from;
    ``sigma``: noise of a reading per axis, m.
    """
    begin = STATES[start]
    change = side.command - side.wanted
    k = change.shape[1]
    shares = np.full(1 if whole else k, begin)
    unsure = side.projected(side.unsure(side.commands[start]))
    covariance = sigma**2 * np.eye(len(unsure)) + unsure @ unsure.T
    inverse = np.linalg.inv(covariance)
    prior = np.eye(len(shares)) / SHARE_STD**2
    for _ in range(STEPS):
        q = side.wanted + shares * change
        moves = side.moves(q)
        if whole:
            moves = moves.sum(axis=1, keepdims=True)
        moves = side.projected(moves)
        residual = side.projected(side.measured - side.seen(q).ravel())
        precision = moves.T @ inverse @ moves + prior
        shares = shares + np.linalg.solve(
            precision, moves.T @ inverse @ residual + prior @ (begin - shares)
        )
    return shares, np.sqrt(np.diag(np.linalg.inv(precision)))


def _state_of_share(share: float, std: float) -> Verdict:
    """State nearest to an estimated share, if its odds against the others are 1000.

    Else 'unclear', also for a std of 1 or more; 'other' if beyond 3.3 stds of the nearest
    state.
    """
    squared_distance = {state: ((share - value) / std) ** 2 for state, value in STATES.items()}
    first, second = sorted(squared_distance, key=lambda state: squared_distance[state])[:2]
    if std >= 0.5 * SHARE_STD or 0.5 * (
        squared_distance[second] - squared_distance[first]
    ) < np.log(ODDS):
        return 'unclear'
    return first if squared_distance[first] < BEYOND_STD**2 else 'other'


def _toggle(compensator: Compensator, visits: Visits) -> tuple[Estimate | None, float | None]:
    """Share of the correction that acts when it is switched on, and the noise of a row, mm.

    From pairs of rows, on and off, of the same configuration, sensor and marker; both None for
    fewer than two pairs.
    """
    pairs = []
    for row in np.flatnonzero(visits.on):
        same = [
            int(other)
            for other in np.flatnonzero(
                ~visits.on & (visits.configuration == visits.configuration[row])
            )
            if (visits.sensor[other], visits.marker[other])
            == (visits.sensor[row], visits.marker[row])
        ]
        pairs += [(int(row), other) for other in same[:1]]
    if len(pairs) < 2:
        return None, None
    on, off = (np.array(rows) for rows in zip(*pairs, strict=True))
    side = _ProjectedRows(compensator, visits, on)
    turned = np.empty((len(pairs), 3))
    for sensor in dict.fromkeys(visits.sensor[row] for row in on):
        selection = np.array([visits.sensor[row] == sensor for row in on])
        T, _ = register_points(side.nominal[selection], visits.position[on][selection])
        turned[selection] = (visits.position[on] - visits.position[off])[selection] @ T[:3, :3].T
    difference, before = turned.ravel(), side.at['not_in_use']
    unsure_off = side.unsure(side.commands['not_in_use'])
    states = {}
    for state, q in side.commands.items():
        moved = side.at[state] - before
        states[state] = _log_likelihood(difference - moved, side.unsure(q) - unsure_off)
    best = max(states, key=lambda state: _integrated(states[state]))
    move = side.at['in_use'] - before
    unsure = side.unsure(side.command) - unsure_off
    other = _log_likelihood(
        difference - move, np.hstack((unsure, SHARE_STD * side.moves(side.command)))
    )
    sigma = SIGMAS[np.argmax(states[best])]
    inverse = np.linalg.inv(sigma**2 * np.eye(len(move)) + unsure @ unsure.T)
    precision = float(move @ inverse @ move)
    share = float(move @ inverse @ difference) / precision
    verdict = _decided({s: _integrated(v) for s, v in states.items()}, _integrated(other))
    residual = difference - share * move
    noise = 1e3 * float(np.sqrt(3.0 * residual @ residual / (len(residual) - 1) / 2.0))
    return Estimate(share, precision**-0.5, verdict), noise


def _poses(side: _ProjectedRows, rivals: list[FloatArray]) -> int | None:
    """Number of poses that would exclude the alternatives; None if `MOST_POSES` would not.

    At least half as many again as were measured. ``rivals``: projected displacements to the
    alternatives, m, (d,) each.
    """
    unsure = side.projected(side.unsure(side.command))
    residual = side.projected(side.measured - side.at['in_use'])
    sigma = float(SIGMAS[np.argmax(_log_likelihood(residual, unsure))])
    count = len(side.wanted)
    # At least half as many again: so many were too few.
    for poses in count * np.geomspace(1.5, MOST_POSES / count, 60):
        noise = sigma * np.sqrt(count / poses)
        if all(_expected(step, unsure, noise) > ENOUGH for step in rivals):
            return int(np.ceil(poses))
    return None
