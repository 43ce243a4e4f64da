# SPDX-License-Identifier: Apache-2.0
"""What the planner does, and in which run: a token is gone on with only where it surely lives."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from remaster_ros.collection.collection_run import NOT_LIVING, CollectionRun
from remaster_ros.collection.events import BridgeState, PlannerState, RecorderState

BRIDGE = BridgeState(halted='', run='a')
RECORDER = RecorderState(waiting_for='', run='a')
ALIVE_S = 1.0


def left_running():
    run = CollectionRun(30.0)
    run.resume('running', 'a', 'half of it')
    return run


def test_a_new_planner_is_idle_and_begins_with_a_token_of_its_own():
    run = CollectionRun(30.0)
    assert (run.state, run.token, run.why) == ('idle', '', '')
    run.collect('a')
    assert (run.state, run.token) == ('running', 'a')
    run.collect('b')
    assert run.token == 'a', 'collect in a run begins none'


def test_each_collect_after_a_pause_is_another_run():
    run = CollectionRun(30.0)
    run.collect('a')
    assert run.pause()
    assert (run.state, run.token) == ('paused', '')
    run.collect('b')
    assert (run.state, run.token) == ('running', 'b')


@pytest.mark.parametrize('state', ['idle', 'stopped', 'complete', 'failed'])
def test_what_does_not_run_is_not_paused(state):
    run = CollectionRun(30.0)
    run.end(state)
    assert not run.pause()
    assert run.state == state


def test_an_end_from_another_state_is_none():
    run = CollectionRun(30.0)
    run.collect('a')
    run.stop()
    assert not run.end('paused', 'a halt that came late', only_from='running')
    assert (run.state, run.why) == ('stopped', '')


# A planner that is started again


def test_a_run_that_lives_is_gone_on_with():
    run = left_running()
    assert (run.state, run.token, run.left) == ('idle', '', 'a')
    assert run.take_up(ALIVE_S, BRIDGE, RECORDER, 'half')
    assert (run.state, run.token, run.left, run.why) == ('running', 'a', '', '')


@pytest.mark.parametrize(
    ('silence_s', 'bridge', 'recorder', 'reason'),
    [
        (None, BRIDGE, RECORDER, NOT_LIVING),
        (31.0, BRIDGE, RECORDER, 'its run has been without a planner for 31 s'),
        (31.0, None, None, 'its run has been without a planner for 31 s'),
        (
            ALIVE_S,
            BridgeState(halted='', run='b'),
            RECORDER,
            'robot_bridge did not take part in its run',
        ),
        (
            ALIVE_S,
            BridgeState(halted=''),
            RecorderState(waiting_for=''),
            'robot_bridge and recorder did not take part in its run',
        ),
        (ALIVE_S, BridgeState(halted='lag', run='a'), RECORDER, 'the arm is halted: lag'),
        (
            ALIVE_S,
            BRIDGE,
            RecorderState(waiting_for='', run='a', changed='moved', changed_run='a'),
            'moved',
        ),
        (
            ALIVE_S,
            BRIDGE,
            RecorderState(waiting_for='', run='a', changed='moved', changed_run=''),
            'moved',
        ),
    ],
)
def test_a_run_that_may_not_live_waits_for_a_person(silence_s, bridge, recorder, reason):
    run = left_running()
    assert run.take_up(silence_s, bridge, recorder, 'half')
    assert (run.state, run.token, run.left) == ('idle', '', '')
    assert run.why == f'half; /remaster/collect goes on ({reason})'


@pytest.mark.parametrize(('bridge', 'recorder'), [(None, RECORDER), (BRIDGE, None), (None, None)])
def test_both_must_confirm_the_run(bridge, recorder):
    run = left_running()
    assert not run.take_up(ALIVE_S, bridge, recorder, 'half')
    assert (run.state, run.left) == ('idle', 'a')
    assert run.take_up(ALIVE_S, BRIDGE, RECORDER, 'half')
    assert run.state == 'running'


def test_a_change_of_an_earlier_run_does_not_matter():
    run = left_running()
    seen = RecorderState(waiting_for='', run='a', changed='moved', changed_run='before')
    assert run.take_up(ALIVE_S, BRIDGE, seen, 'half')
    assert run.state == 'running'


@pytest.mark.parametrize('act', [CollectionRun.pause, CollectionRun.stop])
def test_a_pause_comes_before_a_run_is_gone_on_with(act):
    run = left_running()
    act(run)
    assert run.left == ''
    assert run.state in ('paused', 'stopped')
    assert run.take_up(ALIVE_S, BRIDGE, RECORDER, 'half')
    assert run.state in ('paused', 'stopped')


@pytest.mark.parametrize(
    ('state', 'now', 'why'),
    [
        ('complete', 'complete', ''),
        ('paused', 'idle', 'half; /remaster/collect goes on (it was paused)'),
        ('failed', 'idle', 'half; /remaster/collect goes on (it was failed)'),
    ],
)
def test_what_was_not_running_does_not_go_on_by_itself(state, now, why):
    run = CollectionRun(30.0)
    run.resume(state, '', 'half')
    assert (run.state, run.left, run.why) == (now, '', why)


# What a person may begin


@pytest.mark.parametrize(
    ('bridge', 'recorder', 'has_joints', 'words'),
    [
        (None, None, False, 'no joint_states yet'),
        (BridgeState(halted='lag'), None, True, 'the arm is halted: lag; /remaster/clear_halt'),
        (
            None,
            RecorderState(waiting_for='', exit_status='complete'),
            True,
            'give it a new folder',
        ),
        (None, RecorderState(waiting_for='', changed_run=''), True, 'started just now'),
    ],
)
def test_collect_is_refused_with_a_reason(bridge, recorder, has_joints, words):
    refusal = CollectionRun(30.0).refusal(bridge, recorder, has_joints=has_joints)
    assert words in refusal


@pytest.mark.parametrize('bridge', [None, BRIDGE])
@pytest.mark.parametrize(
    'recorder', [None, RECORDER, RecorderState(waiting_for='', changed_run='a')]
)
def test_collect_is_not_refused_without_one(bridge, recorder):
    assert CollectionRun(30.0).refusal(bridge, recorder, has_joints=True) == ''


@pytest.mark.parametrize('state', ['complete', 'failed'])
def test_what_has_ended_for_good_is_not_collected_again(state):
    run = CollectionRun(30.0)
    run.end(state, 'no pose is left')
    refusal = run.refusal(BRIDGE, RECORDER, has_joints=True)
    assert refusal == f'the collection is {state}: no pose is left'


# In any order


@given(
    st.lists(
        st.sampled_from(['collect', 'pause', 'stop', 'halt', 'complete', 'take up', 'dead']),
        max_size=12,
    ),
    st.booleans(),
)
@settings(max_examples=200)
def test_only_a_person_or_a_living_run_makes_it_run(steps, was_running):
    run = CollectionRun(30.0)
    if was_running:
        run.resume('running', 'a', 'half')
    used = set()
    for number, step in enumerate(steps):
        before = run.state, run.token
        match step:
            case 'collect':
                run.collect(f'token {number}')
            case 'pause':
                run.pause()
            case 'stop':
                run.stop()
            case 'halt':
                run.end('paused', 'lag', only_from='running')
            case 'complete':
                run.end('complete', only_from='running')
            case 'take up' if run.left:
                run.take_up(ALIVE_S, BRIDGE, RECORDER, '')
            case 'dead' if run.left:
                run.take_up(None, BRIDGE, RECORDER, '')
        assert bool(run.token) == (run.state == 'running')
        if run.state == 'running' and before[0] != 'running':
            assert step in ('collect', 'take up')
            assert run.token not in used, 'a run that has ended is another one'
            used.add(run.token)
        assert not (run.left and run.state == 'running')


def test_a_complete_collection_is_gone_further_with_where_that_can_be_measured():
    run = CollectionRun(30.0)
    run.end('complete')
    recorder = RecorderState(waiting_for='', run='', exit_status='complete')
    assert 'start anew' in run.refusal(BRIDGE, recorder, has_joints=True)
    why = run.refusal(BRIDGE, recorder, has_joints=True, further='no look-alikes')
    assert why == 'the collection is complete: no look-alikes'
    assert run.refusal(BRIDGE, recorder, has_joints=True, further='') == ''
    run.end('failed')
    assert 'failed' in run.refusal(BRIDGE, recorder, has_joints=True, further='')
    # Of another plan, or with nothing to go further with.
    other = CollectionRun(30.0)
    assert 'give it a new folder' in other.refusal(BRIDGE, recorder, has_joints=True)


def test_only_a_running_planner_of_the_same_plan_opens_a_complete_session():
    state = PlannerState(state='running', run='a', further='p')
    assert state.goes_further('p')
    assert not state.goes_further('q')
    assert not PlannerState(state='complete', run='', further='p').goes_further('p')
    assert not PlannerState(state='running', run='a').goes_further('')
