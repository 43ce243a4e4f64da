# SPDX-License-Identifier: Apache-2.0
"""The states of the bridge's supervisor and all ways from one to another: three tables.

`ARM`: what the arm does by this program, and what leaves the bridge with each step. `PLACE`: how
far it is known that the arm is where it is reported, and so which move comes next. `CONSENT`:
whether the program may go on by itself. The first is on docs/safety.md as it stands here. What
has no row in `ARM` does not happen: the supervisor halts the arm where it is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from remaster_ros.motion.actions import (
    Action,
    CheckPath,
    Drive,
    Failed,
    Halted,
    Renew,
    Settled,
    Stop,
)


class Arm(StrEnum):
    """State of the arm."""

    STANDS = 'stands'  # Nothing is under way
    ASKS = 'asks'  # It is found out whether a way, or where the arm stands, is free
    PROBES = 'probes'
    LEAVES = 'leaves'  # A contact or a margin, slowly
    MOVES = 'moves'  # To a configuration
    MEASURES = 'measures'  # It has settled, until the recorder answers
    BRAKES = 'brakes'  # And goes on when nothing is in the way
    HALTS = 'halts'  # It brakes, and is halted then
    HALTED = 'halted'  # Until a person clears the halt


HAS_VISIT = (Arm.PROBES, Arm.LEAVES, Arm.MOVES, Arm.MEASURES)
HAS_STOP = (Arm.BRAKES, Arm.HALTS)


class Event(StrEnum):
    """Event that may change the state of the arm."""

    ASK = 'where it stands or its way is to be checked'
    CHECKED = 'the check is answered'
    PROBE = 'the probe is next'
    LEAVE = 'the way out is next'
    MOVE = 'its way is free'
    RENEW = 'the next piece of the move is due'
    MISSED = 'the next piece of the move comes too late'
    REFUSED = 'no way, or the gate refuses it'
    SETTLED = 'settled at its target'
    FAILED = 'not at its target, or no answer, in time'
    ANSWERED = 'the recorder is done'
    ENDED = 'at its end'
    NEW_POSE = 'another pose'
    STOP = 'a reason to stop'
    STOP_AT_END = 'a reason to stop, at the end of its way'
    HALT = 'a reason to halt'
    HALT_BRAKING = 'a reason to halt an arm that follows its path'
    ASTRAY = 'not where it should be'
    GIVEN_UP = 'the controller gives up'
    MOVE_NOT_SENT = 'this process was paused before the move'
    STOP_NOT_SENT = 'this process was paused before the stop'
    CLEARED = 'a person clears the halt'


@dataclass(frozen=True)
class Then:
    """Next state and actions after an event."""

    state: Arm
    actions: tuple[type[Action], ...] = ()  # What leaves the supervisor, in this order


def _always(state: Arm) -> dict[Event, Then]:
    """Return the transitions that most states have: of `STOP`, `HALT` and `GIVEN_UP`.

    A stop leaves the state as it is, without an action; a halt, and a controller that gives
    up, lead to `Arm.HALTED` with the action `Halted`. ``state``: the state whose transitions
    they are.
    """
    return {
        Event.STOP: Then(state),
        Event.HALT: Then(Arm.HALTED, (Halted,)),
        Event.GIVEN_UP: Then(Arm.HALTED, (Halted,)),
    }


def _commanded(state: Arm) -> dict[Event, Then]:
    """Return the transitions of a state with a move under way, in which a stop is commanded.

    ``state``: `Arm.LEAVES` or `Arm.MOVES`.
    """
    return {
        **_always(state),
        Event.STOP: Then(Arm.BRAKES, (Stop,)),
        Event.STOP_AT_END: Then(Arm.STANDS),
        Event.HALT_BRAKING: Then(Arm.HALTS, (Stop, Halted)),
        Event.ASTRAY: Then(Arm.HALTED, (Halted,)),
        Event.MOVE_NOT_SENT: Then(Arm.STANDS),
        Event.RENEW: Then(state, (Renew,)),
        # Its piece ends in a stop by itself.
        Event.MISSED: Then(Arm.BRAKES),
    }


ARM: Mapping[Arm, Mapping[Event, Then]] = {
    Arm.STANDS: {
        **_always(Arm.STANDS),
        Event.NEW_POSE: Then(Arm.STANDS),
        Event.ASK: Then(Arm.ASKS, (CheckPath,)),
        Event.PROBE: Then(Arm.PROBES, (Drive,)),
        Event.LEAVE: Then(Arm.LEAVES, (Drive,)),
        Event.MOVE: Then(Arm.MOVES, (Drive,)),
        Event.REFUSED: Then(Arm.STANDS, (Failed,)),
    },
    Arm.ASKS: {
        **_always(Arm.ASKS),
        Event.NEW_POSE: Then(Arm.STANDS),
        Event.CHECKED: Then(Arm.STANDS),
    },
    Arm.PROBES: {
        **_always(Arm.PROBES),
        # A micrometre needs no stop; one would be fast for an arm that is not as reported.
        Event.STOP: Then(Arm.STANDS),
        Event.ENDED: Then(Arm.STANDS),
        Event.ASTRAY: Then(Arm.HALTED, (Halted,)),
        Event.MOVE_NOT_SENT: Then(Arm.STANDS),
    },
    Arm.LEAVES: {**_commanded(Arm.LEAVES), Event.ENDED: Then(Arm.STANDS)},
    Arm.MOVES: {
        **_commanded(Arm.MOVES),
        Event.SETTLED: Then(Arm.MEASURES, (Settled,)),
        Event.FAILED: Then(Arm.STANDS, (Failed,)),
    },
    Arm.MEASURES: {
        # The reading goes on, only no command follows it.
        **_always(Arm.MEASURES),
        Event.NEW_POSE: Then(Arm.STANDS),
        Event.ANSWERED: Then(Arm.STANDS),
        Event.FAILED: Then(Arm.STANDS, (Failed,)),
        Event.ASTRAY: Then(Arm.HALTED, (Halted,)),
    },
    Arm.BRAKES: {
        **_always(Arm.BRAKES),
        Event.HALT: Then(Arm.HALTS, (Halted,)),
        Event.NEW_POSE: Then(Arm.BRAKES),
        Event.ENDED: Then(Arm.STANDS),
        Event.ASTRAY: Then(Arm.HALTED, (Halted,)),
        Event.STOP_NOT_SENT: Then(Arm.HALTED, (Halted,)),
    },
    Arm.HALTS: {
        Event.STOP: Then(Arm.HALTS),
        Event.NEW_POSE: Then(Arm.HALTS),
        Event.ENDED: Then(Arm.HALTED),
        # Once more: a controller by action is cancelled then.
        Event.ASTRAY: Then(Arm.HALTED, (Halted,)),
        Event.STOP_NOT_SENT: Then(Arm.HALTED, (Halted,)),
        Event.GIVEN_UP: Then(Arm.HALTED),
        Event.CLEARED: Then(Arm.STANDS),
    },
    Arm.HALTED: {
        Event.STOP: Then(Arm.HALTED),
        Event.NEW_POSE: Then(Arm.HALTED),
        Event.GIVEN_UP: Then(Arm.HALTED),
        Event.CLEARED: Then(Arm.STANDS),
    },
}


class Place(StrEnum):
    """Knowledge of whether the arm is where it is reported, and may stand there."""

    UNKNOWN = 'unknown'  # First it is found out whether it may stand where it is reported
    FREE = 'free'  # Then the probe shows that reports are measured
    KNOWN = 'known'  # Then it is moved
    PROBED = 'probed'  # By the probe before a way out: it is found out whether it may stand there
    MAY_LEAVE = 'may leave'  # A person has allowed the way out: first the probe
    LEAVES_NEXT = 'leaves next'  # Then the way out


class Finding(StrEnum):
    """Event that changes the knowledge of the arm's place."""

    FREE = 'nothing touches it there'
    ENDED = 'a probe or a way out has ended'
    LEFT = 'the way out is begun'
    DOUBT = 'a new run, or no believed reports'
    CLEARED = 'a person clears a halt'
    ALLOWED = 'a person clears a halt that has offered a way out'


