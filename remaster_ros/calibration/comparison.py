# SPDX-License-Identifier: Apache-2.0
"""Comparison of a fit with the same fit with all offsets at zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from remaster_ros.calibration.accuracy import accuracy_of
from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.orientation_accuracy import tool_orientations
from remaster_ros.calibration.predictive_accuracy import Predictive
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Comparison:
    """Registrations and residuals with the offsets at zero, and accuracy without and with them."""

    T_R_N_before: Mapping[str, FloatArray]  # Registrations with the offsets at zero, by sensor
    # Measured minus modelled position in N with the offsets at zero, all rows, m, (n, 3)
    residuals_before: FloatArray
    accuracy: Mapping[str, Any]  # The three metrics as fit.json has them


def compared(
    problem: Problem,
    kept: IntArray,
    before: FloatArray,
    after: FloatArray,
    predictive: Predictive,
    rng: np.random.Generator,
) -> Comparison:
    """Compare a fit with the same fit with all offsets at zero.

    ``problem``: the fitted problem; ``kept``: indices of the fitted rows that are no gross
    errors; ``before, after``: pinned parameters with offsets at zero and as estimated, (size,);
    ``predictive``: posterior for predictions; ``rng``: for the theoretical metric.
    """
    model, measurements = predictive.model, problem.measurements
    predicted_before = predicted_rows(problem, model, before)
    T_R_N = model.T_R_N(model.natural(before))
    return Comparison(
        dict(zip(problem.sensor_names, T_R_N, strict=True)),
        measurements.position - predicted_before,
        accuracy_of(
            measurements,
            kept,
            predicted_before,
            predicted_rows(problem, model, after),
            (predictive, before),
            rng,
            tool_orientations(model, measurements, before, after),
        ),
    )


def predicted_rows(problem: Problem, model: Model, z: FloatArray) -> FloatArray:
    """Predicted marker positions of all rows in their sensors' frames N, m, (n, 3).

    In file order of the problem's measurements. For a sensor on the tool: the measured
    position less the error of the model (`Model.seen`). ``z``: pinned parameters, (size,).
    """
    measurements = problem.measurements
    rows = model.rows(measurements, np.arange(len(measurements))).of_points
    predicted = np.empty((len(measurements), 3))
    predicted[rows.source] = model.seen(z, rows)
    return apply(inverse(model.reference)[measurements.sensor], predicted)
