# SPDX-License-Identifier: Apache-2.0
"""Which pose is next, and with which of its solutions: registration first, then the collection."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol, TypeVar

from remaster_ros.collection.events import Decided, PlannerState, RecorderState
from remaster_ros.collection.peers import RequiredSensors
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.planning.collection_plan import Expected, with_expected
from remaster_ros.planning.tour_order import FITTED, REFERENCE, REGISTRATION, PoseVisit, Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.types import FloatArray

Result = TypeVar('Result')


class PlanMemory(Protocol):
    """What of a plan outlives the planner; see `session.plan_journal.PlanJournal`."""

    id: str
    tour: Tour | None
    stop: PoseVisit | None
    trouble: str
    tours: list[Tour]
    decided: Decided

    def begin(self, tour: Tour, expected: Expected | None = None) -> None:
        """Remember a new tour, and what its fit is expected to state where that is known."""

    def open_stop(self, stop: PoseVisit) -> None:
        """Go to the next stop, and remember it."""

    def leave_rest(self) -> None:
        """Remember that no more poses to fit are visited."""


class Planning(Protocol):
    """Does one thing at a time beside the callbacks; see `nodes.background`."""

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return what a job found, in a tuple; None while it works."""


class TourProgress:
    """Go from pose to pose.

    Parameters
    ----------
    memory
        The plan and the open pose.
    tours
        Plans the tours.
    planning
        Where that is done, as it takes a while.

    Attributes
    ----------
    phase
        ``registration`` or ``collection``.
    decided
        What became of configurations, as the recorder has it.
    resumed
        Whether poses were visited by a planner before this one.
    T_R_N
        The registrations so far: sensor -> (4, 4).
    is_complete
        Whether all of the tour was visited.
    enough
        Whether enough is known: from then on only what is held out, and references, are visited.
    standing
        Why the next pose cannot be planned from where the arm stands; ''.
    further
        Plans what is measured further, once the collection is complete; None for nothing.
    judging
        Plans, in place of registration and collection, poses by which an arm is judged; None for
        nothing.
    """

    def __init__(self, memory: PlanMemory, tours: TourPlanner, planning: Planning) -> None:
        self._memory, self._tours, self._planning = memory, tours, planning
        tour, self.decided = memory.tour, memory.decided
        self.resumed = tour is not None and tour.visited > 0
        collecting = tour is not None and REGISTRATION not in tour.plans
        self.phase = 'collection' if collecting else REGISTRATION
        self.T_R_N: dict[str, FloatArray] = {}
        # What the recorder has reported; its transforms come on a topic of their own.
        self._registered = False
        self.is_complete = False
        self.enough = False
        self.standing = ''
        self.further: Callable[[dict[str, FloatArray]], Tour] | None = None
        self.judging: Callable[[], Tour] | None = None

    def describe(self) -> str:
        """Return how far the collection is, as text."""
        tour = self._memory.tour
        poses = f'{tour.poses_begun} of {sum(tour.poses.values())}' if tour else 'none'
        done = sum(self.decided.outcomes.values())
        return f'{poses} {self.phase} poses begun, {done} configurations done'

    def follow(self, recorder: RecorderState) -> bool:
        """Take what became of configurations; return whether that is new."""
        before, self._registered = self.decided, recorder.registered
        if recorder.plan == self._memory.id:
            self.decided = recorder.decided
        return self.decided != before

    # What is next

    def check_session(self, recorder: RecorderState, path: object) -> None:
        """Refuse to add another plan's poses to a session.

        Raises
        ------
        InputError
            The recorder's session holds observations of another plan than the one in `path`.
        """
        if recorder.plan not in ('', self._memory.id) and recorder.observations:
            raise InputError(
                f'the session {recorder.session} holds observations of another plan than '
                f'{path}; give the planner the same session folder as the recorder, '
                'or begin a new session'
            )

    @property
    def open_pose(self) -> PoseVisit | None:
        """The last pose with those of its solutions that have no outcome; None without any."""
        tour, stop = self._memory.tour, self._memory.stop
        if tour is None or stop is None:
            return None
        done = self.decided.solutions if self.decided.pose == stop.pose else ()
        left = [number for number in (*stop.ids, *stop.unreached) if number not in done]
        return tour.along(stop, left) if left else None

    def rest(self, q: FloatArray) -> PoseVisit | None:
        """Return what is left of the open pose, by ways that begin at `q`; None while planned.

        Parameters
        ----------
        q
            Where the arm stands, rad, (k,).
        """
        tour, stop = self._memory.tour, self.open_pose
        assert tour is not None
        assert stop is not None
        self.standing = ''
        what = (tour, stop.split, stop.pose, stop.ids)
        found = self._planning.ask(what, q, lambda: tour.reroute(stop, q))
        return found[0] if found else None

    def next(self, q: FloatArray, sensors: RequiredSensors, words: str) -> PoseVisit | None:
        """Open the next pose and return it; None while it is planned, and at the end.

        Parameters
        ----------
        q
            Where the arm stands, rad, (k,).
        sensors
            Those that must be registered before the collection.
        words
            How far the recorder's registration is, for the error.

        Raises
        ------
        InsufficientDataError
            No registration after all poses for it, or no pose is left to fit on.
        """
        self.standing = ''
        if self.judging is not None:
            judged = self._planning.ask('judging', q, self.judging)
            if judged is None:
                return None
            self.phase, self.judging = 'collection', None
            self._memory.begin(judged[0])
        if self.phase == REGISTRATION and not sensors.are_among(self.T_R_N):
            return self._next_registration(q, sensors.names, words)
        self.phase = 'collection'
        if (plan_further := self.further) is not None:
            self.is_complete = False
            if not sensors.are_among(self.T_R_N):
                self.standing = 'waiting for the registrations of the recorder'
                return None
            T_R_N = dict(self.T_R_N)
            behind = self._planning.ask('further', q, lambda: plan_further(T_R_N))
            if behind is None:
                return None
            self.further = None
            self._memory.begin(behind[0])
        elif self._memory.tour is None or REGISTRATION in self._memory.tour.plans:
            T_R_N = dict(self.T_R_N)
            planned = self._planning.ask('plan', q, lambda: with_expected(self._tours, T_R_N))
            if planned is None:
                return None
            self._memory.begin(*planned[0])
        found = self._open(q)
        self.is_complete = found == (None,)
        return found[0] if found else None

    def _next_registration(
        self, q: FloatArray, sensors: Collection[str], words: str
    ) -> PoseVisit | None:
        if self._registered:
            return None
        if self._memory.tour is None:
            planned = self._planning.ask('register', q, self._tours.registration)
            if planned is None:
                return None
            self._memory.begin(planned[0])
        found = self._open(q)
        if found == (None,):
            missing = ', '.join(name for name in sensors if name not in self.T_R_N)
            visited = self._memory.tour.visited if self._memory.tour else 0
            raise InsufficientDataError(
                f'no registration of {missing} after {visited} poses ({words}); the recorder '
                'counts why readings were rejected'
            )
        return found[0] if found else None

    def _open(self, q: FloatArray) -> tuple[PoseVisit | None] | None:
        """Open the next stop, in a tuple; None in it at the end; None while it is planned."""
        tour = self._memory.tour
        assert tour is not None
        standing = self._tours.model.trouble(q)
        if standing:
            # The bridge halts such an arm and offers a way out; after it the arm is elsewhere.
            self.standing = f'the arm stands too near to something: {standing}'
            return None
        what = (tour, tour.visited, tour.has_left(FITTED))
        found = self._planning.ask(what, q, lambda: tour.propose(q))
        if found is None or found[0] is None:
            return found
        if self.enough and tour.has_left(FITTED) and not tour.begin_at:
            # Here, as nothing is being planned; what was proposed may be one of them.
            self._memory.leave_rest()
            return None
        self._memory.open_stop(found[0])
        return found

    @property
    def planned(self) -> int:
        """How many configurations to fit the collection was planned with; 0 before it is.

        What is measured further is not among them.
        """
        return sum(tour.to_fit for tour in self._memory.tours if not tour.begin_at)

    @property
    def planned_any(self) -> bool:
        """Whether the tour has a configuration at all; nothing may separate two causes."""
        tour = self._memory.tour
        return tour is not None and any(tour.configurations.values())

    @property
    def goes_further(self) -> bool:
        """Whether something is, or will be, measured behind a complete collection."""
        tour = self._memory.tour
        return self.further is not None or (tour is not None and tour.begin_at > 0)

    def is_last_reference(self, stop: PoseVisit) -> bool:
        """Whether a stop is the last reference of its round."""
        tour = self._memory.tour
        return tour is not None and stop.split == REFERENCE and stop.index == tour.references - 1

    def state(self, state: str, run: str) -> PlannerState:
        """Return what the other nodes act on: of the planner in this state and run."""
        further = self._memory.id if self.goes_further else ''
        return PlannerState(state=state, run=run, planned=self.planned, further=further)

    def counts(self) -> dict[str, Any]:
        """Return figures of the tour for people."""
        tour, outcomes = self._memory.tour, self.decided.outcomes
        tours = self._memory.tours
        values: dict[str, Any] = {
            'phase': self.phase,
            'poses_done': sum(one.poses_begun for one in tours),
            'poses': sum(sum(one.poses.values()) for one in tours),
            'configurations_done': sum(outcomes.values()),
            'configurations': sum(sum(one.configurations.values()) for one in tours),
            'references': tour.references if tour else 0,
        }
        tables: dict[str, Mapping[str, int]] = {'outcome': outcomes}
        if tour is not None and self.phase != REGISTRATION:
            tables |= {'dropped': tour.dropped, 'dropped_solutions': tour.dropped_solutions}
        for table, counts in tables.items():
            values |= {f'{table}_{name}': count for name, count in sorted(counts.items())}
        return values
