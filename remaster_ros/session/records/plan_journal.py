# SPDX-License-Identifier: Apache-2.0
"""The plan of a collection on the disk: its tours, and the pose that is next.

``plan.jsonl`` in the session folder is a journal (see `journal`). The plan is in it before the
arm first moves, each pose before the arm is sent there; a planner that is started again resumes
the tour. Outcomes of configurations are in the session's journal alone.
"""

from __future__ import annotations

import os
import uuid
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from remaster_ros.calibration.estimate import FEWEST_POSES
from remaster_ros.collection.events import Decided
from remaster_ros.errors import DiskError, InputError, InsufficientDataError
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan
from remaster_ros.planning.collection_plan import Expected
from remaster_ros.planning.tour_order import FITTED, REFERENCE, REGISTRATION, PoseVisit, Tour
from remaster_ros.session.files import make_folder
from remaster_ros.session.records.journal import Journal, Record, read_journal
from remaster_ros.session.records.reader import PLAN
from remaster_ros.session.records.session_journal import read_outcomes
from remaster_ros.session.yaml_records import from_plain, to_plain
from remaster_ros.types import Session

Configuration = tuple[str, int, int]
"""Split, pose and solution, as in the plan."""
ENOUGH = 'enough is known'
"""Reason for dropped poses once the precision goal is reached."""


class PlanHeader(msgspec.Struct, tag_field='kind', tag='plan'):
    """First record of a plan's journal: the plan's identifier, and settings that it depends on."""

    id: str
    settings: dict[str, Any]


class TourRecord(msgspec.Struct, tag_field='kind', tag='tour'):
    """Record of a tour as planned: its poses with their solutions, and the order of visits."""

    plans: dict[str, Plan]
    in_order: bool
    one_solution: bool
    reference_every: int
    # Empty if the nearest pose is next.
    order: tuple[tuple[str, int, int], ...]
    # Above 0 for a tour after another one of the collection.
    begin_at: int

    def tour(self, chain: SerialChain, model: CollisionModel | None = None) -> Tour:
        """Return the tour at its beginning, with no pose visited.

        ``chain``: the arm; ``model``: arm with obstacles, None for none.
        """
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


class VisitRecord(msgspec.Struct, tag_field='kind', tag='stop'):
    """Record of a visit to a pose: its joint solutions, and those without a free path."""

    split: str
    index: int
    ids: tuple[int, ...]
    unreached: tuple[int, ...] = ()

    def replay(self, tour: Tour) -> PoseVisit:
        """Count this visit as made in ``tour``, in place, and return it.

        The visit has the joint solutions of the record, but no paths to them: these have to be
        planned anew.
        """
        return tour.record_visit(self.split, self.index, self.ids, (), self.unreached)


class RoundRecord(msgspec.Struct, tag_field='kind', tag='round'):
    """Record of a request for a round of visits to the reference configurations."""


class EnoughRecord(msgspec.Struct, tag_field='kind', tag='enough'):
    """Record that the precision goal is reached: no more poses to fit are visited."""


class ExpectationRecord(msgspec.Struct, tag_field='kind', tag='expected'):
    """Record of the expected precision of a fit of the tour, at the noise of the cell file."""

    joint_std_rad: dict[str, float | None]
    tool_rms_m: float


class StateRecord(msgspec.Struct, tag_field='kind', tag='state'):
    """Record of the planner's state and the token of its run."""

    state: str
    run: str = ''


PlanRecord = (
    PlanHeader
    | TourRecord
    | VisitRecord
    | RoundRecord
    | EnoughRecord
    | ExpectationRecord
    | StateRecord
)


def plan_page_path(session: Path) -> Path:
    """Return the path of the page that shows a session's plan, beside the session folder."""
    return session.absolute().with_name(f'{session.absolute().name}.plan.html')


@dataclass
class RecordedPlan:
    """A planned collection and its outcomes.

    Attributes
    ----------
    tour
        As planned.
    page
        Path of the plan's page, which exists if a person has to confirm it (`confirm: true`).
    expected
        Expected precision of the fit; None if unknown.
    outcomes
        Outcome of each configuration begun, references excepted: ``recorded``, ``partial``,
        ``rejected``, ``failed`` or ``no_free_path``.
    references
        Number of visits to references by outcome.
    enough
        Whether poses to fit were dropped because the precision goal was reached.
    """

    tour: Tour
    page: Path
    expected: ExpectationRecord | None = None
    outcomes: dict[Configuration, str] = field(default_factory=dict)
    references: Counter[str] = field(default_factory=Counter)
    enough: bool = False


