"""Screening: every cell tried beside a set already found, with p-values over all of them.

In units of the noise a cell explains ``gain`` of the squared residuals; its score is the log
evidence with the noise's scale integrated out::

    S = −½ N log(1 − gain / total) − ½ k log N − log(cells of its kind)

The p-value of the best cell is the share of surrogate residuals whose best cell, of *all* cells,
scores as high: the family-wise error is held whatever the number of cells and their likeness
(Westfall & Young 1993). Surrogates of two kinds, and the larger p-value counts: signs of whole
poses flipped at random, which holds for any symmetric noise independent between poses, of any
spread (Winkler et al. 2014); and draws from the fitted noise, exact where that is Gaussian. A
few poses have too few patterns of signs (8 give 128, one of which is the observed one): there the
whitened rows are flipped one by one, which relies on the noise model's independence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.at_joints import AtJoints, Products, suit
from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Number and generator to that many sets of errors of all rows, m, (n, 3, draws).
Draw = Callable[[int, np.random.Generator], FloatArray]
# With fewer, flips of whole poses meet the observed pattern, or its like, by chance.
FEWEST_POSES = 12
# Smoothness tried for free forms: penalty over data, in the trace.
SMOOTHNESS = (0.1, 1.0, 10.0)
# Directions of a cell that the others explain to this share of its variance are dropped.
ABSORBED = 1e-6
SINGLE_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Screening:
    """Scores of all cells beside a set of others.

    Attributes
    ----------
    score
        Log evidence gained, with the prior probability of each cell, (cells,); -inf where it
        adds nothing to the set.
    null
        Best score of any cell on each surrogate, of both kinds, (2, draws).
    """

    score: FloatArray
    null: FloatArray

    def p_value(self, score: float) -> float:
        """Return the share of surrogates whose best cell scores as high."""
        if self.null.shape[1] == 0:
            return float('nan')
        as_high = np.sum(self.null >= score, axis=1)
        return float(np.max(1.0 + as_high) / (1.0 + self.null.shape[1]))


def screen(
    data: Residuals,
    catalogue: Catalogue,
    given: Solution,
    *,
    rng: np.random.Generator | None = None,
    draws: int = 0,
    chosen: BoolArray | None = None,
    errors: Draw | None = None,
) -> Screening:
    """Score all cells beside the given ones, under their noise.

    Parameters
    ----------
    data, catalogue
        The residuals and the cells.
    given
        The set already found: projected out, with its penalties.
    rng, draws
        For surrogates of each kind; none by default.
    chosen
        Which cells to score; all by default.
    errors
        To draw surrogates with; by default the noise of the given ones.
    """
    noise = given.noise
    project = _Projection(data, given)
    observed = project.residual(data.noise_model.whitened(data.errors, noise).reshape(-1, 1))
    surrogates = observed.astype(np.float32)
    if draws and rng is not None:
        drawn = project.residual(_surrogates(data, observed, draws, rng, noise, errors))
        surrogates = np.concatenate((surrogates, drawn), axis=1)
    surrogates /= np.linalg.norm(surrogates, axis=0)
    n_eff = 3 * len(data) - data.base.shape[2]
    scores = np.full(len(catalogue.cells), -np.inf)
    best = np.full(surrogates.shape[1], -np.inf)
    others = ~catalogue.which(given.cells)
    wanted = np.flatnonzero(others if chosen is None else others & chosen)

    def take(batch: IntArray, products: Products) -> None:
        value = _scores([catalogue.cells[i] for i in batch], products, n_eff)
        scores[batch] = value[:, 0]
        np.maximum(best, value.max(axis=0), out=best)

    suiting = suit(data, catalogue)[wanted]
    few = wanted[suiting]
    # For fewer columns it is more work than it saves.
    if catalogue.sizes[few].sum() > surrogates.shape[1] + project.top.shape[1]:
        wanted = wanted[~suiting]
        pulled = project.residual(surrogates)
        at_joints = AtJoints.of(data, catalogue, noise, pulled, project.twice())
        for batch in catalogue.batches(few, by_joint=True):
            products, clear = at_joints.products(batch)
            if clear.any():
                take(batch[clear], products.of(clear))
            wanted = np.append(wanted, batch[~clear])
    for batch in catalogue.batches(wanted):
        take(batch, _products(data, catalogue, batch, project, surrogates, noise))
    return Screening(scores, best[1:].reshape(2, -1) if draws else np.zeros((2, 0)))


def scores_in_place(
    data: Residuals, catalogue: Catalogue, solution: Solution, cell: Cell, others: Sequence[Cell]
) -> FloatArray:
    """Return the score of a cell beside the rest of a set, and of others in its place.

    With the noise and the smoothness of the whole set, (1 + others,); -inf for what is not among
    all that are tried.
    """
    index = solution.cells.index(cell)
    without = solution.less(index, solution.evidence_without(index, len(data)))
    score = screen(data, catalogue, without, chosen=catalogue.which((cell, *others))).score
    places = [catalogue.places.get(one.key) for one in (cell, *others)]
    return np.array([-np.inf if place is None else score[place] for place in places])


class _Projection:
    """Takes out what base and given cells explain, in units of the noise."""

    def __init__(self, data: Residuals, given: Solution) -> None:
        columns = data.columns(given.cells)
        joined = np.concatenate((data.base, columns), axis=2)
        white = data.noise_model.whitened(joined, given.noise).reshape(3 * len(data), -1)
        # The factor of H, which is that of a fit: much less work than that of all the rows.
        H = white.T @ white
        p = data.base.shape[2]
        H[:p, :p] += data.base_precision
        H[p:, p:] += given.prior_precision()
        scale = np.sqrt(np.diag(H))
        root = np.linalg.cholesky(H / np.outer(scale, scale))
        self.top = solve_triangular(root, (white / scale).T, lower=True, check_finite=False).T
        self.single = self.top.astype(np.float32)

    def twice(self) -> NDArray[np.float32]:
        """T with M'M = I − T T', (3n, p)."""
        # M = I − Q Q' is no projection where there are penalties: M'M = I − Q (2 I − Q'Q) Q'.
        inner = np.linalg.cholesky(2.0 * np.eye(self.top.shape[1]) - self.top.T @ self.top)
        twice: NDArray[np.float32] = self.single @ inner.astype(np.float32)
        return twice

    def residual(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return (M v) of values (3n, c), M = I − Z (Z'Z + Λ)⁻¹ Z' restricted to the rows."""
        top = self.single if values.dtype == np.float32 else self.top
        return values - top @ (top.T @ values)


