# SPDX-License-Identifier: Apache-2.0
"""Sessions with random truths: intervals, ranks and errors of what is fitted to them.

Compared are parameters in coordinates that the data can see (joint 1 turned into the
registrations, the last joint into the markers).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from worlds.paper_experiment import OPTIMIZATION, experiment

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.types import FloatArray

SENSORS = (('mocap',), ('tracker',), ('mocap', 'tracker'))
NOISES = ('independent', 'common', 'prior')
SIGMA_M = (0.02e-3, 0.5e-3)
RATIO = (2.0, 6.0)
# The half-Cauchy reaches metres, at which the fit rightly refuses. What is cut off is so plain to
# the data that ranks of the rest do not notice.
MOST_COMMON_M = 5e-3
# Ranks run from 0 to this: the draws are thinned to so many.
RANKS = 199


class Outcome(NamedTuple):
    """What one session showed: per parameter whether its interval holds, its rank; its errors.

    Attributes
    ----------
    inside, rank
        By parameter.
    error
        (posterior mean - truth) / Cramér-Rao bound of the inner joints' offsets.
    """

    seed: int
    sensors: str
    noise: str
    inside: dict[str, bool]
    rank: dict[str, int]
    error: list[float]


def draw_noise(kind: str, rng: np.random.Generator) -> tuple[float, float]:
    """Return sigma and pose_sigma, m."""
    while True:
        sigma, pose_sigma = _any_noise(kind, rng)
        if pose_sigma < MOST_COMMON_M:
            return sigma, pose_sigma


def _any_noise(kind: str, rng: np.random.Generator) -> tuple[float, float]:
    sigma = float(np.exp(rng.uniform(*np.log(SIGMA_M))))
    if kind == 'independent':
        return sigma, 0.0
    if kind == 'common':
        return sigma, sigma * float(rng.uniform(*RATIO))
    return sigma, sigma * float(np.abs(np.tan(np.pi * (rng.random() - 0.5))))


def one_session(seed: int, poses: tuple[int, int] = OPTIMIZATION) -> Outcome:
    """Simulate and fit the session of a seed; the kinds take turns."""
    rng = np.random.default_rng([20261121, seed])
    sensors, noise = SENSORS[seed % 3], NOISES[seed // 3 % 3]
    session, truth = experiment(
        rng, {name: draw_noise(noise, rng) for name in sensors}, sizes=(poses,)
    )
    found = estimate(Problem.of(session))
    names, draws = visible_draws(found, rng)
    true = visible_truth(found.model, truth)
    thinned = draws[rng.permutation(len(draws))[:RANKS]]
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    inside, rank = {}, {}
    for index, name in enumerate(names):
        value = true[name]
        if name.endswith('pose_sigma') and noise == 'independent':
            continue
        inside[name] = bool(low[index] <= value <= high[index])
        rank[name] = int(np.sum(thinned[:, index] < value))
    inner = list(found.model.names[1 : found.model.joints - 1])
    where = [names.index(name) for name in inner]
    error = draws[:, where].mean(axis=0) - [true[name] for name in inner]
    bound = cramer_rao_std(found, truth)[1 : found.model.joints - 1]
    return Outcome(seed, '+'.join(sensors), noise, inside, rank, (error / bound).tolist())


def visible_draws(found: Estimate, rng: np.random.Generator) -> tuple[list[str], FloatArray]:
    """Sample as the product does; return names and draws of what the data can see, (n, p)."""
    posterior, model = found.posterior, found.model
    run, _ = sample_posterior(found.mode, chains=4, draws=1000, rng=rng)
    points = run.draws.reshape(-1, run.draws.shape[-1])
    z = posterior.parameters(points)
    noise = posterior.noise_model.sensor_noise(posterior.noise(points[:, len(posterior.free) :]))
    columns = np.concatenate((z[:, visible(model)], noise.sigma, noise.pose_sigma), axis=1)
    return visible_names(model), columns


def visible(model: Model) -> list[int]:
    """Return the indices of all parameters but the outer two joints, which move nothing."""
    return [i for i in range(model.size) if i not in (0, model.joints - 1)]


def visible_names(model: Model) -> list[str]:
    names = [model.names[i] for i in visible(model)]
    for part in ('sigma', 'pose_sigma'):
        names += [f'noise.{sensor}.{part}' for sensor in model.sensor_names]
    return names


def visible_truth(model: Model, truth: SessionTruth) -> dict[str, float]:
    """Return the truth in the same coordinates."""
    noise = [truth.sensors[name].sigma_m for name in model.sensor_names]
    noise += [truth.sensors[name].pose_sigma_m for name in model.sensor_names]
    values = np.concatenate((pinned_truth(model, truth)[visible(model)], noise))
    return dict(zip(visible_names(model), values.tolist()))


def pinned_truth(model: Model, truth: SessionTruth) -> FloatArray:
    """Return the true parameters in the model's pinned coordinates, (size,)."""
    markers = np.array([truth.markers[name] for name in model.marker_names])
    T_R_N = np.array([truth.sensors[name].T_R_N for name in model.sensor_names])
    x = model.vector(truth.joint_offsets, markers)
    return model.pinned(model.with_corrections(x, model.reference @ inverse(T_R_N)))


def cramer_rao_std(found: Estimate, truth: SessionTruth) -> FloatArray:
    """Return the bound of the model's pinned parameters, (size,); NaN where there is none."""
    model = found.model
    rows = Rows.of(found.problem.measurements, found.problem.fitted, model.reference)
    z = pinned_truth(model, truth)
    derivative = model.jacobian(z, rows)
    information = np.zeros((model.size, model.size))
    for start, size, sensor in zip(rows.group_start, rows.group_size, rows.group_sensor):
        noise = truth.sensors[model.sensor_names[sensor]]
        # Of one axis, all solutions of a pose: their common part fills the matrix.
        covariance = noise.sigma_m**2 * np.eye(size) + noise.pose_sigma_m**2
        part = derivative[start : start + size].transpose(1, 0, 2)
        information += np.sum(part.transpose(0, 2, 1) @ np.linalg.solve(covariance, part), axis=0)
    # The last joint turns the marker, and only the prior on the marker's own place resists: seen
    # from the inner joints that is the same marker with a prior loose along the turn. Shifts of
    # half a millimetre change no direction that matters, so the prior is taken at the truth.
    marker_std = found.problem.session.marker_std_m
    origin, axis = model.tool_axis
    for marker in range(len(model.marker_names)):
        where = model.marker(marker)
        information[where, where] += np.eye(3) / marker_std**2
        turned = np.cross(axis, z[where] - origin)
        last = model.joints - 1
        information[last, last] += turned @ turned / marker_std**2
        information[where, last] -= turned / marker_std**2
        information[last, where] -= turned / marker_std**2
    free = np.flatnonzero(np.diag(information) > 0.0)
    scale = 1.0 / np.sqrt(np.diag(information)[free])
    scaled = information[np.ix_(free, free)] * np.outer(scale, scale)
    std = np.full(model.size, np.nan)
    std[free] = scale * np.sqrt(np.diag(np.linalg.inv(scaled)))
    return std
