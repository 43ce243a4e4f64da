# SPDX-License-Identifier: Apache-2.0
"""The tables of the supervisor's states: what they allow, that all of it happens, and the page."""

import copy
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from supervisor_rig import HOME, Rig, restless, stays_halted
from test_supervisor_way_out import in_contact

from remaster_ros.motion import arm_supervisor
from remaster_ros.motion.actions import CheckPath, Drive, Halted, PathAnswer, Stop
from remaster_ros.motion.pieces import HORIZON_S
from remaster_ros.motion.states import ARM, CONSENT, PLACE, Arm, Consent, Event, Place, Word, after

DOCS = Path(__file__).parents[3] / 'docs'


def does(action):
    """Return the rows of the table in which such an action leaves the supervisor."""
    return {
        (state, event)
        for state, rows in ARM.items()
        for event, then in rows.items()
        if action in then.actions
    }


# What the tables allow


def test_only_an_arm_that_stands_is_sent_anywhere():
    assert does(Drive) == {(Arm.STANDS, e) for e in (Event.PROBE, Event.LEAVE, Event.MOVE)}


def test_only_an_arm_on_a_checked_way_is_stopped():
    both = (Event.STOP, Event.HALT_BRAKING)
    assert does(Stop) == {(state, event) for state in (Arm.MOVES, Arm.LEAVES) for event in both}


def test_only_a_person_ends_a_halt():
    is_halted = {Arm.HALTS, Arm.HALTED}
    for state in is_halted:
        out = {e for e, then in ARM[state].items() if then.state not in is_halted}
        assert out == {Event.CLEARED}
        assert not any({Drive, Stop, CheckPath} & {*then.actions} for then in ARM[state].values())


@pytest.mark.parametrize('state', [s for s in Arm if s not in (Arm.HALTS, Arm.HALTED)])
def test_every_other_state_can_be_halted_and_the_halt_is_told(state):
    for event in (Event.HALT, Event.GIVEN_UP):
        then = ARM[state][event]
        assert then.state in (Arm.HALTS, Arm.HALTED)
        assert then.actions == (Halted,)
    assert Event.STOP in ARM[state]


def test_an_arm_is_moved_only_where_it_is_known_to_be_as_reported():
    """A probe or a way out may come before; no other way leads to a place that is known."""
    ways = {
        (place, finding)
        for place, rows in PLACE.items()
        for finding, then in rows.items()
        if then is Place.KNOWN
    }
    assert {place for place, _ in ways} == {Place.FREE, Place.PROBED}
    for place in Place:
        assert after(PLACE, place, 'a new run, or no believed reports') in (
            Place.UNKNOWN,
            Place.MAY_LEAVE,
        )


def test_only_a_run_that_a_person_begins_gives_the_consent_that_was_asked_for():
    assert {w for w, then in CONSENT[Consent.ASKED].items() if then is not Consent.ASKED} == {
        Word.BEGUN
    }


# All of it happens


def moves(rig):
    rig.go([0.9, -1.0])
    return rig


def asks(rig):
    rig.answer_path = lambda request: None
    rig.plan([0.9, -1.0])
    return rig


def measures(rig):
    rig.visit([0.2, 0.1])
    return rig


def probes(rig):
    rig = Rig(begun=False)
    rig.plan([0.5, 0.5])
    rig.run(5.0, lambda: rig.supervisor.state is Arm.PROBES)
    return rig


