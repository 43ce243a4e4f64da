# SPDX-License-Identifier: Apache-2.0
"""A planner that is started again takes up its tour where it was, and refuses another plan."""

from dataclasses import replace

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan, PlannedPose
from remaster_ros.planning.tour_order import REGISTRATION, Tour
from remaster_ros.planning.tour_planner import registration_tour
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.journal import Journal
from remaster_ros.session.records.plan_journal import PlanJournal

SETTINGS = {'cell': 'abc', 'seed': 3}


@pytest.fixture(scope='module')
def chain():
    return read_cell('demo').chain()


def plan_of(chain: SerialChain, seed: int, poses: int, solutions: int) -> Plan:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (poses, solutions, len(chain)))
    return Plan(
        tuple(PlannedPose(chain.forward(solution_set[0]), solution_set) for solution_set in q),
        {'out of reach': 4},
    )


def killed_at_each_stop(chain, folder, rng, settings=SETTINGS, **tour):
    """Visit a tour as one run does, with another planner after each stop.

    Yields the planner's journal and the tour of the one run, to be used alike.
    """
    one_run, book = Tour(chain, **tour), PlanJournal(folder, settings, chain)
    assert not book.path.exists()
    book.begin(Tour(chain, **tour))
    plan_id, q = book.id, np.zeros(len(chain))
    while (wanted := one_run.next(q)) is not None:
        stop = book.tour.propose(q)
        book.open_visit(stop)
        assert (stop.pose, stop.split, stop.ids) == (wanted.pose, wanted.split, wanted.ids)
        yield book, one_run
        book.close()
        book = PlanJournal(folder, settings, chain)
        assert book.id == plan_id
        assert (book.visit.ids, book.visit.pose) == (stop.ids, stop.pose)
        np.testing.assert_array_equal(book.visit.solutions, stop.solutions)
        q = rng.uniform(-1, 1, len(chain))
    assert book.tour.next(q) is None
    assert book.tour.describe() == one_run.describe()
    book.close()


@pytest.mark.parametrize('ordered', [False, True])
def test_any_number_of_restarts_visits_what_one_run_visits(chain, tmp_path, ordered):
    seed = 17
    print('seed', seed)
    rng = np.random.default_rng(seed)
    plans = {'optimization': plan_of(chain, 1, 7, 4), 'validation': plan_of(chain, 2, 5, 3)}
    visits = [
        (split, index, number)
        for split, plan in plans.items()
        for index, pose in enumerate(plan.poses)
        for number in range(len(pose.solutions))
    ]
    order = [visits[i] for i in rng.permutation(len(visits))] if ordered else ()
    visited = []
    for book, _ in killed_at_each_stop(chain, tmp_path / 'a', rng, plans=plans, order=order):
        visited += [(book.visit.split, book.visit.index, number) for number in book.visit.ids]
    assert sorted(visited) == sorted(visits)
    assert not ordered or [v[:2] for v in visited] == [v[:2] for v in order]


def test_a_registration_tour_keeps_its_order_and_its_numbers(chain, tmp_path):
    plans = registration_tour(chain, plan_of(chain, 3, 6, 2), [np.array([0.1, 0.0, 0.02])]).plans
    rng, how = np.random.default_rng(3), {'in_order': True, 'one_solution': True}
    visited = killed_at_each_stop(chain, tmp_path / 'a', rng, plans=plans, **how)
    stops = [book.visit for book, _ in visited]
    assert [stop.pose for stop in stops] == [-1, -2, -3, -4, -5, -6]
    assert {(stop.split, len(stop.ids)) for stop in stops} == {(REGISTRATION, 1)}


def test_the_state_and_its_run_are_known(chain, tmp_path):
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.record_state('running', 'abc')
    assert not book.path.exists()
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 2)}))
    with pytest.raises(InputError, match='another process'):
        PlanJournal(tmp_path, SETTINGS, chain)
    book.close()
    for state, run in (('running', 'abc'), ('running', 'def'), ('paused', '')):
        book = PlanJournal(tmp_path, SETTINGS, chain)
        book.record_state(state, run)
        book.close()
        book = PlanJournal(tmp_path, SETTINGS, chain)
        assert (book.state, book.run) == (state, run)
        book.close()


