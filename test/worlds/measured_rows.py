# SPDX-License-Identifier: Apache-2.0
"""Rows of a session for tests that need a few columns of them, and where markers are in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.types import FloatArray, Measurements


def measured_rows(q: ArrayLike, position: ArrayLike, **columns: ArrayLike) -> Measurements:
    """Return rows of one sensor and one marker, a pose and a configuration each, all to be fitted.

    What a session may leave out is unknown, but for the ``columns`` that are given.
    """
    angles = np.asarray(q, float)
    rows = len(angles)
    each, none = np.arange(rows), np.zeros(rows, np.int64)
    usual = {
        'observation': each,
        'pose': each,
        'configuration': each,
        'is_validation': np.zeros(rows, bool),
        'stamp_s': each.astype(float),
        'sensor': none,
        'marker': none,
        'from_q': np.full_like(angles, np.nan),
        'std': np.full((rows, 3), np.nan),
        'samples': np.full(rows, -1),
        'temperature_c': np.full(rows, np.nan),
    }
    given = {name: np.asarray(values) for name, values in columns.items()}
    readings = {'q': angles, 'position': np.asarray(position, float)}
    return replace(Measurements.empty(angles.shape[1]), **{**usual, **readings, **given})


def predict_in_sensor(
    chain: SerialChain,
    measurements: Measurements,
    joint_offsets: FloatArray,
    T_R_N: FloatArray,
    markers: FloatArray,
) -> FloatArray:
    """Return where the sensors should measure the markers, in the frame of each row's sensor."""
    points = chain.positions(measurements.q, markers[measurements.marker], joint_offsets)
    return apply(inverse(T_R_N)[measurements.sensor], points)
