# SPDX-License-Identifier: Apache-2.0
"""The plan that is next as a page, for a person to look at before the arm moves: `confirm: true`.

The page is drawn in a background thread as soon as the arm's position is known, and again when
another plan is next: after the registration, which the collection is planned from.
"""

from __future__ import annotations

from pathlib import Path

from remaster_ros.collection.peers import Peers, RequiredSensors
from remaster_ros.collection.plan_confirmation import PlanConfirmation, fingerprint
from remaster_ros.collection.tour_progress import PlanMemory, TourProgress
from remaster_ros.errors import InputError, RemasterError
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.nodes.background import Background, PlanningThread
from remaster_ros.planning.collection_plan import look_ahead
from remaster_ros.planning.tour_order import REGISTRATION, PoseVisit, Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.plan_journal import plan_page_path
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray


class PlanPreview(PlanConfirmation):
    """Draws the plan that is next beside the session's folder, until it is confirmed."""

    def __init__(
        self,
        cell: Workcell,
        tours: TourPlanner,
        memory: PlanMemory,
        progress: TourProgress,
        session: Path,
        background: Background,
    ) -> None:
        self.page = plan_page_path(session)
        super().__init__(cell.confirm, str(self.page))
        self._cell, self._tours = cell, tours
        self._memory, self._progress = memory, progress
        self._thread = PlanningThread(background, JointUnits.of(tours.model.chain))
        self._drawn: object = None

    def withdraw(self) -> None:
        """Have the page drawn anew before anything can be confirmed."""
        super().withdraw()
        self._drawn = None

    def values(self) -> dict[str, str]:
        """Return what people are shown of it."""
        if not self.required:
            return {}
        done = self.shown and self.shown == self.confirmed
        page = str(self.page) if self.shown else ''
        confirmed = 'yes' if done else 'no'
        return {'plan_page': page, 'plan_shown': self.shown, 'confirmed': confirmed}

    def asked(self) -> str:
        """Return the refusal of a person's request; what could not be shown is tried again."""
        refusal = self.refusal()
        if self.trouble:
            self.withdraw()
        return refusal

    def draw(self, q: FloatArray, peers: Peers) -> str:
        """Draw what is next, where the page has something else; return what a person is told.

        ``peers``: they tell which sensors must be registered before the collection.
        Returns '' while it is drawn, and where there is nothing new.
        """
        if not self.required:
            return ''
        try:
            what, tour = self._next(peers.required())
        except InputError as error:
            self.trouble = str(error)
            return ''
        if self.confirmed and what == self.confirmed:
            # Also where something else was drawn meanwhile.
            self.show(self.confirmed)
            self._drawn = what
        if what == self._drawn:
            return ''
        if self.shown:
            self.withdraw()
        T_R_N, stop = dict(self._progress.T_R_N), self._progress.open_pose
        # As it is now: the thread must not see it change.
        left = tour.fork() if tour is not None else None
        try:
            found = self._thread.ask(what, q, lambda: self._draw(what, left, stop, T_R_N, q))
            if found is None:
                return ''
            self.show(found[0])
        except RemasterError as error:
            self.trouble = str(error)
        self._drawn = what
        return self.refusal()

    def _next(self, required: RequiredSensors) -> tuple[str, Tour | None]:
        """Return what is next, as `TourProgress.next` has it, by a name of it; and its tour.

        That is the tour under way, by its fingerprint, or else one that is still to be planned.
        """
        T_R_N, tour = self._progress.T_R_N, self._memory.tour
        registered = self._progress.phase != REGISTRATION or required.are_among(T_R_N)
        if tour is not None and (REGISTRATION in tour.plans) != registered:
            return fingerprint(tour), tour
        if not registered:
            return REGISTRATION, None
        places = b''.join(name.encode() + T.tobytes() for name, T in sorted(T_R_N.items()))
        return f'collection {hash(places)}', None

    def _draw(
        self,
        what: str,
        tour: Tour | None,
        stop: PoseVisit | None,
        T_R_N: dict[str, FloatArray],
        q: FloatArray,
    ) -> str:
        """Write the page of what is next, and return the fingerprint of its tour."""
        # Only here: a planner without this page needs none of it.
        from remaster_ros.reports.plan_page import plan_page, write_plan_page
        from remaster_ros.reports.robot_scene import robot_scene

        planner, places = self._tours, T_R_N
        if tour is None:
            stop = None
            tour = planner.registration() if what == REGISTRATION else planner.collection(T_R_N)
        tours, registered = [tour], REGISTRATION not in tour.plans
        if not registered:
            # What is expected to follow; it is planned anew once the sensors are registered.
            tours.append(planner.collection(planner.rough_places))
        if not registered or not T_R_N:
            places = planner.rough_places
        plan = look_ahead(planner, places, tours, q, stop)
        name = fingerprint(tour)
        scene = robot_scene(self._cell, planner.scene).with_sensors(places)
        html = plan_page(
            plan, scene, Path(self._cell.file).stem, registered=registered, confirm=name
        )
        write_plan_page(self.page, html)
        return name
