# SPDX-License-Identifier: Apache-2.0
"""Posterior over models: a Metropolis walk over sets of candidate causes.

A model is a set of blocks beside what every model contains: the columns of the offsets model,
with flat priors, and the background (`walk`). A block is one candidate cause; its weights are
N(0, s²) with s, the RMS displacement of the marker by a weight, one of `LEVELS_M`. With all
weights integrated out, the log posterior of a model S is::

    L(S) = ½ Σ n_g log w_g − ½ log|H| + ½ log|Λ| − ½ (y'Wy − b'H⁻¹b) + Σ log prior(block)

with w_g the weights of the error groups, H = Z'WZ + Λ and b = Z'Wy (Patterson & Thompson 1971).
On a `Surface`, noise and background are as they are: errors and candidate columns are whitened and
the background is taken out once. A `State` holds the regression of all candidates on its blocks,
which a block that joins or leaves changes by a sweep (Goodnight 1979, The American Statistician
33), so that a step costs O(columns of the state × all columns).

Proposals are drawn by the posterior itself, tempered (locally informed proposals: Zanella 2020,
J. Am. Stat. Assoc. 115): one block joins, leaves, is exchanged, or a pair is changed, whose first
is drawn widely: what needs a partner is found by no step of one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import sgemm

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import LARGEST_M, Candidate, Design
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.types import BoolArray, FloatArray, IntArray

Single = NDArray[np.float32]
Where = IntArray | slice

# Prior standard deviations of a weight, RMS displacement of the marker, m: half-decades from a
# fifth of the noise of the best trackers to what no calibrated arm exceeds.
LEVELS_M = np.array([3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2])
# Prior odds that a kind of error is present, shared out among its candidates.
KIND_ODDS = 1.0 / 20.0
# Log posterior below which a proposal is refused by the diagonal of its Gram matrix alone: the
# exact value is hardly ever that much higher.
FAR = 12.0
# Share of the largest eigenvalue below which a direction is rounding.
ROUNDING = 1e-9
# Rows of columns that are worked on at once, so that they are in the processor's cache.
ROWS = 64
# Blocks whose products with all columns are computed with those of another: these are limited by
# reading all columns from memory, which is then done once for sixteen.
AHEAD = 15
# A column with a smaller RMS displacement per unit displaces nothing, m.
NOTHING = 1e-12
# Share of the largest displacement, in square, of the directions of a penalised candidate.
# Coarser, and a fit of curves ends on a plateau, four times as far from held-out poses.
LEAST_SHARE = 1e-7

Model = tuple[tuple[int, int], ...]
"""Blocks of a model, each with its level, ascending."""


@dataclass(frozen=True, eq=False)
class Block:
    """Candidate cause with its parameters scaled to weights, which move the marker by 1 m RMS.

    Parameters are ``map`` times the weights. RMS is over the rows worked on; of a penalised
    candidate all weights together move it so.
    """

    candidate: Candidate
    map: FloatArray  # Parameters of the candidate from the weights, (parameters, weights)
    # Prior precision of each parameter, or factor of the penalty, for weights of precision 1
    scale: FloatArray
    allowed: BoolArray  # Which levels are plausible, (levels,)

    @property
    def size(self) -> int:
        """Number of weights; fewer than parameters if some directions are not seen."""
        return self.map.shape[1]

    @property
    def log_prior(self) -> float:
        """Log prior odds of the candidate at one level, if its effect is in the model already.

        -log of the number of candidates of its kind times that of the block's allowed levels,
        which are prior sizes of its weights.
        """
        return -float(np.log(self.candidate.drawn_from * self.allowed.sum()))

    @property
    def sign(self) -> int:
        """Sign that physics allows the weight; 0 for both signs, or several weights."""
        return self.candidate.sign if self.size == 1 else 0

    def displacement(self, context: Context) -> FloatArray:
        """Return the displacement of the marker by a unit of each weight, m, (n, 3, weights)."""
        moved: FloatArray = self.candidate.columns(context).displacement(context) @ self.map
        return moved

    @cached_property
    def _weights(self) -> dict[int, Candidate]:
        """Cache of `weights`: level -> candidate; {} at first."""
        return {}

    def weights(self, level: int) -> Candidate:
        """Return the block's weights as a candidate, whose parameters are the weights.

        ``level``: index of their prior standard deviation in `LEVELS_M`, m. Cached: the same
        object for the same level.
        """
        if level not in self._weights:
            self._weights[level] = Candidate(
                name=self.candidate.name,
                place=self.candidate.place,
                driver=self.candidate.driver,
                form=self.candidate.form,
                parameters=tuple(f'{self.candidate.key}#{i}' for i in range(self.size)),
                unit='m',
                columns=lambda context: Design(None, self.displacement(context)),
                largest=float(LEVELS_M[level]),
            )
        return self._weights[level]


def blocks_of(data: Residuals, candidates: Sequence[Candidate]) -> list[Block]:
    """Return a block (scaled candidate cause) for each candidate that can matter, in order.

    Left out are candidates of which a parameter (if penalised: all) displaces no marker, or
    whose plausible size is below the least of `LEVELS_M`.
    """
    blocks, n = [], len(data)
    for candidate in candidates:
        if not candidate.size:
            continue
        moved = candidate.columns(data.part).displacement(data.part)
        if candidate.penalty is None:
            unit = np.sqrt(np.sum(moved**2, axis=(0, 1)) / n)
            if np.any(unit < NOTHING):
                continue
            mapping, scale = np.diag(1.0 / unit), unit**2
            largest = float((candidate.largest or np.inf) * unit.max())
        else:
            values, vectors = np.linalg.eigh(candidate.penalty)
            root = vectors / np.sqrt(np.maximum(values, np.finfo(float).eps * values[-1]))
            share = np.sum((moved @ root) ** 2, axis=(0, 1)) / n
            if share.sum() < NOTHING**2:
                continue
            seen = share > LEAST_SHARE * share.max()
            total = share[seen].sum()
            mapping, scale = root[:, seen] / np.sqrt(total), np.array([total])
            largest = _largest(data, candidate)
        allowed = min(largest, LARGEST_M) >= LEVELS_M
        # Near the axis of its joint a marker would let degrees be as likely as minutes.
        if allowed.any():
            blocks.append(Block(candidate, mapping, scale, allowed))
    return blocks


def _largest(data: Residuals, candidate: Candidate) -> float:
    """Return the RMS displacement of the marker by the largest plausible error of a joint, m.

    The error is `Candidate.largest`. Infinity if that is None, or if the candidate does not add
    to a joint's position.
    """
    at = candidate.columns(data.part).at
    if at is None or candidate.largest is None:
        return np.inf
    lever = np.sqrt(np.sum(data.part.jacobian[:, :, at] ** 2) / len(data))
    return float(candidate.largest * lever)


class Pool:
    """All blocks (scaled candidate causes) of a search, with columns on the rows worked on."""

    def __init__(self, data: Residuals, blocks: Sequence[Block]) -> None:
        self.data = data
        self.blocks: list[Block] = []
        # Displacements by a unit of each weight, m, (n, 3, m)
        self.columns: Single = np.zeros((len(data), 3, 0), np.float32)
        self.log_prior = np.zeros(0)
        self._names: list[str] = []
        self._users: dict[str, set[int]] = {}  # Blocks with each parameter
        self.excluded: list[IntArray] = []  # Blocks that are in no model with each
        self.place: dict[object, int] = {}  # Index of the block of each candidate, by key
        self.extend(blocks)

    def extend(self, blocks: Sequence[Block]) -> None:
        """Append blocks (scaled candidate causes) to the pool, with their columns.

        Nothing is done for an empty sequence, except in an empty pool.
        """
        if self.blocks and not blocks:
            return
        known = len(self.blocks)
        self.blocks += blocks
        self.sizes = np.array([block.size for block in self.blocks], dtype=np.int64)
        ends = np.cumsum([0, *self.sizes])
        self.first = ends[:-1]  # First column of each block, (blocks,)
        self.of = [np.arange(a, b) for a, b in itertools.pairwise(ends)]  # Its columns
        before = self.columns
        self.columns = np.empty((len(self.data), 3, int(ends[-1])), np.float32)
        self.columns[:, :, : before.shape[2]] = before
        start = before.shape[2]
        for block in blocks:
            where = slice(start, start + block.size)
            self.columns[:, :, where] = block.displacement(self.data.part)
            start = where.stop
        self.log_prior = np.append(self.log_prior, [block.log_prior for block in blocks])
        self.allowed = np.array([block.allowed for block in self.blocks])
        self.sign = np.array([block.sign for block in self.blocks])
        # Errors of one kind come together; what has no name is no kind, and happens once.
        self._names += [
            str(block.candidate.key)
            if EFFECTS[block.candidate.name].cause_per == 'variant'
            else block.candidate.name
            for block in blocks
        ]
        self.kind: IntArray = np.unique(self._names, return_inverse=True)[1]
        users, touched = self._users, set()
        for index, block in enumerate(blocks, known):
            self.place[block.candidate.key] = index
            for name in block.candidate.parameters:
                users.setdefault(name, set()).add(index)
                touched |= users[name]
        # Blocks with a parameter in common are one cause twice: never in one model.
        self.excluded += [np.zeros(0, np.int64)] * len(blocks)
        for index in touched:
            names = self.blocks[index].candidate.parameters
            self.excluded[index] = np.array(sorted(set().union(*(users[name] for name in names))))

    def prior(self, model: Model) -> float:
        """Return the log prior odds of a model, a set of (block, level) pairs.

        The sum of its blocks' log odds, and log(`KIND_ODDS`) for each effect (kind) among
        them, however many of its blocks the model has.
        """
        which = [block for block, _ in model]
        present = len(np.unique(self.kind[which]))
        return float(np.sum(self.log_prior[which]) + present * np.log(KIND_ODDS))


class Surface:
    """Log posterior of sets of candidate causes (blocks), with noise and background fixed.

    The background are random effects of all kinds of errors, one variance each. Columns and
    errors are whitened, and what the offsets model and the background absorb is taken out: by
    M with M'M = (I + Z D Z')⁻¹ for the background Z with variances D, and by projection for
    the flat columns of the offsets model. The weights of a block are turned so that its Gram
    matrix is diagonal: their prior is the same in all directions.
    """

    def __init__(
        self,
        pool: Pool,
        noise: Noise,
        background: Mapping[Candidate, float],
        last: Surface | None = None,
    ) -> None:
        """Make the surface; of the one before, which is of no use any more, it takes the room."""
        self.pool, data = pool, pool.data
        self.noise, self.background = noise, dict(background)
        n = 3 * len(data)
        std = np.concatenate([np.zeros(0), *(np.full(c.size, s) for c, s in background.items())])
        columns = data.columns(list(background)) * std
        head = np.concatenate((data.base, data.errors[:, :, None], columns), axis=2)
        white = data.noise_model.whitened(head, noise).reshape(n, -1)
        p = data.base.shape[2]
        # Priors on the base columns as further rows.
        values, vectors = np.linalg.eigh(data.base_precision)
        known = values > ROUNDING * max(1.0, values[-1])
        rows = (vectors[:, known] * np.sqrt(values[known])).T
        Q = np.linalg.qr(np.concatenate((white[:, :p], rows)))[0]
        remainder = np.concatenate((white[:, p:], np.zeros((len(rows), white.shape[1] - p))))
        remainder -= Q @ (Q.T @ remainder)
        errors, absorbed = remainder[:, 0], remainder[:, 1:]
        square, turn = np.linalg.eigh(absorbed.T @ absorbed)
        seen = square > ROUNDING * max(1.0, square.max(initial=0.0))
        U = absorbed @ (turn[:, seen] / np.sqrt(square[seen]))
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + square[seen])
        self.errors = errors - U @ (shrink * (U.T @ errors))
        # What is taken out of columns, by their products with the same.
        self._both: Single = np.concatenate((Q, U), axis=1).astype(np.float32)
        self._share = np.concatenate((np.ones(p), shrink)).astype(np.float32)
        self.columns: Single = np.zeros((n + len(rows), 0), np.float32)
        self.pull, self.square = np.zeros(0), np.zeros(0)
        # Where the columns are; it may be longer than they are.
        self.room: Single = np.zeros(0, np.float32) if last is None else last.room
        # Products of the columns of blocks that were asked for: with all columns, with each other.
        self._rows: dict[int, Single] = {}
        self._grams: dict[int, FloatArray] = {}
        self.extend()

    def has(self, noise: Noise, background: Mapping[Candidate, float]) -> bool:
        """Return whether the surface was made for exactly this noise and background.

        ``background``: prior std of the weights of each kind of random effects, m.
        """
        mine, parts = self.noise, ('sigma', 'pose_sigma', 'frame_sigma')
        return self.background == background and all(
            np.array_equal(getattr(mine, part), getattr(noise, part)) for part in parts
        )

    def extend(self) -> None:
        """Add the columns of blocks that were added to the pool since, if any."""
        known, count = self.columns.shape[1], self.pool.columns.shape[2]
        if count == known:
            return
        before, height = self.columns, len(self.errors)
        if known or len(self.room) < height * count:
            self.room = np.empty(height * count, np.float32)
        self.columns = self.room[: height * count].reshape(height, count)
        self.columns[:, :known] = before
        n = 3 * len(self.pool.data)
        new = self.pool.columns[:, :, known:]
        white = self.columns if not known else np.empty((height, count - known), np.float32)
        self.pool.data.noise_model.whitened(new, self.noise, white[:n].reshape(new.shape))
        white[n:] = 0.0
        product = self._both.T @ white
        product *= self._share[:, None]
        # In place: as large as all columns.
        sgemm(-1.0, product.T, self._both.T, 1.0, white.T, overwrite_c=1)
        self._turn(white, known)
        if known:
            self.columns[:, known:] = white
        pull = (self.errors.astype(np.float32) @ white).astype(float)
        square = np.einsum('ij,ij->j', white, white).astype(float)
        self.pull = np.concatenate((self.pull, pull))
        self.square = np.concatenate((self.square, square))
        self._rows.clear()

    def is_known(self, block: int) -> bool:
        """Return whether `products` of a block have been computed; ``block``: its index."""
        return block in self._rows

    def fetch(self, blocks: Sequence[int]) -> None:
        """Compute `products` of some blocks at once, where not yet known; ``blocks``: indices."""
        new = [block for block in blocks if not self.is_known(block)]
        if not new:
            return
        of = self.pool.of
        rows = self.columns[:, np.concatenate([of[block] for block in new])].T @ self.columns
        edges = np.cumsum([0, *(len(of[block]) for block in new)])
        for block, start, stop in zip(new, edges[:-1], edges[1:], strict=True):
            self._rows[block] = rows[start:stop]

    def products(self, block: int, gains: FloatArray | None = None) -> Single:
        """Return the products of a block's columns with all columns, (weights, m).

        ``gains``: gain in log posterior by each block and level, `State.gains`. If given,
        the products of the blocks with the largest gains are computed and kept as well, since
        all columns have to be read from memory anyway.
        """
        if not self.is_known(block):
            ahead = [block]
            if gains is not None:
                best = gains.max(axis=1)
                ahead += np.argpartition(-best, min(AHEAD, len(best) - 1))[:AHEAD].tolist()
            self.fetch([*dict.fromkeys(ahead)])
        return self._rows[block]

    def gram(self, block: int) -> FloatArray:
        """Return the products of a block's columns with each other, (weights, weights)."""
        if block not in self._grams:
            mine = self.columns[:, self.pool.of[block]]
            self._grams[block] = (mine.T @ mine).astype(float)
        return self._grams[block]

    def between(self, block: int, model: Sequence[tuple[int, int]]) -> FloatArray:
        """Return the products of a block's columns with those of a model's blocks, (weights, q).

        ``model``: at least one (block, level); q: number of its weights.
        """
        block_columns = self.pool.of[block]
        rows = [self.products(other)[:, block_columns] for other, _ in model]
        return np.concatenate(rows).T.astype(float)

    def _turn(self, columns: Single, first: int) -> None:
        """Turn the weights of each block to the principal axes of its Gram matrix, in place.

        ``columns``: whitened columns of the last blocks, those from column index ``first`` on;
        only these blocks are turned.
        """
        new = self.pool.first >= first
        start, sizes = self.pool.first[new] - first, self.pool.sizes[new]
        pairs = start[sizes == 2]
        spans = [slice(i, i + ROWS) for i in range(0, len(columns), ROWS)]
        a, b, c = np.zeros((3, len(pairs)), np.float32)
        for span in spans:
            column, other = columns[span, pairs], columns[span, pairs + 1]
            a += np.einsum('ij,ij->j', column, column)
            b += np.einsum('ij,ij->j', column, other)
            c += np.einsum('ij,ij->j', other, other)
        angle = 0.5 * np.arctan2(2.0 * b, a - c)
        cosine, sine = np.cos(angle), np.sin(angle)
        for span in spans:
            column, other = columns[span, pairs], columns[span, pairs + 1]
            columns[span, pairs] = cosine * column + sine * other
            columns[span, pairs + 1] = cosine * other - sine * column
        for i, size in zip(start[sizes > 2], sizes[sizes > 2], strict=True):
            mine = columns[:, i : i + size]
            columns[:, i : i + size] = mine @ np.linalg.eigh(mine.T @ mine)[1]


