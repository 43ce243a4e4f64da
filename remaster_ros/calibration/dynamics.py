# SPDX-License-Identifier: Apache-2.0
"""Contributions of motion to the errors of an arm: parameters of every fit of a moving session.

With q̇ and q̈ of a row, J_j the derivative of the marker by joint j, and t its time::

    clock of a sensor   Σ_j J_j q̇_j c,  Σ_j J_j q̇_j (t - mean of t) d
    lag of a joint      J_j q̇_j l_j: its reports are late by l_j more than those of all joints
    wind-up             J_j f_j w_j: friction, f with the sign of the speed, after a reversal
                        within some travel (`friction_share`), of which two are tried
    inertia             J_j τ_j s_j, τ the torque of the links' inertia (`moving_links`)
    tool                - a_x m_x along each axis of the tool, a the acceleration of its frame: a
                        mode far above what the motion excites, m = 1 / (2 π f)². What drives it is
                        the acceleration of the tool's centre of mass, which is not known: the same
                        of the acceleration from the frame to the middle of the markers

Sizes of real machines are Gaussian priors about 0. A lag of all joints is one of the clock: the
mean of the lags, each weighted with the square of the speed that its joint gives the markers, is
0. The standard deviations of the offsets then contain the uncertainty of these parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.extension import Extension, Start, Term
from remaster_ros.calibration.path_noise import PathNoise, path_noise
from remaster_ros.kinematics.moving_links import MovingLinks
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray, IntArray, Measurements

# Time of the frames of a row, s: a dozen frames of a camera of 120 Hz, within which the errors of
# sensor and arm are nearly equal.
ROW_S = 0.1
# Travels of a joint within which its friction reverses, rad: of gears, which slip at once, and of
# seals and grease.
TRAVELS_RAD = (1e-4, 1e-3)
# Parts of a row in which friction is followed.
PARTS = 8
# Longest time between neighbouring rows, s.
LONGEST_GAP_S = 1.6 * ROW_S
# Standard deviations of the priors. A clock is found to less than a millisecond when a recording
# is imported; crystals differ by parts in 1e5.
CLOCK_STD_S, DRIFT_STD = 5e-3, 1e-4
# Reports of one controller are of times that differ by less than a few of its cycles, s.
LAG_STD_S = 3e-3
# Standard deviation of the lags' weighted mean, which is 0 by definition, s.
MEAN_LAG_STD_S = 1e-6
# Play and wind-up of friction, some hundredths of a degree, rad.
WINDUP_STD_RAD = 5e-4
# Gearboxes of 3 kN m/rad and stiffer, rad/(N m).
SOFTNESS_STD = 3e-4
# Below this std a delay is shown to a microsecond, s.
SHOWN_S = 5e-6
# Fewest frames of a sensor that show correlations.
FEWEST_FRAMES = 40
# A tool's mode of 7 Hz and above, s².
MODE_STD_S2 = 5e-4
# Parameters of the tool's mode: along its axes, by its frame and by the way to its markers.
MODES = tuple(f'tool_mode_{by}{axis}' for by in ('', 'out_') for axis in 'xyz')


@dataclass(frozen=True, eq=False)
class MotionColumns:
    """Motion of n rows and k joints, and what the parameters of motion do to each row.

    A row without rates has friction only if the arm has come to rest there (`turned`).
    """

    chain: SerialChain
    q: FloatArray  # With zero-offsets, rad, (n, k)
    velocity: FloatArray  # rad/s
    acceleration: FloatArray  # rad/s²
    seconds: FloatArray  # Times of the rows, s, (n,)
    turned: FloatArray  # Where each joint of an arm that has come to rest turned last, (n, k)

    @classmethod
    def of(cls, chain: SerialChain, m: Measurements, offsets: FloatArray) -> MotionColumns:
        """Motion of n measurements that have velocities: joints, rates, times, turning points.

        NaN rates of an arm that stood still count as 0, with friction 0. A row with velocities
        0 is of an arm that has come to rest: its friction follows from the way since
        ``from_q``, where each joint turned last. ``offsets``: zero-offsets added to q, rad or
        m, (k,).
        """
        assert m.velocity is not None
        assert m.acceleration is not None
        rates = np.nan_to_num(m.velocity), np.nan_to_num(m.acceleration)
        at_rest = ~np.any(m.velocity != 0.0, axis=1)
        turned = np.where(at_rest[:, None], m.from_q, np.nan)
        return cls(chain, m.q + offsets, *rates, m.stamp_s, turned + offsets)

    def at(self, rows: IntArray) -> MotionColumns:
        """Motion of some rows, by their indices; friction is that along the path of all rows."""
        return _PartOfMotion(
            self.chain,
            self.q[rows],
            self.velocity[rows],
            self.acceleration[rows],
            self.seconds[rows],
            self.turned[rows],
            self,
            rows,
        )

    @cached_property
    def links(self) -> MovingLinks:
        """Velocities and accelerations of the arm's links in the rows, computed once."""
        return MovingLinks.of(self.chain, self.q, self.velocity, self.acceleration)

    def jacobian(self, places: FloatArray) -> FloatArray:
        """Derivative of markers at positions in the tool frame, (n, 3), by the joints, (n, 3, k).

        m/rad, or 1 for a joint that slides, in R.
        """
        return self.chain.position_jacobian(self.q, places)

    @cached_property
    def friction(self) -> tuple[FloatArray, FloatArray]:
        """Friction of each joint as a share of its full torque, by two travels, (n, k) each.

        A travel is the way within which friction reverses (`TRAVELS_RAD`, times
        ``per_radian``). The first result is the share by the short travel, -1 to 1; the second
        is that by the long travel less the first.
        """
        soon, late = (
            friction_share(
                self.seconds, self.q, self.velocity, self.acceleration, travel, self.turned
            )
            for travel in (np.outer(TRAVELS_RAD, self.chain.per_radian))
        )
        return soon, late - soon

    @cached_property
    def inertial_torque(self) -> FloatArray:
        """Torque of the links' inertia about each joint, N m, or N for a slide, (n, k)."""
        return self.links.inertial_torque()

    def swing(self, middle: FloatArray) -> FloatArray:
        """Displacement in R by an elastic mode along each axis of the tool, m per s², (n, 3, 6).

        Columns are per unit of 1 / (2 π f)² of the mode's frequency f. The first three are
        driven by the acceleration of the tool frame's origin; the last three by the
        acceleration of ``middle``, the middle of the markers in the tool frame, m, (3,), less
        that of the origin.
        """
        tool = self.links.frames[:, -1] @ self.chain.T_fixed[-1]
        frame = self.links.point_acceleration(tool[:, :3, 3])
        turning = self.links.point_acceleration(apply(tool, middle)) - frame
        along = [
            np.einsum('nia,ni->na', tool[:, :3, :3], acceleration)
            for acceleration in (frame, turning)
        ]
        return np.concatenate(
            [-tool[:, :3, :3] * acceleration[:, None, :] for acceleration in along], axis=2
        )


