# SPDX-License-Identifier: Apache-2.0
"""What is known before the data: markers, base frames and offsets, Gaussian.

Numpy in, numpy out; how they are read from a session or a file is in `session`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.model import Model
from remaster_ros.kinematics.transforms import (
    matrix_from_quaternion_xyzw,
    matrix_to_rotation_vector,
)
from remaster_ros.types import BasePrior, FloatArray

# A prior std of 0 in a session means "as good as known": a micrometre, a microradian.
TIGHTEST_PRIOR = 1e-6
# A mastering is off by tenths of a degree. This prior keeps an offset that the data leave open
# from running away; one that they determine to 0.05 degrees it moves by 1 in 10,000 of its size.
# Of a joint that slides it is as much as that at `LEVER_M`, 22 mm: a switch or stop that sets such
# a zero is rarely off by more than a turn of the motor, some millimetres.
OFFSET_STD = np.radians(5.0)
# A larger offset is that of a joint that has lost its mastering, or joints, signs or the robot
# model are not those of the arm that was measured.
LARGEST_OFFSET = OFFSET_STD
# Error of an arm that nobody has calibrated, m: larger ones are not of its offsets.
UNCALIBRATED_ERROR_M = 5e-3
# A marker where it was stated to be is that many times the stated std off in one of a million
# sessions (square root of chi squared with three degrees of freedom).
DISPLACED = 5.5
# How far a drawing is off is no normal variable: most links are within its tolerance, and one is
# many times beyond. With the tails of Student's t with four degrees of freedom, for which this is
# the standard deviation over the scale, 95 % are within 1.96 standard deviations as of a normal
# one. With 1 the intervals held 91.7 % of 300 offsets of arms with an elbow 0.1 to 1 mm off.
DRAWING_TAILS = 2.0**0.5
# Standard deviation of a zero-offset's step beside effects, rad: a marker 1 m from the axis is
# then 0.15 mm off the tangent, on which the effects were searched.
STEP_STD = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian prior as a function of the natural parameters."""

    description: str  # How the report names it: 'the prior on marker sir, 0.5 mm per axis'
    # Natural parameters (..., size) to whitened residuals (..., m), standard normal a priori
    residual: Callable[[FloatArray], FloatArray]


def marker_prior(model: Model, marker: int, nominal: FloatArray, std_m: float) -> Prior:
    """Return what is known of a marker before: near its nominal place, std_m per axis."""
    where = model.marker(marker)
    width = max(std_m, TIGHTEST_PRIOR)
    return Prior(
        f'the prior on marker {model.marker_names[marker]}, {std_m * 1e3:g} mm per axis',
        lambda x: (x[..., where] - nominal) / width,
    )


def offset_prior(model: Model, joint: int, mean: float, std: float) -> Prior:
    """Return what is known of a joint's offset before, rad or m."""
    width = max(std, TIGHTEST_PRIOR)
    shown = f'{1e3 * std:g} mm' if model.chain.slides[joint] else f'{np.degrees(std):g} deg'
    return Prior(
        f'the prior on {model.chain.joint_names[joint]}, {shown}',
        lambda x: (x[..., joint : joint + 1] - mean) / width,
    )


def plausible_offsets(model: Model, joints: Sequence[int]) -> Prior:
    """Return what is known of any joint's offset: it is no more than some degrees.

    Beside effects it is near the one that they were searched with.
    """
    which = list(joints)
    effects, per_radian = model.extension, model.chain.per_radian[which]
    if effects is None or effects.joint_offsets is None:
        std = OFFSET_STD * per_radian
        also = f' or {1e3 * std.min():.0f} mm' if model.chain.slides[which].any() else ''
        return Prior(
            f'the size of a mastering error, {np.degrees(OFFSET_STD):g} deg{also}',
            lambda x: x[..., which] / std,
        )
    searched, width = effects.joint_offsets[which], effects.step_std * per_radian
    return Prior(
        'the zero-offsets that the effects were searched with',
        lambda x: (x[..., which] - searched) / width,
    )


def base_prior(model: Model, sensor: int, prior: BasePrior) -> Prior:
    """Return what is known of a sensor's registration T_R_N before."""
    known = matrix_from_quaternion_xyzw(prior.rotation_xyzw)
    widths = max(prior.std_m, TIGHTEST_PRIOR), max(prior.std_rad, TIGHTEST_PRIOR)

    def residual(x: FloatArray) -> FloatArray:
        T_R_N = model.T_R_N(x)[..., sensor, :, :]
        shift = (T_R_N[..., :3, 3] - prior.translation_m) / widths[0]
        turn = matrix_to_rotation_vector(T_R_N[..., :3, :3] @ known.T) / widths[1]
        return np.concatenate((shift, turn), axis=-1)

    return Prior(f'the prior on the base frame of {model.sensor_names[sensor]}', residual)


def prior_rows(
    model: Model, priors: Sequence[Prior], z: FloatArray, *, natural: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (m,) of all priors and their derivative (m, size) at z.

    Numerical differences: the priors are smooth, few, and written as plain functions. ``natural``
    where z and the derivative are in natural, not in pinned coordinates.
    """
    # Priors are on the core; theta's is linear, so differences would only cost.
    step, core = 1e-6 * np.eye(model.core, model.size), model.core
    points = np.concatenate((z[None], z + step, z - step))
    x = points if natural else model.natural(points)
    values = np.concatenate(
        [np.zeros((len(x), 0)), *(prior.residual(x) for prior in priors)], axis=-1
    )
    by_z = np.zeros((values.shape[1], model.size))
    by_z[:, :core] = (values[1 : core + 1] - values[core + 1 :]).T / 2e-6
    root = model.extension_root
    theta = model.theta(z)
    by_theta = np.concatenate((np.zeros((len(root), core)), root), axis=1)
    return (
        np.concatenate((values[0], root @ theta)),
        np.concatenate((by_z, by_theta)),
    )
