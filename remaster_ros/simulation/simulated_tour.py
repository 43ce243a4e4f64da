# SPDX-License-Identifier: Apache-2.0
"""Tour of a cell, planned and ordered as the planner node does it, all at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.planned_design import designed_plans
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.types import FloatArray


def plan_tour(
    chain: SerialChain,
    cell: Workcell,
    places: Mapping[str, FloatArray] | None,
    counts: Mapping[str, int],
    rng: np.random.Generator,
    *,
    without_meshes: bool = True,
) -> Tour:
    """Plan a tour of poses that face one sensor and are visible to all, for every split.

    Parameters
    ----------
    chain, cell
        Arm and workcell.
    places
        T_R_N of every sensor that has to see its marker, (4, 4); None for the cell's rough places.
    counts
        Split -> number of candidate poses; a split with 0 is left out.
    rng
        Source of randomness.
    without_meshes
        Whether capsules are used in place of meshes: a simulated arm can hurt no one, and its
        meshes may be on another machine.

    Raises
    ------
    InputError
        If the inverse kinematics of this robot cannot be solved, or no pose to fit is asked for or
        can be reached.
    """
    if not counts.get('optimization'):
        raise InputError('no pose to fit is asked for; give at least one')
    scene = cell.planning_scene(chain, without_meshes=without_meshes)
    sensors_R = scene.rough_R
    if places is not None:
        sensors_R = {name: T_R_N[:3, 3] for name, T_R_N in places.items()}
    plans = {split: scene.plan(n, sensors_R, rng) for split, n in counts.items() if n}
    settings = cell.design_settings()
    if settings.optimal and plans['optimization'].poses:
        travel = TravelTime.of(scene.model, acceleration=cell.acceleration_limits(chain))
        plans = dict(designed_plans(scene, settings, plans, sensors_R, travel, rng).plans)
    tour = Tour(chain, plans)
    if not tour.poses['optimization']:
        raise InputError(
            f'{tour.describe()}: no pose is left to fit; give more --poses, or a --cell with '
            'ranges of poses that suit this robot'
        )
    return tour


def visit(tour: Tour, chain: SerialChain) -> dict[str, list[FloatArray]]:
    """Joint solutions, rad or m, (m, k) per pose, of each split in the order of the visits.

    Keys are 'optimization' and 'validation', [] without poses. A simulated session begins at
    the position within the limits nearest to zero and goes from one split to the other, each
    time to the nearest pose.
    """
    visits: dict[str, list[FloatArray]] = {'optimization': [], 'validation': []}
    q = np.clip(np.zeros(len(chain)), chain.lower, chain.upper)
    for split, plan in tour.plans.items():
        part = Tour(chain, {split: plan})
        while (visit_of_pose := part.next(q)) is not None:
            visits[split].append(visit_of_pose.solutions)
            q = visit_of_pose.solutions[-1]
    return visits