@dataclass(frozen=True, eq=False)
class _PartOfMotion(MotionColumns):
    """Motion of some rows of a session, with the friction along the path of all its rows."""

    whole: MotionColumns
    rows: IntArray

    @cached_property
    def friction(self) -> tuple[FloatArray, FloatArray]:
        """`MotionColumns.friction` of these rows, computed along the path of all rows."""
        soon, late = self.whole.friction
        return soon[self.rows], late[self.rows]


def friction_share(
    seconds: FloatArray,
    q: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    travel: FloatArray,
    turned: FloatArray | None = None,
) -> FloatArray:
    """Friction of each joint as a share of its full torque, the mean over each row, (n, k).

    After each reversal friction reverses within a ``travel`` of the joint, rad or m, (k,): in
    Dahl's model (1968, Aerospace Corp. TOR-0158) the share approaches the sign of the speed
    exponentially. It is followed from row to row. After a gap of more than `LONGEST_GAP_S` it
    begins anew, with the sign of the speed, and near 0 for a joint that hardly moves within a
    row.

    In rows in which no joint moves the share is 0 if ``turned`` is None. ``turned`` are the
    positions at which the joints reversed last, (n, k): the share at rest is then that after
    the way from there to q, and 0 if the position is NaN. ``seconds``: times of the rows, s,
    (n,); ``q``, ``velocity``, ``acceleration``: (n, k).
    """
    moments, first, which = np.unique(seconds, return_index=True, return_inverse=True)
    q, velocity, acceleration = q[first], velocity[first], acceleration[first]
    gap = np.diff(moments, prepend=-np.inf)
    # Times within a row; its speed changes steadily.
    part = ROW_S * ((np.arange(PARTS) + 0.5) / PARTS - 0.5)
    shares = np.zeros_like(q)
    share, last = np.sign(velocity[0]), q[0]
    for i in range(len(moments)):
        if gap[i] > LONGEST_GAP_S:
            # Of a joint that has hardly moved nothing is known.
            begins = velocity[i] + acceleration[i] * part[0]
            share = np.sign(begins) * -np.expm1(-np.abs(begins) * ROW_S / travel)
            last = q[i] + velocity[i] * part[0]
        total = np.zeros_like(share)
        path = q[i] + np.outer(part, velocity[i]) + 0.5 * np.outer(part**2, acceleration[i])
        for place in path:
            step = place - last
            side = np.sign(step)
            share = side + (share - side) * np.exp(-np.abs(step) / travel)
            total += share
            last = place
        shares[i] = total / PARTS
    still = ~np.any(velocity != 0.0, axis=1)
    shares[still] = 0.0
    if turned is not None:
        way = q - turned[first]
        at_rest = np.sign(way) * (1.0 - 2.0 * np.exp(-np.abs(way) / travel))
        shares[still] = np.nan_to_num(at_rest[still])
    return shares[which.reshape(-1)]


