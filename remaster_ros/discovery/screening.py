"""Screening: every cell tried beside a set already found.

In units of the noise a cell explains ``gain`` of the squared residuals; its score is the log
evidence with the noise's scale integrated out::

    S = −½ N log(1 − gain / total) − ½ k log N − log(cells of its kind)

Where the noise is known, as of a set with a cell taken out, the first term is ½ gain.

It chooses which cells are fitted; the evidence of the fits decides.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from remaster_ros.calibration.linearisation import log_determinant
from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Poses from which on a search for causes is worth its while.
FEWEST_POSES = 12
# Smoothness tried for free forms: penalty over data, in the trace.
SMOOTHNESS = (0.1, 1.0, 10.0)
# Directions of a cell that the others explain to this share of its variance are dropped.
ABSORBED = 1e-6
SINGLE_ROUNDING = 1e-6
# Columns that are worked on at a time.
CHUNK = 1024


@dataclass(frozen=True, eq=False)
class Catalogue:
    """All cells that can be tried on these rows, with their columns at hand."""

    cells: tuple[Cell, ...]  # As the effects gave them
    starts: IntArray  # First column of each cell, and the number of columns, (cells + 1,)
    at: IntArray  # Joint of each column, -1 where it displaces, (columns,)
    # Added angles of the columns at joints, (n, joint columns), in order
    features: NDArray[np.float32]
    shifts: NDArray[np.float32]  # Displacements of the other columns, (n, 3, others), in order
    position: IntArray  # Where each column is among the features or the shifts, (columns,)
    jacobian: NDArray[np.float32]

    @classmethod
    def of(cls, data: Residuals, cells: Sequence[Cell]) -> Catalogue:
        """Compute all columns on the rows of the residuals, in single precision."""
        context, n = data.part, len(data)
        turns = [cell.place == 'joint_angle' for cell in cells]
        at = [c.joints[0] - 1 if so else -1 for c, so in zip(cells, turns, strict=True)]
        joint = np.repeat(np.array(at, dtype=np.int64), [cell.size for cell in cells])
        position = np.where(joint >= 0, np.cumsum(joint >= 0), np.cumsum(joint < 0)) - 1
        starts = np.cumsum([0, *(cell.size for cell in cells)])
        # Filled in place, as it is most of the memory of a search.
        features = np.empty((n, int(np.sum(joint >= 0))), np.float32)
        shifts = np.empty((n, 3, int(np.sum(joint < 0))), np.float32)
        for cell, so, start in zip(cells, turns, starts, strict=False):
            if cell.size:
                first = int(position[start])
                place = features if so else shifts
                place[..., first : first + cell.size] = cell.columns(context).values
        jacobian = context.jacobian.astype(np.float32)
        return cls(tuple(cells), starts, joint, features, shifts, position, jacobian)

    @cached_property
    def cheap(self) -> BoolArray:
        """Which cells are not too many to be tried again and again, (cells,)."""
        return np.array([not EFFECTS[cell.name].costly for cell in self.cells], dtype=bool)

    @cached_property
    def structure(self) -> BoolArray:
        """Which cells locate structure and claim no cause, (cells,)."""
        return np.array([not EFFECTS[cell.name].is_cause for cell in self.cells], dtype=bool)

    def which(self, cells: Sequence[Cell]) -> BoolArray:
        """Return which cells of the catalogue are among others, (cells,)."""
        found = np.zeros(len(self.cells), dtype=bool)
        found[[self.places[cell.key] for cell in cells if cell.key in self.places]] = True
        return found

    @cached_property
    def places(self) -> dict[object, int]:
        """Index of each cell by its key."""
        return {cell.key: index for index, cell in enumerate(self.cells)}

    def block(self, columns: IntArray) -> NDArray[np.float32]:
        """Return displacements of the given columns, (n, 3, c), single precision."""
        at, position = self.at[columns], self.position[columns]
        angle = at >= 0
        turned: NDArray[np.float32] = np.take(self.jacobian, at[angle], axis=2)
        turned *= np.take(self.features, position[angle], axis=1)[:, None]
        if angle.all():
            return turned
        block = np.empty((len(self.jacobian), 3, len(columns)), np.float32)
        block[:, :, angle] = turned
        block[:, :, ~angle] = np.take(self.shifts, position[~angle], axis=2)
        return block

    @cached_property
    def joint(self) -> IntArray:
        """Joint of the columns of each cell, -1 where they displace, (cells,)."""
        return self.at[self.starts[:-1]]

    @cached_property
    def sizes(self) -> IntArray:
        """Number of columns of each cell, (cells,)."""
        return np.diff(self.starts)

    @cached_property
    def penalised(self) -> BoolArray:
        """Which cells are free forms with a penalty, (cells,)."""
        return np.array([cell.penalty is not None for cell in self.cells], dtype=bool)

    def columns(self, batch: IntArray) -> IntArray:
        """Return the columns of some cells, one cell after the other."""
        edges = zip(self.starts[batch], self.starts[batch + 1], strict=True)
        return np.concatenate([np.arange(first, last) for first, last in edges])

    def batches(self, chosen: IntArray, *, by_joint: bool = False) -> Iterator[IntArray]:
        """Give batches of cells of equal size and kind, about `CHUNK` columns each.

        Where wanted of one joint each.
        """
        alike = np.stack((self.sizes, self.penalised, self.joint * by_joint), axis=1)[chosen]
        kinds, kind_of = np.unique(alike, axis=0, return_inverse=True)
        for kind, (size, _, _) in enumerate(kinds):
            mine = chosen[kind_of.ravel() == kind]
            step = max(1, CHUNK // int(size))
            for start in range(0, len(mine), step):
                yield mine[start : start + step]


class Products(NamedTuple):
    """Of the columns of a batch of cells, what the others explain taken out.

    ``norm`` (cells, m) before that, in units of which ``gram`` (cells, m, m) has their products
    with each other, and ``pull`` (cells, m) those with the residuals.
    """

    norm: FloatArray
    gram: FloatArray
    pull: FloatArray


def screen(
    data: Residuals,
    catalogue: Catalogue,
    given: Solution,
    *,
    chosen: BoolArray | None = None,
    known_noise: bool = False,
) -> FloatArray:
    """Score all cells beside the given ones, under their noise.

    ``data, catalogue``: the residuals and the cells; ``given``: the set already found: projected
    out, with its penalties; ``chosen``: which cells to score; all by default; ``known_noise``:
    whether its noise is not to be estimated again.
    Returns log evidence gained, with the prior probability of each cell, (cells,); -inf where it
    adds nothing to the set.
    """
    project = _Projection(data, given)
    residual = project.residual(_white(data, data.errors, given.noise))
    total = float(np.sum(residual**2))
    residual = (residual / np.sqrt(total)).astype(np.float32)
    n_eff = 3 * len(data) - data.base.shape[2]

    def explained(gain: FloatArray) -> FloatArray:
        if known_noise:
            return 0.5 * total * gain
        return -0.5 * n_eff * np.log1p(-np.minimum(gain, 1.0 - 1e-9))

    scores = np.full(len(catalogue.cells), -np.inf)
    others = ~catalogue.which(given.cells)
    wanted = np.flatnonzero(others if chosen is None else others & chosen)
    for batch in catalogue.batches(wanted):
        products = _products(data, catalogue, batch, project, residual, given.noise)
        cells = [catalogue.cells[i] for i in batch]
        scores[batch] = _scores(cells, products, n_eff, explained)
    return scores


def rises(data: Residuals, given: Solution, cells: Sequence[Cell]) -> list[bool]:
    """Return of kinds of errors whether the likelihood rises with their variance from nothing.

    Its derivative by the variance v of the weights of the columns X, beside the given ones, is
    ½ (|X'P y|² − tr X'P X), with P the precision of the rows (Patterson & Thompson 1971).
    """
    project = _Projection(data, given)
    errors = _white(data, data.errors, given.noise)
    residual = project.residual(errors).astype(np.float32)
    found = []
    for cell in cells:
        columns = _white(data, data.columns([cell]), given.noise)
        left = project.residual(columns.astype(np.float32))
        found.append(bool(np.sum((left.T @ residual) ** 2) > np.sum(left**2)))
    return found


def _white(data: Residuals, values: NDArray[Any], noise: Noise) -> NDArray[Any]:
    """Return vectors (n, 3, …) in units of the noise, (3n, c)."""
    return data.noise_model.whitened(values, noise).reshape(3 * len(data), -1)


class _Projection:
    """Takes out what base and given cells explain, in units of the noise.

    Z has their columns, Λ their prior precision.
    """

    def __init__(self, data: Residuals, given: Solution) -> None:
        p = data.base.shape[2]
        edges = p + np.cumsum([0, *(cell.size for cell in given.cells)])
        white = np.empty((3 * len(data), edges[-1]))
        # One after the other: of a thousand columns every copy counts.
        white[:, :p] = _white(data, data.base, given.noise)
        for cell, (start, end) in zip(given.cells, itertools.pairwise(edges), strict=True):
            white[:, start:end] = _white(data, data.columns([cell]), given.noise)
        # The factor of H, which is that of a fit: much less work than that of all the rows.
        H = white.T @ white
        H[:p, :p] += data.base_precision
        H[p:, p:] += given.prior_precision()
        scale = np.sqrt(np.diag(H))
        root = np.linalg.cholesky(H / np.outer(scale, scale))
        white /= scale
        top = solve_triangular(root, white.T, lower=True, check_finite=False, overwrite_b=True).T
        # What the priors hold back.
        values, vectors = np.linalg.eigh(np.eye(len(H)) - top.T @ top)
        self.top, self.held = top, (vectors * np.sqrt(np.maximum(values, 0.0))).T
        self.single = top.astype(np.float32), self.held.astype(np.float32)

    def residual(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return what is left of values (3n, c), (3n + p, c).

        Its products are v'M w with M = I − Z (Z'Z + Λ)⁻¹ Z', the precision of the rows with what
        has a prior integrated out.
        """
        top, held = self.single if values.dtype == np.float32 else (self.top, self.held)
        taken = top.T @ values
        return np.concatenate((values - top @ taken, held @ taken))


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
    white = _white(data, block, noise)
    norm = np.linalg.norm(white, axis=0).reshape(count, m)
    if catalogue.penalised[batch[0]]:
        # The penalty compares neighbours: one unit for all of a cell's splines.
        norm = np.repeat(norm.max(axis=1, keepdims=True), m, axis=1)
    left = project.residual(white / np.where(norm > 0.0, norm, 1.0).ravel())
    pull = (left.T @ residuals).reshape(count, m)
    blocks = left.reshape(len(left), count, m).transpose(1, 2, 0)
    gram = np.asarray(blocks @ blocks.transpose(0, 2, 1), dtype=float)
    return Products(norm, gram, np.asarray(pull, dtype=float))


