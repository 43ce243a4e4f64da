# SPDX-License-Identifier: Apache-2.0
"""The next visit of a collection: registration first, then the collection itself."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol, TypeVar

from remaster_ros.collection.events import Decided, PlannerState, RecorderState
from remaster_ros.collection.peers import RequiredSensors
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.planning.collection_plan import Expected, expected_collection
from remaster_ros.planning.tour_order import FITTED, REFERENCE, REGISTRATION, PoseVisit, Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.types import FloatArray

Result = TypeVar('Result')


class PlanMemory(Protocol):
    """State of a plan that outlives the planner; see `session.plan_journal.PlanJournal`."""

    id: str
    tour: Tour | None
    visit: PoseVisit | None
    trouble: str
    tours: list[Tour]
    decided: Decided

    def begin(self, tour: Tour, expected: Expected | None = None) -> None:
        """Record a tour as begun: `tour` is then a copy with no pose visited, and `visit` is None.

        ``expected``: expected precision of its fit; None if it is not known.
        """

    def open_visit(self, visit: PoseVisit) -> None:
        """Begin a visit, which becomes `visit`, and is kept before the arm moves."""

    def drop_remaining_fits(self) -> None:
        """Record that the remaining poses to fit are dropped."""


class Planning(Protocol):
    """Runs one job at a time in the background; see `nodes.background`."""

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return the result of a job in a tuple; None while it runs.

        Raises what the job raised. ``what``: identifier of the job, equal whenever the same one is
        asked for; ``q``: configuration of the arm, rad or m, (k,).
        """


