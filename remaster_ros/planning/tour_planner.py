# SPDX-License-Identifier: Apache-2.0
"""The tours of a session: registration, collection with references, inspections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np

from remaster_ros.errors import InputError, InsufficientDataError, RemasterError
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import transform
from remaster_ros.planning.candidates import Plan, PlannedPose, PlanningScene, order_solutions
from remaster_ros.planning.moving_design import (
    MOVING_S,
    MovingDesign,
    design_moving,
    stays_in_sight,
)
from remaster_ros.planning.planned_design import (
    POOL_CANDIDATES,
    DesignResult,
    DesignSettings,
    designed_plans,
)
from remaster_ros.planning.reference_choice import choose_references
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import (
    SeparatingDesign,
    measured_so_far,
    scene_with_other_elbows,
    separate,
)
from remaster_ros.planning.tour_order import (
    FITTED,
    HELD_OUT,
    REFERENCE,
    REGISTRATION,
    Tour,
    free_waypoints,
)
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.planning.visit_order import visit_order
from remaster_ros.types import FloatArray, Measurements

REGISTRATION_CANDIDATES = 12
"""Default number of candidate poses for the three-point registration."""
MORE_CANDIDATES = 10 * REGISTRATION_CANDIDATES
"""Additional candidates if fewer than three of these are usable."""
ROOM_RAD = np.deg2rad(6.0)
"""Curves that are prepared for rough positions keep so much of the angle at which a marker is
visible: a sensor may be 0.15 m from there at 1.5 m."""
MOST_TRIES = 5
"""Most repetitions of a choice if a pose has no free path to it."""
VERIFIED_POSES = 10
"""Poses of a verification: at 0.1 mm of noise they detect 0.1 degrees in 97 % of cases."""
VERIFIED_CANDIDATES = 6 * VERIFIED_POSES
"""Candidates of a verification, of which arms reach a half to a sixth."""


def registration_tour(
    chain: SerialChain,
    plan: Plan,
    markers_T: Sequence[FloatArray],
    model: CollisionModel | None = None,
) -> Tour:
    """Return the tour of a three-point registration, the best three poses first.

    The first three span the largest triangle; the others follow if a sensor misses one of them.

    ``chain``: the arm; ``plan``: poses that face roughly towards the sensors; ``markers_T``:
    markers in the tool frame, m, (3,) each; ``model``: obstacles.
    Raises InsufficientDataError if there are fewer than three poses.
    """
    if len(plan.poses) < 3:
        reasons = ', '.join(f'{count} {reason}' for reason, count in plan.dropped.items())
        raise InsufficientDataError(
            f'only {len(plan.poses)} of the poses for the registration can be reached '
            f'({reasons}); correct rough_position_m of the sensors or the ranges of poses'
        )
    # The smallest triangle of a marker counts, since every sensor is registered by its own marker.
    points = np.array(
        [[chain.positions(pose.solutions[0], m) for m in markers_T] for pose in plan.poses]
    )
    candidates = list(combinations(range(len(plan.poses)), 3))
    areas = [
        np.min(np.linalg.norm(np.cross(points[b] - points[a], points[c] - points[a]), axis=-1))
        for a, b, c in candidates
    ]
    best = candidates[int(np.argmax(areas))]
    other_poses = [i for i in range(len(plan.poses)) if i not in best]
    poses = tuple(plan.poses[i] for i in (*best, *other_poses))
    ordered = Plan(poses, plan.dropped, plan.dropped_solutions)
    return Tour(chain, {REGISTRATION: ordered}, in_order=True, one_solution=True, model=model)


class TourPlanner:
    """Plans the tours of one session; equal arguments give equal tours.

    Parameters
    ----------
    scene
        The arm, its obstacles, and the sensors.
    counts
        Number of candidate poses of each split, the registration's among them.
    seed
        Seed of the Latin hypercubes.
    reference_every
        Most configurations between two rounds of the references; 0 for no references.
    design
        Which poses are visited, and in which order; by default all of them, nearest next.
    travel
        Travel times of the robot; None for the bridge's defaults.
    causes
        Causes that were found: configurations that separate them from their look-alikes are
        added.
    moving_s
        Time of measured motion, s; 0 for stop and go. Other than 0, a collection has curves
        (`moving_design`), and neither the counts, but for the registration's, nor references nor
        causes matter.

    Attributes
    ----------
    scene, design, travel
        As given.
    model
        The arm with its obstacles.
    design_result
        Result of the optimal design; None without one.
    separating_design
        Configurations added to separate causes; None without causes.
    moving_design
        Curves that are measured in motion; None for stop and go.
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
        moving_s: float = 0.0,
    ) -> None:
        self.scene, self._counts, self._seed = scene, counts, seed
        self._every = reference_every
        self._chain, self.model = scene.model.chain, scene.model
        self.design = design or DesignSettings()
        self.travel = travel or TravelTime.of(scene.model)
        self.design_result: DesignResult | None = None
        self._causes = tuple(causes)
        self.separating_design: SeparatingDesign | None = None
        self.moving_s = moving_s
        self.moving_design: MovingDesign | None = None
        # Curves for sensors at their rough positions.
        self._prepared: MovingDesign | None = None

    @property
    def rough_places(self) -> dict[str, FloatArray]:
        """Transform T_R_N of each sensor at its rough position, unrotated, name -> (4, 4)."""
        return {name: transform(np.eye(3), at) for name, at in self.scene.rough_R.items()}

    @property
    def registers(self) -> bool:
        """Whether this planner plans poses for a registration."""
        return REGISTRATION in self._counts

    def registration(self) -> Tour:
        """Return the tour of the three-point registration, for sensors at their rough positions.

        If too few of the candidates are usable, more are drawn. Raises InsufficientDataError as
        `registration_tour`.
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
    def usable_to_fit(self) -> int:
        """Number of usable poses to fit among the candidates, for sensors at rough positions."""
        return len(self._plan('optimization', self.scene.rough_R).poses)

    def collection(self, T_R_N: Mapping[str, FloatArray]) -> Tour:
        """Return the tour of poses to fit and to validate, for sensors with these registrations.

        ``T_R_N``: (4, 4) each. Sets `design_result` and `separating_design`. Raises
        InsufficientDataError if no pose is left to fit; with an optimal design also as
        `designed_plans`. With `moving_s` as `moving`.
        """
        if self.moving_s > 0.0:
            return self.moving(T_R_N)
        sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
        plans = {
            split: self._plan(split, sensors_R)
            for split, count in self._counts.items()
            if count and split != REGISTRATION
        }
        if not plans['optimization'].poses:
            counts = Tour(self._chain, plans).describe()
            raise InsufficientDataError(f'{counts}: no pose is left to fit on')
        if self.design.optimal:
            rng = np.random.default_rng([self._seed, *b'design'])
            self.design_result = designed_plans(
                self.scene, self.design, plans, sensors_R, self.travel, rng
            )
            plans = dict(self.design_result.plans)
        if self._causes:
            plans['optimization'] = self._separating(plans['optimization'], sensors_R)
        order = []
        if self.design.fastest:
            whole_poses = self.design.whole_poses
            order = visit_order(plans, self.model, self.travel, whole_poses=whole_poses)
        if self._every:
            plans[REFERENCE] = self._references(plans)
        return Tour(self._chain, plans, model=self.model, reference_every=self._every, order=order)

    def moving(self, T_R_N: Mapping[str, FloatArray]) -> Tour:
        """Return the tour of a collection that is measured while the arm moves along curves.

        The rows to fit are measured along the curves; the only pose to fit is where the first
        curve begins. Then come the poses to validate, at standstill, in their order: each of
        the first ones is the end of a curve (`PlannedPose.way`), which begins at the pose
        before it.

        ``T_R_N``: registrations, (4, 4) each. Sets `moving_design`. Raises as `design_moving`.
        """
        sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
        design = self._prepared
        if (
            design is None
            or sensors_R.keys() != self.scene.rough_R.keys()
            or not stays_in_sight(design, self.scene, self.design, sensors_R)
        ):
            design = self._curves(sensors_R)
        self.moving_design = design
        held_out = Plan(design.ends)
        return Tour(
            self._chain,
            {FITTED: Plan((design.begin,)), HELD_OUT: held_out},
            in_order=True,
            one_solution=True,
            model=self.model,
            order=[(FITTED, 0, 0), *((HELD_OUT, i, 0) for i in range(len(held_out.poses)))],
        )

    def prepare(self) -> None:
        """Choose the curves for measuring in motion ahead, for sensors at their rough positions.

        That takes half a minute. `moving` uses the curves if the registered sensors see all
        markers along them. If no curves are found, nothing is raised here; `moving` tries
        again, and raises. Nothing is done without `moving_s`.
        """
        if not self.moving_s:
            return
        sights = [
            replace(sight, max_angle_rad=sight.max_angle_rad - ROOM_RAD)
            for sight in self.scene.sights
        ]
        with suppress(RemasterError):
            scene = replace(self.scene, sights=sights)
            self._prepared = self._prepared or self._curves(self.scene.rough_R, scene)

    def _curves(
        self, sensors_R: Mapping[str, FloatArray], scene: PlanningScene | None = None
    ) -> MovingDesign:
        """Return the joint-space curves along which the arm is measured while it moves.

        ``sensors_R``: sensor -> position in the robot base frame R, m, (3,); ``scene``: arm,
        obstacles and sights, None for the planner's own. The curves begin near the likely end
        of a registration. Raises as `design_moving`.
        """
        rng = np.random.default_rng([self._seed, *b'moving'])
        seconds = self.moving_s or MOVING_S
        return design_moving(
            scene or self.scene,
            self.travel,
            self.design,
            sensors_R,
            rng,
            seconds,
            self._likely_end(),
        )

    def _likely_end(self) -> FloatArray:
        """Return the configuration at the end of a likely registration, rad or m, (k,).

        It begins at 0, cut to the joint limits, and visits the first three poses by straight
        paths. Without a registration the begin itself.
        """
        q: FloatArray = np.clip(np.zeros(len(self._chain)), self._chain.lower, self._chain.upper)
        if self.registers:
            tour = self.registration().first_poses(3).restarted_straight()
            while (visit := tour.next(q)) is not None:
                q = visit.solutions[-1]
        return q

    def _separating(self, plan: Plan, sensors_R: Mapping[str, FloatArray]) -> Plan:
        """Return the plan of poses to fit with poses added that separate the planner's causes.

        ``sensors_R``: positions in the robot base frame R, m, (3,). Sets `separating_design`.
        """
        rng = np.random.default_rng([self._seed, *b'separate'])
        pool = scene_with_other_elbows(self.scene).plan(POOL_CANDIDATES, sensors_R, rng)
        self.separating_design = separate(
            self._chain,
            plan.poses,
            pool.poses,
            self.design.with_sensors_at(sensors_R).sensors,
            self.design.marker_std_m,
            self._causes,
            self.design.priors,
        )
        return replace(plan, poses=(*plan.poses, *self.separating_design.poses))

    def separating_tour(
        self,
        T_R_N: Mapping[str, FloatArray],
        causes: Sequence[FoundCause],
        rows: Measurements,
        previous: Tour,
        most: int,
    ) -> Tour:
        """Return a tour that separates causes found in a session, to be measured after it.

        ``T_R_N``: registrations of the sensors, (4, 4); ``causes``: with their look-alikes;
        ``rows``: the session's measurements; ``previous``: its last tour, whose references are
        visited again, and whose numbers go on; ``most``: largest number of configurations. Without
        poses if none separate the causes. Sets `separating_design`.
        """
        sensors_R = {name: T[:3, 3] for name, T in T_R_N.items()}
        rng = np.random.default_rng(
            [self._seed, *b'further', previous.begin_at + previous.visited]
        )
        pool = scene_with_other_elbows(self.scene).plan(POOL_CANDIDATES, sensors_R, rng)
        planned, so_far = measured_so_far(rows)
        design = self.design.with_sensors_at(sensors_R)
        self.separating_design = separate(
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
        plans = {FITTED: Plan(self.separating_design.poses)}
        if previous.references and self.separating_design.poses:
            plans[REFERENCE] = previous.plans[REFERENCE]
        return Tour(
            self._chain,
            plans,
            model=self.model,
            reference_every=previous.reference_every if REFERENCE in plans else 0,
            order=[(FITTED, *visit) for visit in self.separating_design.order],
            begin_at=previous.begin_at + previous.visited,
        )

    def verification(self) -> Tour:
        """Return a tour of new poses, each with the correction off and on in random order.

        The random order keeps drift out of the difference. The sensors are assumed at their rough
        positions; no registration is needed. One solution of each pose is visited. Raises
        InsufficientDataError if fewer than `VERIFIED_POSES` of `VERIFIED_CANDIDATES` candidates
        can be reached from one another.
        """
        rng = np.random.default_rng([self._seed, *b'verify'])
        plan = self.scene.plan(VERIFIED_CANDIDATES, self.scene.rough_R, rng)
        poses = [replace(p, solutions=rng.permutation(p.solutions)[:1]) for p in plan.poses]
        chosen = self._reachable(poses)
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
        """Return a tour through configurations q, rad or m, (n, k), in their order.

        Raises InputError, which names the first by its number from 1, if a configuration is in
        collision (clearance and `RESERVE_M`) or nearer to a joint limit than the scene's
        `limit_margin_rad`.
        """
        margin = self.scene.limit_margin_rad * self._chain.per_radian
        for number, (each, why) in enumerate(zip(q, self.model.reasons(q, RESERVE_M)), 1):
            if why or not self._chain.within_limits(each, -margin):
                raise InputError(
                    f'configuration {number} of the check: {why or "too near to a joint limit"}; '
                    'choose others (remaster plan --check)'
                )
        poses = tuple(PlannedPose(self._chain.forward(each), each[None]) for each in q)
        plans = {FITTED: Plan(()), HELD_OUT: Plan(poses)}
        return Tour(self._chain, plans, in_order=True, model=self.model)

    def _reachable(self, poses: list[PlannedPose]) -> list[PlannedPose]:
        """Return `VERIFIED_POSES` of the poses in an order with a path from each to the next.

        Fewer, down to none, if not enough can be reached. Each pose has one solution.
        """
        while True:
            q = np.array([pose.solutions[0] for pose in poses[:VERIFIED_POSES]])
            chosen = [poses[i] for i in self._nearest_order(q, list(range(len(q))))]
            unreachable = self._unreachable(chosen)
            if not unreachable:
                return chosen
            poses = [pose for pose in poses if all(pose is not each for each in unreachable)]

    def _references(self, plans: Mapping[str, Plan]) -> Plan:
        """Return a plan of references, chosen among the configurations of plans.

        In an order with a free path from each to the next; if `MOST_TRIES` choices have none,
        the last choice as it is.
        """
        poses = [
            PlannedPose(pose.T_R_T, q[None])
            for plan in plans.values()
            for pose in plan.poses
            for q in pose.solutions
        ]
        markers = {sight.sensor: (sight.marker, sight.marker_T) for sight in self.scene.sights}
        chosen: list[PlannedPose] = []
        for _ in range(MOST_TRIES):
            q = np.array([pose.solutions[0] for pose in poses])
            picked = choose_references(self._chain, q, markers).indices
            chosen = [poses[i] for i in self._nearest_order(q, list(picked))]
            unreachable = self._unreachable(chosen)
            if not unreachable:
                break
            poses = [pose for pose in poses if all(pose is not each for each in unreachable)]
        return Plan(tuple(chosen))

    def _nearest_order(self, q: FloatArray, indices: list[int]) -> list[int]:
        """Return indices of configurations in nearest-neighbour order, from the first one on.

        Nearest by travel time, see `order_solutions`. ``q``: configurations, (n, k);
        ``indices``: into q; [] gives [].
        """
        order = indices[:1]
        while remaining := [i for i in indices if i not in order]:
            limits = self._chain.velocity_limits
            order.append(remaining[int(order_solutions(q[remaining], q[order[-1]], limits)[0])])
        return order

    def _unreachable(self, poses: Sequence[PlannedPose]) -> list[PlannedPose]:
        """Return the poses to which there is no free path from the one before.

        The first one counts as coming after the last. Each pose has one solution.
        """
        limits = self._chain.velocity_limits
        return [
            pose
            for i, pose in enumerate(poses)
            if free_waypoints(self.model, poses[i - 1].solutions[0], pose.solutions[0], limits, i)
            is None
        ]

    def _plan(self, split: str, sensors_R: Mapping[str, FloatArray]) -> Plan:
        """Return the plan of a split from its candidates; the same arguments give the same plan.

        ``sensors_R``: position in R of each sensor that has to see its marker, m, (3,).
        """
        # Seeded by the split: the plan does not depend on what was planned before a restart.
        rng = np.random.default_rng([self._seed, *split.encode()])
        return self.scene.plan(self._counts[split], sensors_R, rng)