_ANEW = {Finding.CLEARED: Place.UNKNOWN, Finding.ALLOWED: Place.MAY_LEAVE}
PLACE: Mapping[Place, Mapping[Finding, Place]] = {
    Place.UNKNOWN: {
        **_ANEW,
        Finding.FREE: Place.FREE,
        Finding.ENDED: Place.PROBED,
        Finding.DOUBT: Place.UNKNOWN,
    },
    Place.FREE: {**_ANEW, Finding.ENDED: Place.KNOWN, Finding.DOUBT: Place.UNKNOWN},
    Place.KNOWN: {**_ANEW, Finding.DOUBT: Place.UNKNOWN},
    Place.PROBED: {
        **_ANEW,
        Finding.FREE: Place.KNOWN,
        Finding.ENDED: Place.PROBED,
        Finding.DOUBT: Place.UNKNOWN,
    },
    Place.MAY_LEAVE: {
        **_ANEW,
        Finding.ENDED: Place.LEAVES_NEXT,
        Finding.DOUBT: Place.MAY_LEAVE,
    },
    Place.LEAVES_NEXT: {
        **_ANEW,
        Finding.LEFT: Place.PROBED,
        Finding.DOUBT: Place.MAY_LEAVE,
    },
}


class Consent(StrEnum):
    """Whether the program may go on by itself."""

    GIVEN = 'given'
    HELD = 'held'  # Something is in the way, since a time
    ASKED = 'asked'  # Only a person goes on, by /remaster/collect


class Word(StrEnum):
    """Event that changes a person's consent to move."""

    HINDERED = 'something is in the way after the first move'
    FREE = 'nothing is in the way any more'
    TOO_LONG = 'for more than resume_alone_s, and the robot did not say "released" all the time'
    REVOKED = 'a person has cleared a halt or raised a limit'
    BEGUN = 'a person has begun a run'


CONSENT: Mapping[Consent, Mapping[Word, Consent]] = {
    Consent.GIVEN: {
        Word.HINDERED: Consent.HELD,
        Word.REVOKED: Consent.ASKED,
        Word.BEGUN: Consent.GIVEN,
    },
    Consent.HELD: {
        Word.HINDERED: Consent.HELD,
        Word.FREE: Consent.GIVEN,
        Word.TOO_LONG: Consent.ASKED,
        Word.REVOKED: Consent.ASKED,
        Word.BEGUN: Consent.GIVEN,
    },
    Consent.ASKED: {Word.REVOKED: Consent.ASKED, Word.BEGUN: Consent.GIVEN},
}

S = TypeVar('S', bound=StrEnum)
E = TypeVar('E', bound=StrEnum)


def after(table: Mapping[S, Mapping[E, S]], state: S, event: E) -> S:
    """Return the state after an event; unchanged if the table has no row for the event."""
    return table[state].get(event, state)
