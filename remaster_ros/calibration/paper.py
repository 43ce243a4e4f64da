# SPDX-License-Identifier: Apache-2.0
"""Exact estimator of the source paper: equations 8 and 12 to 16 of Van Wyk et al.

The paper's chain does not converge within its 2e5 steps, which one chain alone does not show.
Therefore several chains run at once, each from a three-point registration of its own, and R-hat
shows it. Units inside are the paper's, mm and degrees, because its proposals are one number for
both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from msgspec import structs

from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.identifiability import Gauge, find_gauge
from remaster_ros.calibration.initial_guess import referenced, register
from remaster_ros.calibration.laplace import find_mode
from remaster_ros.calibration.metropolis import random_walk_sampler
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.priors import TIGHTEST_PRIOR
from remaster_ros.calibration.result import Sampled, sampled_columns
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse, transform
from remaster_ros.types import FloatArray, IntArray

STEPS = 200_000
BURN_IN_SHARE = 0.875
HALF_WIDTH = 0.0125
START_SIGMA_MM = 1.0
# Smallest ratio of a triangle's area to the square of its longest side, from which its points are
# not collinear (0.43 for an equilateral one).
FLATTEST_TRIANGLE = 0.1


@dataclass(frozen=True, eq=False)
class PaperPosterior:
    """Posterior of the paper (equation 15), for one or more sensors and several chains.

    A state is, per sensor, x, y, z in mm and alpha, beta, gamma in degrees (Theta_1); the
    offsets of all joints in degrees (Theta_2); and sigma per sensor in mm.
    """

    chain: SerialChain  # The nominal robot
    rows: Rows  # The observations; `Rows.target` is not used
    # Measured positions in each sensor's frame N, in the order of ``rows``, m, (n, 3)
    measured: FloatArray
    markers: FloatArray  # Nominal markers in the tool frame, m, (markers, 3)
    # Three-point registration that each chain starts from, (chains, sensors, 4, 4)
    T_N_R: FloatArray

    @classmethod
    def of(cls, problem: Problem, chains: int, rng: np.random.Generator) -> PaperPosterior:
        """Posterior of a problem's optimization rows, sampled by a number of chains.

        Three random points register each sensor of each chain. Raises InsufficientDataError if a
        sensor has no three points that make a triangle.
        """
        identity = np.tile(np.eye(4), (len(problem.sensor_names), 1, 1))
        rows = Rows.of(problem.measurements, problem.fitted, identity)
        measured = problem.measurements.position[rows.source]
        nominal = problem.chain.positions(rows.q, problem.markers[rows.marker])
        T_N_R = np.empty((chains, len(problem.sensor_names), 4, 4))
        for sensor, span in rows.spans:
            name = problem.sensor_names[sensor]
            for index in range(chains):
                three = span.start + _three_points(nominal[span], name, rng)
                T_N_R[index, sensor] = inverse(register(nominal[three], measured[three], name))
        return cls(problem.chain, rows, measured, problem.markers, T_N_R)

    @property
    def sensors(self) -> int:
        """Number of sensors."""
        return self.T_N_R.shape[1]

    def start(self) -> FloatArray:
        """First states of the chains, (chains, d): zeros, and sigma 1 mm, as in the paper."""
        chains = len(self.T_N_R)
        zeros = np.zeros((chains, 6 * self.sensors + len(self.chain)))
        return np.concatenate((zeros, np.full((chains, self.sensors), START_SIGMA_MM)), axis=1)

    def split(self, states: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Registrations T_N_R, offsets in rad and sigma in m of states (chains, ..., d).

        Shapes (chains, ..., sensors, 4, 4), (chains, ..., k) and (chains, ..., sensors).
        """
        turned = 6 * self.sensors
        theta_1 = states[..., :turned].reshape(*states.shape[:-1], self.sensors, 6)
        between = states.ndim - 2
        initial = self.T_N_R.reshape(len(self.T_N_R), *(1,) * between, self.sensors, 4, 4)
        turn = _euler_zyx(np.radians(theta_1[..., 3:]))
        correction = transform(turn, 1e-3 * theta_1[..., :3])
        offsets = np.radians(states[..., turned : turned + len(self.chain)])
        return correction @ initial, offsets, 1e-3 * states[..., -self.sensors :]

    def log_density(self, states: FloatArray) -> FloatArray:
        """Logarithm (chains,) of eq. 15 at states (chains, d), up to a constant.

        -inf where a sigma is not above 0.
        """
        T_N_R, offsets, sigma = self.split(states)
        points = self.chain.positions(
            self.rows.q, self.markers[self.rows.marker], offsets[:, None, :]
        )
        value = np.zeros(len(states))
        positive = np.all(sigma > 0.0, axis=1)
        for sensor, span in self.rows.spans:
            turn, shift = T_N_R[:, sensor, :3, :3], T_N_R[:, sensor, None, :3, 3]
            errors = self.measured[span] - shift - points[:, span] @ np.swapaxes(turn, -1, -2)
            # Eq. 7, in mm as sigma is.
            cost = 1e6 * np.einsum('cni,cni->c', errors, errors)
            scale = np.where(positive, 1e3 * sigma[:, sensor], 1.0)
            exponent = 3 * (span.stop - span.start) + 2
            value -= exponent * np.log(scale) + cost / (2.0 * scale**2)
        return np.where(positive, value, -np.inf)


