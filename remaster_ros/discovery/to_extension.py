"""From chosen cells to an `Extension` of the model that is sampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.extension import Extension, Start, Term
from remaster_ros.calibration.priors import OFFSET_STD, STEP_STD, prior_rows
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.random_effects import Family, kinds
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

# Where the prior on steps takes a smaller share of its variance off an offset nothing is added.
NOTICEABLE = 0.1


def extension_of(residuals: Residuals, solution: Solution, found: Estimate) -> Extension:
    """Return the cells of a solution as further parameters, linearised where it has them."""
    terms = []
    displacement0 = np.zeros((len(residuals.context), 3))
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        term = Term(where, *_columns(cell, residuals.context))
        if term.at is None:
            displacement0 += term.values @ solution.parameters[where]
        terms.append(term)
    model = found.model
    # Steps of the natural parameters, zeros where the gauge holds.
    x, free = model.natural(found.mode.z), found.posterior.free
    columns = residuals.full_jacobian[residuals.rows.source][:, :, free].reshape(-1, len(free))
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    step = (residuals.base @ solution.base).ravel()
    x[free] += np.linalg.lstsq(columns / scale, step, rcond=None)[0] / scale
    names = tuple(name for cell in solution.cells for name in cell.parameters)
    units = tuple(cell.unit for cell in solution.cells for _ in cell.parameters)
    return Extension(
        names,
        units,
        tuple(terms),
        displacement0,
        solution.parameters,
        solution.prior_precision(),
        offsets_of(found)[0],
        STEP_STD,
        Start(
            model.offsets(x),
            model.T_R_N(x),
            model.markers(x),
            np.setdiff1d(found.problem.fitted, np.union1d(found.kept, residuals.rows.source)),
        ),
    )


def moved_by_open_offsets(found: Estimate, data: Residuals, solution: Solution) -> FloatArray:
    """Return how the parameters move with offsets that the prior on steps holds, one std of each.

    It is no knowledge of the arm: an offset is known no better than by the data and by what is
    known of any mastering. Of all natural parameters and the m of the cells, (size + m, c).
    """
    _, root, where = _solved(found, data, solution)
    names = found.problem.chain.joint_names
    joints = np.array(
        [
            place
            for place, joint in enumerate(found.posterior.free)
            if joint < len(names) and names[joint] not in found.problem.priors.joint_offsets
        ],
        dtype=np.int64,
    )
    covariance = root @ root[joints].T
    free = covariance[joints]
    taken = STEP_STD**-2.0 - OFFSET_STD**-2.0
    per_radian = found.problem.chain.per_radian[found.posterior.free[joints]]
    held = np.linalg.inv(np.linalg.inv(free) + np.diag(taken / per_radian**2))
    variance, less = np.diag(free), np.diag(free) - np.diag(held)
    noticeable = less > NOTICEABLE * variance
    moves = np.zeros((found.model.size + len(solution.parameters), int(noticeable.sum())))
    # All else goes along, so that the predictions stay.
    moves[where] = (covariance / variance * np.sqrt(np.maximum(less, 0.0)))[:, noticeable]
    return moves


def _solved(
    found: Estimate, data: Residuals, solution: Solution
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return the whitened columns of all that is fitted, a root of its covariance, and where."""
    free, size = found.posterior.free, found.model.size
    own = data.columns(solution.cells)
    columns = np.concatenate((data.full_jacobian[data.rows.source][:, :, free], own), axis=2)
    x = found.model.natural(found.mode.z)
    rows = prior_rows(found.model, found.posterior.priors, x, natural=True)[1][:, free]
    precision = np.zeros((columns.shape[2],) * 2)
    precision[: len(free), : len(free)] = rows.T @ rows
    precision[len(free) :, len(free) :] = solution.prior_precision()
    white = data.noise_model.whitened(columns, solution.noise).reshape(3 * len(data), -1)
    root = root_of_inverse(white.T @ white + precision)
    return white, root, np.concatenate((free, size + np.arange(own.shape[2])))


