"""Residuals of the offsets model that discovery works on, with their noise and absorption.

The noise is that of `calibration.noise`, with the directions that the fit distinguishes. What
registrations, offsets and markers can absorb is projected out with flat priors, but for steps of
zero-offsets that are longer than the tangent holds: where poses hardly determine one beside the
causes, it would go many degrees, for a fit that no arm of these dimensions has.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.noise import Noise, NoiseModel
from remaster_ros.calibration.outliers import robust_noise
from remaster_ros.calibration.path_noise import PathNoise
from remaster_ros.calibration.priors import STEP_STD
from remaster_ros.discovery import packed
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import BLOCK_ROWS, Context
from remaster_ros.linear_algebra import svd
from remaster_ros.types import FloatArray, IntArray

# Directions of the offsets model below this share of the largest are its gauge.
ROUNDING = 1e-8
# Bytes of displacements, and of Gram matrices, that are kept for the next fit; only those of large
# sessions are more.
KEPT_BYTES = 1 << 27
# Gram matrices of so many sets are kept: of the set so far, and of families beside it.
KEPT_GRAMS = 4


class Fit(Protocol):
    """Protocol of a fit to residuals: its candidates, their parameters, base coefficients.

    m parameters of the candidates, and p coefficients of the columns that the offsets model
    can absorb.
    """

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Candidates of the fit, in the order of its parameters."""

    @property
    def parameters(self) -> FloatArray:
        """Values of the candidates' parameters, (m,)."""

    @property
    def base(self) -> FloatArray:
        """Coefficients of the base columns, those that the offsets model can absorb, (p,)."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of the offsets model in n rows worked on, with what that model can absorb.

    Rows are sorted by sensor and pose. Natural parameters of the model are zero-offsets,
    registrations and markers.
    """

    context: Context  # All rows of the session at the solution of the offsets model
    rows: Rows  # The rows worked on; ``source`` are their indices in the context
    errors: FloatArray  # Measured minus modelled, in base coordinates, m, (n, 3)
    base: FloatArray  # What the offsets model can absorb, orthonormal columns, (n, 3, p)
    base_precision: FloatArray  # Of the prior on their coefficients, about 0, (p, p)
    full_base: FloatArray  # The same columns for every row of the session, (all rows, 3, p)
    full_errors: FloatArray  # Errors of every row of the session, m, (all rows, 3)
    # Derivative of the prediction by the model's natural parameters, (all rows, 3, size)
    full_jacobian: FloatArray
    step_precision: FloatArray  # Of the prior on steps of these; 0 for a flat one, (size,)
    reference: FloatArray  # T_R_N of every sensor that `errors` are relative to, (sensors, 4, 4)
    noise_model: NoiseModel  # Which errors of the rows have which variance
    noise: Noise  # A robust first estimate
    path_noise: PathNoise | None = None  # Of errors along a path

    @classmethod
    def of(cls, found: Estimate) -> Residuals:
        """Return the residuals of a fit with offsets at its mode, on the rows that it kept."""
        return cls.at(found, found.mode)

    @classmethod
    def at(cls, found: Estimate, mode: Mode) -> Residuals:
        """Return the residuals of a fit with offsets at a given mode, on the rows that it kept.

        ``mode``: parameter values to use in place of ``found.mode``.
        """
        problem, model = found.problem, found.model
        x = model.natural(mode.z)
        context = Context(
            problem.chain,
            problem.measurements,
            problem.sensor_names,
            problem.marker_names,
            model.offsets(x),
            model.markers(x),
            model.T_R_N(x),
            timed=problem.session.timed,
            sensor_kinds=tuple(
                problem.session.sensor_kinds.get(name, '') for name in problem.sensor_names
            ),
        )
        count = len(context)
        every = Rows.of(problem.measurements, np.arange(count), model.reference)
        full_errors = np.empty((count, 3))
        full_jacobian = np.empty((count, 3, model.size))
        for first, last in every.blocks(BLOCK_ROWS):
            block = every.of_groups(first, last)
            full_errors[block.source] = block.target - model.predict(mode.z, block)
            full_jacobian[block.source] = model.natural_jacobian(x, block)

        rows = Rows.of(problem.measurements, found.kept, model.reference)
        rows = rows.along_path(problem.path_noise)
        combinations = _orthonormal(full_jacobian[rows.source])
        full_base = full_jacobian @ combinations
        step_precision = np.zeros(model.size)
        free = found.posterior.free
        joints = free[free < model.joints]
        step_precision[joints] = (STEP_STD * problem.chain.per_radian[joints]) ** -2.0
        split = found.posterior.noise_model.of_points.split
        noise_model = NoiseModel.of(rows, model.reference, split)
        noise = robust_noise(rows, full_errors[rows.source], np.ones(len(rows), bool))
        return cls(
            context,
            rows,
            full_errors[rows.source],
            full_base[rows.source],
            _quadratic(step_precision, combinations),
            full_base,
            full_errors,
            full_jacobian,
            step_precision,
            model.reference,
            noise_model,
            noise_model.of_sensors(*noise),
            problem.path_noise,
        )

    def holding(self, parameters: IntArray) -> Residuals:
        """Return a copy in which some natural parameters are fixed, so that they absorb nothing.

        ``parameters``: their columns in ``full_jacobian``.
        """
        jacobian = np.delete(self.full_jacobian, parameters, axis=2)
        combinations = _orthonormal(jacobian[self.rows.source])
        full_base = jacobian @ combinations
        return replace(
            self,
            base=full_base[self.rows.source],
            base_precision=_quadratic(np.delete(self.step_precision, parameters), combinations),
            full_base=full_base,
        )

    def less(self, shift: FloatArray) -> Residuals:
        """Return a copy with displacements subtracted from all errors.

        ``shift``: m, (all rows, 3).
        """
        full_errors = self.full_errors - shift
        return replace(self, full_errors=full_errors, errors=full_errors[self.rows.source])

    def only(self, source: IntArray) -> Residuals:
        """Return a copy that works on other rows; ``source``: their indices in the session.

        The base columns are not made anew: they are orthonormal over the previous rows, not over
        these.
        """
        rows = Rows.of(self.context.measurements, np.sort(source), self.reference)
        rows = rows.along_path(self.path_noise)
        return replace(
            self,
            rows=rows,
            errors=self.full_errors[rows.source],
            base=self.full_base[rows.source],
            noise_model=NoiseModel.of(rows, self.reference, self.noise_model.split),
        )

    def __len__(self) -> int:
        """Return the number of rows n."""
        return len(self.rows)

    @cached_property
    def part(self) -> Context:
        """Context of the rows worked on, in their order.

        What the search needs of hundreds of causes is computed on these rows alone.
        """
        return self.context.at(self.rows.source)

    @cached_property
    def _displacements(self) -> dict[Candidate, FloatArray]:
        """Cache of each candidate's `columns`, m per unit, (n, 3, size); {} at first."""
        return {}

    @cached_property
    def pose_of_row(self) -> IntArray:
        """Number of each row's pose, counted from 0 over all sensors, (n,)."""
        poses = self.context.measurements.pose[self.rows.source]
        return np.unique(poses, return_inverse=True)[1]

    @property
    def poses(self) -> int:
        """Number of poses among the rows worked on."""
        return int(self.pose_of_row.max()) + 1

    def columns(self, candidates: Sequence[Candidate]) -> FloatArray:
        """Return marker displacements by a unit of each candidate's parameters, (n, 3, c).

        m per unit, in the rows worked on; c: parameters of all candidates in order. (n, 3, 0)
        for none.
        """
        kept = self._displacements
        for candidate in candidates:
            if candidate not in kept:
                kept[candidate] = candidate.columns(self.part).displacement(self.part)
        parts = [kept[candidate] for candidate in candidates]
        joined = np.concatenate([np.zeros((len(self), 3, 0)), *parts], axis=2)
        while len(kept) > 1 and sum(values.nbytes for values in kept.values()) > KEPT_BYTES:
            del kept[next(iter(kept))]
        return joined

    @cached_property
    def _grams(self) -> list[tuple[tuple[Candidate, ...], FloatArray, FloatArray]]:
        """Cache of the last results for `gram_matrices`: (candidates, norms, packed matrices).

        The latest is first; columns are in the order base, errors, candidates. At first it has
        one entry, without candidates. A search often fits part of an earlier set, or one
        candidate more.
        """
        return [((), *self._grams_of((), np.empty((1, 0)), 0))]

    def gram_matrices(self, candidates: Sequence[Candidate]) -> tuple[FloatArray, FloatArray]:
        """Return norms and Gram matrices of the columns [base, candidates, errors].

        Norms over all rows, (p + c + 1,); a `packed` matrix for each error group of the noise
        model, (groups, length), with the candidates' columns divided by their `units`. Read
        only.
        """
        wanted = set(candidates)
        known, norms, grams = max(
            self._grams,
            key=lambda entry: sum(candidate.size for candidate in entry[0] if candidate in wanted),
        )
        if not wanted <= set(known):
            part = [candidate for candidate in known if candidate in wanted]
            chosen = self._positions(known, part)
            known = (*part, *(candidate for candidate in candidates if candidate not in part))
            norms, grams = self._grams_of(known, packed.picked(grams, chosen), len(chosen))
            self._grams.insert(0, (known, norms, grams))
            sizes = np.cumsum([kept.nbytes for _, _, kept in self._grams])
            del self._grams[max(1, min(KEPT_GRAMS, int(np.sum(sizes < KEPT_BYTES)))) :]
        p = self.base.shape[2]
        order = np.append(np.delete(self._positions(known, candidates), p), p)
        return norms[order], packed.picked(grams, order)

    def _positions(self, known: Sequence[Candidate], candidates: Sequence[Candidate]) -> IntArray:
        """Return indices of the base, the errors and some candidates in a set's Gram matrices.

        ``known``: all candidates of that set, in order; ``candidates``: those wanted, all among
        these.
        """
        count = self.base.shape[2] + 1
        first = dict(
            zip(known, np.cumsum([count, *(candidate.size for candidate in known)]), strict=False)
        )
        parts = [
            np.arange(first[candidate], first[candidate] + candidate.size)
            for candidate in candidates
        ]
        return np.concatenate([np.arange(count), *parts])

    def _grams_of(
        self, candidates: Sequence[Candidate], first: FloatArray, known: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return norms and packed Gram matrices of the columns [base, errors, candidates].

        ``known``: number of first columns whose packed matrices are given as ``first``,
        (groups or 1, length), and so are not computed.
        """
        p = self.base.shape[2]
        columns = self.base, self.errors[:, :, None], self.columns(candidates)
        joined = np.concatenate(columns, axis=2)
        norms = np.sqrt(np.einsum('nim,nim->m', joined, joined))
        joined[:, :, p + 1 :] /= units(candidates, norms[p + 1 :])
        # Matrices of a thousand columns are most of what a search holds: none is there twice.
        model, done = self.noise_model, packed.length(known)
        grams = np.zeros((len(model.error_groups), packed.length(len(norms))))
        grams[:, :done] = first
        for index, part in model.parts(lambda _, where: joined[where]):
            packed.add_products(grams[index], part, known)
        for index, contents in model.contained.items():
            for other in contents:
                grams[index, done:] -= grams[other, done:]
        # Fits are given parts of them.
        grams.setflags(write=False)
        return norms, grams

    def displaced(self, candidates: Sequence[Candidate], parameters: FloatArray) -> FloatArray:
        """Return the displacement by candidates in every row of the session, m, (all rows, 3).

        ``parameters``: of all of them in order, (c,).
        """
        shift = np.zeros((len(self.context), 3))
        for where, context in self.context.blocks():
            start = 0
            for candidate in candidates:
                columns = candidate.columns(context).displacement(context)
                shift[where] += columns @ parameters[start : start + candidate.size]
                start += candidate.size
        return shift

    def unexplained(self, fit: Fit) -> FloatArray:
        """Return the residuals that a fit leaves in every row of the session, m, (all rows, 3)."""
        residuals: FloatArray = self.full_errors - self.full_base @ fit.base
        return residuals - self.displaced(fit.candidates, fit.parameters)

    def left(self, fit: Fit) -> FloatArray:
        """Return the residuals that a fit leaves in the rows worked on, m, (n, 3)."""
        explained: FloatArray = (
            self.base @ fit.base + self.columns(fit.candidates) @ fit.parameters
        )
        return self.errors - explained


def units(candidates: Sequence[Candidate], norms: FloatArray) -> FloatArray:
    """Return the scale by which each column of candidates is divided, (c,).

    ``norms``: of the columns, (c,), which are the scale; of a penalised candidate the largest
    one for all its columns, as its penalty compares neighbours. 1 for columns of zeros.
    """
    unit = norms.copy()
    edges = np.cumsum([0, *(candidate.size for candidate in candidates)])
    for candidate, (first, last) in zip(candidates, itertools.pairwise(edges), strict=True):
        if candidate.penalty is not None:
            unit[first:last] = np.max(unit[first:last])
    return np.where(unit > 0.0, unit, 1.0)


def _quadratic(precision: FloatArray, combinations: FloatArray) -> FloatArray:
    """Return the prior precision C'PC of p coefficients of combinations C of parameters, (p, p).

    ``precision``: diagonal of P, the prior precision of the parameters, (c,);
    ``combinations``: C, (c, p).
    """
    return combinations.T @ (precision[:, None] * combinations)


def _orthonormal(jacobian: FloatArray) -> FloatArray:
    """Return combinations of a Jacobian's columns that are orthonormal over the rows, (c, p).

    ``jacobian``: (n, 3, c). p is its rank: combinations below rounding are left out.
    """
    flat = jacobian.reshape(-1, jacobian.shape[2])
    scale = np.linalg.norm(flat, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, singular, vectors = svd(flat / scale, full_matrices=False)
    seen = singular > ROUNDING * singular[0]
    combinations: FloatArray = (vectors[seen] / scale).T / singular[seen]
    return combinations
