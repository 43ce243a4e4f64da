"""Do the parameters of one stretch of a session agree with those of the others?

Where a model is wrong in ways that nothing names, its errors at neighbouring poses resemble each
other: a pose that is left out alone is predicted by its neighbours, and standard deviations that
count every row for itself are too small. So runs of poses, one after the other in time, are left
out in turn (only rows that were fitted).

*Parameters.* With whitened columns X_b of a stretch, A = Σ X_b' X_b + Λ, A⁻¹ = L L' and the
residuals e_b at the solution, a stretch pulls the parameters by::

    m_b = L (I − G_b)^(−1/2) L' X_b' e_b,    G_b = L' X_b' X_b L

Where the model is right, Σ m_b m_b' is on average the part of their covariance that is due to
noise: the cluster-robust covariance with bias reduction (Bell & McCaffrey 2002, Survey Methodology
28; Pustejovsky & Tipton 2018, J. Bus. Econ. Stat. 36). The ratio of the two, the mean over joints
and causes, is compared with simulated noise. Only where it is credibly above 1 the moves, in part,
are added to the posterior, as those of causes outside the model (`undetected`). What is wrong in
the same way in all stretches does not show.

*Predictions.* Their 95 % regions are multiplied by what puts 95 % of the rows of left-out
stretches inside, at least by 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.predictions import REGION, squared_distances
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.undetected import fitted_columns
from remaster_ros.types import FloatArray, IntArray

STRETCHES = 10
FEWEST_POSES = 20
# Of a ratio as large where the model is right; by so many simulated ones.
SIGNIFICANCE = 0.01
SIMULATED = 300
# Parameters that rows determine to less than this share, not their priors, are not compared.
SHOWN = 1e-3
# Directions that a stretch alone determines to this share tell nothing of the others.
ALONE = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class Stretches:
    """How stretches of a session agree with each other.

    Attributes
    ----------
    count
        Of stretches; 0 where there are too few poses, or rows determine no parameter.
    ratio
        Of the variance of parameters between stretches to that by the model.
    p_value
        Of so large a ratio by chance.
    moves
        What is added to the posterior: one standard deviation of so many independent moves of all
        natural parameters of the fit and the m of the cells, (size + m, moves).
    widening
        Factor on the size of the predicted 95 % regions; None where nothing was compared.
    """

    count: int
    ratio: float
    p_value: float
    moves: FloatArray
    widening: float | None

    @property
    def widened(self) -> bool:
        """Whether standard deviations contain how the stretches differ."""
        return self.moves.shape[1] > 0


def compare_stretches(found: Estimate, data: Residuals, solution: Solution) -> Stretches:
    """Compare the stretches of a session.

    Parameters
    ----------
    found
        The fit that the search began with.
    data, solution
        What it worked on and found.
    """
    columns, precision, where = fitted_columns(found, data, solution)
    moves = np.zeros((found.model.size + len(solution.parameters), 0))
    if data.poses < FEWEST_POSES:
        return Stretches(0, np.nan, np.nan, moves, None)
    stretch = stretch_of_row(data)
    left = data.left(solution)
    both = np.concatenate((columns, left[:, :, None]), axis=2)
    white = data.noise_model.whitened(both, solution.noise).reshape(3 * len(data), -1)
    X, errors = white[:, :-1], white[:, -1]
    root = root_of_inverse(X.T @ X + precision)
    X = X @ root
    of_stretch = [np.repeat(stretch == index, 3) for index in range(STRETCHES)]
    parts = [_Part.of(X[mine], errors[mine]) for mine in of_stretch]
    by_noise = np.sum([(root @ part.vectors) ** 2 @ part.values for part in parts], axis=0)
    shown = by_noise > SHOWN * np.sum(root**2, axis=1)
    groups = [mine for group in _groups(found, solution) if len(mine := group[shown[group]])]
    if not groups:
        return Stretches(0, np.nan, np.nan, moves, None)

    def ratio_of(pulls: list[FloatArray]) -> FloatArray:
        """Return the ratio for the pulls X_b' e_b of each stretch, (P, s), of s sessions."""
        moved = [root @ part.moved(pull) for part, pull in zip(parts, pulls, strict=True)]
        share = np.sum(np.square(moved), axis=0) / np.where(shown, by_noise, 1.0)[:, None]
        ratio: FloatArray = np.mean([share[group].mean(axis=0) for group in groups], axis=0)
        return ratio

    ratio = float(ratio_of([part.pull[:, None] for part in parts])[0])
    # A fixed seed: the noise is what the ratio is measured by, the same in all sessions.
    simulated = ratio_of(_simulated(parts, np.random.default_rng(0)))
    p_value = float((1 + np.sum(simulated >= ratio)) / (1 + SIMULATED))
    if p_value <= SIGNIFICANCE and ratio > 1.0:
        moves = np.zeros((len(moves), STRETCHES))
        of_parts = np.concatenate([part.moved(part.pull[:, None]) for part in parts], axis=1)
        moves[where] = np.sqrt(1.0 - 1.0 / ratio) * root @ of_parts
    widening = _widening(data, solution, columns @ root, left, stretch, parts)
    return Stretches(STRETCHES, ratio, p_value, moves, widening)