def _surrogates(
    data: Residuals,
    observed: FloatArray,
    draws: int,
    rng: np.random.Generator,
    noise: Noise,
    errors: Draw | None,
) -> NDArray[np.float32]:
    """Return residuals with flipped poses, and drawn ones, (3n, 2 draws), single precision."""
    unit = data.pose_of_row if data.poses >= FEWEST_POSES else np.arange(len(data))
    signs = rng.integers(0, 2, (int(unit.max()) + 1, draws)) * 2.0 - 1.0
    flipped = observed * np.repeat(signs[unit], 3, axis=0)
    if errors is None:
        drawn = rng.standard_normal((len(observed), draws))
    else:
        drawn = data.noise_model.whitened(errors(draws, rng), noise).reshape(-1, draws)
    return np.concatenate((flipped, drawn), axis=1, dtype=np.float32)


def _products(
    data: Residuals,
    catalogue: Catalogue,
    batch: IntArray,
    project: _Projection,
    residuals: NDArray[np.float32],
    noise: Noise,
) -> Products:
    """Return the products of the columns of a batch, from what they displace in every row."""
    count, m = len(batch), int(catalogue.sizes[batch[0]])
    block = catalogue.block(catalogue.columns(batch))
    white = data.noise_model.whitened(block, noise).reshape(3 * len(data), -1)
    norm = np.linalg.norm(white, axis=0).reshape(count, m)
    if catalogue.penalised[batch[0]]:
        # The penalty compares neighbours: one unit for all of a cell's splines.
        norm = np.repeat(norm.max(axis=1, keepdims=True), m, axis=1)
    left = project.residual(white / np.where(norm > 0.0, norm, 1.0).ravel())
    pull = (left.T @ residuals).reshape(count, m, -1)
    blocks = left.reshape(len(left), count, m).transpose(1, 2, 0)
    gram = np.asarray(blocks @ blocks.transpose(0, 2, 1), dtype=float)
    return Products(norm, gram, pull)


def _scores(cells: Sequence[Cell], products: Products, n_eff: int) -> FloatArray:
    """Return the score of each cell of a batch on each residual, (cells, residuals)."""
    norm, gram, pull = products
    count, m = norm.shape
    prior = np.array([np.log(cell.drawn_from) for cell in cells])
    sign = np.array([cell.sign for cell in cells])
    if cells[0].penalty is None:
        values, vectors = np.linalg.eigh(gram)
        seen = values > ABSORBED
        # The prior on their size, the same for all of a cell's directions; none without a size.
        largest = np.array([cell.largest or np.nan for cell in cells])
        ridge = (largest**2 * np.mean(norm**2, axis=1) + np.finfo(float).tiny) ** -1.0
        ridge[np.isnan(largest)] = 0.0
        strength = np.maximum(values, ABSORBED) + ridge[:, None]
        root = vectors * np.where(seen, strength**-0.5, 0.0)[:, None]
        if m == 1:
            pull[sign[:, None, None] * pull < 0.0] = 0.0
        gain = np.sum((root.transpose(0, 2, 1).astype(np.float32) @ pull) ** 2, axis=1)
        rank = seen.sum(axis=1)
        price = 0.5 * rank * np.log(n_eff) + prior
        score = _explained(gain, n_eff) - price[:, None]
        score[rank == 0] = -np.inf
        return score
    score = np.full((count, pull.shape[2]), -np.inf)
    for index, cell in enumerate(cells):
        assert cell.penalty is not None
        weight = np.trace(gram[index])
        penalty = cell.penalty * weight / np.trace(cell.penalty)
        jitter = SINGLE_ROUNDING * weight * np.eye(m)
        for factor in SMOOTHNESS:
            root = np.linalg.cholesky(gram[index] + factor * penalty + jitter)
            shrink = np.linalg.inv(root).astype(np.float32)
            gain = np.sum((shrink @ pull[index]) ** 2, axis=0)
            volume = np.sum(np.log(np.diag(root))) - 0.5 * np.linalg.slogdet(factor * penalty)[1]
            price = volume + prior[index] + np.log(len(SMOOTHNESS))
            score[index] = np.maximum(score[index], _explained(gain, n_eff) - price)
    return score


def _explained(gain: FloatArray, n_eff: int) -> FloatArray:
    return -0.5 * n_eff * np.log1p(-np.minimum(np.asarray(gain, dtype=float), 1.0 - 1e-9))
