"""From chosen candidates to an `Extension` of the model that is sampled."""

from __future__ import annotations

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.extension import Extension, Start, Term
from remaster_ros.calibration.priors import STEP_STD
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray


def extension_of(residuals: Residuals, solution: Solution, found: Estimate) -> Extension:
    """Return a solution's candidates as further parameters of the model that is sampled.

    Errors of a joint add to its position; displacements of the marker are linear about the
    parameters of ``solution``, at which the sampling starts. Parameters of motion that the model
    of ``found`` has already are kept.
    """
    terms = []
    displacement0 = np.zeros((len(residuals.context), 3))
    for candidate, where in zip(solution.candidates, solution.slices(), strict=True):
        term = Term(where, *_columns(candidate, residuals.context))
        if term.at is None:
            displacement0 += term.values @ solution.parameters[where]
        terms.append(term)
    model = found.model
    x = model.natural(found.mode.z)
    x[found.posterior.free] += natural_steps(residuals, found, solution.base)
    names = tuple(name for candidate in solution.candidates for name in candidate.parameters)
    units = tuple(
        candidate.unit for candidate in solution.candidates for _ in candidate.parameters
    )
    extension = Extension(
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
    return extension.with_motion(model.extension)


def natural_steps(residuals: Residuals, found: Estimate, base: FloatArray) -> FloatArray:
    """Return the steps of the free natural parameters that base coefficients amount to.

    Natural parameters: zero-offsets, registrations, markers; free: not held fixed by the fit
    (`found.posterior.free`), rad or m. ``base``: coefficients of the columns that the offsets
    model can absorb, (p,).
    """
    free = found.posterior.free
    columns = residuals.full_jacobian[residuals.rows.source][:, :, free].reshape(-1, len(free))
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    steps: FloatArray = np.linalg.lstsq(
        columns / scale, (residuals.base @ base).ravel(), rcond=None
    )[0]
    return steps / scale


def root_of_inverse(precision: FloatArray) -> FloatArray:
    """Return L with L L' the inverse of a positive definite matrix, (P, P).

    Its parameters may have units far apart.
    """
    unit = np.maximum(np.diag(precision), np.finfo(float).tiny) ** -0.5
    scaled = precision * np.outer(unit, unit) + 1e-12 * np.eye(len(precision))
    root: FloatArray = unit[:, None] * np.linalg.inv(np.linalg.cholesky(scaled)).T
    return root


def offsets_of(found: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the zero-offsets of a fit and their standard deviations, rad or m, (k,) each.

    The latter is NaN for offsets that the fit holds fixed, as the data do not determine them.
    """
    joints = found.model.joints
    std = np.full(joints, np.nan)
    free = found.posterior.free
    angles = free < joints
    std[free[angles]] = np.sqrt(np.diag(found.mode.covariance)[: len(free)][angles])
    return found.model.offsets(found.mode.z), std


def _columns(candidate: Candidate, context: Context) -> tuple[int | None, FloatArray]:
    """Return index of the joint (None if none) and values of a candidate's columns.

    In every row of the session; see `Design`.
    """
    blocks = [candidate.columns(block) for _, block in context.blocks()]
    return blocks[0].at, np.concatenate([block.values for block in blocks])
