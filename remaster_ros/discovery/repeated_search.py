"""What the choice of causes costs: the search, repeated without a fifth of the poses in turn.

A search that chooses many causes from few rows has chosen by their noise, too. Its errors on those
rows are then too small, also where poses are left out with the causes held: the causes were chosen
with them. So five searches each do without a fifth of the poses and predict it (Varma & Simon
2006, BMC Bioinformatics 7; Hastie, Tibshirani & Friedman 2009, sec. 7.10.2).

*Causes.* One that most of the five do not find is taken by chance, and leaves (Meinshausen &
Bühlmann 2010, J. R. Stat. Soc. B 72, 417), unless the data are too clear about it.

*Predictions.* Their 95 % regions are multiplied by what puts 95 % of these rows inside.

*Parameters.* The posterior is widened by how far the five searches differ, as a jackknife by
groups has it: with the parameters θ_i without group i, and 0 for those of causes that it did not
find, the covariance is (K − 1)/K Σ (θ_i − mean)(θ_i − mean)' (Efron & Tibshirani 1993, ch. 11).

Only where the causes take up a good part of what the rows tell: elsewhere the choice costs
nothing, and in larger sessions there would be no end to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.predictions import REGION, squared_distances
from remaster_ros.discovery.cross_validation import worth_of
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import BEYOND_DOUBT, Search
from remaster_ros.discovery.stretches import noise_covariance
from remaster_ros.discovery.undetected import natural_parameters
from remaster_ros.types import FloatArray

GROUPS = 5
FEWEST_POSES = 20
# A search of so many rows takes a second or two.
MOST_ROWS = 160
# Causes whose effective parameters are fewer than this share of the coordinates are no choice by
# noise.
FREEDOM_SPENT = 0.04


@dataclass(frozen=True, eq=False)
class RepeatedSearch:
    """What the searches without a fifth of the poses found.

    Attributes
    ----------
    count
        Of searches.
    same
        How many of them found the same causes of the same joints.
    widening
        Factor on the size of the predicted 95 % regions.
    moves
        What is added to the posterior: one standard deviation of each of independent moves of all
        natural parameters of the fit and the m of the cells, (size + m, count).
    """

    count: int
    same: int
    widening: float
    moves: FloatArray


@dataclass(frozen=True, eq=False)
class PartialSearches:
    """Five searches, each without a fifth of the poses.

    Attributes
    ----------
    solutions
        What each found.
    errors
        What is left of each row by the search that did without it, m, (n, 3).
    """

    solutions: tuple[Solution, ...]
    errors: FloatArray

    def surviving(self, search: Search, solution: Solution) -> Solution:
        """Return a solution of the whole search without the causes that most of these do not find.

        One without which the evidence falls by `BEYOND_DOUBT` stays: they may have found it under
        another name.
        """
        found = Counter(cause for one in self.solutions for cause in _causes(one))
        price = np.log(3.0 * len(search.data))
        kept: set[Cell] = set()
        while True:
            rare = [
                (worth_of(solution, cell, where, price), index)
                for index, (cell, where) in enumerate(
                    zip(solution.cells, solution.slices(), strict=True)
                )
                if EFFECTS[cell.name].is_cause
                and 2 * found[cell.name, cell.joints] < GROUPS
                and cell not in kept
            ]
            if not rare:
                return solution
            _, index = min(rare)
            rest = (*solution.cells[:index], *solution.cells[index + 1 :])
            without = search.fit(rest, solution)
            if without is None or without.log_evidence < solution.log_evidence - BEYOND_DOUBT:
                kept.add(solution.cells[index])
            else:
                solution = without

    def compared(
        self, found: Estimate, data: Residuals, searched: Solution, solution: Solution
    ) -> RepeatedSearch:
        """Return how these differ from a solution, and from the one that the search ended with.

        Parameters
        ----------
        found
            The fit that the search began with.
        data
            What it worked on.
        searched, solution
            What it ended with, and the same as it is told, with plainer forms in place of some.
        """
        distances = squared_distances(self.errors, row_covariance(data, solution))
        widening = float(np.sqrt(np.quantile(distances, REGION) / chi2.ppf(REGION, 3)))
        parameters = [natural_parameters(found, data, solution, one) for one in self.solutions]
        moves = np.array(parameters).T
        moves -= moves.mean(axis=1, keepdims=True)
        moves *= np.sqrt((GROUPS - 1) / GROUPS)
        same = sum(_causes(one) == _causes(searched) for one in self.solutions)
        return RepeatedSearch(GROUPS, same, max(1.0, widening), moves)


def search_partly(
    search: Search, solution: Solution, progress: Callable[[float], None]
) -> PartialSearches | None:
    """Repeat a search; None where that is not needed, or would take too long.

    Parameters
    ----------
    search
        As it ended.
    solution
        What it found.
    progress
        Called with the share that is done.
    """
    data = search.data
    if data.poses < FEWEST_POSES or len(data) > MOST_ROWS:
        return None
    spent = len(solution.parameters) - np.trace(solution.prior_precision() @ solution.covariance)
    if spent < FREEDOM_SPENT * data.errors.size:
        return None
    # Generators of their own: the rest of the discovery is the same with and without this.
    rngs = search.rng.spawn(GROUPS + 1)
    group = (rngs[-1].permutation(data.poses) % GROUPS)[data.pose_of_row]
    errors, solutions = np.empty((len(data), 3)), []
    for index, rng in enumerate(rngs[:GROUPS]):
        progress(index / GROUPS)
        mine = group == index
        kept = data.only(data.rows.source[~mine])
        again = replace(
            search,
            data=kept,
            rng=rng,
            judge=lambda rows, _: rows,
            progress=lambda _: None,
        )
        solutions.append(again.run().solution)
        errors[mine] = kept.unexplained(solutions[-1])[data.rows.source[mine]]
    return PartialSearches(tuple(solutions), errors)


def _causes(solution: Solution) -> set[tuple[str, tuple[int, ...]]]:
    return {(cell.name, cell.joints) for cell in solution.cells if EFFECTS[cell.name].is_cause}


def row_covariance(data: Residuals, solution: Solution) -> FloatArray:
    """Return the covariance of each row by the noise and the parameters, m², (n, 3, 3)."""
    columns = np.concatenate((data.base, data.columns(solution.cells)), axis=2)
    by_parameters = columns @ solution.full_covariance @ np.swapaxes(columns, 1, 2)
    total: FloatArray = by_parameters + noise_covariance(data, solution)
    return total
