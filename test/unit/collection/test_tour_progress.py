# SPDX-License-Identifier: Apache-2.0
"""Which pose is next, with the journal of a real session and tours of a few poses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from remaster_ros.collection.events import RecorderState
from remaster_ros.collection.peers import RequiredSensors
from remaster_ros.collection.tour_progress import TourProgress
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.planning.candidates import Plan, PlannedPose
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION, Tour
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.plan_journal import PlanJournal
from remaster_ros.session.records.session_journal import Outcomes

CHAIN = read_cell('demo').chain()
Q = np.zeros(len(CHAIN))
SENSORS = RequiredSensors(['mocap'], 'all')


def plan_of(seed, poses, solutions):
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (poses, solutions, len(CHAIN)))
    return Plan(
        tuple(PlannedPose(CHAIN.forward(solution_set[0]), solution_set) for solution_set in q),
        {'unseen': 4},
    )


class Tours:
    """Plans of a few poses; the arm stands where nothing is near unless told otherwise."""

    def __init__(self, references=0, held_out=0):
        self.references, self.held_out = references, held_out
        self.standing, self.seen, self.moving_design = '', [], None

    def registration(self):
        return Tour(CHAIN, {REGISTRATION: plan_of(1, 2, 1)}, in_order=True)

    def collection(self, T_R_N):
        self.seen.append(T_R_N)
        plans = {'optimization': plan_of(2, 2, 2)}
        if self.held_out:
            plans['validation'] = plan_of(4, self.held_out, 2)
        if self.references:
            plans[REFERENCE] = plan_of(3, self.references, 1)
        return Tour(CHAIN, plans, reference_every=100 * bool(self.references))

    @property
    def design(self):
        raise InsufficientDataError('of so few poses nothing is expected')

    @property
    def model(self):
        return SimpleNamespace(trouble=lambda q: self.standing)


class Planning:
    """Does each thing at the second time it is asked for, as a thread would."""

    def __init__(self):
        self.what = None

    def ask(self, what, q, job):
        if self.what != what:
            self.what = what
            return None
        self.what = None
        return (job(),)


class Bench:
    """A planner's progress in a session folder, and what a recorder has written down."""

    def __init__(self, folder, **options):
        self.folder, self.tours, self.outcomes = folder, Tours(**options), Outcomes()
        self.open()

    def follow(self, **values):
        """Follow the recorder's state; return whether that is news."""
        values = {'plan': self.journal.id, 'decided': self.outcomes.decided(), **values}
        return self.progress.follow(RecorderState(waiting_for='', **values))

    def end(self, stop, solution, result='recorded', **values):
        """Have the recorder tell what became of a configuration; return whether it is news."""
        end = {'pose': stop.pose, 'split': stop.split, 'solution': solution, 'result': result}
        self.outcomes.take({'kind': 'configuration', **end})
        return self.follow(**values)

    def open(self):
        self.journal = PlanJournal(self.folder, {'cell': 'a'}, CHAIN)
        self.progress = TourProgress(self.journal, self.tours, Planning())

    def restart(self):
        T_R_N = self.progress.T_R_N
        self.journal.close()
        self.open()
        self.follow()
        self.progress.T_R_N = T_R_N

    def register(self):
        self.progress.T_R_N['mocap'] = np.eye(4)

    def next(self, sensors=SENSORS, words='point 2 of 3'):
        """Return the next pose, however long it is planned; None at the end."""
        for _ in range(6):
            stop = self.progress.next(Q, sensors, words)
            if stop is not None or self.progress.is_complete:
                return stop
        return None

    def visit(self, stop, result='recorded'):
        for solution in stop.ids:
            assert self.end(stop, solution, result)
        assert self.progress.open_pose is None


@pytest.fixture
def bench(tmp_path):
    made = []

    def make(registered=True, **options):
        made.append(Bench(tmp_path / 'session', **options))
        if registered:
            made[-1].register()
        return made[-1]

    yield make
    for rig in made:
        rig.journal.close()