def stretch_of_row(data: Residuals) -> IntArray:
    """Return the stretch of each row worked on, (n,): whole poses, by their mean time."""
    time = data.context.elapsed_s[data.rows.source]
    mean = np.bincount(data.pose_of_row, time) / np.bincount(data.pose_of_row)
    rank = np.empty(data.poses, dtype=np.int64)
    rank[np.argsort(mean, kind='stable')] = np.arange(data.poses)
    stretch: IntArray = (rank * STRETCHES // data.poses)[data.pose_of_row]
    return stretch


@dataclass(frozen=True, eq=False)
class _Part:
    """A stretch, in coordinates of the P parameters whose posterior covariance is the identity.

    Attributes
    ----------
    values, vectors
        Of G_b, (v,) and (P, v); a stretch of fewer numbers than parameters leaves the other values
        at 0.
    pull
        L' X_b' e_b, (P,).
    """

    values: FloatArray
    vectors: FloatArray
    pull: FloatArray

    @classmethod
    def of(cls, X: FloatArray, errors: FloatArray) -> _Part:
        """Summarise whitened rows X (3 n, P) and errors (3 n,)."""
        if len(X) < X.shape[1]:
            _, singular, rows = np.linalg.svd(X, full_matrices=False)
            values, vectors = singular**2, rows.T
        else:
            values, vectors = np.linalg.eigh(X.T @ X)
        return cls(np.clip(values, 0.0, 1.0), vectors, X.T @ errors)

    def times(self, power: float, columns: FloatArray) -> FloatArray:
        """Return (I − G_b) to a negative power times columns (P, s)."""
        apart = self.values < ALONE
        factor = np.where(apart, (1.0 - np.where(apart, self.values, 0.0)) ** power, 0.0)
        # Along all other directions G_b is 0.
        further = (factor - 1.0)[:, None] * (self.vectors.T @ columns)
        product: FloatArray = columns + self.vectors @ further
        return product

    def moved(self, pull: FloatArray) -> FloatArray:
        """Return by how much pulls (P, s) of this stretch move the parameters."""
        return self.times(-0.5, pull)


def _simulated(parts: list[_Part], rng: np.random.Generator) -> list[FloatArray]:
    """Return the pulls of each stretch where the model is right, (P, s) each.

    With u_b = L' X_b' ε_b of the noise and v of the prior, the solution moves by Σ u_b − v, and
    the residuals by X_b times that.
    """
    size = len(parts[0].vectors)
    noise = [
        part.vectors
        @ (np.sqrt(part.values)[:, None] * rng.standard_normal((len(part.values), SIMULATED)))
        for part in parts
    ]
    inner = np.sum([(part.vectors * part.values) @ part.vectors.T for part in parts], axis=0)
    values, vectors = np.linalg.eigh(np.eye(size) - inner)
    drawn = rng.standard_normal((size, SIMULATED))
    prior = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * drawn)
    moved = np.sum(noise, axis=0) - prior
    return [
        u - part.vectors @ (part.values[:, None] * (part.vectors.T @ moved))
        for part, u in zip(parts, noise, strict=True)
    ]


def _groups(found: Estimate, solution: Solution) -> list[IntArray]:
    """Return the places of each free joint offset, and of each cell's parameters."""
    free = len(found.posterior.free)
    joints = np.flatnonzero(found.posterior.free < found.model.joints)
    own = np.arange(free, free + len(solution.parameters))
    return [*joints[:, None], *(own[where] for where in solution.slices())]


def root_of_inverse(precision: FloatArray) -> FloatArray:
    """Return L with L L' the inverse of a matrix of parameters in units far apart, (P, P)."""
    unit = np.maximum(np.diag(precision), np.finfo(float).tiny) ** -0.5
    scaled = precision * np.outer(unit, unit) + 1e-12 * np.eye(len(precision))
    root: FloatArray = unit[:, None] * np.linalg.inv(np.linalg.cholesky(scaled)).T
    return root


def noise_covariance(data: Residuals, solution: Solution) -> FloatArray:
    """Return the covariance of all the noise of each row worked on, m², (n, 3, 3)."""
    sensor = data.context.sensor[data.rows.source]
    along, across = data.noise_model.total_noise(solution.noise)[sensor].T ** 2
    sight = data.rows.target - data.reference[sensor, :3, 3]
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    covariance: FloatArray = across[:, None, None] * np.eye(3)
    covariance += (along - across)[:, None, None] * sight[:, :, None] * sight[:, None, :]
    return covariance


def _widening(
    data: Residuals,
    solution: Solution,
    columns: FloatArray,
    left: FloatArray,
    stretch: IntArray,
    parts: list[_Part],
) -> float:
    """Return the factor by which 95 % of the rows of left-out stretches lie in their regions.

    Parameters
    ----------
    columns
        What the parameters do whose posterior covariance is the identity, m, (n, 3, P).
    left
        Residuals at the solution, m, (n, 3).
    """
    covariance = noise_covariance(data, solution)
    errors = left.copy()
    for index, part in enumerate(parts):
        mine = stretch == index
        errors[mine] += columns[mine] @ part.times(-1.0, part.pull[:, None])[:, 0]
        spread = part.times(-0.5, columns[mine].reshape(-1, columns.shape[2]).T)
        spread = spread.T.reshape(-1, 3, columns.shape[2])
        covariance[mine] += spread @ np.swapaxes(spread, 1, 2)
    distances = squared_distances(errors, covariance)
    return max(
        1.0, float(np.sqrt(np.quantile(distances, REGION) / scipy.stats.chi2.ppf(REGION, 3)))
    )
