# SPDX-License-Identifier: Apache-2.0
"""Rows of a table that do not fit the robot, found before the final fit.

A robust fit follows the majority; rows with an error that would be gross in a fit (`outliers`) are
named.
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
    """Distance of each of the n rows of a session from a robust fit."""

    error_m: FloatArray  # Distance of the row's point from the modelled one, m, (n,)
    off: BoolArray  # Whether the row does not fit, (n,)
    too_many: bool  # Whether more rows do not fit than a fit leaves out as gross errors


def find_rows_off(session: Session, most: int) -> RowsOff:
    """Comparison of every row, held-out rows as well, with a robust fit of optimization rows.

    A row does not fit if it is gross with a probability above 99 % (`outliers.CERTAIN`). One
    flag for the session, ``too_many``, tells whether for any sensor more than a tenth of the
    rows, and more than one, do not fit, of all its rows or of those that are not held out.
    ``session``: with unknown marker positions, as a firm wrong position would bend the fit;
    ``most``: largest number of fitted rows, evenly spread. Raises InsufficientDataError if
    there are too few rows or poses.
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
        selection = length[span]
        scale = float(np.median(selection)) / MEDIAN_LENGTH + RESOLUTION_M
        # Wider tails are the arm's own; beyond this limit a fifth of the rows is off, which makes
        # the standard deviation by the tail that of the gross errors.
        scale = by_tail if (by_tail := robust_scale(selection)) < TAIL_LIMIT * scale else scale
        gross = gross_probability(selection / scale) > CERTAIN
        error[rows.source[span]], off[rows.source[span]] = selection, gross
        # The final fit judges the rows to fit only.
        for judged in (gross, gross[~m.is_validation[rows.source[span]]]):
            too_many |= int(judged.sum()) > max(1.0, LARGEST_SHARE * len(judged))
    return RowsOff(error, off, too_many)
