# SPDX-License-Identifier: Apache-2.0
"""What the true zero-offset is where another effect is in part the same.

Of an error that follows the joint's own angle and is not named, the mean over the configurations
to fit is part of the offset, as an error curve has none. A tilt of an axis that turns about the
axis before, which it meets, is an offset of that joint.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from worlds.hidden_world import HiddenTruth, HiddenWorld

from remaster_ros.simulation.hidden_effect import Deviation, HiddenEffect
from remaster_ros.simulation.hidden_effects import add_effect
from remaster_ros.types import FloatArray

OWN_ANGLE = ('encoder_eccentricity', 'encoder_scale', 'gear_periodic', 'joint_error_curve')


def true_offsets(
    world: HiddenWorld, truth: HiddenTruth, named: set[tuple[str, int]]
) -> FloatArray:
    """Return what the zero-offsets of a session should come out as, rad, (k,).

    Parameters
    ----------
    world, truth
        Of the session.
    named
        Effect and joint of everything that an estimate has named.
    """
    fitted = ~world.visits.is_validation
    offsets = truth.joint_offsets.copy()
    for effect in truth.effects:
        if effect.kind in OWN_ANGLE and not {(effect.kind, j) for j in effect.joints} & named:
            curve = Deviation.none(*world.circumstances.q.shape)
            add_effect(effect, curve, world.circumstances)
            offsets += curve.angle[fitted].mean(axis=0)
        if effect.kind == 'joint_axis_tilt':
            offsets += _same_as_offsets(world, effect)
    return offsets


def _same_as_offsets(world: HiddenWorld, tilt: HiddenEffect) -> FloatArray:
    """Return the zero-offsets that are the same as a part of a tilt, rad, (k,)."""
    turns = [replace(tilt, values=1e-4 * axis) for axis in np.eye(3)]
    responses = np.stack([world.response(turn).ravel() for turn in turns], axis=1)
    nuisance = world.nuisance.reshape(len(responses), -1)
    taken_up = np.linalg.lstsq(nuisance, responses, rcond=1e-9)[0]
    residuals = responses - nuisance @ taken_up
    size, direction = np.linalg.eigh(residuals.T @ residuals)
    # Directions of which next to nothing is left; about the own axis it is the joint's own offset.
    same = direction[:, size < 1e-4 * np.sum(responses**2)]
    steps = taken_up @ (same @ (same.T @ tilt.values)) / 1e-4
    found: FloatArray = steps[: world.arm.joints]
    return found