def test_the_registration_comes_first_then_the_collection_to_its_end(bench):
    b = bench(registered=False)
    stop = b.next()
    assert (stop.split, stop.pose, b.progress.phase) == (REGISTRATION, -1, REGISTRATION)
    b.visit(stop)
    b.register()
    for number in range(2):
        stop = b.next()
        assert (stop.split, stop.pose, len(stop.ids)) == ('optimization', number, 2)
        b.visit(stop)
    assert b.progress.phase == 'collection'
    assert b.next() is None
    assert b.progress.is_complete
    assert b.tours.seen[0].keys() == {'mocap'}
    counts = b.progress.counts()
    assert (counts['poses_done'], counts['poses']) == (2, 2)
    assert (counts['configurations_done'], counts['configurations']) == (4, 4)
    assert counts['outcome_recorded'] == 4
    assert counts['dropped_unseen'] == 4
    assert b.progress.describe() == '2 of 2 collection poses begun, 4 configurations done'


def test_a_pose_is_in_the_journal_before_it_is_returned(bench):
    b = bench()
    stop = b.next()
    b.restart()
    assert b.progress.open_pose.ids == stop.ids
    assert b.progress.resumed
    assert b.progress.phase == 'collection'


def test_nothing_is_planned_on_while_a_registration_is_on_its_way(bench):
    """The recorder has reported it; its transforms come on a topic of their own."""
    b = bench(registered=False)
    stop = b.next()
    assert b.end(stop, stop.ids[0], registered=True)
    assert b.next() is None
    b.register()
    assert b.next().split == 'optimization'


def test_poses_that_register_nothing_are_an_error_with_the_reason(bench):
    b = bench(registered=False)
    for _ in range(2):
        b.visit(b.next())
    with pytest.raises(InsufficientDataError, match=r'mocap after 2 poses \(point 2 of 3\)'):
        b.next()


def test_one_of_the_sensors_may_be_enough(bench):
    b = bench()
    assert b.next(RequiredSensors(['mocap', 'tracker'], 'any')).split == 'optimization'


def test_what_is_no_solution_of_the_open_pose_changes_nothing(bench):
    b = bench()
    assert not b.follow()
    stop = b.next()
    b.end(stop, 7)
    assert not b.end(stop, stop.ids[0], plan='another')
    assert b.progress.open_pose.ids == stop.ids
    b.end(replace(stop, pose=9), stop.ids[0])
    assert b.progress.open_pose.ids == stop.ids


def test_what_no_way_leads_to_is_open_until_the_recorder_has_written_it_down(bench):
    b = bench()
    b.next()
    tour = b.journal.tour
    stop = tour.with_route(tour.propose(Q), (), (), (0, 1))
    b.journal.open_visit(stop)
    assert b.progress.open_pose.ids == (0, 1)
    for number in (0, 1):
        b.end(stop, number, 'no_free_path')
    assert b.progress.open_pose is None
    assert b.progress.counts()['outcome_no_free_path'] == 2


def test_what_is_left_of_a_pose_is_reached_from_where_the_arm_stands(bench):
    b = bench()
    stop = b.next()
    b.end(stop, stop.ids[0], 'failed')
    elsewhere = Q + 0.3
    assert b.progress.rest(elsewhere) is None, 'it is planned'
    remaining_stop = b.progress.rest(elsewhere)
    assert (remaining_stop.pose, remaining_stop.ids) == (stop.pose, stop.ids[1:])
    b.restart()
    assert b.progress.open_pose.ids == stop.ids[1:]


@pytest.mark.parametrize(
    ('plan', 'observations', 'refused'), [('other', 3, True), ('other', 0, False), ('', 3, False)]
)
def test_the_session_of_another_plan_is_refused(bench, plan, observations, refused):
    b = bench()
    b.next()
    recorder = RecorderState(
        waiting_for='', plan=plan, observations=observations, session='their session'
    )
    if not refused:
        b.progress.check_session(recorder, b.journal.path)
        return
    with pytest.raises(InputError, match=r'their session holds .* of another plan than .*plan'):
        b.progress.check_session(recorder, b.journal.path)


def test_an_arm_that_stands_too_near_is_not_planned_for(bench):
    b = bench()
    b.tours.standing = 'tool and floor'
    assert b.next() is None
    assert b.progress.standing == 'the arm stands too near to something: tool and floor'
    b.tours.standing = ''
    assert b.next() is not None
    assert b.progress.standing == ''


def test_the_last_reference_of_a_round_is_known(bench):
    b = bench(references=2)
    last = []
    for _ in range(4):
        stop = b.next()
        assert stop.split == REFERENCE
        last.append(b.progress.is_last_reference(stop))
        b.visit(stop)
    assert last == [False, True, False, True]
    stop = b.next()
    assert stop.split == 'optimization'
    assert not b.progress.is_last_reference(stop)