def _scores(
    cells: Sequence[Cell],
    products: Products,
    n_eff: int,
    explained: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Return the score of each cell of a batch, (cells,)."""
    norm, gram, pull = products
    m = norm.shape[1]
    prior = np.array([np.log(cell.drawn_from) for cell in cells])
    if cells[0].penalty is None:
        values, vectors = np.linalg.eigh(gram)
        seen = values > ABSORBED
        # The prior on their size, the same for all of a cell's directions; none without a size.
        largest = np.array([cell.largest or np.nan for cell in cells])
        ridge = (largest**2 * np.mean(norm**2, axis=1) + np.finfo(float).tiny) ** -1.0
        ridge[np.isnan(largest)] = 0.0
        strength = np.maximum(values, ABSORBED) + ridge[:, None]
        if m == 1:
            sign = np.array([cell.sign for cell in cells])
            pull[sign * pull[:, 0] < 0.0] = 0.0
        along = np.einsum('cij,ci->cj', vectors, pull)
        gain = np.sum(np.where(seen, along**2 / strength, 0.0), axis=1)
        rank = seen.sum(axis=1)
        score = explained(gain) - 0.5 * rank * np.log(n_eff) - prior
        score[rank == 0] = -np.inf
        return score
    weight = np.trace(gram, axis1=1, axis2=2)[:, None, None]
    penalty = np.array([cell.penalty for cell in cells])
    penalty *= weight / np.trace(penalty, axis1=1, axis2=2)[:, None, None]
    jitter = SINGLE_ROUNDING * weight * np.eye(m)
    flat = np.linalg.slogdet(penalty)[1]
    score = np.full(len(cells), -np.inf)
    for factor in SMOOTHNESS:
        root = np.linalg.cholesky(gram + factor * penalty + jitter)
        gain = np.sum(np.linalg.solve(root, pull[:, :, None])[:, :, 0] ** 2, axis=1)
        price = log_determinant(root) - 0.5 * (flat + m * np.log(factor))
        price += prior + np.log(len(SMOOTHNESS))
        score = np.maximum(score, explained(gain) - price)
    return score
