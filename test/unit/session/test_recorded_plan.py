# SPDX-License-Identifier: Apache-2.0
"""The plan of a session that is over: what was planned, expected, and became of it."""

import json

import numpy as np
import pytest
from rigs.command_line import refusal

import remaster_ros
from remaster_ros.errors import InputError
from remaster_ros.planning.candidates import CurvedWay, Plan, PlannedPose
from remaster_ros.planning.collection_plan import Expected
from remaster_ros.planning.tour_order import FITTED, REFERENCE, REGISTRATION, Tour
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.journal import Journal
from remaster_ros.session.records.plan_journal import PlanJournal, plan_page_path, read_plan
from remaster_ros.session.records.reader import write_session

CHAIN = read_cell('demo').chain()
JOINTS = len(CHAIN)


def plan_of(seed, poses, solutions):
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (poses, solutions, JOINTS))
    return Plan(
        tuple(PlannedPose(CHAIN.forward(solution_set[0]), solution_set) for solution_set in q),
        {'unseen': 4},
    )


def collected(folder, expected=None):
    """Register, then visit a reference and all of four poses but the last."""
    folder.mkdir()
    journal, recorder = PlanJournal(folder, {}, CHAIN), Journal(folder / 'journal.jsonl')

    def end(solution, result):
        stop = {'pose': journal.visit.pose, 'split': journal.visit.split}
        end = {'solution': solution, 'result': result}
        recorder.append({'kind': 'configuration', **stop, **end})

    tour = Tour(CHAIN, {REGISTRATION: plan_of(1, 2, 1)}, in_order=True)
    journal.begin(tour)
    recorder.append({'kind': 'plan', 'id': journal.id})
    journal.open_visit(tour.next(np.zeros(JOINTS)))
    end(journal.visit.ids[0], 'recorded')
    plans = {FITTED: plan_of(2, 2, 3), 'validation': plan_of(3, 2, 3)}
    plans[REFERENCE] = plan_of(4, 1, 1)
    tour = Tour(CHAIN, plans, reference_every=100)
    journal.begin(tour, expected)
    visited = []
    for _ in range(4):
        journal.open_visit(tour.next(np.zeros(JOINTS)))
        visited.append(journal.visit)
        for number in journal.visit.ids:
            end(number, 'rejected')
            if number:
                end(number, 'recorded')
    journal.close()
    recorder.close()
    return tour, visited


def test_what_became_of_every_configuration(tmp_path):
    tour, visited = collected(tmp_path / 's')
    plan = read_plan(tmp_path / 's', CHAIN)
    assert plan.tour.configurations == tour.configurations == {FITTED: 6, 'validation': 6}
    assert plan.expected is None
    rounds = [stop for stop in visited if stop.split == REFERENCE]
    assert plan.references == {'rejected': len(rounds)}
    assert len(rounds) == 2
    for stop in visited:
        if stop.split != REFERENCE:
            found = [plan.outcomes[stop.split, stop.index, number] for number in range(3)]
            assert found == ['rejected', 'recorded', 'recorded'], 'the last one counts'
    assert len(plan.outcomes) == 6
    assert plan.page == plan_page_path(tmp_path / 's') == tmp_path / 's.plan.html'


def test_what_was_expected_is_kept_and_gone_on_with(tmp_path):
    stds = dict.fromkeys(CHAIN.joint_names, np.float64(1e-5)) | {'joint_1': None}
    tour, _ = collected(tmp_path / 's', Expected(stds, 1e-5, np.float64(2e-4)))
    plan = read_plan(tmp_path / 's', CHAIN)
    assert plan.expected.joint_std_rad == stds
    assert plan.expected.tool_rms_m == 2e-4
    again = PlanJournal(tmp_path / 's', {}, CHAIN)
    assert again.tour.plans.keys() == tour.plans.keys()
    assert again.visit is not None
    assert again.decided.outcomes == {'recorded': 4, 'rejected': 2}
    again.close()


def test_sessions_without_a_plan_of_a_collection_have_none(tmp_path):
    assert read_plan(tmp_path, CHAIN) is None
    journal = PlanJournal(tmp_path / 's', {}, CHAIN)
    journal.begin(Tour(CHAIN, {REGISTRATION: plan_of(1, 2, 1)}, in_order=True))
    journal.close()
    assert read_plan(tmp_path / 's', CHAIN) is None


@pytest.mark.parametrize(
    'change',
    [{'kind': 'other'}, {'plans': {'optimization': {'poses': 3}}}, {'plans': {}}],
)
def test_what_is_no_plan_is_refused_in_one_line(tmp_path, change):
    collected(tmp_path / 's')
    path = tmp_path / 's/plan.jsonl'
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    last = max(i for i, record in enumerate(lines) if record['kind'] == 'tour')
    for record in lines:
        record.pop('crc32')
    lines[last] |= change
    path.unlink()
    journal = Journal(path)
    for record in lines:
        journal.append(record)
    journal.close()
    with pytest.raises(InputError, match='no plan of this version') as found:
        read_plan(tmp_path / 's', CHAIN)
    assert '\n' not in str(found.value)
    assert str(path) in str(found.value)


@pytest.mark.parametrize('verb', ['fit', 'discover'])
@pytest.mark.parametrize('moves', [True, False])
def test_a_session_whose_motion_is_not_imported_names_the_import(tmp_path, verb, moves):
    """Of an arm that is measured while it moves the session itself holds one pose to fit."""
    session = remaster_ros.simulate(poses=5, validation_poses=3, seed=1).session
    rows = session.measurements
    folder = tmp_path / 's'
    write_session(folder, session.select(rows.is_validation | (rows.pose == rows.pose[0])))
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (3, JOINTS))
    way = CurvedWay(q, np.array([0.0, 0.3, 0.6])) if moves else None
    on_the_way = PlannedPose(CHAIN.forward(q[2]), q[2:], way=way)
    journal = PlanJournal(folder, {}, CHAIN)
    journal.begin(Tour(CHAIN, {FITTED: plan_of(2, 1, 1), 'validation': Plan((on_the_way,))}))
    journal.close()
    (folder / 'bag').mkdir()
    told = refusal(verb, folder, '--out', tmp_path / 'out', status=1)
    command = f'remaster import --moving {folder}/bag --cell CELL --proof {folder} --out NEW'
    assert (command in told) == moves
    assert ('saw 1 pose to fit' in told) != moves