def test_once_enough_is_known_the_rest_is_what_is_held_out_and_the_references(bench):
    b = bench(references=1, held_out=2)
    assert b.progress.planned == 0
    while (stop := b.next()).split != 'optimization':
        b.visit(stop)
    assert b.progress.planned == 4
    assert b.end(stop, stop.ids[0])
    b.progress.enough = True
    # The pose under way is finished, all of it.
    assert b.progress.open_pose.ids == stop.ids[1:]
    b.end(stop, stop.ids[1])
    splits = []
    while (stop := b.next()) is not None:
        splits.append(stop.split)
        b.visit(stop)
        if len(splits) == 1:
            # It is in the journal: a planner that is started again does the same.
            b.restart()
            assert not b.progress.enough
    assert b.progress.is_complete
    assert splits.count('validation') == 2
    assert 'optimization' not in splits
    assert splits[-1] == REFERENCE, 'the round at the end'
    counts = b.progress.counts()
    assert counts['poses_done'] == counts['poses']
    assert counts['configurations_done'] == counts['configurations']
    assert counts['dropped_enough is known'] == 1
    assert counts['dropped_solutions_enough is known'] == 2
    assert b.progress.planned == 4


def test_enough_at_the_last_pose_changes_nothing(bench):
    b = bench()
    for _ in range(2):
        b.visit(b.next())
    b.progress.enough = True
    assert b.next() is None
    assert b.progress.is_complete
    assert 'dropped_solutions_enough is known' not in b.progress.counts()


def test_what_is_measured_further_follows_a_complete_collection_also_after_a_restart(bench):
    b = bench(references=2)
    while (stop := b.next()) is not None:
        b.visit(stop)
    assert b.progress.is_complete
    assert not b.progress.measures_additions
    before = b.journal.tour
    planned, done = b.progress.planned, b.progress.counts()['configurations_done']
    plan = plan_of(9, 2, 2)

    def further(T_R_N):
        b.tours.seen.append(T_R_N)
        order = [('optimization', *visit) for visit in ((1, 0), (0, 1), (1, 1), (0, 0))]
        plans = {'optimization': plan, REFERENCE: before.plans[REFERENCE]}
        return Tour(CHAIN, plans, reference_every=100, order=order, begin_at=before.visited)

    b.progress.additions = further
    places, b.progress.T_R_N = b.progress.T_R_N, {}
    assert b.next() is None
    assert b.progress.standing == 'waiting for the registrations of the recorder'
    assert not b.progress.is_complete
    b.progress.T_R_N = places
    # That enough was known of the offsets ends no search for what separates causes.
    b.progress.enough = True
    splits, numbers, visits = [], [], []
    while (stop := b.next()) is not None:
        splits.append(stop.split)
        numbers.append(stop.pose)
        visits += [(stop.index, i) for i in stop.ids if stop.split == 'optimization']
        b.visit(stop)
        b.restart()
    assert b.progress.is_complete
    assert b.progress.measures_additions
    assert b.progress.planned_any
    assert splits[:4] == [REFERENCE] * 4
    assert min(numbers) == before.visited
    assert visits == [(1, 0), (0, 1), (1, 1), (0, 0)]
    assert b.tours.seen[-1].keys() == {'mocap'}
    assert b.progress.planned == planned
    counts = b.progress.counts()
    assert (counts['configurations_done'], counts['configurations']) == (done + 4, done + 4)
    assert (counts['poses_done'], counts['poses']) == (4, 4)
    assert [tour.to_fit for tour in b.journal.tours] == [planned, 4]


def test_poses_to_judge_by_need_no_registration_and_keep_their_state_over_a_restart(bench):
    b = bench(registered=False)
    plan = plan_of(9, 2, 1)
    visits = [replace(p, correction=state) for p in plan.poses for state in ('off', 'on')]
    plans = {'optimization': Plan(()), 'validation': Plan(tuple(visits))}
    b.progress.inspection = lambda: Tour(CHAIN, plans, in_order=True)
    seen = []
    while (stop := b.next()) is not None:
        seen.append((stop.pose, stop.split, stop.correction))
        b.restart()
        # What was announced before is announced as it was.
        assert b.progress.rest(Q) is None
        assert b.progress.rest(Q).correction == stop.correction
        b.visit(stop)
    assert seen == [(i, 'validation', state) for i, state in enumerate(('off', 'on') * 2)]
    assert b.progress.is_complete
    assert b.journal.tour.inspection == 'verify'
