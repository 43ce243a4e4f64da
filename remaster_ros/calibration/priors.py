# SPDX-License-Identifier: Apache-2.0
"""Prior knowledge of markers, base frames and offsets, as Gaussian priors.

Numpy in, numpy out; `session` reads it from a session or a file.
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

# Standard deviation for a prior std of 0 in a session ("as good as known"), m or rad.
TIGHTEST_PRIOR = 1e-6
# Standard deviation of an offset's prior. Errors of a mastering are tenths of a degree. The prior
# keeps an offset that the data do not determine near zero; an offset that they determine to
# 0.05 degrees it moves by 1 in 10,000 of its size. For a joint that slides it is the arc at
# `LEVER_M`, 22 mm: the switch or stop of such a zero is rarely off by more than a turn of the
# motor, some millimetres.
OFFSET_STD = np.radians(5.0)
# Largest plausible offset. A larger one means a joint that has lost its mastering, or joints,
# signs or a robot model that are not those of the measured arm.
LARGEST_OFFSET = OFFSET_STD
# Largest error of an uncalibrated arm, m; larger errors have other causes than offsets.
UNCALIBRATED_ERROR_M = 5e-3
# Distance of a marker from its stated position, in stated standard deviations, that one of a
# million sessions exceeds (square root of chi squared with three degrees of freedom).
DISPLACED = 5.5
# Standard deviation over scale of Student's t with four degrees of freedom, for deviations from a
# drawing. These are not normal: most links are within the tolerance, and one is many times beyond.
# 95 % of such a t are within 1.96 standard deviations, as of a normal variable. With 1 the
# intervals held 91.7 % of 300 offsets of arms with an elbow 0.1 to 1 mm off.
DRAWING_TAILS = 2.0**0.5
# Standard deviation of a zero-offset's step in a fit with effects, rad: a marker 1 m from the
# axis is then 0.15 mm off the tangent, on which the effects were searched.
STEP_STD = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior as a function of the natural parameters."""

    description: str  # Name in the report: 'the prior on marker sir, 0.5 mm per axis'
    # Natural parameters (..., size) to whitened residuals (..., m), standard normal a priori
    residual: Callable[[FloatArray], FloatArray]


def marker_prior(model: Model, marker: int, nominal: FloatArray, std_m: float) -> Prior:
    """Prior of a marker: near its nominal position in T, m, with std_m per axis, at least 1 µm.

    ``marker``: its index in the model.
    """
    where = model.marker(marker)
    width = max(std_m, TIGHTEST_PRIOR)
    return Prior(
        f'the prior on marker {model.marker_names[marker]}, {std_m * 1e3:g} mm per axis',
        lambda x: (x[..., where] - nominal) / width,
    )


def offset_prior(model: Model, joint: int, mean: float, std: float) -> Prior:
    """Gaussian prior of a joint's offset, rad, or m for a slide; a std below 1e-6 counts as that.

    ``joint``: index from 0.
    """
    width = max(std, TIGHTEST_PRIOR)
    shown = f'{1e3 * std:g} mm' if model.chain.slides[joint] else f'{np.degrees(std):g} deg'
    return Prior(
        f'the prior on {model.chain.joint_names[joint]}, {shown}',
        lambda x: (x[..., joint : joint + 1] - mean) / width,
    )


def plausible_offsets(model: Model, joints: Sequence[int]) -> Prior:
    """Gaussian prior about 0 of joint offsets (indices), std 5 degrees (`OFFSET_STD`).

    22 mm for a joint that slides. If the model has effects found by discovery: about the
    offsets at which these were found (``joint_offsets`` of the extension), with its
    ``step_std``.
    """
    indices = list(joints)
    effects, per_radian = model.extension, model.chain.per_radian[indices]
    if effects is None or effects.joint_offsets is None:
        std = OFFSET_STD * per_radian
        also = f' or {1e3 * std.min():.0f} mm' if model.chain.slides[indices].any() else ''
        return Prior(
            f'the size of a mastering error, {np.degrees(OFFSET_STD):g} deg{also}',
            lambda x: x[..., indices] / std,
        )
    searched, width = effects.joint_offsets[indices], effects.step_std * per_radian
    return Prior(
        'the zero-offsets that the effects were searched with',
        lambda x: (x[..., indices] - searched) / width,
    )


def base_prior(model: Model, sensor: int, prior: BasePrior) -> Prior:
    """Prior of a sensor's registration T_R_N: six residuals in standard deviations.

    Translation and rotation vector along and about the axes of R; stds are at least 1e-6.
    ``sensor``: its index.
    """
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
    """Residuals (m,) of all priors, and their derivative (m, size) at z (size,).

    Derivatives by central differences of 1e-6; the last rows are the extension's prior on theta,
    exactly. ``natural``: whether z and the derivative are in natural instead of pinned
    coordinates.
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
