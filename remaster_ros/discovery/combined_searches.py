"""One model of several searches: the mean of the sets that explain all rows nearly as well.

Searches without some of the poses find other causes. Where the evidence of such a set, fitted to
all rows, is within 5 units of that of the set that was chosen, the rows do not tell which of them
it is, as for look-alikes: no model is right enough for its evidence to be known to a few units.
The mean of their predictions is better than those of one (Madigan & Raftery 1994, J. Am. Stat.
Assoc. 89, whose window this is). The model then has the causes of all of these sets, with the mean
of their parameters (0 of a cause in a set that does not have it). Predictions are linear in the
parameters, so they are the mean, too. Where the rows decide for the chosen set, as they do where
causes are few and clear, the model has this set and no other.

The model is sampled like any other. So that its parameters are this mean, and as uncertain as they
are in the sets on the average, its prior has the precision ::

    P = C⁻¹ − H

with C the mean of the covariances of the sets (0 of what a set does not have) and H what the rows
tell of all the causes together. P is nowhere negative: a cause that a set does not have is known
in it to be 0. The prior is about what makes the mean the most likely. How far the searches differ
is added to the posterior by `repeated_search`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.families import visible
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Covariances, Solution
from remaster_ros.discovery.stepwise_selection import Search
from remaster_ros.discovery.stretches import root_of_inverse
from remaster_ros.types import FloatArray, IntArray

# Sets whose log evidence is lower by more than this are none of the answers.
WINDOW = 5.0
# Precision, in units of what is known in all, below which a prior is none.
ROUNDING = 1e-6
# The RMS error of the rows that were fitted may be so many times that of the linear mean.
TANGENT = 1.1


def combined(search: Search, chosen: Solution, others: Sequence[Solution]) -> Solution:
    """Fit the causes of several searches together.

    Parameters
    ----------
    search
        As it ended: of all rows.
    chosen
        What it found: its cells come first, and its noise is taken.
    others
        What the other searches found.

    Returns
    -------
    Solution
        Also with what only others found, but what the rest imitates; the chosen one where no other
        set is as good. Its evidence is that of the chosen cells.
    """
    data = search.data
    fits = _as_good([chosen, *(_to_all(search, other) for other in others)])
    if len(fits) == 1:
        return chosen
    cells = (*chosen.cells, *_further(data, chosen, fits))
    try:
        return _with_mean(data, [_only(search, fit, cells) for fit in fits], cells)
    except np.linalg.LinAlgError:
        # The causes of all sets together agree up to rounding.
        return chosen


def holds(data: Residuals, model: Solution, left: FloatArray) -> bool:
    """Return whether what the sampled model leaves of the rows is what the mean leaves.

    The mean is that of linear fits. Where poses hardly determine the parameters these go further
    than the tangent holds, and the mean is then no answer of the model itself.

    Parameters
    ----------
    data, model
        What was searched, and the combined searches.
    left
        Measured minus modelled position of every row, as sampled, m, (all rows, 3).
    """
    where = data.rows.source
    meant, sampled = (np.sum(errors[where] ** 2) for errors in (data.unexplained(model), left))
    return bool(sampled <= TANGENT**2 * meant)


def searches_with(cell: Cell, searches: Sequence[Solution]) -> int:
    """Return how many searches found a cause; what happened at one moment, at any of them."""
    return sum(any(_same(cell, other) for other in search.cells) for search in searches)


def _same(cell: Cell, other: Cell) -> bool:
    if np.isnan(cell.moment):
        return cell.key == other.key
    parts = [(one.name, one.joints, one.subject, one.variant) for one in (cell, other)]
    return parts[0] == parts[1]


def _to_all(search: Search, other: Solution) -> Solution | None:
    """Return another search's causes fitted to all rows; None where they do not make a model.

    Errors that follow each other belong to the readings, and are no part of it.
    """
    kept = [cell for cell in other.cells if cell.driver != 'time' or EFFECTS[cell.name].is_cause]
    fit = search.fit(kept, other)
    return None if fit is None or fit.unphysical() else fit


def _only(search: Search, fit: Solution, cells: Sequence[Cell]) -> Solution:
    """Return a fit of those of its cells that are among some others."""
    kept = [cell for cell in fit.cells if any(_same(cell, one) for one in cells)]
    return fit if len(kept) == len(fit.cells) else search.fit(kept, fit) or fit


def _as_good(fits: Sequence[Solution | None]) -> list[Solution]:
    """Return the different sets that explain nearly as much as the first one, and this first."""
    different: list[Solution] = []
    for fit in fits:
        if fit is None or (different and fit.log_evidence < different[0].log_evidence - WINDOW):
            continue
        keys = {cell.key for cell in fit.cells}
        if all(keys != {cell.key for cell in one.cells} for one in different):
            different.append(fit)
    return different


def _further(data: Residuals, chosen: Solution, fits: Sequence[Solution]) -> Iterator[Cell]:
    """Give what only other fits have, but what the rest imitates."""
    found: list[Cell] = []
    for cell in itertools.chain.from_iterable(fit.cells for fit in fits):
        if not any(_same(cell, one) for one in (*chosen.cells, *found)):
            found.append(cell)
    found.sort(key=lambda cell: -searches_with(cell, fits))
    names = {name for cell in chosen.cells for name in cell.parameters}
    kept = list(chosen.cells)
    for cell in visible(data, chosen.cells, found):
        if names.isdisjoint(cell.parameters) and data.leaves_noise([*kept, cell]):
            names.update(cell.parameters)
            kept.append(cell)
            yield cell


def _mean_of(fits: Sequence[Solution], cells: tuple[Cell, ...]) -> tuple[Solution, list[IntArray]]:
    """Return the mean over fits, the first one's noise with it, and where each has parameters."""
    edges = np.cumsum([0, *(cell.size for cell in cells)])
    places = [np.arange(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    mean, ridge = np.zeros(edges[-1]), np.empty(edges[-1])
    smoothness = np.full(len(cells), np.nan)
    sets = []
    # The smoothness of a curve is that of the first that has it.
    for fit in reversed(fits):
        taken: list[int] = []
        for cell, where, factor in zip(fit.cells, fit.slices(), fit.smoothness, strict=True):
            index = _index_of(cell, cells, taken)
            if index is not None:
                taken.append(index)
                mean[places[index]] += fit.parameters[where] / len(fits)
                ridge[places[index]], smoothness[index] = fit.ridge[where], factor
        sets.append(np.concatenate([np.zeros(0, int), *(places[index] for index in taken)]))
    model = replace(fits[0], cells=cells, parameters=mean, smoothness=smoothness, ridge=ridge)
    return model, sets


def _index_of(cell: Cell, cells: Sequence[Cell], taken: Sequence[int]) -> int | None:
    """Return which of the cells is the same as one, at the same moment if there is such a one."""
    same = [i for i, one in enumerate(cells) if i not in taken and _same(cell, one)]
    exact = [i for i in same if cells[i].key == cell.key]
    return next(iter((*exact, *same)), None)


def _with_mean(data: Residuals, fits: Sequence[Solution], cells: tuple[Cell, ...]) -> Solution:
    """Return the model whose posterior has the mean of fits and of their covariances."""
    model, sets = _mean_of(fits, cells)
    mean, p = model.parameters, data.base.shape[2]
    columns = (data.base, data.columns(cells), data.errors[:, :, None])
    white = data.noise_model.whitened(np.concatenate(columns, axis=2), model.noise)
    gram = np.tensordot(white, white, axes=((0, 1), (0, 1)))
    precision, pull = gram[:-1, :-1], gram[:-1, -1]
    precision[:p, :p] += data.base_precision
    flat = model.prior_precision()
    precision[p:, p:] += flat
    of_base = _inverse(precision[:p, :p])
    base = of_base @ (pull[:p] - precision[:p, p:] @ mean)
    # Of the log posterior at the mean: the prior has to make up for it there.
    slope = pull[p:] - precision[p:] @ np.concatenate((base, mean))
    told = precision[p:, p:] - precision[p:, :p] @ of_base @ precision[:p, p:]
    covariance = np.zeros_like(told)
    for own in sets:
        covariance[np.ix_(own, own)] += _inverse(told[np.ix_(own, own)]) / len(fits)
    unit = np.sqrt(np.diag(covariance))
    values, vectors = _principal(_inverse(covariance) - told, unit)
    drawn = (vectors * values) @ vectors.T / np.outer(unit, unit)
    precision[p:, p:] += drawn
    values, vectors = _principal(flat + drawn, unit)
    vectors = unit[:, None] * vectors
    fixed = [np.full(cell.size, cell.penalty is None) for cell in cells]
    unpenalised = np.flatnonzero(np.concatenate((np.ones(p, bool), *fixed)))
    covariances = _inverse(precision), _inverse(precision[np.ix_(unpenalised, unpenalised)])
    return replace(
        model,
        base=base,
        covariances=Covariances(lambda: covariances),
        drawn=drawn,
        prior_mean=(vectors / values) @ (vectors.T @ (drawn @ mean - slope)),
    )


def _principal(precision: FloatArray, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues, those of rounding left out, and vectors of a precision in some units."""
    values, vectors = np.linalg.eigh(precision * np.outer(unit, unit))
    kept = values > ROUNDING
    return values[kept], vectors[:, kept]


def _inverse(matrix: FloatArray) -> FloatArray:
    root = root_of_inverse(matrix)
    return root @ root.T
