# SPDX-License-Identifier: Apache-2.0
"""What a planner keeps on the disk: its plan, and which of its poses was next.

``plan.jsonl`` in the session folder is a journal (see `journal`). The plan is in it before the
arm first moves, each pose before the arm is sent there; a planner that is started again takes up
the tour where it was. What became of a configuration is in the session's journal alone.
"""

from __future__ import annotations

import uuid
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from remaster_ros.collection.events import Decided
from remaster_ros.errors import DiskError, InputError
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan
from remaster_ros.planning.collection_plan import Expected
from remaster_ros.planning.tour_order import FITTED, REFERENCE, REGISTRATION, PoseVisit, Tour
from remaster_ros.session.files import make_folder
from remaster_ros.session.journal import Journal, Record, read_journal
from remaster_ros.session.reader import PLAN
from remaster_ros.session.session_journal import read_outcomes
from remaster_ros.session.yaml_records import from_plain, to_plain


class PlanBegun(msgspec.Struct, tag_field='kind', tag='plan'):
    """The first record: the plan's name, and what it depends on."""

    id: str
    settings: dict[str, Any]


class TourNoted(msgspec.Struct, tag_field='kind', tag='tour'):
    """A tour, as planned."""

    plans: dict[str, Plan]
    in_order: bool
    one_solution: bool
    reference_every: int
    # Empty where the nearest pose is next.
    order: tuple[tuple[str, int, int], ...]
    # Above 0 behind another tour of the collection.
    begin_at: int

    def tour(self, chain: SerialChain, model: CollisionModel | None = None) -> Tour:
        """Return the tour of this arm, at its beginning; the model is what it must not hit."""
        return Tour(
            chain,
            self.plans,
            in_order=self.in_order,
            one_solution=self.one_solution,
            model=model,
            reference_every=self.reference_every,
            order=self.order,
            begin_at=self.begin_at,
        )


class StopNoted(msgspec.Struct, tag_field='kind', tag='stop'):
    """The next pose: which of its split, its solutions, and those that nothing leads to."""

    split: str
    index: int
    ids: tuple[int, ...]
    unreached: tuple[int, ...] = ()

    def take(self, tour: Tour) -> PoseVisit:
        """Go there in a tour; the ways to it are found anew from where the arm stands."""
        return tour.go_to(self.split, self.index, self.ids, (), self.unreached)


class RoundNoted(msgspec.Struct, tag_field='kind', tag='round'):
    """A round of the references is next, by request."""


class EnoughNoted(msgspec.Struct, tag_field='kind', tag='enough'):
    """Enough is known: no more poses to fit are visited."""


class ExpectationNoted(msgspec.Struct, tag_field='kind', tag='expected'):
    """What a fit of the tour before it is expected to state, at the noise of the cell file."""

    joint_std_rad: dict[str, float | None]
    tool_rms_m: float


class StateNoted(msgspec.Struct, tag_field='kind', tag='state'):
    """The planner's state, and the token of the run that it is in."""

    state: str
    run: str = ''


PlanRecord = (
    PlanBegun | TourNoted | StopNoted | RoundNoted | EnoughNoted | ExpectationNoted | StateNoted
)


def plan_page_path(session: Path) -> Path:
    """Return where the plan of a session is drawn for a person: beside its folder."""
    return session.absolute().with_name(f'{session.absolute().name}.plan.html')


Configuration = tuple[str, int, int]
"""Split, pose and solution, as in the plan."""


@dataclass
class RecordedPlan:
    """A planned collection and its end.

    Attributes
    ----------
    tour
        As planned.
    page
        Where the planner draws it where a person has to confirm it (`confirm: true`).
    expected
        What its fit was expected to state; None where that was not known.
    outcomes
        What became of each configuration that was begun, references not among them: ``recorded``,
        ``partial``, ``rejected``, ``failed`` or ``no_free_path``.
    references
        How many visits to references came to which end.
    enough
        Whether poses to fit were left out because enough was known.
    """

    tour: Tour
    page: Path
    expected: ExpectationNoted | None = None
    outcomes: dict[Configuration, str] = field(default_factory=dict)
    references: Counter[str] = field(default_factory=Counter)
    enough: bool = False


