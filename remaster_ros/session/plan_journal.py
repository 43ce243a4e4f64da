"""The planner's memory: what is planned, which pose is open, what became of each configuration.

``plan.jsonl`` in the session folder is a journal (see `journal`). The plan is in it before the
arm first moves, each pose before the arm is sent there; a planner that is started again takes up
the tour where it was.
"""

from __future__ import annotations

import uuid
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.errors import DiskError, InputError
from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan, PlannedPose
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION, PoseVisit, Tour
from remaster_ros.session.files import make_folder
from remaster_ros.session.journal import Journal, Record
from remaster_ros.session.session_opening import PLAN
from remaster_ros.types import FloatArray

NO_FREE_PATH = 'no_free_path'
"""Outcome of a configuration that the arm cannot get to without hitting something."""


class PlanJournal:
    """Keep what a planner must not forget; what a method returned from is on the disk.

    Unless `trouble` says that the disk is full: then it is kept until `write_out` succeeds.

    Parameters
    ----------
    folder
        The session's; the file is made when there is something to remember.
    settings
        What the plan depends on, plain data by name.
    chain
        The arm.
    model
        What the arm must not hit on its way; handed on to the tour.

    Attributes
    ----------
    id
        Tells this plan from others; '' before there is one.
    tour
        The tour under way, at the stop where it was; None where there is none.
    stop
        The last stop with the solutions that still have no outcome; None before the first.
    outcomes
        How many configurations of the collection came to which end, references not counted.
    references
        The same for visits to the references.
    state
        What the planner last said it does, '' before.
    run
        The token of the run in which it said so, '' where none was under way.
    lost
        What a crash has cut off, in words; '' where nothing was.
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
        self.outcomes: Counter[str] = Counter()
        self.references: Counter[str] = Counter()
        if self.path.exists():
            self._open()

    def _open(self) -> Journal:
        self._journal = Journal(self.path)
        self.lost = self._journal.lost
        if not self._journal.records:
            self.id = uuid.uuid4().hex[:12]
            self._journal.append({'kind': 'plan', 'id': self.id, 'settings': self._settings})
            return self._journal
        try:
            self._check(self._journal.records[0])
            for record in self._journal.records[1:]:
                self._replay(record)
        except BaseException as error:
            self._journal.close()
            if isinstance(error, (KeyError, IndexError, TypeError, ValueError)):
                raise InputError(
                    f'{self.path}: no plan of this version ({type(error).__name__}: {error}); '
                    'name a new session folder'
                ) from None
            raise
        return self._journal

    def _check(self, record: Record) -> None:
        self.id = record['id']
        made = record['settings']
        # Plans of older versions have no references, and go on without them.
        here = {k: v for k, v in self._settings.items() if k != 'reference_every' or k in made}
        other = [name for name, value in here.items() if made.get(name) != value]
        if other:
            name = other[0]
            was = '' if name == 'cell' else f' ({made.get(name)}, now {self._settings[name]})'
            raise InputError(
                f'{self.path}: the plan of this session was made with another {name}{was}; start '
                'with the same to go on, or name a new session folder'
            )

    def _replay(self, record: Record) -> None:
        kind = record['kind']
        if kind == 'tour':
            plans = {split: _plan(content) for split, content in record['plans'].items()}
            self.tour = Tour(
                self._chain,
                plans,
                in_order=record['in_order'],
                one_solution=record['one_solution'],
                model=self._model,
                reference_every=record.get('reference_every', 0),
            )
            self.stop = None
        elif kind == 'stop' and self.tour is not None:
            route = _route(record, len(self._chain))
            self._take(self.tour.go_to(record['split'], record['index'], *route))
        elif kind == 'route' and self.stop is not None and self.tour is not None:
            ids, paths, unreached = _route(record, len(self._chain))
            pose = self.tour.plans[self.stop.split].poses[self.stop.index]
            solutions = pose.solutions[list(ids)]
            self._take(
                replace(self.stop, solutions=solutions, ids=ids, paths=paths, unreached=unreached)
            )
        elif kind == 'round' and self.tour is not None:
            self.tour.ask_round()
        elif kind == 'outcome':
            self._close_solution(record['id'], record['result'])
        elif kind == 'state':
            self.state, self.run = record['state'], record.get('run', '')

    def _take(self, stop: PoseVisit) -> None:
        """Go to a stop; the solutions that nothing leads to have their outcome with it."""
        if stop.unreached:
            self._count(stop.split, NO_FREE_PATH, len(stop.unreached))
        # Counted once.
        self.stop = replace(stop, unreached=())

    def _close_solution(self, solution: int, result: str) -> None:
        assert self.stop is not None
        self._count(self.stop.split, result, 1)
        self.stop = self.stop.only([number for number in self.stop.ids if number != solution])

    def _count(self, split: str, result: str, times: int) -> None:
        if split != REGISTRATION:
            (self.references if split == REFERENCE else self.outcomes)[result] += times

    def _append(self, record: Record) -> None:
        if self._journal is None:
            make_folder(self.path.parent)
            self._journal = self._open()
        self._unwritten.append(record)
        self.write_out()

    def write_out(self) -> None:
        """Write what the disk has not taken yet; `trouble` says whether it does now."""
        try:
            while self._unwritten and self._journal is not None:
                self._journal.append(self._unwritten[0])
                self._unwritten.popleft()
            self.trouble = ''
        except DiskError as error:
            self.trouble = str(error)

    def begin(self, tour: Tour) -> None:
        """Remember a new tour."""
        self._append(
            {
                'kind': 'tour',
                'plans': {split: _content(plan) for split, plan in tour.plans.items()},
                'in_order': tour.in_order,
                'one_solution': tour.one_solution,
                'reference_every': tour.reference_every,
            }
        )
        # Said before there was a file to keep it in.
        self._append({'kind': 'state', 'state': self.state, 'run': self.run})
        self.tour, self.stop = tour, None

    def ask_round(self) -> None:
        """Visit the references next, and remember that: something was seen to by a person."""
        if self.tour is not None and self.tour.references:
            self._append({'kind': 'round'})
            self.tour.ask_round()

    def open_stop(self, stop: PoseVisit) -> None:
        """Remember the next stop, before the arm is sent there."""
        self._append({'kind': 'stop', 'split': stop.split, 'index': stop.index, **_ways(stop)})
        self._take(stop)

    def reroute(self, stop: PoseVisit) -> None:
        """Remember other ways to what is left of the open stop, before the arm is sent there."""
        self._append({'kind': 'route', **_ways(stop)})
        self._take(stop)

    def outcome(self, solution: int, result: str) -> None:
        """Remember what became of a solution of the open stop; one that has its outcome keeps it.

        Parameters
        ----------
        solution
            One of the stop's `ids`.
        result
            ``recorded``, ``partial``, ``rejected`` or ``failed``; what cannot be reached without
            hitting something is counted as ``no_free_path`` when its stop is opened.
        """
        if self.stop is None or solution not in self.stop.ids:
            return
        self._append({'kind': 'outcome', 'id': solution, 'result': result})
        self._close_solution(solution, result)

    def say_state(self, state: str, run: str = '') -> None:
        """Remember what the planner does, and in which run, once there is a plan."""
        before, (self.state, self.run) = (self.state, self.run), (state, run)
        if self._journal is not None and before != (state, run):
            self._append({'kind': 'state', 'state': state, 'run': run})

    def close(self) -> None:
        """Let others go on with the plan."""
        if self._journal is not None:
            self._journal.close()


def _content(plan: Plan) -> dict[str, Any]:
    return {
        'poses': [
            {'T_R_T': pose.T_R_T.tolist(), 'solutions': pose.solutions.tolist()}
            for pose in plan.poses
        ],
        'dropped': dict(plan.dropped),
        'dropped_solutions': dict(plan.dropped_solutions),
    }


def _ways(stop: PoseVisit) -> dict[str, Any]:
    """Return a stop's solutions and the ways to them, as they are written."""
    return {
        'ids': list(stop.ids),
        'paths': {str(i): way.tolist() for i, way in zip(stop.ids, stop.paths) if len(way)},
        'unreached': list(stop.unreached),
    }


def _route(
    record: Record, joints: int
) -> tuple[tuple[int, ...], tuple[FloatArray, ...], tuple[int, ...]]:
    """Read what `_ways` wrote: ids, paths, unreached."""
    written = record.get('paths', {})
    ids = tuple(record['ids'])
    paths = tuple(np.array(written.get(str(i), []), float).reshape(-1, joints) for i in ids)
    return ids, paths, tuple(record.get('unreached', ()))


def _plan(content: Mapping[str, Any]) -> Plan:
    poses = tuple(
        PlannedPose(np.array(pose['T_R_T'], float), np.array(pose['solutions'], float))
        for pose in content['poses']
    )
    return Plan(poses, content['dropped'], content.get('dropped_solutions', {}))