def moved_by_models(
    found: Estimate, data: Residuals, models: Sequence[tuple[Solution, float]]
) -> FloatArray:
    """Return how all that is fitted moves from the first of some models to each other one.

    Each by the root of its share, so that their squares are the variance among the models. Of all
    natural parameters and the m of the first model, (size + m, c).
    """
    first = models[0][0]
    free, size = found.posterior.free, found.model.size
    place = {name: size + i for i, name in enumerate(_names(first))}
    columns = data.full_jacobian[data.rows.source][:, :, free].reshape(-1, len(free))
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    base = data.base.reshape(len(columns), -1)
    moves = np.zeros((size + len(place), len(models) - 1))
    for column, (other, share) in enumerate(models[1:]):
        step = base @ (other.base - first.base)
        moves[free, column] = np.linalg.lstsq(columns / scale, step, rcond=None)[0] / scale
        moves[size:, column] = -first.parameters
        for name, value in zip(_names(other), other.parameters, strict=True):
            if name in place:
                moves[place[name], column] += value
        moves[:, column] *= np.sqrt(share)
    return moves


def drawn_kinds(found: Estimate, data: Residuals, named: Sequence[Cell]) -> list[Family]:
    """Return lengths and tilts without a name, each kind with the tolerance of a drawing."""
    cells = [
        cell
        for effect in EFFECTS.values()
        if effect.place in ('link_translation', 'link_rotation') and not effect.needs(data.context)
        for cell in effect.cells(data.context)
        if cell.model_change is not None
    ]
    tolerance_m = found.problem.priors.geometry_tolerance_m
    families = kinds(data, cells, named)
    return [replace(one, cell=replace(one.cell, least=tolerance_m)) for one in families]


def moved_by_drawing(
    found: Estimate, data: Residuals, solution: Solution, drawn: Sequence[Family]
) -> FloatArray:
    """Return how lengths and tilts within the tolerance of a drawing move all that is fitted.

    No session proves that an arm is its drawing. Of each weight one standard deviation, of those
    that the model has what it lacks of that. Of all natural parameters and the m of the cells,
    (size + m, c).
    """
    white, root, where = _solved(found, data, solution)
    size = found.model.size
    place = {name: size + i for i, name in enumerate(_names(solution))}
    precision = dict(zip(_names(solution), np.diag(solution.prior_precision()), strict=True))
    parts = [np.zeros((size + len(place), 0))]
    for family in drawn:
        for member, mapping, scale in zip(family.members, family.maps, family.scales, strict=True):
            known = np.array([precision.get(name, np.inf) for name in member.parameters])
            variance = np.maximum(family.cell.least**2 - (scale / known), 0.0)
            shift = data.columns([member]) @ (mapping * np.sqrt(variance))
            others = data.noise_model.whitened(shift, solution.noise).reshape(3 * len(data), -1)
            moves = np.zeros((len(parts[0]), others.shape[1]))
            moves[where] = root @ (root.T @ (white.T @ others))
            parts.append(moves)
    return np.concatenate(parts, axis=1)


def std_of_offsets(
    found: Estimate, data: Residuals, solution: Solution, moves: Sequence[FloatArray]
) -> FloatArray:
    """Return the std of the zero-offsets beside a model, and by what moves them, rad, (k,).

    NaN where the gauge holds them. ``moves``: columns of one standard deviation each.
    """
    _, root, where = _solved(found, data, solution)
    variance = np.full(found.model.size + len(solution.parameters), np.nan)
    variance[where] = np.sum(root**2, axis=1)
    for columns in moves:
        variance += np.sum(columns**2, axis=1)
    return np.sqrt(variance[: found.model.joints])


def _names(solution: Solution) -> list[str]:
    return [name for cell in solution.cells for name in cell.parameters]


def root_of_inverse(precision: FloatArray) -> FloatArray:
    """Return L with L L' the inverse of a matrix of parameters in units far apart, (P, P)."""
    unit = np.maximum(np.diag(precision), np.finfo(float).tiny) ** -0.5
    scaled = precision * np.outer(unit, unit) + 1e-12 * np.eye(len(precision))
    root: FloatArray = unit[:, None] * np.linalg.inv(np.linalg.cholesky(scaled)).T
    return root


def offsets_of(found: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the zero-offsets of the fit without effects and their stds, rad, (k,) each."""
    joints = found.model.joints
    std = np.full(joints, np.nan)
    free = found.posterior.free
    angles = free < joints
    std[free[angles]] = np.sqrt(np.diag(found.mode.covariance)[: len(free)][angles])
    return found.model.offsets(found.mode.z), std


def _columns(cell: Cell, context: Context) -> tuple[int | None, FloatArray]:
    """Return joint and values of a cell's columns in every row of a session."""
    blocks = [cell.columns(block) for _, block in context.blocks()]
    return blocks[0].at, np.concatenate([block.values for block in blocks])