def dynamic_extension(
    chain: SerialChain, m: Measurements, sensor_names: tuple[str, ...], markers: FloatArray
) -> Extension:
    """Extension of the model by the parameters of motion, for all rows of the measurements.

    They are each sensor's clock and its drift, each joint's lag, friction and inertia, and the
    tool's modes (see the module). The measurements have velocities. ``markers``: nominal
    positions in the tool frame, m, (markers, 3).
    """
    k = len(chain)
    columns = MotionColumns.of(chain, m, np.zeros(k))
    names: list[str] = []
    units: list[str] = []
    std: list[float] = []
    terms: list[Term] = []

    def named(name: str, unit: str, size: float) -> slice:
        names.append(name)
        units.append(unit)
        std.append(size)
        return slice(len(names) - 1, len(names))

    seconds = m.stamp_s - m.stamp_s.mean()
    for sensor, name in enumerate(sensor_names):
        selection: IntArray = (m.sensor == sensor).astype(np.int64)
        for what, unit, size, factor in (
            ('clock', 's', CLOCK_STD_S, selection),
            ('clock_drift', 's/s', DRIFT_STD, selection * seconds),
        ):
            where = named(f'{what}_{name}', unit, size)
            terms += [
                Term(where, joint, (columns.velocity[:, joint] * factor)[:, None])
                for joint in range(k)
            ]
    lags = []
    for joint in range(k):
        per = float(chain.per_radian[joint])
        joint_unit = chain.units[joint]
        lags.append(len(names))
        terms.append(
            Term(
                named(f'lag_{joint + 1}', 's', LAG_STD_S),
                joint,
                columns.velocity[:, joint, None],
            )
        )
        for name, friction in zip(('windup', 'late_windup'), columns.friction, strict=True):
            where = named(f'{name}_{joint + 1}', joint_unit, WINDUP_STD_RAD * per)
            terms.append(Term(where, joint, friction[:, joint, None]))
        if chain.has_inertials:
            where = named(
                f'inertia_{joint + 1}',
                f'{joint_unit}/{chain.torque_units[joint]}',
                SOFTNESS_STD * per**2,
            )
            terms.append(Term(where, joint, columns.inertial_torque[:, joint, None]))
    swing = columns.swing(markers.mean(axis=0))
    for column, name in enumerate(MODES):
        where = named(name, 's²', MODE_STD_S2)
        terms.append(Term(where, None, swing[:, :, column, None]))
    precision = np.diag(np.array(std) ** -2.0)
    power = np.mean(
        (columns.jacobian(markers[m.marker]) * columns.velocity[:, None, :]) ** 2, (0, 1)
    )
    weight = power / power.sum()
    precision[np.ix_(lags, lags)] += np.outer(weight, weight) / MEAN_LAG_STD_S**2
    return Extension(
        tuple(names),
        tuple(units),
        tuple(terms),
        np.zeros((len(m), 3)),
        np.zeros(len(names)),
        precision,
        of_motion=True,
    )


def estimate_moving(problem: Problem) -> Estimate:
    """Estimate with the parameters of motion, under noise that is correlated along the path.

    A first fit under independent noise gives the correlations; if no sensor has enough frames
    for them (`noise_along_path`), it is the result. Raises as `estimate`.
    """
    extension = dynamic_extension(
        problem.chain, problem.measurements, problem.sensor_names, problem.markers
    )
    found = estimate(problem, extension)
    noise = noise_along_path(found)
    if noise is None:
        return found
    model, x = found.model, found.model.natural(found.mode.z)
    gross = np.array([row for row, _ in found.left_out], dtype=np.int64)
    start = Start(model.offsets(x), model.T_R_N(x), model.markers(x), gross)
    return estimate(replace(problem, path_noise=noise), replace(extension, start=start))


def estimate_beside(moving: Estimate, problem: Problem) -> Estimate:
    """Estimate of a moving session without parameters of motion, for comparison.

    Clocks, lags, friction, inertia and the tool's modes stay in its errors. Its noise has the
    correlations along the path, if any, of ``moving``, an estimate with these parameters by
    `estimate_moving`. ``problem``: to be fitted. Raises as `estimate`.
    """
    return estimate(replace(problem, path_noise=moving.problem.path_noise))


