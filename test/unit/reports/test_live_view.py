# SPDX-License-Identifier: Apache-2.0
"""The state of the live page: events in, a view out."""

import json

import msgspec
import numpy as np
import pytest
from worlds.played_collection import CHAIN, MARKERS, T_R_N, PlayedCollection

from remaster_ros import simulate
from remaster_ros.collection import events
from remaster_ros.collection.stopping_rule import StoppingGoal, StoppingRule
from remaster_ros.reports.live_view import (
    LONGEST_TEXT,
    MOST_NODES,
    SILENT_S,
    FitFacts,
    LiveView,
    PlanPage,
    tool_path,
)
from remaster_ros.reports.precision_json import precision_json


@pytest.fixture
def played():
    return PlayedCollection()


def after(played, configurations, every_s=5.0, **step):
    played.state = 'running'
    for i in range(configurations):
        played.step(now=every_s * i, **step)
    return played.view.view(every_s * (configurations - 1))


def test_before_any_node_is_heard_nothing_can_be_begun():
    view = LiveView(CHAIN, MARKERS).view(0.0)
    assert view['run']['state'] == 'silent'
    assert not view['commands']['collect']['on']
    assert view['commands']['stop']['on']
    assert {row['message'] for row in view['nodes']} == {'not seen yet'}
    assert view['scene']['q'] is None


def test_progress_and_time_left(played):
    view = after(played, 21)
    run = view['run']
    assert (run['done'], run['of'], run['poses_done'], run['poses']) == (21, 40, 5, 10)
    assert run['left'] == 'about 2 min left'
    assert view['commands']['pause']['on']
    assert not view['commands']['collect']['on']


def test_residuals_and_points(played):
    view = after(played, 12)
    mocap, tracker = view['sensors']
    assert len(mocap['residuals_mm']) == 12
    assert mocap['median_mm'] < 0.4
    assert mocap['registered']
    assert not tracker['registered']
    assert (tracker['ready'], tracker['message']) == (False, 'the beam is broken')
    assert tracker['median_mm'] is None
    assert len(view['scene']['points']['mocap']) == 12


def test_residuals_of_registration_poses_are_labelled(played):
    """They are measured before the first configuration that the line under the bar counts."""
    played.state = 'running'
    for i in range(6):
        played.step(now=float(i), phase='registration')
    view = played.view.view(5.0)
    assert (view['run']['done'], view['run']['of']) == (0, 0)
    assert view['sensors'][0]['of_registration'] == len(view['sensors'][0]['residuals_mm']) == 6
    for i in range(6, 9):
        played.step(now=float(i))
    mocap, tracker = played.view.view(8.0)['sensors']
    assert (mocap['of_registration'], len(mocap['residuals_mm'])) == (6, 9)
    assert tracker['of_registration'] == 0


def test_the_line_under_the_bar_is_one_sentence_and_the_rest_is_complete(played):
    tour = 'planned 13 optimization poses with 40 configurations'
    details = [
        '6 reference configurations',
        'dropped poses: ' + ', '.join(['12 beyond reach'] * 60),
    ]
    played.view.take(events.TourPlanned('; '.join([tour, *details])), 1.0)
    run = played.view.view(1.0)['run']
    assert run['plan'] == 'Planned 13 optimization poses with 40 configurations.'
    assert run['plan_details'] == f'6 reference configurations; {details[1]}.'


def test_a_rejected_configuration_is_told_and_leaves_no_residual(played):
    view = after(played, 8, result='rejected')
    assert view['sensors'][0]['residuals_mm'] == []
    assert view['messages'][0]['text'].startswith('configuration rejected')


def test_the_scene_has_the_arm_its_way_and_the_sensors(played):
    scene = after(played, 3)['scene']
    assert np.allclose(scene['q'], played.q, atol=1e-6)
    assert np.allclose(np.reshape(scene['target'], (4, 4)), CHAIN.forward(played.q), atol=1e-5)
    assert np.allclose(scene['way'][-1], CHAIN.positions(played.q, np.zeros(3)), atol=1e-4)
    assert np.allclose(scene['sensors']['mocap'], T_R_N[:3, 3], atol=1e-3)


def test_a_way_is_straight_in_the_joints():
    way = np.array([[0.0] * 7, [0.4] * 7, [0.4] * 7])
    path = tool_path(CHAIN, way, steps=3)
    middle = CHAIN.positions(np.full(7, 0.2), np.zeros(3))
    assert path.shape == (6, 3)
    assert np.allclose(path[1], middle)
    assert tool_path(CHAIN, way[:1]).shape == (0, 3)


