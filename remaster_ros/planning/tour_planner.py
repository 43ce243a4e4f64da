# SPDX-License-Identifier: Apache-2.0
"""The tours of a session: for the registration, and for the collection with its references."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import transform
from remaster_ros.planning.candidates import Plan, PlannedPose, PlanningScene, order_solutions
from remaster_ros.planning.planned_design import (
    POOL_CANDIDATES,
    Designed,
    DesignSettings,
    designed_plans,
    visit_order,
)
from remaster_ros.planning.reference_choice import choose_references
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import (
    SeparatingDesign,
    further_scene,
    measured_so_far,
    separate,
)
from remaster_ros.planning.tour_order import (
    FITTED,
    HELD_OUT,
    REFERENCE,
    REGISTRATION,
    Tour,
    free_way,
)
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import FloatArray, Measurements


def registration_tour(
    chain: SerialChain,
    plan: Plan,
    markers_T: Sequence[FloatArray],
    model: CollisionModel | None = None,
) -> Tour:
    """Choose poses for a three-point registration: the first three span the largest triangle.

    The others follow in case a sensor cannot see one of them.

    ``chain``: the arm; ``plan``: poses that face roughly towards the sensors; ``markers_T``: the
    markers that are seen, in the tool frame, m, (3,) each; ``model``: what the arm must not hit on
    its way.
    Raises InsufficientDataError: if there are fewer than three poses.
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


REGISTRATION_CANDIDATES = 12
"""Candidate poses for the three-point registration, where nothing else is stated."""
MORE_CANDIDATES = 10 * REGISTRATION_CANDIDATES
"""Further ones where fewer than three of these can be taken."""
MOST_TRIES = 5
"""So often poses are chosen anew where one has no free way to it."""
VERIFIED_POSES = 10
"""Of a verification: at 0.1 mm of noise they tell offsets of 0.1 degrees in 97 of 100 cases."""
VERIFIED_CANDIDATES = 6 * VERIFIED_POSES
"""As of a collection, of which arms reach a half to a sixth."""


