"""What the choice of causes costs: the search, repeated without a fifth of the poses in turn.

A search that chooses many causes from few rows has chosen by their noise, too. Its errors on those
rows are then too small, also where poses are left out with the causes held: the causes were chosen
with them. So five searches each do without a fifth of the poses and predict it (Varma & Simon
2006, BMC Bioinformatics 7; Hastie, Tibshirani & Friedman 2009, sec. 7.10.2).

*Predictions.* Their 95 % regions are multiplied by what puts 95 % of these rows inside.

*The model.* It is the mean of the sets found that explain all rows nearly as well
(`combined_searches`).

*Parameters.* The posterior is widened by how far the five searches differ, as a jackknife by
groups has it: with the parameters θ_i without group i, and 0 for those of causes that it did not
find, the covariance is (K − 1)/K Σ (θ_i − mean)(θ_i − mean)' (Efron & Tibshirani 1993, ch. 11).

Only where the causes take up a good part of what the rows tell: elsewhere the choice costs
nothing, and in larger sessions there would be no end to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.predictions import REGION, squared_distances
from remaster_ros.discovery.combined_searches import combined, searches_with
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import Search
from remaster_ros.discovery.stretches import noise_covariance
from remaster_ros.discovery.undetected import natural_parameters
from remaster_ros.types import FloatArray

GROUPS = 5
FEWEST_POSES = 10
# A search of so many rows takes a second or two.
MOST_ROWS = 160
# Causes whose effective parameters are fewer than this share of the coordinates are no choice by
# noise.
FREEDOM_SPENT = 0.03


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
    solution
        The mean of several sets, or what the search of all rows found, alone.
    found_by
        Of each cell of the solution, how many of all searches found it, that of all rows included.
    moves
        What is added to the posterior: one standard deviation of each of independent moves of all
        natural parameters of the fit and the m of the cells, (size + m, count).
    """

    count: int
    same: int
    widening: float
    solution: Solution
    found_by: tuple[int, ...]
    moves: FloatArray

    def not_combined(self, chosen: Solution) -> RepeatedSearch:
        """Return the same for a model of what the search of all rows found, by itself."""
        further = len(self.solution.parameters) - len(chosen.parameters)
        return replace(
            self,
            solution=chosen,
            found_by=self.found_by[: len(chosen.cells)],
            moves=self.moves[: len(self.moves) - further],
        )


def repeat_search(
    found: Estimate,
    search: Search,
    solution: Solution,
    progress: Callable[[float], None],
    *,
    combine: bool = True,
) -> RepeatedSearch | None:
    """Repeat a search; None where that is not needed, or would take too long.

    Parameters
    ----------
    found
        The fit that the search began with.
    search
        As it ended.
    solution
        What it found.
    progress
        Called with the share that is done.
    combine
        Whether sets that are as good may make the model together, where there is a cause.
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
    errors = np.empty((len(data), 3))
    others: list[Solution] = []
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
        without = again.run().solution
        errors[mine] = kept.unexplained(without)[data.rows.source[mine]]
        others.append(without)
    distances = squared_distances(errors, row_covariance(data, solution))
    widening = float(np.sqrt(np.quantile(distances, REGION) / scipy.stats.chi2.ppf(REGION, 3)))
    model = combined(search, solution, others) if combine and _causes(solution) else solution
    moves = np.array([natural_parameters(found, data, model, other) for other in others]).T
    moves -= moves.mean(axis=1, keepdims=True)
    moves *= np.sqrt((GROUPS - 1) / GROUPS)
    return RepeatedSearch(
        GROUPS,
        sum(_causes(other) == _causes(solution) for other in others),
        max(1.0, widening),
        model,
        tuple(searches_with(cell, (solution, *others)) for cell in model.cells),
        moves,
    )


def _causes(solution: Solution) -> set[tuple[str, tuple[int, ...]]]:
    return {(cell.name, cell.joints) for cell in solution.cells if EFFECTS[cell.name].is_cause}


def row_covariance(data: Residuals, solution: Solution) -> FloatArray:
    """Return the covariance of each row by the noise and the parameters, m², (n, 3, 3)."""
    columns = np.concatenate((data.base, data.columns(solution.cells)), axis=2)
    by_parameters = columns @ solution.full_covariance @ np.swapaxes(columns, 1, 2)
    total: FloatArray = by_parameters + noise_covariance(data, solution)
    return total