def noise_along_path(found: Estimate) -> PathNoise | None:
    """Correlations of a fit's position errors along the path, estimated sensor by sensor.

    None if no sensor has 40 frames (`FEWEST_FRAMES`); a sensor with fewer has no correlations.
    """
    posterior, model, mode = found.posterior, found.model, found.mode
    rows, free = posterior.rows.of_points, posterior.free
    errors = rows.target - model.predict(mode.z, rows)
    columns = model.jacobian(mode.z, rows)[:, :, free]
    prior = mode.linearisation.prior[: len(free), : len(free)]
    noise: PathNoise | None = None
    for sensor, span in rows.spans:
        first, last = np.searchsorted(rows.frame_start, (span.start, span.stop)).tolist()
        if last - first < FEWEST_FRAMES:
            continue
        frame = np.repeat(np.arange(last - first), rows.frame_size[first:last])
        variance = float(np.mean(errors[span] ** 2) * np.mean(rows.frame_size[first:last]))
        noise = path_noise(
            found.problem.chain,
            found.problem.measurements,
            sensor,
            (rows.source[span], frame, rows.marker[span]),
            errors[span],
            columns[span],
            prior * variance,
            noise,
            len(model.sensor_names),
        )
    return noise


def moving_words(found: Estimate) -> str:
    """Sentence with the median remaining error, mm, and the delay of each sensor's stamps."""
    posterior = found.posterior
    errors = posterior.rows.target - found.model.predict(found.mode.z, posterior.rows)
    length = 1e3 * float(np.median(np.linalg.norm(errors[: posterior.rows.points], axis=1)))
    clocks = [
        f'the stamps of {name} are {late_words(*late)}' for name, late in clocks_of(found).items()
    ]
    return f'the moving robot fits to {length:.2f} mm (median); {"; ".join(clocks)}'


def friction_at_rest(found: Estimate) -> FloatArray:
    """Variance of each row's marker position by unknown friction of an arm at rest, m², (n,).

    It is the sum of the variances along the three axes. The standard deviation of a joint's
    share of friction is taken for half of the difference between the shares by the model's two
    travels. 0 in motion, and for a fit without parameters of motion.
    """
    m, extension, model = found.problem.measurements, found.model.extension, found.model
    variance = np.zeros(len(m))
    if extension is None or not extension.of_motion or m.velocity is None:
        return variance
    columns = MotionColumns.of(found.problem.chain, m, np.zeros(m.q.shape[1]))
    at_rest = np.all(m.velocity == 0.0, axis=1)
    names, theta = list(extension.names), model.theta(found.mode.z)
    windup = np.array([theta[names.index(f'windup_{j + 1}')] for j in range(m.q.shape[1])])
    off = 0.5 * columns.friction[1][at_rest] * windup
    markers = found.problem.markers[m.marker[at_rest]]
    jacobian = found.problem.chain.position_jacobian(m.q[at_rest], markers)
    variance[at_rest] = np.einsum('nik,nk->n', jacobian**2, off**2)
    return variance


def clocks_of(found: Estimate) -> dict[str, tuple[float, float]]:
    """Delay of each sensor's stamps against the joints', and its standard deviation, s, by name.

    Negative if the stamps are early. What the import has corrected already (``clock_offset_s``
    of the session) is included. Only sensors that measured in motion; {} for a fit without
    parameters of motion.
    """
    extension, model = found.model.extension, found.model
    if extension is None or not extension.of_motion:
        return {}
    theta, free = model.theta(found.mode.z), found.posterior.free
    variance = dict(zip(free.tolist(), np.diag(found.mode.covariance), strict=False))
    clocks = {}
    m = found.problem.measurements
    assert m.velocity is not None
    for sensor, name in enumerate(model.sensor_names):
        if np.isnan(m.velocity[m.sensor == sensor]).all():
            # It measured at standstills alone.
            continue
        index = extension.names.index(f'clock_{name}')
        taken = found.problem.session.clock_offset_s.get(name, 0.0)
        std = float(np.sqrt(variance.get(model.core + index, 0.0)))
        clocks[name] = (-(taken + float(theta[index])), std)
    return clocks


def late_words(late_s: float, std_s: float) -> str:
    """Delay and its std as text in ms: '9.97 ± 0.12 ms late'; 'early' if negative."""
    what = 'late' if late_s >= 0.0 else 'early'
    digits = 2 if std_s >= SHOWN_S else 3
    return f'{1e3 * abs(late_s):.{digits}f} ± {1e3 * std_s:.{digits}f} ms {what}'
