"""A planner that is started again takes up its tour where it was, and refuses another plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan, PlannedPose
from remaster_ros.planning.tour_order import REGISTRATION, Tour
from remaster_ros.planning.tour_planner import registration_tour
from remaster_ros.session.journal import Journal
from remaster_ros.session.plan_journal import PlanJournal
from remaster_ros.session.workcell import read_cell

SETTINGS = {'cell': 'abc', 'seed': 3}


@pytest.fixture(scope='module')
def chain():
    return read_cell('demo').chain()


def plan_of(chain: SerialChain, seed: int, poses: int, solutions: int) -> Plan:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (poses, solutions, len(chain)))
    return Plan(tuple(PlannedPose(chain.forward(own[0]), own) for own in q), {'out of reach': 4})


def visit(tour, book, q, rng, outcomes):
    """Go to the next stop and give some of its solutions an outcome; returns it."""
    stop = tour.next(q)
    if stop is None:
        return None
    book.open_stop(stop)
    for number in stop.ids[: rng.integers(0, len(stop.ids) + 1)]:
        result = str(rng.choice(['recorded', 'rejected']))
        book.outcome(number, result)
        outcomes[result] = outcomes.get(result, 0) + 1
    return stop


def test_any_number_of_restarts_visits_what_one_run_visits(chain, tmp_path):
    seed = 17
    print('seed', seed)
    rng = np.random.default_rng(seed)
    plans = {'optimization': plan_of(chain, 1, 7, 4), 'validation': plan_of(chain, 2, 5, 3)}
    one_run = Tour(chain, plans)
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    assert not book.path.exists()
    book.begin(Tour(chain, plans))
    plan_id, outcomes, q = book.id, {}, np.zeros(len(chain))
    while (wanted := one_run.next(q)) is not None:
        stop = visit(book.tour, book, q, rng, outcomes)
        assert (stop.pose, stop.split, stop.ids) == (wanted.pose, wanted.split, wanted.ids)
        open_ids = book.stop.ids
        book.close()
        book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
        assert book.id == plan_id
        assert book.stop.ids == open_ids
        assert book.stop.pose == stop.pose
        for number, solution in zip(book.stop.ids, book.stop.solutions):
            np.testing.assert_array_equal(solution, stop.solutions[stop.ids.index(number)])
        assert dict(book.outcomes) == outcomes
        q = rng.uniform(-1, 1, len(chain))
    assert book.tour.next(q) is None
    assert book.tour.describe() == one_run.describe()
    book.close()


def test_a_registration_tour_keeps_its_order_and_its_numbers(chain, tmp_path):
    tour = registration_tour(chain, plan_of(chain, 3, 6, 2), [np.array([0.1, 0.0, 0.02])])
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.begin(tour)
    q = np.zeros(len(chain))
    numbers = []
    for _ in range(6):
        stop = book.tour.next(q)
        book.open_stop(stop)
        book.outcome(stop.ids[0], 'recorded')
        numbers.append(stop.pose)
        assert stop.split == REGISTRATION
        assert len(stop.ids) == 1
        book.close()
        book = PlanJournal(tmp_path, SETTINGS, chain)
    assert numbers == [-1, -2, -3, -4, -5, -6]
    assert not book.outcomes
    book.close()


def test_the_state_and_its_run_are_known(chain, tmp_path):
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.say_state('running', 'abc')
    assert not book.path.exists()
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 2)}))
    with pytest.raises(InputError, match='another process'):
        PlanJournal(tmp_path, SETTINGS, chain)
    book.close()
    for state, run in (('running', 'abc'), ('running', 'def'), ('paused', '')):
        book = PlanJournal(tmp_path, SETTINGS, chain)
        book.say_state(state, run)
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
    stop = book.tour.next(np.zeros(len(chain)))
    book.open_stop(stop)
    book.outcome(stop.ids[0], 'recorded')
    book.close()
    whole = book.path.read_bytes()
    book.path.write_bytes(whole[:-5])
    book = PlanJournal(tmp_path, SETTINGS, chain)
    assert 'cut off' in book.lost
    assert book.stop.ids == stop.ids
    book.close()
    book.path.write_bytes(whole.replace(b'"stop"', b'"step"', 1))
    with pytest.raises(InputError, match='line 4: damaged'):
        PlanJournal(tmp_path, SETTINGS, chain)


def test_what_a_full_disk_does_not_take_is_kept(chain, tmp_path, full_disk):
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 2)}))
    stop = book.tour.next(np.zeros(len(chain)))
    with full_disk():
        book.open_stop(stop)
        book.outcome(stop.ids[0], 'recorded')
        assert 'No space left' in book.trouble
        book.write_out()
        assert 'No space left' in book.trouble
    book.write_out()
    assert not book.trouble
    left = book.stop.ids
    book.close()
    book = PlanJournal(tmp_path, SETTINGS, chain)
    assert book.stop.ids == left == stop.ids[1:]
    assert book.outcomes['recorded'] == 1
    book.close()


def test_ways_and_what_has_none_survive_a_restart(chain, tmp_path):
    rng = np.random.default_rng(5)
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan_of(chain, 1, 2, 4)}))
    way = rng.uniform(-1, 1, (2, len(chain)))
    straight = np.empty((0, len(chain)))
    stop = book.tour.go_to('optimization', 0, [2, 0], [way, straight], [1, 3])
    book.open_stop(stop)
    assert dict(book.outcomes) == {'no_free_path': 2}
    book.outcome(2, 'recorded')
    book.close()

    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    assert dict(book.outcomes) == {'no_free_path': 2, 'recorded': 1}
    assert book.stop.ids == (0,)
    other = rng.uniform(-1, 1, (1, len(chain)))
    book.reroute(replace(book.stop, paths=(other,)))
    book.close()

    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    np.testing.assert_array_equal(book.stop.paths[0], other)
    assert (book.stop.ids, book.stop.pose) == ((0,), stop.pose)
    # From where the arm stands now nothing leads there: its outcome, and the totals add up.
    book.reroute(replace(book.stop.only([]), unreached=(0,)))
    book.close()
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    assert book.stop.ids == ()
    assert book.outcomes.total() == 4
    assert book.tour.plans['optimization'].dropped_solutions == {}


def test_the_counts_of_dropped_solutions_survive_a_restart(chain, tmp_path):
    plan = replace(plan_of(chain, 1, 2, 2), dropped_solutions={'self-collision': 3})
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    book.begin(Tour(chain, {'optimization': plan}))
    book.close()
    book = PlanJournal(tmp_path / 'session', SETTINGS, chain)
    assert book.tour.dropped_solutions == {'self-collision': 3}


def test_references_are_visited_as_in_one_run_whatever_is_killed(chain, tmp_path):
    """Also a round that was asked for."""
    seed = 29
    print('seed', seed)
    rng = np.random.default_rng(seed)
    plans = {
        'optimization': plan_of(chain, 5, 6, 3),
        'reference': plan_of(chain, 6, 3, 1),
    }
    settings = {**SETTINGS, 'reference_every': 7}
    one_run = Tour(chain, plans, reference_every=7)
    book = PlanJournal(tmp_path / 'session', settings, chain)
    book.begin(Tour(chain, plans, reference_every=7))
    q, number = np.zeros(len(chain)), 0
    while (wanted := one_run.next(q)) is not None:
        stop = visit(book.tour, book, q, rng, {})
        assert (stop.pose, stop.split, stop.ids) == (wanted.pose, wanted.split, wanted.ids)
        number += 1
        if number in (7, 10):
            # In the middle of a round, and between two.
            book.ask_round()
            one_run.ask_round()
        for solution in book.stop.ids:
            book.outcome(solution, 'recorded')
        book.close()
        book = PlanJournal(tmp_path / 'session', settings, chain)
        q = rng.uniform(-1, 1, len(chain))
    assert book.tour.next(q) is None
    assert book.outcomes.total() == sum(book.tour.configurations.values()) == 18
    assert book.references.total() == book.tour.reference_stops == number - 6
    book.close()
    with pytest.raises(InputError, match='another reference_every'):
        PlanJournal(tmp_path / 'session', {**settings, 'reference_every': 8}, chain)


@pytest.mark.parametrize(
    'records',
    [
        [{'kind': 'outcome', 'id': 0, 'result': 'recorded'}],
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


def test_a_tour_in_a_given_order_goes_on_in_it(chain, tmp_path):
    seed = 18
    print('seed', seed)
    rng = np.random.default_rng(seed)
    plans = {'optimization': plan_of(chain, 1, 5, 3), 'validation': plan_of(chain, 2, 3, 2)}
    visits = [
        (split, index, number)
        for split, plan in plans.items()
        for index, pose in enumerate(plan.poses)
        for number in range(len(pose.solutions))
    ]
    order = [visits[i] for i in rng.permutation(len(visits))]
    one_run = Tour(chain, plans, order=order)
    book = PlanJournal(tmp_path, SETTINGS, chain)
    book.begin(Tour(chain, plans, order=order))
    q = np.zeros(len(chain))
    while (wanted := one_run.next(q)) is not None:
        stop = book.tour.next(q)
        book.open_stop(stop)
        assert (stop.pose, stop.split, stop.ids) == (wanted.pose, wanted.split, wanted.ids)
        for number in stop.ids:
            book.outcome(number, 'recorded')
        book.close()
        book = PlanJournal(tmp_path, SETTINGS, chain)
        q = stop.solutions[-1]
    assert book.tour.next(q) is None
    assert book.outcomes['recorded'] == len(visits)
    book.close()