def test_a_silent_planner_is_named_and_takes_the_buttons_away(played):
    after(played, 3)
    view = played.view.view(10.0 + SILENT_S + 1.0)
    assert view['run']['message'] == 'no sign of pose_planner'
    assert not view['commands']['collect']['on']
    assert not view['commands']['pause']['on']
    assert view['commands']['stop']['on']
    assert all('silent for' in row['message'] for row in view['nodes'])


@pytest.mark.parametrize('state', ['idle', 'paused', 'stopped'])
def test_a_halt_is_shown_and_nothing_goes_on(played, state):
    played.state = state
    played.beat(1.0)
    assert played.view.view(1.0)['commands']['collect']['on']
    played.halted = 'the emergency stop was pressed'
    played.beat(2.0)
    view = played.view.view(2.0)
    assert view['halted'] == 'the emergency stop was pressed'
    assert not view['commands']['collect']['on']
    assert 'clear_halt' not in view['commands']
    assert set(view['commands']) == {'collect', 'pause', 'stop', 'fit', 'confirm'}


def test_stop_is_labelled_as_no_emergency_stop(played):
    stop = played.view.view(0.0)['commands']['stop']
    assert stop['note'].startswith('No emergency stop')


@pytest.mark.parametrize(
    'change',
    [{'state': 'paused'}, {'halted': 'silence'}, {'changed': 'the tracker was moved'}],
)
def test_the_mark_of_what_was_seen_changes_with_what_a_person_decides_by(played, change):
    played.beat(1.0)
    before = played.view.seen(1.0)
    played.beat(2.0)
    assert played.view.seen(2.0) == before
    vars(played).update(change)
    played.beat(3.0)
    assert played.view.seen(3.0) != before
    assert played.view.seen(3.0) != played.view.seen(3.0 + SILENT_S + 1.0)


def test_a_plan_is_offered_for_confirmation_only_where_it_can_be_looked_at(played):
    played.beat(1.0)
    before = played.view.view(1.0)
    assert before['confirmation'] is None
    assert not before['commands']['confirm']['on']
    played.plan = 'ab12cd34'
    played.beat(2.0)
    view = played.view.view(2.0)
    assert view['seen'] != before['seen']
    assert view['commands']['collect']['note'] == 'plan ab12cd34 is not confirmed'
    assert not view['commands']['collect']['on']
    # Its page is not read yet; that of another plan does not count.
    played.view.take_plan_page(PlanPage('00000001', 'plan/other'))
    assert view['confirmation'] == played.view.view(2.0)['confirmation']
    assert view['confirmation']['address'] == ''
    assert not played.view.view(2.0)['commands']['confirm']['on']
    played.view.take_plan_page(PlanPage('ab12cd34', '', 'it is elsewhere'))
    assert played.view.view(2.0)['confirmation']['trouble'] == 'it is elsewhere'
    assert not played.view.view(2.0)['commands']['confirm']['on']
    played.view.take_plan_page(PlanPage('ab12cd34', 'plan/x'))
    assert not played.view.view(2.0)['commands']['confirm']['on'], 'nobody offers it yet'
    played.view.plan_offered = True
    view = played.view.view(2.0)
    assert view['commands']['confirm']['on']
    assert view['commands']['confirm']['label'] == 'Confirm plan ab12cd34'
    # A silent planner confirms nothing.
    assert not played.view.view(2.0 + SILENT_S + 1.0)['commands']['confirm']['on']
    played.confirmed = 'ab12cd34'
    played.beat(3.0)
    after_it = played.view.view(3.0)
    assert after_it['confirmation']['confirmed']
    assert not after_it['commands']['confirm']['on']
    assert after_it['commands']['collect']['on']
    assert after_it['seen'] != view['seen']
    # Another plan takes its place: what was seen of the first does not count for it.
    played.plan = '00000002'
    played.beat(4.0)
    another = played.view.view(4.0)
    assert another['seen'] not in (view['seen'], after_it['seen'])
    assert another['confirmation']['address'] == ''
    assert not another['commands']['collect']['on']