class TourPlanner:
    """Plans the tours of one session; equal arguments give equal tours.

    Parameters
    ----------
    scene
        The arm, what it can hit, and the sensors.
    counts
        Candidate poses of each split, the registration's among them.
    seed
        Of the Latin hypercube.
    reference_every
        How many configurations lie between two rounds of the references; 0 for no references.
    design
        Which of the poses are visited, and in which order; all of them, nearest first, by default.
    travel
        How long the robot takes; where None it moves with the bridge's defaults.
    causes
        Found before: configurations that separate them from their look-alikes are added.

    Attributes
    ----------
    scene, design, travel
        As given.
    model
        The arm and all that it must not hit.
    designed
        What an optimal design has led to; None without one.
    separated
        What was added to separate causes; None without causes.
    """

    def __init__(
        self,
        scene: PlanningScene,
        counts: Mapping[str, int],
        seed: int,
        reference_every: int = 0,
        design: DesignSettings | None = None,
        travel: TravelTime | None = None,
        causes: Sequence[FoundCause] = (),
    ) -> None:
        self.scene, self._counts, self._seed = scene, counts, seed
        self._every = reference_every
        self._chain, self.model = scene.model.chain, scene.model
        self.design = design or DesignSettings()
        self.travel = travel or TravelTime.of(scene.model)
        self.designed: Designed | None = None
        self._causes = tuple(causes)
        self.separated: SeparatingDesign | None = None

    @property
    def rough_places(self) -> dict[str, FloatArray]:
        """T_R_N of each sensor at its rough place, (4, 4)."""
        return {name: transform(np.eye(3), at) for name, at in self.scene.rough_R.items()}

    @property
    def registers(self) -> bool:
        """Whether the sensors are registered by poses of this planner's."""
        return REGISTRATION in self._counts

    def registration(self) -> Tour:
        """Plan poses for the three-point registration, before sensors at their rough places.

        Where the arm can take too few of the candidates, as one whose limits are narrow, more are
        drawn.
        """
        plan = self._plan(REGISTRATION, self.scene.rough_R)
        if len(plan.poses) < 3:
            rng = np.random.default_rng([self._seed, *b'register'])
            more = self.scene.plan(MORE_CANDIDATES, self.scene.rough_R, rng)
            plan = Plan(
                (*plan.poses, *more.poses),
                dict(Counter(plan.dropped) + Counter(more.dropped)),
                dict(Counter(plan.dropped_solutions) + Counter(more.dropped_solutions)),
            )
        markers = [sight.marker_T for sight in self.scene.sights]
        return registration_tour(self._chain, plan, markers, self.model)

    @property
    def left_to_fit(self) -> int:
        """How many poses to fit the arm can take, before sensors at their rough places."""
        return len(self._plan('optimization', self.scene.rough_R).poses)

    def collection(self, T_R_N: Mapping[str, FloatArray]) -> Tour:
        """Plan the poses to fit and to validate, before sensors with these registrations.

        Raises
        ------
        InsufficientDataError
            No pose is left to fit on.
        """
        sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
        plans = {
            split: self._plan(split, sensors_R)
            for split, count in self._counts.items()
            if count and split != REGISTRATION
        }
        if not plans['optimization'].poses:
            nothing = Tour(self._chain, plans).describe()
            raise InsufficientDataError(f'{nothing}: no pose is left to fit on')
        if self.design.optimal:
            rng = np.random.default_rng([self._seed, *b'design'])
            self.designed = designed_plans(
                self.scene, self.design, plans, sensors_R, self.travel, rng
            )
            plans = dict(self.designed.plans)
        if self._causes:
            plans['optimization'] = self._separating(plans['optimization'], sensors_R)
        order = []
        if self.design.fastest:
            whole = self.design.whole_poses
            order = visit_order(plans, self.model, self.travel, whole_poses=whole)
        if self._every:
            plans[REFERENCE] = self._references(plans)
        return Tour(self._chain, plans, model=self.model, reference_every=self._every, order=order)

    def _separating(self, plan: Plan, sensors_R: Mapping[str, FloatArray]) -> Plan:
        """Add configurations to a plan that separate the causes."""
        rng = np.random.default_rng([self._seed, *b'separate'])
        pool = further_scene(self.scene).plan(POOL_CANDIDATES, sensors_R, rng)
        self.separated = separate(
            self._chain,
            plan.poses,
            pool.poses,
            self.design.before(sensors_R).sensors,
            self.design.marker_std_m,
            self._causes,
            self.design.priors,
        )
        return replace(plan, poses=(*plan.poses, *self.separated.poses))

    def further(
        self,
        T_R_N: Mapping[str, FloatArray],
        causes: Sequence[FoundCause],
        rows: Measurements,
        before: Tour,
        most: int,
    ) -> Tour:
        """Plan what separates causes that were found in a session, to be measured behind it.

        Parameters
        ----------
        T_R_N
            Registrations of the sensors, (4, 4).
        causes
            With their look-alikes.
        rows
            What the session has.
        before
            Its last tour, whose references are visited again.
        most
            Configurations that may be added.
        """
        sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
        rng = np.random.default_rng([self._seed, *b'further', before.begin_at + before.visited])
        pool = further_scene(self.scene).plan(POOL_CANDIDATES, sensors_R, rng)
        planned, so_far = measured_so_far(rows)
        design = self.design.before(sensors_R)
        self.separated = separate(
            self._chain,
            planned,
            pool.poses,
            design.sensors,
            design.marker_std_m,
            causes,
            design.priors,
            so_far,
            most,
        )
        plans = {FITTED: Plan(self.separated.poses)}
        if before.references and self.separated.poses:
            plans[REFERENCE] = before.plans[REFERENCE]
        return Tour(
            self._chain,
            plans,
            model=self.model,
            reference_every=before.reference_every if REFERENCE in plans else 0,
            order=[(FITTED, *visit) for visit in self.separated.order],
            begin_at=before.begin_at + before.visited,
        )

    def verification(self) -> Tour:
        """Plan poses that no collection has, each with the correction off and on.

        Which of the two is first is random at each: what drifts is in neither alone. The sensors
        are taken to be at their rough places; nothing has to be registered.

        Raises
        ------
        InsufficientDataError
            Too few of the candidates can be reached, each from the one before it.
        """
        rng = np.random.default_rng([self._seed, *b'verify'])
        plan = self.scene.plan(VERIFIED_CANDIDATES, self.scene.rough_R, rng)
        poses = [replace(p, solutions=rng.permutation(p.solutions)[:1]) for p in plan.poses]
        chosen = self._reached(poses)
        if len(chosen) < VERIFIED_POSES:
            raise InsufficientDataError(
                f'{len(chosen)} poses can be reached of {VERIFIED_CANDIDATES} candidates, and a '
                f'verification takes {VERIFIED_POSES}; widen the ranges of poses in the cell file'
            )
        visits = [
            replace(pose, correction=state)
            for pose in chosen
            for state in (('on', 'off') if rng.random() < 0.5 else ('off', 'on'))
        ]
        held_out = Plan(tuple(visits), plan.dropped, plan.dropped_solutions)
        return Tour(
            self._chain, {FITTED: Plan(()), HELD_OUT: held_out}, in_order=True, model=self.model
        )

    def check(self, q: FloatArray) -> Tour:
        """Plan a visit to each of these configurations, in their order, rad, (n, k).

        Raises
        ------
        InputError
            The arm cannot stand at one of them.
        """
        margin = self.scene.limit_margin_rad * self._chain.per_radian
        for number, (one, why) in enumerate(zip(q, self.model.reasons(q, RESERVE_M)), 1):
            if why or not self._chain.within_limits(one, -margin):
                raise InputError(
                    f'configuration {number} of the check: {why or "too near to a joint limit"}; '
                    'choose others (remaster plan --check)'
                )
        poses = tuple(PlannedPose(self._chain.forward(one), one[None]) for one in q)
        plans = {FITTED: Plan(()), HELD_OUT: Plan(poses)}
        return Tour(self._chain, plans, in_order=True, model=self.model)

    def _reached(self, poses: list[PlannedPose]) -> list[PlannedPose]:
        """Return some of the poses in an order in which each is reached from the one before."""
        while True:
            q = np.array([pose.solutions[0] for pose in poses[:VERIFIED_POSES]])
            chosen = [poses[i] for i in self._in_turn(q, list(range(len(q))))]
            lost = self._without_way(chosen)
            if not lost:
                return chosen
            poses = [pose for pose in poses if all(pose is not other for other in lost)]

    def _references(self, plans: Mapping[str, Plan]) -> Plan:
        """Choose references among the planned configurations, each with a way from the last."""
        poses = [
            PlannedPose(pose.T_R_T, q[None])
            for plan in plans.values()
            for pose in plan.poses
            for q in pose.solutions
        ]
        seen = {sight.sensor: (sight.marker, sight.marker_T) for sight in self.scene.sights}
        chosen: list[PlannedPose] = []
        for _ in range(MOST_TRIES):
            q = np.array([pose.solutions[0] for pose in poses])
            picked = choose_references(self._chain, q, seen).indices
            chosen = [poses[i] for i in self._in_turn(q, list(picked))]
            lost = self._without_way(chosen)
            if not lost:
                break
            poses = [pose for pose in poses if all(pose is not other for other in lost)]
        return Plan(tuple(chosen))

    def _in_turn(self, q: FloatArray, left: list[int]) -> list[int]:
        """Order the indices so that each is the nearest of those left to the one before."""
        order = left[:1]
        while rest := [i for i in left if i not in order]:
            limits = self._chain.velocity_limits
            order.append(rest[int(order_solutions(q[rest], q[order[-1]], limits)[0])])
        return order

    def _without_way(self, poses: Sequence[PlannedPose]) -> list[PlannedPose]:
        """Return the references that no free way leads to from the one before."""
        limits = self._chain.velocity_limits
        return [
            pose
            for i, pose in enumerate(poses)
            if free_way(self.model, poses[i - 1].solutions[0], pose.solutions[0], limits, i)
            is None
        ]

    def _plan(self, split: str, sensors_R: Mapping[str, FloatArray]) -> Plan:
        # Each split has its own draws: the same plan, whatever was planned before a restart.
        rng = np.random.default_rng([self._seed, *split.encode()])
        return self.scene.plan(self._counts[split], sensors_R, rng)