def leaves(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    rig.collect()
    rig.run(30.0, lambda: rig.supervisor.state is Arm.LEAVES and rig.speed() > 0.02)
    return rig


def brakes(rig):
    moves(rig)
    pause(rig)
    return rig


def halts(rig):
    moves(rig)
    rival(rig)
    return rig


def halted(rig):
    emergency(rig)
    rig.do(rig.supervisor.emergency(False, rig.wall))
    return rig


pause = Rig.pause


def rival(rig):
    rig.do(rig.supervisor.observe('rivals', 'another publisher', rig.wall))


def emergency(rig):
    rig.do(rig.supervisor.emergency(True, rig.wall))


def given_up(rig):
    rig.do(rig.supervisor.given_up('the controller refuses'))


def another(rig):
    rig.plan([0.3, 0.3])


def not_sent(rig):
    command = rig.said(Drive, Stop)[-1]
    rig.do(rig.supervisor.not_sent(command, rig.wall + 2.0))


def goes_on(rig):
    rig.run(60.0, lambda: rig.supervisor.state in (Arm.STANDS, Arm.MEASURES, Arm.HALTED))


def freezes(rig):
    rig.freeze()
    goes_on(rig)


def clears(rig):
    rig.supervisor.clear_halt()
    rig.supervisor.clear_halt()


def at_its_end(rig):
    """Pause in the last ramp, which is a stop by itself."""
    for _ in range(4000):
        seen, visit = rig.supervisor._seen, rig.supervisor._motion.visit
        if visit is None or visit.following.has_ended(seen, rig.wall, 1.0):
            break
        rig.step()
    pause(rig)


def never_settles(rig):
    rig.alter = restless(rig)
    rig.plan([0.2, 0.1])
    rig.run(30.0, lambda: rig.supervisor.state is Arm.STANDS)


def not_answered(rig):
    rig.run(60.0, lambda: rig.supervisor.state is not Arm.MEASURES)


def is_moved_by_hand(rig):
    rig.arm.follow(rig.t, [])
    rig.alter = lambda t, q: np.add(q, [0.05, 0.0])
    rig.run(3.0)


def refused(rig):
    rig.answer_path = lambda request: PathAnswer(None, 'a post')
    rig.plan([0.3, 0.3])


def goes_on_after_its_stop(rig):
    rig.alter = lambda t, q: np.add(q, [0.05, 0.0])
    rig.run(5.0)


def is_away_for_a_while(rig):
    """The process stands still while the next piece would be due."""
    rig.alive.discard('bridge')
    rig.run(1.1)
    rig.alive.add('bridge')
    rig.run(3.0)


REACHED = {
    Arm.STANDS: (lambda rig: rig, [emergency, given_up, another, pause, refused]),
    Arm.ASKS: (asks, [emergency, given_up, another, pause]),
    Arm.PROBES: (probes, [emergency, given_up, pause, goes_on, not_sent, is_moved_by_hand]),
    Arm.LEAVES: (
        leaves,
        [emergency, given_up, pause, rival, goes_on, not_sent, freezes, at_its_end],
    ),
    Arm.MOVES: (
        moves,
        [emergency, given_up, pause, rival, goes_on, not_sent, freezes, at_its_end],
    ),
    Arm.MEASURES: (
        measures,
        [emergency, given_up, another, pause, not_answered, is_moved_by_hand],
    ),
    Arm.BRAKES: (
        brakes,
        [emergency, given_up, another, pause, goes_on, not_sent, goes_on_after_its_stop],
    ),
    Arm.HALTS: (
        halts,
        [given_up, another, pause, goes_on, not_sent, goes_on_after_its_stop, clears],
    ),
    Arm.HALTED: (halted, [given_up, another, pause, clears]),
}


@pytest.fixture
def rows(monkeypatch):
    """Return the rows that were used."""
    used = set()
    step = arm_supervisor.ArmSupervisor._step

    def recorded(supervisor, event, *actions):
        before = supervisor.state
        actions_left = step(supervisor, event, *actions)
        then = ARM[before][event]
        assert supervisor.state is then.state
        assert tuple(map(type, actions_left)) == then.actions
        used.add((before, event))
        return actions_left

    monkeypatch.setattr(arm_supervisor.ArmSupervisor, '_step', recorded)
    return used


def test_every_row_of_the_table_happens_and_nothing_else(rows, rig):
    begun = rig
    for state, (reach, causes) in REACHED.items():
        for cause in causes:
            rig = reach(copy.deepcopy(begun))
            assert rig.supervisor.state is state, cause
            cause(rig)
            assert 'a fault of this program' not in rig.supervisor.halted, (state, cause)
    for state, reach in ((Arm.MOVES, moves), (Arm.LEAVES, leaves)):
        for cause in (goes_on, is_away_for_a_while):
            rig = copy.deepcopy(begun)
            rig.supervisor._motion.horizon_s = HORIZON_S
            limits = rig.supervisor.gate.limits
            if state is Arm.MOVES:
                # A long way, so that it has pieces; that out of a contact is slow anyway.
                slow = dataclasses.replace(limits, velocity=limits.velocity / 3.0)
                rig.do(rig.supervisor.use_limits(slow, rig.wall))
            rig = reach(rig)
            assert rig.supervisor.state is state
            cause(rig)
            assert 'a fault of this program' not in rig.supervisor.halted
    rig = copy.deepcopy(begun)
    never_settles(rig)
    rig = measures(copy.deepcopy(begun))
    rig.answer(0)
    assert rows == {(state, event) for state, events in ARM.items() for event in events}


@pytest.mark.parametrize('event', [Event.MOVE, Event.CHECKED])
def test_what_is_not_in_the_table_halts_and_commands_nothing(rig, monkeypatch, event):
    state = Arm.STANDS if event is Event.MOVE else Arm.ASKS
    less = {e: then for e, then in ARM[state].items() if e is not event}
    monkeypatch.setattr(arm_supervisor, 'ARM', {**ARM, state: less})
    rig.plan([0.9, -1.0])
    rig.run(2.0)
    assert rig.supervisor.halted == f'a fault of this program: "{event}" while the arm {state}'
    assert not rig.commands
    assert len(rig.said(Halted)) == 1
    np.testing.assert_allclose(rig.supervisor.end, HOME, atol=2e-6)
    stays_halted(rig, rig.supervisor.halted)


# What a person reads


def test_the_page_has_the_tables():
    sys.path.insert(0, str(DOCS))
    try:
        import make_states
    finally:
        sys.path.remove(str(DOCS))
    text = make_states.PAGE.read_text(encoding='utf-8')
    assert make_states.page(text) == text, 'run: python docs/make_states.py'
