# SPDX-License-Identifier: Apache-2.0
"""Which rows of a table do not fit the robot that the others fit, before it is fitted for good.

A robust fit follows the majority; a row whose error would be gross in a fit (`outliers`) is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.initial_guess import closest_start
from remaster_ros.calibration.noise import MEDIAN_LENGTH, RESOLUTION_M
from remaster_ros.calibration.outliers import (
    CERTAIN,
    LARGEST_SHARE,
    TAIL_LIMIT,
    gross_probability,
    robust_scale,
)
from remaster_ros.types import BoolArray, FloatArray, Session


@dataclass(frozen=True, eq=False)
class RowsOff:
    """How far each of the n rows of a session is from a robust fit."""

    error_m: FloatArray  # Distance of its point from the modelled one, m, (n,)
    off: BoolArray  # Whether it does not fit, (n,)
    too_many: bool  # Whether these are more than a fit leaves out as gross errors


def find_rows_off(session: Session, most: int) -> RowsOff:
    """Compare every row, held-out ones as well, with a robust fit.

    Parameters
    ----------
    session
        With its markers open: one that is firm at a wrong place would bend the fit.
    most
        Rows to fit at most, evenly spread over those to fit.

    Raises
    ------
    InsufficientDataError
        Too few rows or poses.
    """
    problem = Problem.of(session)
    model, m = problem.empty_model(), problem.measurements
    few = np.linspace(0, len(problem.fitted) - 1, min(most, len(problem.fitted))).astype(np.int64)
    start, z = closest_start(
        model,
        m,
        problem.fitted[few],
        problem.markers,
        float(np.max(problem.marker_std_m)),
        problem.marker_priors(model),
    )
    rows = Rows.of(m, np.arange(len(m)), start.reference)
    length = np.linalg.norm(rows.target - start.predict(z, rows), axis=1)
    error, off, too_many = np.zeros(len(m)), np.zeros(len(m), bool), False
    for _, span in rows.spans:
        mine = length[span]
        scale = float(np.median(mine)) / MEDIAN_LENGTH + RESOLUTION_M
        # Wider tails are the arm's own; beyond this limit a fifth of the rows is off, which makes
        # the standard deviation by the tail that of the gross errors.
        scale = by_tail if (by_tail := robust_scale(mine)) < TAIL_LIMIT * scale else scale
        gross = gross_probability(mine / scale) > CERTAIN
        error[rows.source[span]], off[rows.source[span]] = mine, gross
        # Of the rows to fit alone a fit judges, too.
        for judged in (gross, gross[~m.is_validation[rows.source[span]]]):
            too_many |= int(judged.sum()) > max(1.0, LARGEST_SHARE * len(judged))
    return RowsOff(error, off, too_many)
