"""Errors that remember belong to the readings, not to the arm: when does fitting them help?

A sensor's wander in the model changes how the rows are weighted against each other. Where it is
large this makes zero-offsets much better; where it is as short as a few readings, or small, it
changes them by chance. Let d be the difference of the predicted positions with and without the
wander, and e the error of those with it. Under the noise that the residuals show (`memory`), e and
d are jointly Gaussian; given d, the probability that ::

    |e|² > 1.05² |e - d|²        (sums over all rows)

is that of doing harm; likewise that of a gain. Unless harm is unlikely and a gain likely, the
wander is set aside: it is said, but not fitted. The posterior is widened by what the memory adds
to the covariance of the ordinary estimate (a sandwich, White 1980, Econometrica 48, with a
parametric covariance of the errors).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.guard import MOST_HARM
from remaster_ros.discovery.memory import DRAWS, Memory, draws_of
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stretches import root_of_inverse
from remaster_ros.discovery.undetected import fitted_columns
from remaster_ros.types import FloatArray, IntArray

# The wander stays in the model where it does harm with at most this probability, and brings a gain
# with at least the other.
RISK = 0.01
HOPE = 0.5
NOT_FITTED = (
    ' This is not in the model, where it could do harm: everything is estimated as from readings '
    'that do not follow each other, with intervals that allow for it.'
)
# Directions in which the two estimates differ by less than this share in variance say nothing.
RESOLVED = 1e-3


def is_memory(cell: Cell) -> bool:
    """Return whether a cell is errors that follow each other and no cause."""
    return cell.driver == 'time' and not EFFECTS[cell.name].is_cause


def remembering(data: Residuals, solution: Solution) -> list[int]:
    """Return the sensors whose errors follow each other by a solution."""
    subjects = {cell.subject for cell in solution.cells if is_memory(cell)}
    return [i for i, name in enumerate(data.context.sensor_names) if name in subjects]


@dataclass(frozen=True, eq=False)
class SetAside:
    """What is located and not fitted.

    Attributes
    ----------
    searched
        The solution of the search, with the wander.
    solution
        The same without it.
    memory
        Of the errors that this leaves.
    """

    searched: Solution
    solution: Solution
    memory: Memory

    @staticmethod
    def said(structure: Sequence[FoundEffect]) -> tuple[FoundEffect, ...]:
        """Return structure without a cause, where the wander's sentence says what is done."""
        return tuple(
            replace(found, cause=found.cause + NOT_FITTED) if found.driver == 'time' else found
            for found in structure
        )


def set_aside(
    data: Residuals,
    solution: Solution,
    fit: Callable[[Sequence[Cell], Solution], Solution | None],
) -> SetAside | None:
    """Return a solution less its wander where that may do harm; None where nothing changes.

    Parameters
    ----------
    data, solution
        What the search worked on and found.
    fit
        Fits a set of cells, as the search does.
    """
    sensors = remembering(data, solution)
    rest = tuple(cell for cell in solution.cells if not is_memory(cell))
    if not sensors:
        return None
    without = fit(rest, solution)
    if without is None:
        return None
    memory = Memory.of(data, without, sensors)
    harm, gain = harm_and_gain(data, solution, without, memory)
    if harm <= RISK and gain >= HOPE:
        return None
    return SetAside(solution, without, memory)


def harm_and_gain(
    data: Residuals, solution: Solution, without: Solution, memory: Memory
) -> tuple[float, float]:
    """Return how probably the wander makes predicted positions worse, and better, by over 5 %.

    Parameters
    ----------
    data, solution
        What the search worked on and found.
    without
        The solution less its wander.
    memory
        Of the errors that this leaves.
    """
    p = data.base.shape[2]
    # A set that was fitted before has its cells in the order they had then.
    wheres = dict(zip(solution.cells, solution.slices(), strict=True))
    core = np.concatenate((np.arange(p), *(_indices(wheres[one]) + p for one in without.cells)))
    columns = np.concatenate((data.base, data.columns(without.cells)), axis=2)
    # Coordinates whose squares add up to those of the predicted displacements.
    root = np.linalg.qr(columns.reshape(3 * len(data), -1), mode='r')
    maps = [
        (root @ _estimator(data, solution)[core], solution),
        (root @ _estimator(data, without), without),
    ]
    error, plain = draws_of(memory, maps)
    change = error - plain
    found = np.concatenate((solution.base, solution.parameters))[core]
    d = root @ (found - np.concatenate((without.base, without.parameters)))
    follows = error @ change.T @ np.linalg.pinv(change @ change.T, RESOLVED, hermitian=True)
    e = (follows @ d)[:, None] + error - follows @ change
    before, after = np.sum((e - d[:, None]) ** 2, axis=0), np.sum(e**2, axis=0)
    worse, better = after > MOST_HARM**2 * before, before > MOST_HARM**2 * after
    return float(np.mean(worse)), float(np.mean(better))


def moved_by_memory(
    found: Estimate, data: Residuals, solution: Solution, memory: Memory
) -> FloatArray:
    """Return how the memory moves the parameters beyond noise without any, one std of each.

    Parameters
    ----------
    found
        The fit that the search began with.
    data, solution
        What it worked on, and the solution without wander.
    memory
        Of the errors that it leaves.

    Returns
    -------
    ndarray
        (size + m, c) as `undetected` returns it.
    """
    columns, precision, where = fitted_columns(found, data, solution)
    white = data.noise_model.whitened(columns, solution.noise).reshape(3 * len(data), -1)
    root = root_of_inverse(white.T @ white + precision)
    (pull,) = draws_of(memory, [((white @ root).T, solution)])
    # The covariance in units of the one that is stated; where it is smaller that stays.
    ratio, axes = np.linalg.eigh(pull @ pull.T / DRAWS + root.T @ precision @ root)
    moves = np.zeros((found.model.size + len(solution.parameters), len(ratio)))
    moves[where] = root @ axes * np.sqrt(np.maximum(ratio - 1.0, 0.0))
    return moves


def _estimator(data: Residuals, solution: Solution) -> FloatArray:
    """Return what takes whitened errors to the base and the cells of a solution, (p + m, 3 n)."""
    columns = np.concatenate((data.base, data.columns(solution.cells)), axis=2)
    white = data.noise_model.whitened(columns, solution.noise).reshape(3 * len(data), -1)
    estimator: FloatArray = solution.full_covariance @ white.T
    return estimator


def _indices(where: slice) -> IntArray:
    return np.arange(where.start, where.stop)