@pytest.mark.parametrize(
    ('settings', 'problem'),
    [
        ({'cell': 'other', 'seed': 3}, 'another cell;'),
        ({'cell': 'abc', 'seed': 4}, r'another seed \(3, now 4\)'),
    ],
)
def test_another_plan_is_refused(chain, tmp_path, settings, problem):
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 2)}))
    book.close()
    with pytest.raises(InputError, match=problem):
        PlanJournal(tmp_path, settings, chain)
    # And it is not held any longer.
    PlanJournal(tmp_path, SETTINGS, chain).close()


def test_a_torn_line_is_dropped_and_a_damaged_one_refused(chain, tmp_path):
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 2)}))
    stop = book.tour.propose(np.zeros(len(chain)))
    book.open_visit(stop)
    book.record_state('running', 'abc')
    book.close()
    data = book.path.read_bytes()
    book.path.write_bytes(data[:-5])
    book = PlanJournal(tmp_path, SETTINGS, chain)
    assert 'cut off' in book.lost
    assert book.visit.ids == stop.ids
    book.close()
    book.path.write_bytes(data.replace(b'"stop"', b'"step"', 1))
    with pytest.raises(InputError, match='line 4: damaged'):
        PlanJournal(tmp_path, SETTINGS, chain)


def test_what_a_full_disk_does_not_take_is_kept(chain, tmp_path, full_disk):
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 2)}))
    stop = book.tour.propose(np.zeros(len(chain)))
    with full_disk():
        book.open_visit(stop)
        book.record_state('running', 'abc')
        assert 'No space left' in book.trouble
        book.write_out()
        assert 'No space left' in book.trouble
    book.write_out()
    assert not book.trouble
    book.close()
    book = PlanJournal(tmp_path, SETTINGS, chain)
    assert (book.visit.ids, book.run) == (stop.ids, 'abc')
    book.close()


def test_what_no_way_leads_to_and_what_was_dropped_survive_a_restart(chain, tmp_path):
    plan = replace(plan_of(chain, 1, 2, 4), dropped_solutions={'self-collision': 3})
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan}))
    q = np.zeros(len(chain))
    stop = book.tour.with_route(book.tour.propose(q), [2, 0], (), [1, 3])
    book.open_visit(stop)
    book.close()
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    assert (book.visit.ids, book.visit.unreached, book.visit.pose) == ((2, 0), (1, 3), stop.pose)
    assert book.tour.dropped_solutions == {'self-collision': 3}
    book.close()


def test_references_are_visited_as_in_one_run_whatever_is_killed(chain, tmp_path):
    """Also a round that was asked for."""
    seed = 29
    print('seed', seed)
    rng = np.random.default_rng(seed)
    plans = {'optimization': plan_of(chain, 5, 6, 3), 'reference': plan_of(chain, 6, 3, 1)}
    settings, number = {**SETTINGS, 'reference_every': 7}, 0
    tour = {'plans': plans, 'reference_every': 7}
    for book, one_run in killed_at_each_stop(chain, tmp_path / 'a', rng, settings, **tour):
        number += 1
        if number in (7, 10):
            # In the middle of a round, and between two.
            book.request_reference_round()
            one_run.request_reference_round()
        assert book.tour.reference_visits == one_run.reference_visits
    assert book.tour.reference_visits == number - 6
    with pytest.raises(InputError, match='another reference_every'):
        PlanJournal(tmp_path / 'a', {**settings, 'reference_every': 8}, chain)


@pytest.mark.parametrize(
    'records',
    [
        [{'kind': 'state', 'state': 'running'}],
        [{'kind': 'plan', 'id': 'a', 'settings': SETTINGS}, {'kind': 'other'}],
        [{'kind': 'plan', 'id': 'a', 'settings': SETTINGS}, {'kind': 'stop', 'split': 'x'}],
        [{'kind': 'plan', 'id': 'a'}],
    ],
)
def test_records_that_are_no_plan_are_refused(chain, tmp_path, records):
    """Whole lines with a right checksum, of another program or version."""
    journal = Journal(tmp_path / 'plan.jsonl')
    for record in records:
        journal.append(record)
    journal.close()
    with pytest.raises(InputError, match='no plan of this version'):
        PlanJournal(tmp_path, SETTINGS, chain)
    # And it is not held any longer.
    Journal(tmp_path / 'plan.jsonl').close()