def read_plan(folder: Path, chain: SerialChain) -> RecordedPlan | None:
    """Return the plan of a session's collection; None where it has none.

    Parameters
    ----------
    folder
        The session's.
    chain
        Its arm.

    Raises
    ------
    InputError
        plan.jsonl or the session's journal is damaged, or it is no plan of this version.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    plan: RecordedPlan | None = None
    try:
        found = read_outcomes(folder)
        for record in from_plain(read_journal(path).records, list[PlanRecord]):
            match record:
                case TourNoted():
                    collection = REGISTRATION not in record.plans
                    tour = record.tour(chain)
                    plan = RecordedPlan(tour, plan_page_path(folder)) if collection else None
                case StopNoted() if plan is not None:
                    _, ends = found.poses.get(record.take(plan.tour).pose, ('', {}))
                    if record.split == REFERENCE:
                        plan.references.update(ends.values())
                    else:
                        place = record.split, record.index
                        plan.outcomes |= {(*place, number): end for number, end in ends.items()}
                case ExpectationNoted() if plan is not None:
                    plan.expected = record
                case EnoughNoted() if plan is not None:
                    plan.enough = True
        return plan if plan is not None and plan.tour.plans[FITTED].poses else None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f'{path}: no plan of this version ({type(error).__name__}: {error}); '
            'move it out of the session folder to go without'
        ) from None


ENOUGH = 'enough is known'
"""Why planned poses are not visited once the wanted precision is reached."""


class PlanJournal:
    """Keep the state of a planner; when a method returns, what it noted is on the disk.

    Unless the disk is full, which is in `trouble`: then it is kept until `write_out` succeeds.

    Parameters
    ----------
    folder
        The session's; the file is made with the first record.
    settings
        What the plan depends on, plain data by name.
    chain
        The arm.
    model
        What the arm must not hit on its way; handed on to the tour.

    Attributes
    ----------
    id
        Identifies this plan; '' before there is one.
    tour
        The tour under way, at the stop where it was; None where there is none.
    stop
        The last stop; None before the first.
    tours
        Those of the collection so far, with the one under way; or that for the registration.
    decided
        What the session's journal had of this plan at the beginning.
    state
        The planner's last state, '' before the first.
    run
        The token of the run that it was in, '' where none was under way.
    lost
        What a crash has cut off, in a line; '' where nothing was.
    trouble
        Why something is not on the disk yet; '' where everything is.

    Raises
    ------
    InputError
        Another planner is running there, the plan was made with other settings, or the file is
        damaged.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        chain: SerialChain,
        model: CollisionModel | None = None,
    ) -> None:
        self.path = folder / PLAN
        self._settings, self._chain, self._model = dict(settings), chain, model
        self._journal: Journal | None = None
        self.id = self.state = self.run = self.lost = self.trouble = ''
        self._unwritten: deque[Record] = deque()
        self.tour: Tour | None = None
        self.stop: PoseVisit | None = None
        self.tours: list[Tour] = []
        self.decided = Decided()
        if self.path.exists():
            outcomes = read_outcomes(folder)
            self._open()
            if outcomes.plan == self.id:
                self.decided = outcomes.decided()

    def _open(self) -> Journal:
        self._journal = Journal(self.path)
        self.lost = self._journal.lost
        if not self._journal.records:
            self.id = uuid.uuid4().hex[:12]
            self._journal.append(to_plain(PlanBegun(self.id, self._settings)))
            return self._journal
        try:
            begun, *records = from_plain(self._journal.records, list[PlanRecord])
            if not isinstance(begun, PlanBegun):
                raise ValueError('it does not begin with a plan')
            self.id = begun.id
            self._refuse_other_settings(begun.settings)
            for record in records:
                self._follow(record)
        except BaseException as error:
            self._journal.close()
            if isinstance(error, (KeyError, IndexError, TypeError, ValueError)):
                raise InputError(
                    f'{self.path}: no plan of this version ({type(error).__name__}: {error}); '
                    'name a new session folder'
                ) from None
            raise
        return self._journal

    def _refuse_other_settings(self, made: Mapping[str, Any]) -> None:
        other = [name for name, value in self._settings.items() if made.get(name) != value]
        if other:
            name = other[0]
            was = '' if name == 'cell' else f' ({made.get(name)}, now {self._settings[name]})'
            raise InputError(
                f'{self.path}: the plan of this session was made with another {name}{was}; start '
                'with the same to go on, or name a new session folder'
            )

    def _follow(self, record: PlanRecord) -> None:
        """Go on by a record, new or of a planner before this one: both lead to the same state."""
        tour = self.tour
        match record:
            case TourNoted():
                self.tour, self.stop = record.tour(self._chain, self._model), None
                self.tours = [*(one for one in self.tours if FITTED in one.plans), self.tour]
            case StopNoted() if tour is not None:
                self.stop = record.take(tour)
            case RoundNoted() if tour is not None:
                tour.ask_round()
            case EnoughNoted() if tour is not None:
                tour.leave_out(FITTED, ENOUGH)
            case StateNoted():
                self.state, self.run = record.state, record.run

    def _note(self, record: PlanRecord) -> None:
        if self._journal is None:
            make_folder(self.path.parent)
            self._journal = self._open()
        self._unwritten.append(to_plain(record))
        self.write_out()
        self._follow(record)

    def write_out(self) -> None:
        """Write what the disk has not taken yet; `trouble` has why it still does not."""
        try:
            while self._unwritten and self._journal is not None:
                self._journal.append(self._unwritten[0])
                self._unwritten.popleft()
            self.trouble = ''
        except DiskError as error:
            self.trouble = str(error)

    def begin(self, tour: Tour, expected: Expected | None = None) -> None:
        """Note a new tour, and what its fit is expected to state where that is known."""
        how = tour.in_order, tour.one_solution, tour.reference_every, tour.order, tour.begin_at
        self._note(TourNoted(tour.plans, *how))
        if expected is not None:
            self._note(ExpectationNoted(dict(expected.joint_std), expected.tool_rms))
        # As it was set before there was a file to keep it in.
        self._note(StateNoted(self.state, self.run))

    def ask_round(self) -> None:
        """Visit the references next, since a person has changed something; note that."""
        if self.tour is not None and self.tour.references:
            self._note(RoundNoted())

    def leave_rest(self) -> None:
        """Visit no more poses to fit, since enough is known; note that."""
        if self.tour is not None:
            self._note(EnoughNoted())

    def open_stop(self, stop: PoseVisit) -> None:
        """Go to a stop that the tour proposes, and note it, before the arm is sent there."""
        self._note(StopNoted(stop.split, stop.index, stop.ids, stop.unreached))

    def say_state(self, state: str, run: str = '') -> None:
        """Note the planner's state and run, once there is a plan."""
        before, (self.state, self.run) = (self.state, self.run), (state, run)
        if self._journal is not None and before != (state, run):
            self._note(StateNoted(state, run))

    def close(self) -> None:
        """Let others go on with the plan."""
        if self._journal is not None:
            self._journal.close()