def read_plan(folder: Path, chain: SerialChain) -> RecordedPlan | None:
    """Return the plan of a session's collection; None if it has none with poses to fit.

    ``folder``: the session's; ``chain``: its arm. Raises InputError if plan.jsonl or the
    session's journal is damaged, or the plan is of another version.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    plan: RecordedPlan | None = None
    try:
        outcomes = read_outcomes(folder)
        for record in from_plain(read_journal(path).records, list[PlanRecord]):
            match record:
                case TourRecord():
                    collection = REGISTRATION not in record.plans
                    tour = record.tour(chain)
                    plan = RecordedPlan(tour, plan_page_path(folder)) if collection else None
                case VisitRecord() if plan is not None:
                    _, ends = outcomes.poses.get(record.replay(plan.tour).pose, ('', {}))
                    if record.split == REFERENCE:
                        plan.references.update(ends.values())
                    else:
                        place = record.split, record.index
                        plan.outcomes |= {(*place, number): end for number, end in ends.items()}
                case ExpectationRecord() if plan is not None:
                    plan.expected = record
                case EnoughRecord() if plan is not None:
                    plan.enough = True
        return plan if plan is not None and plan.tour.plans[FITTED].poses else None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f'{path}: no plan of this version ({type(error).__name__}: {error}); '
            'move it out of the session folder to go without'
        ) from None


def refuse_unimported(session: Session, folder: str | os.PathLike[str]) -> None:
    """Raise InsufficientDataError if the rows to fit are still in the recording of the motion.

    They are if the arm of the session's plan is measured while it moves along curves, and the
    session itself has too few poses to fit. ``folder``: of the session.
    """
    fitted = session.measurements.pose[~session.measurements.is_validation]
    if session.is_moving or len(np.unique(fitted)) >= FEWEST_POSES:
        return
    folder = Path(folder)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    try:
        plan = read_plan(folder, chain)
    except InputError:
        return
    if plan is None or all(
        pose.way is None for part in plan.tour.plans.values() for pose in part.poses
    ):
        return
    recording, where = folder / 'bag', ''
    if not recording.is_dir():
        recording, where = Path('BAG'), f', and BAG a bag of it, as {recording} is not there'
    raise InsufficientDataError(
        f'{folder}: by its plan the arm is measured while it moves, so that the rows to fit are '
        f'in the recording of the motion. Import them: remaster import --moving {recording} '
        f'--cell CELL --proof {folder} --out NEW, where CELL is the cell file of the '
        f'collection{where}. Then use NEW as the session'
    )


class PlanJournal:
    """Journal of a planner: each method writes its record through to the disk before it returns.

    If the disk is full (`trouble`), records wait in memory until `write_out` succeeds.

    Parameters
    ----------
    folder
        The session's; the file is created with the first record.
    settings
        Settings that the plan depends on, plain data by name.
    chain
        The arm.
    model
        Obstacles, for the tour.

    Attributes
    ----------
    id
        Identifier of the plan; '' before there is one.
    tour
        The tour under way, in its present state; None before there is one.
    visit
        The last visit; None before the first.
    tours
        All tours of the collection so far; or that of the registration.
    decided
        Outcomes of this plan that the session's journal had at the beginning.
    state
        The planner's last state, '' before the first.
    run
        Token of the run under way, '' for none.
    lost
        What a crash has cut off, in one line; '' for nothing.
    trouble
        Why a record is not on the disk yet; '' if all are.

    Raises
    ------
    InputError
        If another planner uses the file, the plan was made with other settings, or the file is
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
        self.visit: PoseVisit | None = None
        self.tours: list[Tour] = []
        self.decided = Decided()
        if self.path.exists():
            outcomes = read_outcomes(folder)
            self._open()
            if outcomes.plan == self.id:
                self.decided = outcomes.decided()

    def _open(self) -> Journal:
        """Open the file, and restore the state from its records; begin a plan in an empty file.

        A last line cut off by a crash is dropped, and noted in `lost`. Raises InputError if
        another planner uses the file, or it is damaged, or of other settings.
        """
        self._journal = Journal(self.path)
        self.lost = self._journal.lost
        if not self._journal.records:
            self.id = uuid.uuid4().hex[:12]
            self._journal.append(to_plain(PlanHeader(self.id, self._settings)))
            return self._journal
        try:
            begun, *records = from_plain(self._journal.records, list[PlanRecord])
            if not isinstance(begun, PlanHeader):
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
        """Raise InputError, which names the first such setting, if one differs from the plan's.

        ``made``: settings that the plan was made with; one that is missing counts as
        different.
        """
        other = [name for name, value in self._settings.items() if made.get(name) != value]
        if other:
            name = other[0]
            was = '' if name == 'cell' else f' ({made.get(name)}, now {self._settings[name]})'
            raise InputError(
                f'{self.path}: the plan of this session was made with another {name}{was}; start '
                'with the same to go on, or name a new session folder'
            )

    def _follow(self, record: PlanRecord) -> None:
        """Update tour, visit, state and run by a record, of this planner or of one before it.

        Visits, requests of reference rounds, and dropped poses to fit change the tour in
        place; before there is a tour they are ignored.
        """
        tour = self.tour
        match record:
            case TourRecord():
                self.tour, self.visit = record.tour(self._chain, self._model), None
                self.tours = [*(each for each in self.tours if FITTED in each.plans), self.tour]
            case VisitRecord() if tour is not None:
                self.visit = record.replay(tour)
            case RoundRecord() if tour is not None:
                tour.request_reference_round()
            case EnoughRecord() if tour is not None:
                tour.drop_remaining(FITTED, ENOUGH)
            case StateRecord():
                self.state, self.run = record.state, record.run

    def _note(self, record: PlanRecord) -> None:
        """Write a record, or keep it until the disk has room, and update the state by it.

        The first one makes folder and file: DiskError if that fails, InputError as `_open`. Later
        a full disk shows in `trouble` alone.
        """
        if self._journal is None:
            make_folder(self.path.parent)
            self._journal = self._open()
        self._unwritten.append(to_plain(record))
        self.write_out()
        self._follow(record)

    def write_out(self) -> None:
        """Write the records that the disk has not taken yet; `trouble` is '' if all are.

        It does not raise DiskError: `trouble` is its text.
        """
        try:
            while self._unwritten and self._journal is not None:
                self._journal.append(self._unwritten[0])
                self._unwritten.popleft()
            self.trouble = ''
        except DiskError as error:
            self.trouble = str(error)

    def begin(self, tour: Tour, expected: Expected | None = None) -> None:
        """Begin a tour and note the state; ``expected``: expected precision of its fit."""
        how = tour.in_order, tour.one_solution, tour.reference_every, tour.order, tour.begin_at
        self._note(TourRecord(tour.plans, *how))
        if expected is not None:
            self._note(ExpectationRecord(dict(expected.joint_std), expected.tool_rms))
        # The state was set before there was a file for it.
        self._note(StateRecord(self.state, self.run))

    def request_reference_round(self) -> None:
        """Request a round of visits to the reference configurations, as the setup was changed.

        The request is recorded, and inserts the round in `tour`. Nothing happens without a
        tour or references.
        """
        if self.tour is not None and self.tour.references:
            self._note(RoundRecord())

    def drop_remaining_fits(self) -> None:
        """Record that the precision goal is reached: the tour drops the remaining poses to fit.

        Nothing happens without a tour.
        """
        if self.tour is not None:
            self._note(EnoughRecord())

    def open_visit(self, visit: PoseVisit) -> None:
        """Record a visit that the tour proposes as begun, before the arm is sent there.

        It becomes `visit`, in place of the one before.
        """
        self._note(VisitRecord(visit.split, visit.index, visit.ids, visit.unreached))

    def record_state(self, state: str, run: str = '') -> None:
        """Set `state` and `run` (token of the run, '' for none), and record them.

        They are recorded only if one has changed and there is a plan. On a full disk the record is
        kept for later, and `trouble` has the reason; DiskError is not raised.
        """
        before, (self.state, self.run) = (self.state, self.run), (state, run)
        if self._journal is not None and before != (state, run):
            self._note(StateRecord(state, run))

    def close(self) -> None:
        """Release the file for other planners; a second call does nothing."""
        if self._journal is not None:
            self._journal.close()
