# SPDX-License-Identifier: Apache-2.0
"""Movement of zero-offsets and causes by errors that are not in the model that is sampled.

Each source gives columns of one standard deviation, (size + m, c), of all natural parameters of
the offsets model and the m parameters of a solution's candidates: other models of the walk,
lengths and tilts within the tolerance of a drawing, zero-offsets that only the prior on steps
holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.priors import DRAWING_TAILS, OFFSET_STD, STEP_STD, prior_rows
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import BLOCK_ROWS
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.random_effects import kinds
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.to_extension import natural_steps, root_of_inverse
from remaster_ros.types import FloatArray, IntArray

# Where the prior on steps takes a smaller share of its variance off an offset nothing is added.
NOTICEABLE = 0.1


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """Normal equations of a solution, and how errors outside its model would move its parameters.

    ``found``: fit whose residuals the discovery explains; ``data``: those residuals, on the rows
    that were searched; ``fitted``: the same on the rows that are fitted, of a large session more.
    """

    found: Estimate
    data: Residuals
    fitted: Residuals
    solution: Solution
    root: FloatArray  # Of the covariance, (P, P)
    where: IntArray  # Places of the P among natural parameters and those of the candidates

    @classmethod
    def of(
        cls,
        found: Estimate,
        data: Residuals,
        solution: Solution,
        fitted: IntArray | None = None,
    ) -> Unmodelled:
        """Assemble the normal equations of a solution, with its noise and its priors.

        ``fitted``: indices of the rows that are fitted, those of ``data`` among them; these
        alone, if it is None.
        """
        every = data if fitted is None or len(fitted) == len(data) else data.only(fitted)
        free, size = found.posterior.free, found.model.size
        x = found.model.natural(found.mode.z)
        rows = prior_rows(found.model, found.posterior.priors, x, natural=True)[1][:, free]
        precision = _products(every, found, solution)
        precision[: len(free), : len(free)] += rows.T @ rows
        precision[len(free) :, len(free) :] += solution.prior_precision()
        root = root_of_inverse(precision)
        where = np.concatenate((free, size + np.arange(len(solution.parameters))))
        return cls(found, data, every, solution, root, where)

    @property
    def size(self) -> int:
        """Number of parameters: natural ones of the fit, then those of the candidates."""
        return int(self.found.model.size + len(self.solution.parameters))

    def by_models(self, models: Sequence[tuple[Solution, float]]) -> FloatArray:
        """Return the change of all parameters to each other model, times the root of its weight.

        ``models``: the other models, each with its posterior weight. (size, models); the sum of
        squares of a row is that parameter's variance among the models. A parameter that another
        model lacks counts as 0 there.
        """
        first, names = self.solution, _names(self.solution)
        size = self.found.model.size
        place = {name: size + i for i, name in enumerate(names)}
        moves = np.zeros((self.size, len(models)))
        for column, (other, share) in enumerate(models):
            steps = natural_steps(self.data, self.found, other.base - first.base)
            moves[self.found.posterior.free, column] = steps
            moves[size:, column] = -first.parameters
            for name, value in zip(_names(other), other.parameters, strict=True):
                if name in place:
                    moves[place[name], column] += value
            moves[:, column] *= np.sqrt(share)
        return moves

    def by_drawing(self, named: Sequence[Candidate]) -> FloatArray:
        """Return columns F, (size, c), by which lengths and tilts off their drawing move the fit.

        They add FF' to the covariance. ``named``: candidates of the named causes; lengths and
        tilts among these are left out.

        No session proves that an arm is exactly its drawing, so the lengths and tilts are added
        to the model as random effects with the drawing's tolerance. With their columns Z, the
        model's columns A and its covariance LL', they add L U G⁻¹ U'L' to the covariance, with
        U = L'A'Z and G = I + Z'Z - U'U: the more the data contradict them, the less they add.
        For a length or tilt that the model has already, only the variance that its prior lacks
        of the tolerance is added.
        """
        candidates = [
            candidate
            for effect in EFFECTS.values()
            if effect.place in ('link_translation', 'link_rotation')
            if not effect.needs(self.data.context)
            for candidate in effect.candidates(self.data.context)
            if candidate.model_change is not None
        ]
        tolerance = DRAWING_TAILS * self.found.problem.priors.geometry_tolerance_m
        diagonal = np.diag(self.solution.prior_precision())
        precision = dict(zip(_names(self.solution), diagonal, strict=True))
        shifts: list[tuple[Candidate, FloatArray]] = []
        for family in kinds(self.data, candidates, named):
            for member, mapping, scale in zip(
                family.members, family.maps, family.scales, strict=True
            ):
                known = np.array([precision.get(name, np.inf) for name in member.parameters])
                variance = np.maximum(tolerance**2 - scale / known, 0.0)
                shifts.append((member, mapping * np.sqrt(variance)))
        products = _products(self.fitted, self.found, self.solution, shifts)
        P = len(self.where)
        U = self.root.T @ products[:P, P:]
        G = np.eye(U.shape[1]) + products[P:, P:] - U.T @ U
        moves = np.zeros((self.size, U.shape[1]))
        moves[self.where] = self.root @ np.linalg.solve(np.linalg.cholesky(G), U.T).T
        return moves

    def by_open_offsets(self) -> FloatArray:
        """Return columns by which zero-offsets may move that the data hardly determine, (size, c).

        In the sampled fit they are held by the prior on their steps (`STEP_STD`), which is no
        knowledge of the arm. The columns widen the variance to that with a prior of any mastering
        (`OFFSET_STD`): one for each offset whose variance the prior on steps reduces noticeably,
        with the other parameters moving along. Offsets with a stated prior have none.
        """
        found = self.found
        names = found.problem.chain.joint_names
        joints = np.array(
            [
                place
                for place, joint in enumerate(found.posterior.free)
                if joint < len(names) and names[joint] not in found.problem.priors.joint_offsets
            ],
            dtype=np.int64,
        )
        covariance = self.root @ self.root[joints].T
        free = covariance[joints]
        taken = STEP_STD**-2.0 - OFFSET_STD**-2.0
        per_radian = found.problem.chain.per_radian[found.posterior.free[joints]]
        held_covariance = np.linalg.inv(np.linalg.inv(free) + np.diag(taken / per_radian**2))
        variance, less = np.diag(free), np.diag(free) - np.diag(held_covariance)
        noticeable = less > NOTICEABLE * variance
        moves = np.zeros((self.size, int(noticeable.sum())))
        # All else goes along, so that the predictions stay.
        moves[self.where] = (covariance / variance * np.sqrt(np.maximum(less, 0.0)))[:, noticeable]
        return moves

    def std_of_offsets(self, moves: Sequence[FloatArray]) -> FloatArray:
        """Return the standard deviation of the zero-offsets, with some further uncertainty, (k,).

        rad or m; NaN for offsets that the fit holds fixed. ``moves``: columns, (size, c) each,
        whose squares are added to the variances.
        """
        variance = np.full(self.size, np.nan)
        variance[self.where] = np.sum(self.root**2, axis=1)
        variance += sum(np.sum(columns**2, axis=1) for columns in moves)
        return np.sqrt(variance[: self.found.model.joints])


def _products(
    data: Residuals,
    found: Estimate,
    solution: Solution,
    more: Sequence[tuple[Candidate, FloatArray]] = (),
) -> FloatArray:
    """Return the products A'A of columns in units of a solution's noise, (P + c, P + c).

    Columns: of the free natural parameters and of the solution's candidates, P, then of ``more``:
    candidates, each with the matrix that turns its weights into its parameters, c weights in all.
    """
    free, blocks = found.posterior.free, [data]
    if data.path_noise is None and len(data) > BLOCK_ROWS:
        # Columns of all rows of a large session would be more than all else that is held.
        blocks = [
            data.only(data.rows.of_groups(first, last).source)
            for first, last in data.rows.blocks(BLOCK_ROWS)
        ]
    count = len(free) + len(solution.parameters) + sum(turn.shape[1] for _, turn in more)
    products = np.zeros((count, count))
    for block in blocks:
        parts = [
            block.full_jacobian[block.rows.source][:, :, free],
            block.columns(solution.candidates),
            *(block.columns([member]) @ turn for member, turn in more),
        ]
        white = block.noise_model.whitened(np.concatenate(parts, axis=2), solution.noise)
        flat = white.reshape(3 * len(block), count)
        products += flat.T @ flat
    return products


def _names(solution: Solution) -> list[str]:
    """Return the names of all parameters of a solution's candidates, in order."""
    return [name for candidate in solution.candidates for name in candidate.parameters]