class TourProgress:
    """Progress of a collection from visit to visit.

    Parameters
    ----------
    memory
        The plan and the visit under way.
    tours
        Plans the tours.
    planning
        Runs that in the background.

    Attributes
    ----------
    phase
        ``registration`` or ``collection``.
    decided
        Outcomes of configurations, from the recorder.
    resumed
        Whether a planner before this one has visited poses.
    T_R_N
        The registrations so far: sensor -> (4, 4).
    is_complete
        Whether all of the tour was visited.
    enough
        Whether the precision goal is reached: then only poses to validate and references are
        visited.
    standing
        Why the next visit cannot be planned from the arm's configuration; ''.
    additions
        Plans measurements after the complete collection; None for none.
    inspection
        Plans an inspection in place of registration and collection; None for none.
    """

    def __init__(self, memory: PlanMemory, tours: TourPlanner, planning: Planning) -> None:
        self._memory, self._tours, self._planning = memory, tours, planning
        tour, self.decided = memory.tour, memory.decided
        self.resumed = tour is not None and tour.visited > 0
        collecting = tour is not None and REGISTRATION not in tour.plans
        self.phase = 'collection' if collecting else REGISTRATION
        self.T_R_N: dict[str, FloatArray] = {}
        # Reported by the recorder; the transforms come on another topic.
        self._registered = False
        self.is_complete = False
        self.enough = False
        self.standing = ''
        self.additions: Callable[[dict[str, FloatArray]], Tour] | None = None
        self.inspection: Callable[[], Tour] | None = None

    def describe(self) -> str:
        """Return as text how many poses are begun and configurations done."""
        tour = self._memory.tour
        poses = f'{tour.poses_begun} of {sum(tour.poses.values())}' if tour else 'none'
        done = sum(self.decided.outcomes.values())
        return f'{poses} {self.phase} poses begun, {done} configurations done'

    def follow(self, recorder: RecorderState) -> bool:
        """Update outcomes from the recorder; return whether any is new.

        Outcomes of another plan than `memory.id` are ignored.
        """
        previous, self._registered = self.decided, recorder.registered
        if recorder.plan == self._memory.id:
            self.decided = recorder.decided
        return self.decided != previous

    def check_session(self, recorder: RecorderState, path: object) -> None:
        """Raise InputError if the recorder's session has observations of another plan.

        ``path``: of this plan, for the message.
        """
        if recorder.plan not in ('', self._memory.id) and recorder.observations:
            raise InputError(
                f'the session {recorder.session} holds observations of another plan than '
                f'{path}; give the planner the same session folder as the recorder, '
                'or begin a new session'
            )

    @property
    def open_pose(self) -> PoseVisit | None:
        """Last visit, with its solutions that have no outcome yet; None if there are none.

        Its paths are not planned: see `rest`.
        """
        tour, visit = self._memory.tour, self._memory.visit
        if tour is None or visit is None:
            return None
        done = self.decided.solutions if self.decided.pose == visit.pose else ()
        remaining = [number for number in (*visit.ids, *visit.unreached) if number not in done]
        return tour.with_route(visit, remaining) if remaining else None

    def rest(self, q: FloatArray) -> PoseVisit | None:
        """Return the remaining visit with paths from q, (k,); None while it is planned.

        q: rad or m. There must be an `open_pose`.
        """
        tour, visit = self._memory.tour, self.open_pose
        assert tour is not None
        assert visit is not None
        self.standing = ''
        what = (tour, visit.split, visit.pose, visit.ids)
        result = self._planning.ask(what, q, lambda: tour.reroute(visit, q))
        return result[0] if result else None

    def next(self, q: FloatArray, sensors: RequiredSensors, words: str) -> PoseVisit | None:
        """Begin the next visit and return it; None while there is none to begin.

        None while it is planned, while the arm cannot go on (`standing` has the reason), in
        the one call that drops the remaining poses to fit (as `enough` is set), while
        registrations that the recorder reports have not arrived, and at the end
        (`is_complete`).

        ``q``: configuration of the arm, rad, (k,); ``sensors``: must be registered before the
        collection; ``words``: state of the registration, for the message. Raises
        InsufficientDataError if there is no registration after all its poses, or no pose is
        left to fit.
        """
        self.standing = ''
        if self.inspection is not None:
            result = self._planning.ask('inspection', q, self.inspection)
            if result is None:
                return None
            self.phase, self.inspection = 'collection', None
            self._memory.begin(result[0])
        if self.phase == REGISTRATION and not sensors.are_among(self.T_R_N):
            return self._next_registration(q, sensors.names, words)
        self.phase = 'collection'
        if (plan_additions := self.additions) is not None:
            self.is_complete = False
            if not sensors.are_among(self.T_R_N):
                self.standing = 'waiting for the registrations of the recorder'
                return None
            T_R_N = dict(self.T_R_N)
            result = self._planning.ask('additions', q, lambda: plan_additions(T_R_N))
            if result is None:
                return None
            self.additions = None
            self._memory.begin(result[0])
        elif self._memory.tour is None or REGISTRATION in self._memory.tour.plans:
            T_R_N = dict(self.T_R_N)
            planned = self._planning.ask(
                'plan', q, lambda: expected_collection(self._tours, T_R_N)
            )
            if planned is None:
                return None
            self._memory.begin(*planned[0])
        opened = self._open(q)
        self.is_complete = opened == (None,)
        return opened[0] if opened else None

    def _next_registration(
        self, q: FloatArray, sensors: Collection[str], words: str
    ) -> PoseVisit | None:
        """Begin the next visit of the registration; None while planned, and once registered.

        ``q``: where the arm is, rad or m, (k,); ``sensors``: those to be registered; ``words``:
        state of the registration, for the error.

        Raises InsufficientDataError if all poses were visited without a registration.
        """
        if self._registered:
            return None
        if self._memory.tour is None:
            planned = self._planning.ask('register', q, self._tours.registration)
            if planned is None:
                return None
            self._memory.begin(planned[0])
        result = self._open(q)
        if result == (None,):
            missing = ', '.join(name for name in sensors if name not in self.T_R_N)
            visited = self._memory.tour.visited if self._memory.tour else 0
            raise InsufficientDataError(
                f'no registration of {missing} after {visited} poses ({words}); the recorder '
                'counts why readings were rejected'
            )
        return result[0] if result else None

    def _open(self, q: FloatArray) -> tuple[PoseVisit | None] | None:
        """Begin the next visit; return it in a tuple, (None,) at the end, None while planned.

        None also if the arm stands too near to something (`standing` says so), and once `enough`
        has dropped the remaining poses to fit.
        """
        tour = self._memory.tour
        assert tour is not None
        standing = self._tours.model.trouble(q)
        if standing:
            # The bridge halts such an arm and offers an escape path to another configuration.
            self.standing = f'the arm stands too near to something: {standing}'
            return None
        what = (tour, tour.visited, tour.has_unvisited(FITTED))
        result = self._planning.ask(what, q, lambda: tour.propose(q))
        if result is None or result[0] is None:
            return result
        if self.enough and tour.has_unvisited(FITTED) and not tour.begin_at:
            # Nothing is being planned now; the proposed visit may be one of the dropped ones.
            self._memory.drop_remaining_fits()
            return None
        self._memory.open_visit(result[0])
        return result

    @property
    def planned(self) -> int:
        """Number of configurations to fit as planned, without later additions; 0 before a plan."""
        return sum(tour.to_fit for tour in self._memory.tours if not tour.begin_at)

    @property
    def planned_any(self) -> bool:
        """Whether the present tour has configurations; False without a tour.

        A tour to separate two causes has none if no configuration can separate them.
        """
        tour = self._memory.tour
        return tour is not None and any(tour.configurations.values())

    @property
    def measures_additions(self) -> bool:
        """Whether measurements after the complete collection are planned or under way."""
        tour = self._memory.tour
        return self.additions is not None or (tour is not None and tour.begin_at > 0)

    def is_last_reference(self, visit: PoseVisit) -> bool:
        """Whether a visit is to the last reference of its round."""
        tour = self._memory.tour
        return tour is not None and visit.split == REFERENCE and visit.index == tour.references - 1

    def state(self, state: str, run: str) -> PlannerState:
        """Return the state message for the other nodes.

        ``state``: the planner's state, as in `PlannerState`; ``run``: token of its run, '' for
        none.
        """
        further = self._memory.id if self.measures_additions else ''
        return PlannerState(state=state, run=run, planned=self.planned, further=further)

    def counts(self) -> dict[str, Any]:
        """Return phase and numbers of poses and configurations, by the names that the status has.

        Sums over all tours of the session; outcomes and dropped ones with a prefix.
        """
        tour, outcomes = self._memory.tour, self.decided.outcomes
        tours = self._memory.tours
        values: dict[str, Any] = {
            'phase': self.phase,
            'poses_done': sum(each.poses_begun for each in tours),
            'poses': sum(sum(each.poses.values()) for each in tours),
            'configurations_done': sum(outcomes.values()),
            'configurations': sum(sum(each.configurations.values()) for each in tours),
            'references': tour.references if tour else 0,
        }
        tables: dict[str, Mapping[str, int]] = {'outcome': outcomes}
        if tour is not None and self.phase != REGISTRATION:
            tables |= {'dropped': tour.dropped, 'dropped_solutions': tour.dropped_solutions}
        for table, counts in tables.items():
            values |= {f'{table}_{name}': count for name, count in sorted(counts.items())}
        return values
