# SPDX-License-Identifier: Apache-2.0
"""The next plan as a page, which a person confirms before the arm moves: `confirm: true`.

The page is drawn in a background thread as soon as the arm's configuration is known, and again
when another plan is next: after the registration, which the collection is planned from.
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
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.session.records.plan_journal import plan_page_path
from remaster_ros.types import FloatArray


class PlanPreview(PlanConfirmation):
    """Page of the next plan, beside the session's folder, until the plan is confirmed."""

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
        self._drawn_id: object = None

    def withdraw(self) -> None:
        """Mark the page as outdated, so that it is drawn again before a confirmation."""
        super().withdraw()
        self._drawn_id = None

    def values(self) -> dict[str, str]:
        """Return the values for the status: page, plan shown, confirmed (yes or no).

        {} if no confirmation is required.
        """
        if not self.required:
            return {}
        done = self.shown and self.shown == self.confirmed
        page = str(self.page) if self.shown else ''
        confirmed = 'yes' if done else 'no'
        return {'plan_page': page, 'plan_shown': self.shown, 'confirmed': confirmed}

    def collect_refusal(self) -> str:
        """Return why /remaster/collect is refused, '' if it is not; see `refusal`.

        If the page could not be drawn, it is drawn again.
        """
        refusal = self.refusal()
        if self.trouble:
            self.withdraw()
        return refusal

    def draw(self, q: FloatArray, peers: Peers) -> str:
        """Draw the page of the next plan if it shows another one; return a message for the user.

        The page is drawn in the background, so that this is called again and again. The
        message, once the page is drawn, is `refusal`: what to confirm, or why planning or
        drawing failed. '' while the page is drawn, if nothing has changed, if no confirmation
        is required, and if the next plan is not known yet; `trouble` has the reason then.
        ``q``: the arm's configuration, rad or m, (k,); ``peers``: the other nodes; they tell
        which sensors must be registered first.
        """
        if not self.required:
            return ''
        try:
            plan_id, tour = self._next(peers.required())
        except InputError as error:
            self.trouble = str(error)
            return ''
        if self.confirmed and plan_id == self.confirmed:
            # Another plan may have been drawn meanwhile.
            self.show(self.confirmed)
            self._drawn_id = plan_id
        if plan_id == self._drawn_id:
            return ''
        if self.shown:
            self.withdraw()
        T_R_N, visit = dict(self._progress.T_R_N), self._progress.open_pose
        # A copy, since the thread must not see the tour change.
        remaining = tour.fork() if tour is not None else None
        try:
            result = self._thread.ask(
                plan_id, q, lambda: self._draw(plan_id, remaining, visit, T_R_N, q)
            )
            if result is None:
                return ''
            self.show(result[0])
        except RemasterError as error:
            self.trouble = str(error)
        self._drawn_id = plan_id
        return self.refusal()

    def _next(self, required: RequiredSensors) -> tuple[str, Tour | None]:
        """Return identifier and tour of the plan that `TourProgress.next` would visit next.

        The tour is None if it is not planned yet; the identifier is then `REGISTRATION`, or
        ``collection`` with a hash of the registrations, else the tour's fingerprint.
        ``required``: sensors that must be registered before the collection.
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
        plan_id: str,
        tour: Tour | None,
        visit: PoseVisit | None,
        T_R_N: dict[str, FloatArray],
        q: FloatArray,
    ) -> str:
        """Write the page of `tour`, planned here if None; return the fingerprint of the tour.

        In the background thread. ``visit``: the open one, at which a tour goes on; ``T_R_N``:
        registrations, sensor -> (4, 4); before them the sensors' rough places are shown; ``q``:
        where the arm is. Raises RemasterError if it cannot be planned or written.
        """
        # Imported when needed: most planners draw no page.
        from remaster_ros.reports.plan_page import plan_page, write_plan_page
        from remaster_ros.reports.robot_scene import robot_scene

        planner, places = self._tours, T_R_N
        if tour is None:
            visit = None
            tour = planner.registration() if plan_id == REGISTRATION else planner.collection(T_R_N)
        tours, registered = [tour], REGISTRATION not in tour.plans
        if not registered:
            # A forecast of the collection, which is planned again after the registration.
            tours.append(planner.collection(planner.rough_places))
        if not registered or not T_R_N:
            places = planner.rough_places
        plan = look_ahead(planner, places, tours, q, visit)
        name = fingerprint(tour)
        scene = robot_scene(self._cell, planner.scene).with_sensors(places)
        html = plan_page(
            plan, scene, Path(self._cell.file).stem, registered=registered, confirm=name
        )
        write_plan_page(self.page, html)
        return name