class State:
    """Set of candidate causes (blocks) on a `Surface`: weights, and gain by each further one.

    ``value``: log posterior relative to that of no block. ``pull``, ``square``: products, with
    the errors and with themselves, of all m columns after regression on the model's. What
    needs all columns is computed when it is asked for: most models are refused by their value.
    """

    def __init__(
        self,
        surface: Surface,
        model: tuple[tuple[int, int], ...],
        value: float,
        inverse: FloatArray,
        weights: FloatArray,
        products: Callable[[], tuple[FloatArray, FloatArray]],
        regression: Callable[[Where], Single],
    ) -> None:
        self.surface, self.model, self.value = surface, model, value
        self.inverse = inverse  # H⁻¹ of the weights of the blocks, (q, q)
        self.weights = weights  # Their means, (q,)
        self._products: Callable[[], tuple[FloatArray, FloatArray]] | None = products
        self._regression: Callable[[Where], Single] | None = regression

    @classmethod
    def empty(cls, surface: Surface) -> State:
        """Return the state without any block (candidate cause), of value 0."""
        none: Single = np.zeros((0, surface.columns.shape[1]), np.float32)
        return cls(
            surface,
            (),
            0.0,
            np.zeros((0, 0)),
            np.zeros(0),
            lambda: (surface.pull, surface.square),
            lambda where: none[:, where],
        )

    @classmethod
    def of(cls, surface: Surface, model: Model) -> State:
        """Return the state of a model; ``model``: its blocks, (block, level) each."""
        surface.fetch([block for block, _ in model])
        state = cls.empty(surface)
        for block, level in model:
            state = state.with_block(block, level)
        return state

    @cached_property
    def regression(self) -> Single:
        """Coefficients of the ridge regression of all m columns on the model's q columns, (q, m).

        The ridge is the prior precision of the model's weights.
        """
        assert self._regression is not None
        found = self._regression(slice(None))
        # Columns and states before are kept no longer.
        self._regression = None
        return found

    def regression_of(self, where: IntArray) -> Single:
        """Return the coefficients of some columns on the model's columns, (q, c).

        ``where``: indices of these columns, (c,).
        """
        if self._regression is None:
            return self.regression[:, where]
        return self._regression(where)

    @cached_property
    def _pull_and_square(self) -> tuple[FloatArray, FloatArray]:
        """Both `pull` and `square`, (m,) each."""
        assert self._products is not None
        found = self._products()
        self._products = None
        return found

    @property
    def pull(self) -> FloatArray:
        """Products of all columns with the errors, after regression on the model's blocks, (m,).

        X'(y - Z w), w: posterior means of the weights of the blocks Z.
        """
        return self._pull_and_square[0]

    @property
    def square(self) -> FloatArray:
        """Squared lengths of all columns after regression on the model's blocks, (m,)."""
        return self._pull_and_square[1]

    @cached_property
    def places(self) -> list[slice]:
        """Slice of each of the model's blocks in `weights`."""
        ends = np.cumsum([0, *(self.surface.pool.sizes[block] for block, _ in self.model)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    @property
    def is_physical(self) -> bool:
        """Whether the weights of the model's blocks have signs that physics allows."""
        first = [where.start for where in self.places]
        sign = self.surface.pool.sign[[block for block, _ in self.model]]
        return bool(np.all(sign * self.weights[first] >= 0.0)) if first else True

    @cached_property
    def gains(self) -> FloatArray:
        """Gain in log posterior by adding each block of the pool at each level, (blocks, levels).

        Level: prior size of the block's weights, one of `LEVELS_M`. -inf if the block shares a
        parameter with the model, or its level or sign is not allowed. For a block of several
        weights by the diagonal of its Gram matrix, until `with_block` sets the exact value.
        """
        pool = self.surface.pool
        precision = LEVELS_M[:, None] ** -2.0
        d = np.maximum(self.square, 0.0)
        each = self.pull**2 / (precision + d) - np.log1p(d / precision)
        gain: FloatArray = 0.5 * np.add.reduceat(each, pool.first, axis=1).T
        gain[(pool.sign != 0) & (pool.sign * self.pull[pool.first] < 0.0)] = -np.inf
        gain[~pool.allowed] = -np.inf
        there = np.isin(pool.kind, self.kinds)
        gain += (pool.log_prior + np.where(there, 0.0, np.log(KIND_ODDS)))[:, None]
        for block, _ in self.model:
            gain[pool.excluded[block]] = -np.inf
        return gain

    @cached_property
    def losses(self) -> FloatArray:
        """Loss in log posterior by leaving out each block of the model, (its blocks,)."""
        pool = self.surface.pool
        which = np.array([block for block, _ in self.model], dtype=np.int64)
        levels = LEVELS_M[[level for _, level in self.model]]
        of_kind = np.bincount(pool.kind[which], minlength=1)
        is_single = of_kind[pool.kind[which]] == 1
        lost = pool.log_prior[which] + np.where(is_single, np.log(KIND_ODDS), 0.0)
        sizes, first = pool.sizes[which], np.array([where.start for where in self.places])
        for size in np.unique(sizes).tolist():
            alike = np.flatnonzero(sizes == size)
            indices = first[alike][:, None] + np.arange(size)
            covariance, mean = (
                self.inverse[indices[:, :, None], indices[:, None, :]],
                self.weights[indices],
            )
            determinant = np.linalg.slogdet(covariance / levels[alike, None, None] ** 2)[1]
            pulled = np.linalg.solve(covariance, mean[:, :, None])[:, :, 0]
            lost[alike] += 0.5 * (np.sum(mean * pulled, axis=1) + determinant)
        return lost

    def with_block(self, block: int, level: int) -> State:
        """Return the state with one block more; this one is not changed, except one of `gains`.

        If `gains` is known, that of the block at the level becomes exact. ``block``: index in
        the pool; ``level``: index in `LEVELS_M`.
        """
        surface, pool = self.surface, self.surface.pool
        block_columns = pool.of[block]
        between = self.regression_of(block_columns).astype(float)
        gram = surface.gram(block)
        if self.model:
            gram = gram - surface.between(block, self.model) @ between
        gram = 0.5 * (gram + gram.T) + np.eye(len(block_columns)) * LEVELS_M[level] ** -2.0
        middle = np.linalg.inv(gram)
        pull = self.pull[block_columns]
        mean = middle @ pull
        gain = 0.5 * (mean @ pull + np.linalg.slogdet(middle)[1])
        gain += self._prior(block, pool.kind[block] in self.kinds)
        gain -= len(block_columns) * np.log(LEVELS_M[level])
        corner = -between @ middle
        if 'gains' in self.__dict__ and np.isfinite(self.gains[block, level]):
            self.gains[block, level] = gain

        @cache
        def residual() -> Single:
            found = surface.products(block, self.__dict__.get('gains'))
            return found - found[:, self.columns] @ self.regression if self.model else found

        def products() -> tuple[FloatArray, FloatArray]:
            step = middle.astype(np.float32) @ residual()
            return (
                self.pull - mean @ residual(),
                self.square - np.einsum('km,km->m', residual(), step),
            )

        def regression(where: Where) -> Single:
            step = middle.astype(np.float32) @ residual()[:, where]
            before = self.regression[:, where]
            return np.concatenate((before - between.astype(np.float32) @ step, step))

        return State(
            surface,
            (*self.model, (block, level)),
            self.value + float(gain),
            np.block([[self.inverse - corner @ between.T, corner], [corner.T, middle]]),
            np.concatenate((self.weights - between @ mean, mean)),
            products,
            regression,
        )

    def without(self, position: int) -> State:
        """Return the state without one block; ``position``: its index in `model`."""
        out = np.zeros(len(self.weights), bool)
        out[self.places[position]] = True
        middle = np.linalg.inv(self.inverse[out][:, out])
        pulled = self.inverse[~out][:, out] @ middle

        def products() -> tuple[FloatArray, FloatArray]:
            across = self.regression[out]
            turned = middle.astype(np.float32) @ across
            return (
                self.pull + (middle @ self.weights[out]) @ across,
                self.square + np.einsum('km,km->m', across, turned),
            )

        def regression(where: Where) -> Single:
            before = self.regression[:, where]
            return before[~out] - pulled.astype(np.float32) @ before[out]

        return State(
            self.surface,
            (*self.model[:position], *self.model[position + 1 :]),
            self.value - float(self.losses[position]),
            self.inverse[~out][:, ~out] - pulled @ self.inverse[out][:, ~out],
            self.weights[~out] - pulled @ self.weights[out],
            products,
            regression,
        )

    @cached_property
    def kinds(self) -> list[int]:
        """Index of the effect (kind of error) of each of the model's blocks, see `Pool.kind`."""
        return [int(self.surface.pool.kind[block]) for block, _ in self.model]

    def _prior(self, block: int, there: bool) -> float:
        """Return the log prior odds that a block adds to those of the model.

        ``there``: whether the model has another block of this kind; else log(`KIND_ODDS`) is
        added.
        """
        odds = float(self.surface.pool.log_prior[block])
        return odds if there else odds + float(np.log(KIND_ODDS))

    @property
    def columns(self) -> IntArray:
        """Indices of the columns of the model's blocks, in the order of `weights`, (q,)."""
        of = self.surface.pool.of
        return np.concatenate([np.zeros(0, np.int64), *(of[block] for block, _ in self.model)])

    @property
    def key(self) -> Model:
        """The model as a key: its (block, level) pairs, sorted."""
        return tuple(sorted(self.model))


class Walker:
    """Metropolis chain over states of a surface; notes the log posterior of every one proposed."""

    def __init__(self, state: State, rng: np.random.Generator) -> None:
        self.state, self.rng = state, rng
        self.seen = {state.key: state.value}

    def step(self, heat: float) -> None:
        """Propose one move and accept or refuse it: a block joins, leaves or is exchanged.

        Or two blocks join. Block: a candidate cause. ``heat``: exponent of the posterior, the
        inverse of a temperature; 1 for the posterior itself, less for wider moves.
        """
        u, state = self.rng.random(), self.state
        if not state.model or u < 0.25:
            self._add(state, heat)
        elif u < 0.4:
            self._accept(state.without(self._which(state, heat)), heat)
        elif u < 0.7:
            self._add(state.without(self._which(state, heat)), heat)
        else:
            # What needs a partner: one block drawn widely, then what goes best with it.
            drawn = self._draw(state, 0.3 * heat)
            if drawn is None:
                return
            more = state.with_block(*drawn)
            if state.model and self.rng.random() < 0.5:
                self._accept(more.without(int(np.argmin(more.losses[:-1]))), heat)
            else:
                self._add(more, heat)

    def _add(self, state: State, heat: float) -> None:
        """Propose `state` with one more block (candidate cause) as the chain's next state.

        The block is drawn by its gain in log posterior. Nothing if there is none to add, or if
        that gain by the Gram matrix's diagonal leaves it over `FAR` below the present log
        posterior. ``heat``: exponent of the posterior, the inverse of a temperature.
        """
        drawn = self._draw(state, heat)
        # By the diagonal far worse: the exact gain is hardly ever that much more.
        if drawn is not None and state.value + state.gains[drawn] > self.state.value - FAR:
            self._accept(state.with_block(*drawn), heat)

    def _accept(self, state: State, heat: float) -> None:
        """Accept or refuse a state as the chain's next one (Metropolis); note its log posterior.

        Nothing for a state that is not physical: a block that joined later may have turned the
        sign of one that was there before. ``heat``: exponent of the posterior, the inverse of a
        temperature.
        """
        if not state.is_physical:
            return
        self.seen[state.key] = state.value
        if np.log(self.rng.random()) < heat * (state.value - self.state.value):
            self.state = state

    def _draw(self, state: State, heat: float) -> tuple[int, int] | None:
        """Draw a block (candidate cause) to add, and its level; None if no block can be added.

        With odds exp(heat × gain in log posterior); ``heat``: an inverse temperature.
        """
        gain = state.gains.ravel()
        top = gain.max()
        if not np.isfinite(top):
            return None
        cumulative = np.cumsum(np.exp(heat * (gain - top)))
        index = int(np.searchsorted(cumulative, self.rng.random() * cumulative[-1]))
        return divmod(min(index, gain.size - 1), len(LEVELS_M))

    def _which(self, state: State, heat: float) -> int:
        """Draw one of the model's blocks (causes) to leave out; return its position in the model.

        The probability is the mean of an even one and one in proportion to exp(-heat × loss in
        log posterior). ``heat``: an inverse temperature.
        """
        chance = np.exp(-heat * (state.losses - state.losses.min()))
        chance = 0.5 * chance / chance.sum() + 0.5 / len(chance)
        return int(self.rng.choice(len(chance), p=chance))
