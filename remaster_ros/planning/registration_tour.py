"""The tour of a three-point registration: the poses that span the largest triangle first."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan
from remaster_ros.planning.tour_order import REGISTRATION, Tour
from remaster_ros.types import FloatArray


def registration_tour(
    chain: SerialChain,
    plan: Plan,
    markers_T: Sequence[FloatArray],
    model: CollisionModel | None = None,
) -> Tour:
    """Choose poses for a three-point registration: the first three span the largest triangle.

    The others follow in case a sensor cannot see one of them.

    Parameters
    ----------
    chain
        The arm.
    plan
        Poses that face roughly towards the sensors.
    markers_T
        The markers that are seen, in the tool frame, m, (3,) each.
    model
        What the arm must not hit on its way.

    Raises
    ------
    InsufficientDataError
        If there are fewer than three poses.
    """
    if len(plan.poses) < 3:
        reasons = ', '.join(f'{count} {reason}' for reason, count in plan.dropped.items())
        raise InsufficientDataError(
            f'only {len(plan.poses)} of the poses for the registration can be reached '
            f'({reasons}); correct rough_position_m of the sensors or the ranges of poses'
        )
    # The triangle of the worst-off marker counts: every sensor is registered by its own.
    points = np.array(
        [[chain.positions(pose.solutions[0], m) for m in markers_T] for pose in plan.poses]
    )
    candidates = list(combinations(range(len(plan.poses)), 3))
    areas = [
        np.min(np.linalg.norm(np.cross(points[b] - points[a], points[c] - points[a]), axis=-1))
        for a, b, c in candidates
    ]
    best = candidates[int(np.argmax(areas))]
    rest = [i for i in range(len(plan.poses)) if i not in best]
    poses = tuple(plan.poses[i] for i in (*best, *rest))
    ordered = Plan(poses, plan.dropped, plan.dropped_solutions)
    return Tour(chain, {REGISTRATION: ordered}, in_order=True, one_solution=True, model=model)