def fit_paper(
    problem: Problem,
    *,
    chains: int,
    steps: int,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Sampled:
    """Fit of a problem as in the paper: markers at nominal, no row left out, no parameter held.

    All parameters move at once by U(-0.0125, 0.0125) mm and degrees (eq. 16); the last eighth of
    the steps is kept. ``chains, steps``: number of chains, and of steps of each chain with the
    burn-in; ``progress``: called with the share that is done. Raises InsufficientDataError as
    `find_gauge`, or if a sensor has no three points that make a triangle.
    """
    measurements, identity = problem.measurements, problem.empty_model()
    target = PaperPosterior.of(problem, chains, rng)
    start = target.start()
    run = random_walk_sampler(
        target.log_density,
        lambda source: source.uniform(-HALF_WIDTH, HALF_WIDTH, start.shape),
        start=start,
        steps=steps,
        burn_in=int(BURN_IN_SHARE * steps),
        rng=rng,
        trace_every=max(1, steps // 1000),
        progress=progress,
    )
    # Registrations of all chains as corrections to their mean, about the data's centroid.
    T_N_R = target.split(run.draws)[0]
    model = referenced(identity, measurements, problem.fitted, inverse(T_N_R[0, -1]))
    x, _ = _paper_natural(target, model, run.draws)
    mean = x.reshape(-1, model.size).mean(axis=0)
    model = referenced(identity, measurements, problem.fitted, model.T_R_N(mean))
    rows = Rows.of(measurements, problem.fitted, model.reference)
    at_mean = model.vector(model.offsets(mean), problem.markers)
    # Over the markers too: the paper takes their places as exact, which does not determine them.
    found = find_gauge(model, at_mean, rows, problem.marker_priors(model))
    # The parameters that the paper has: not the markers. One noise for each sensor.
    moved = np.arange(model.joints + 6 * len(model.sensor_names))
    nominal = model.vector(np.zeros(model.joints), problem.markers)
    free = moved[model.joints :]
    posterior = Posterior.of(model, rows, (), free, nominal).with_independent_rows()

    def columns(states: FloatArray) -> FloatArray:
        x, sigma = _paper_natural(target, model, states)
        return sampled_columns(posterior, x, np.log(sigma), moved)

    x, sigma = _paper_natural(target, model, run.draws)
    z = model.pinned(x)
    fixed = z.copy()
    fixed[..., found.held] = 0.0
    # Markers do not move here: their place is the mean in natural parameters, not in pinned ones.
    middle = model.natural(fixed).reshape(-1, model.size).mean(axis=0)
    return Sampled(
        posterior=posterior,
        z=z,
        eta=np.log(sigma),
        z_mean=model.pinned(middle),
        moved=moved,
        run=run._replace(draws=columns(run.draws), trace=columns(run.trace)),
        name=f'paper: random-walk Metropolis, {steps} steps, the last eighth kept',
        precision=None,
        gauge=_paper_gauge(found, model),
        taken_as_known=_taken_as_known(found, model, problem.marker_std_m),
        z_before=lambda: find_mode(posterior).z,
        left_out=(),
    )


def _paper_natural(
    target: PaperPosterior, model: Model, states: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Natural parameters (..., size) and sigma, m, (..., sensors), of the paper's states (..., d).

    Markers are at nominal.
    """
    T_N_R, offsets, sigma = target.split(states)
    shape = (*states.shape[:-1], model.size)
    x = np.broadcast_to(model.vector(np.zeros(model.joints), target.markers), shape).copy()
    x[..., : model.joints] = offsets
    return model.with_corrections(x, model.reference @ T_N_R), sigma


def _paper_gauge(gauge: Gauge, model: Model) -> Gauge:
    """Gauge in which `fixed_by` and `why` say what fixes each direction in the paper's fit.

    Directions are those of the given gauge. If that fixes one by a joint held at zero, nothing
    fixes it in the paper's fit, whose priors are flat; any other is fixed by taking markers as
    exact.
    """
    held_joints = {f'{model.names[index]} = 0' for index in gauge.held}
    directions, why = [], list(gauge.why)
    for direction in gauge.directions:
        old = direction.fixed_by
        new = f'taking the marker as known exactly, where there is no more than {old}'
        if old in held_joints:
            new = (
                'nothing: its prior is flat and the chain wanders along it (registrations and '
                f'markers are given for {old})'
            )
        directions.append(structs.replace(direction, fixed_by=new))
        why = [text.replace(f'fixed by {old}', f'fixed by {new}') for text in why]
    return Gauge(tuple(directions), gauge.held, tuple(why))


def _taken_as_known(gauge: Gauge, model: Model, marker_std_m: FloatArray) -> FloatArray:
    """Standard deviation of each offset by that of the markers, rad, (k,).

    The paper takes markers as exact. 0 for offsets that are held or that no marker determines.
    """
    variance = np.zeros(model.joints)
    for direction in gauge.directions:
        entries = direction.combination
        pull = 0.0
        for index, std in enumerate(marker_std_m):
            moved = [entries.get(name, 0.0) for name in model.names[model.marker(index)]]
            pull += float(np.sum(np.square(moved))) / max(float(std), TIGHTEST_PRIOR) ** 2
        for joint, name in enumerate(model.chain.joint_names):
            if pull > 0.0:
                variance[joint] += entries.get(name, 0.0) ** 2 / pull
    variance[gauge.held] = 0.0
    return np.sqrt(variance)


def _three_points(points: FloatArray, sensor: str, rng: np.random.Generator) -> IntArray:
    """Indices (3,) of three random points (of n, (n, 3)) that are not on a line.

    The triangle's area is over a tenth of the square of its longest side. Raises
    InsufficientDataError, naming the sensor, if there are fewer than 3 points or 1,000 tries fail.
    """
    for _ in range(1000):
        if len(points) < 3:
            break
        three = rng.choice(len(points), 3, replace=False)
        sides = points[three] - points[np.roll(three, 1)]
        area = 0.5 * np.linalg.norm(np.cross(sides[0], sides[1]))
        if area > FLATTEST_TRIANGLE * np.max(np.sum(sides**2, axis=1)):
            return three
    raise InsufficientDataError(
        f"sensor '{sensor}': no three of its {len(points)} points make a triangle to register "
        'by; measure poses that are spread further'
    )


def _euler_zyx(angles: FloatArray) -> FloatArray:
    """Rotations Rz(alpha) Ry(beta) Rx(gamma), (..., 3, 3), for angles (..., 3), rad.

    Written out, since every step of the chains needs it: a tenth of the time of SciPy's.
    """
    sa, sb, sg = np.moveaxis(np.sin(angles), -1, 0)
    ca, cb, cg = np.moveaxis(np.cos(angles), -1, 0)
    rows = (
        (ca * cb, ca * sb * sg - sa * cg, ca * sb * cg + sa * sg),
        (sa * cb, sa * sb * sg + ca * cg, sa * sb * cg - ca * sg),
        (-sb, cb * sg, cb * cg),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
