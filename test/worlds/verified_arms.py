# SPDX-License-Identifier: Apache-2.0
"""Arms whose correction is in a known state, measured at poses with what was wanted there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from worlds.compensation_files import arm
from worlds.hidden_tours import robot

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.verification import Visits
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    rotation_vector_to_matrix,
    transform,
)

# Of each offset that was found, as forty poses give it.
POSTERIOR_STD = np.radians(0.003)
POSES = 10


@dataclass(frozen=True)
class Case:
    """What is simulated; the outermost joints have no offset, as base and marker take these up."""

    seed: int
    offset_deg: float
    noise_mm: float
    state: str
    joint: int = -1
    name: str = 'iiwa7'
    toggled: bool = False
    poses: int = POSES


def found_arm(case: Case) -> tuple[ArmModel, ArmModel]:
    """Return the true arm, and as it was found; each offset has the std of the case."""
    rng = np.random.default_rng(case.seed)
    true = arm(robot(case.name))
    k = true.joints
    offsets = np.radians(case.offset_deg) * rng.standard_normal(k)
    if case.joint >= 0:
        # The joint in question has an offset of that size, whichever sign.
        offsets[case.joint] = np.sign(offsets[case.joint]) * np.radians(case.offset_deg)
    offsets[[0, -1]] = 0.0
    error = POSTERIOR_STD * rng.standard_normal(k)
    error[[0, -1]] = 0.0
    root = np.zeros((k, len(true.parameter_names)))
    root[1 : k - 1, 1 : k - 1] = POSTERIOR_STD * np.eye(k - 2)
    true = replace(true, joint_offsets=offsets)
    return true, replace(true, joint_offsets=offsets + error, root=root)


def measured(case: Case) -> tuple[Compensator, Visits]:
    """Return the correction, and what was measured with it in the state of the case."""
    true, found = found_arm(case)
    rng = np.random.default_rng((case.seed, 1))
    compensator = Compensator(found)
    wanted = rng.uniform(-1.5, 1.5, (case.poses, true.joints))
    once = compensator.command(wanted)
    change = once - wanted
    if case.state == 'one joint':
        change[:, case.joint] *= -1.0
    reached = {
        'in_use': once,
        'not_in_use': wanted,
        'twice': compensator.command(once),
        'wrong_sign': wanted - change,
        'one joint': wanted + change,
    }[case.state]
    # The sensor stands elsewhere than in the fit, and the marker was put on again.
    sensor = transform(rotation_vector_to_matrix(rng.standard_normal(3)), (2.0, -1.0, 0.5))
    marker = found.markers['sir'] + 1e-3 * rng.standard_normal(3)

    def seen(q: np.ndarray) -> np.ndarray:
        points = apply(inverse(sensor), apply(true.state(q).tool, marker))
        return points + 1e-3 * case.noise_mm * rng.standard_normal(points.shape)

    positions, on = [seen(reached)], [np.ones(case.poses, dtype=bool)]
    if case.toggled:
        positions.append(seen(wanted))
        on.append(np.zeros(case.poses, dtype=bool))
    sides = len(on)
    rows = sides * case.poses
    return compensator, Visits(
        np.tile(wanted, (sides, 1)),
        np.concatenate(on),
        np.tile(np.arange(case.poses), sides),
        ('mocap',) * rows,
        ('sir',) * rows,
        np.concatenate(positions),
    )
