# SPDX-License-Identifier: Apache-2.0
"""How far the hidden arm is from where it is wanted, once it is commanded by a compensation.

The truth is the hidden world's: pinocchio, and effects by their own equations. What errs in the
measurement alone is no error of the arm, and left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from worlds.hidden_sessions import HiddenSession
from worlds.hidden_world import Visits

from remaster_ros.compensation.compensator import Compensator
from remaster_ros.kinematics.transforms import apply, inverse

ARM_KINDS = (
    *('joint_compliance', 'encoder_eccentricity', 'encoder_scale', 'gear_periodic'),
    *('joint_error_curve', 'joint_coupling', 'link_length', 'joint_axis_tilt', 'thermal_growth'),
    'base_compliance',
)
"""Those that can be corrected."""
# Quantile of chi-squared with three degrees of freedom.
IN_95 = 7.815


@dataclass(frozen=True)
class Judged:
    """Errors of the marker at all poses of a tour.

    Attributes
    ----------
    rms_m, predicted_m
        Against where the file's base frame and marker have the nominal robot's tool.
    refitted_m
        With base and marker fitted again.
    inside
        Share of the poses in their predicted 95 %.
    poses
        How many.
    """

    rms_m: float
    predicted_m: float
    refitted_m: float
    inside: float
    poses: int


def judged(hidden: HiddenSession, compensator: Compensator, tour: Visits) -> Judged:
    """Command the hidden arm along a tour that it was not measured on."""
    model, world = compensator.model, hidden.world.on(tour)
    sensor, marker = next(iter(model.T_R_N)), next(iter(model.markers))
    T, place = model.T_R_N[sensor], model.markers[marker]
    # What a thermometer without noise shows.
    warm = model.reference_c + world.visited.warming_k
    found = compensator.correct(tour.q, warm)
    nominal = model.chain.forward(tour.q)
    wanted = apply(inverse(T), apply(nominal, place))
    effects = [effect for effect in hidden.truth.effects if effect.kind in ARM_KINDS]
    seen = hidden.world.on(replace(tour, q=found.command)).seen(effects)
    error = seen - wanted
    spread = T[:3, :3].T @ compensator.spread(tour.q, temperature_c=warm)
    covariance = spread @ np.swapaxes(spread, 1, 2)
    square = np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error[..., None])[..., 0])
    design = np.zeros((len(error), 3, 9))
    design[:, :, :3] = np.eye(3)
    design[:, :, 3:6] = np.cross(np.eye(3), wanted[:, None, :]).swapaxes(1, 2)
    design[:, :, 6:] = T[:3, :3].T @ nominal[:, :3, :3]
    columns = design.reshape(-1, 9)
    residuals = error.ravel() - columns @ np.linalg.lstsq(columns, error.ravel(), rcond=None)[0]
    return Judged(
        rms(error),
        float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))),
        rms(residuals.reshape(-1, 3)),
        float(np.mean(square < IN_95)),
        len(error),
    )


def rms(errors: np.ndarray) -> float:
    """Return the RMS length of (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