@pytest.mark.parametrize('name', ['', 'x' * 8, '../../a1', 'ab12cd34/../stop', 'AB12CD34'])
def test_a_name_that_no_plan_has_is_no_plan(played, name):
    values = {'plan_page': '/page', 'plan_shown': name, 'confirmed': 'no'}
    played.view.take_summary('pose_planner', 'ok', '', values, 1.0)
    assert played.view.plan_to_show() == ('', '')
    assert played.view.view(1.0)['confirmation'] is None


def looks(*stds):
    names = CHAIN.joint_names
    return [
        {
            'configurations': 5 * i + 5,
            'minutes': 1.5 * i,
            'joint_std_deg': dict.fromkeys(names, std) | {'joint_1': None},
            'joint_rms_deg': std,
        }
        for i, std in enumerate(stds)
    ]


def test_what_is_known_by_configurations_and_minutes(played):
    message = {'format': 'remaster-precision/1', 'message': '5 more', 'looks': looks(0.1, 0.02)}
    played.view.take_precision(json.dumps(message))
    table = played.view.view(20.0)['precision']
    assert table['message'] == '5 more'
    assert (table['configurations'], table['minutes']) == ([5, 10], [0.0, 1.5])
    assert table['std_deg']['joint_1'] == [None, None]
    assert table['std_deg']['joint_2'] == [0.1, 0.02]
    for nonsense in ('', '[]', '{"looks": [{}]}', '{"looks": 1}'):
        with pytest.raises(msgspec.MsgspecError):
            played.view.take_precision(nonsense)
    assert played.view.view(20.0)['precision'] == table


def test_what_the_optimizer_publishes_is_understood(played):
    rule = StoppingRule(StoppingGoal(joint_std_rad=1e-4), planned=20, every=5)
    session = simulate(robot='iiwa7', seed=1).session
    look = rule.look(session, 5, None, np.random.default_rng(0))
    played.view.take_precision(precision_json(rule, [look]))
    table = played.view.view(0.0)['precision']
    assert table['configurations'] == [look.configurations]
    assert table['message'] == rule.describe(look)


def test_a_result_needs_every_joint_as_a_number(played):
    names = CHAIN.joint_names
    means = dict.fromkeys(names, 0.01)
    played.view.take_offsets(means, dict.fromkeys(names[:-1], 0.001))
    played.view.take_offsets(means | {'joint_3': float('nan')}, dict.fromkeys(names, 0.001))
    assert played.view.view(0.0)['result']['joints'] == []
    played.view.take_offsets(means | {'joint_9': 0.0}, dict.fromkeys(names, 0.001))
    joints = played.view.view(0.0)['result']['joints']
    assert [row['joint'] for row in joints] == list(names)
    assert joints[0]['mean_deg'] == pytest.approx(np.degrees(0.01), abs=1e-6)
    assert None not in [row['std_deg'] for row in joints]
    played.view.take_fit(FitFacts({'files': 'fit'}, frozenset({'joint_7'})))
    result = played.view.view(0.0)['result']
    assert result['fit'] == {'files': 'fit'}
    assert [row['joint'] for row in result['joints'] if row['std_deg'] is None] == ['joint_7']


def test_strangers_cannot_fill_the_memory_or_break_the_page(played):
    view, long = played.view, 'x' * 100_000
    for i in range(1000):
        view.take_summary(f'stranger_{i}', 'ok', long, {'configurations': long}, 1.0)
        view.take(events.SensorReport(sensor=f'sensor_{i}', ready=True, message=long), 1.0)
        view.take(events.ArmStopped(stamp='', reason=long), 1.0)
        view.take_registration(f'sensor_{i}', np.eye(4))
    view.take_summary('pose_planner', 'ok', long, {'configurations': 'many'}, 1.0)
    view.take(events.TourPlanned(long), 1.0)
    view.take_precision(json.dumps({'message': long, 'looks': looks(*[0.1] * 5000)}))
    view.take(events.BridgeState(halted=long), 1.0)
    view.take_joints(np.full(7, np.nan))
    view.take_target(np.full((4, 4), np.inf))
    view.take_way(np.full((2, 7), np.nan))
    view.take_way(np.zeros((10_000, 7)))
    view.take(events.PlannerState(state=long, run=long), 1.0)
    shown = view.view(1.0)
    assert len(shown['nodes']) == MOST_NODES
    assert len(shown['halted']) == LONGEST_TEXT
    content = msgspec.json.encode(shown)
    assert len(content) < 150_000
    json.loads(content, parse_constant=pytest.fail)
