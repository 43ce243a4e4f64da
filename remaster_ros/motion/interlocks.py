# SPDX-License-Identifier: Apache-2.0
"""What must be right before an arm may move: live nodes, observations, a person's consent."""

from __future__ import annotations

import numpy as np

from remaster_ros.motion.states import CONSENT, Consent, Word, after

NAMES = ('planner', 'recorder', 'robot')
"""The nodes that must be live; their reasons not to move count in this order."""
OBSERVED = ('safety_link', 'model', 'controller', 'clock', 'rivals')
"""What else must be right."""
KNOWN_S = 1.0
"""A planner's run that appears this soon after its first summary may be an old one, because the
summaries that were under way while this process started arrive together, s of wall time."""
OWN_PAUSE_S = 0.5
"""If more passes between two looks at the clock, this process was paused, s of wall time."""


class Interlocks:
    """Reasons not to move, each by its origin, and when each origin last gave a sign of life.

    Origins are nodes (`NAMES`), other things observed (`OBSERVED`) and 'safety'.
    ``heartbeat_s``: longest silence of those in `NAMES`, s of wall time; ``resume_alone_s``:
    after a longer interruption of a run only a person goes on, s of wall time. Attributes:
    ``consent``: see `states.CONSENT`; ``paused``: whether the planner was paused, by its last
    record; ``run``: the run of a collection that was reported last; '' before the first.
    """

    def __init__(self, heartbeat_s: float, resume_alone_s: float) -> None:
        self.consent, self.paused, self.run = Consent.GIVEN, False, ''
        # Where it is asked for: why.
        self._must_collect = ''
        self._resume_alone_s = resume_alone_s
        # Whether the arm was moved in this run: what is waited for before is no interruption.
        self._moved = False
        # Where it is held: since when, and whether the robot reported all the time since that it
        # is not stopped.
        self._held_since_wall = np.inf
        self._released = False
        self._planner_since_wall = -np.inf
        self._heartbeat_s = heartbeat_s
        self._seen: dict[str, float] = {}
        self._reasons: dict[str, str] = {}
        self._looked_wall: float | None = None

    def note_alive(self, name: str, reason: str, wall_s: float) -> None:
        """Note a sign of life of a node at `wall_s`, s, and its reason not to move, '' for none.

        ``name``: one of `NAMES`.
        """
        self._seen[name], self._reasons[name] = wall_s, reason

    def planner(self, state: str, run: str, wall_s: float) -> bool:
        """Process the planner's state; return whether its run replaces an earlier, other run.

        False for the first run, and for ''. The call is a sign of life. Every new run, also
        the first, gives consent to move, unless it appears within `KNOWN_S` of the planner's
        first sign of life after a silence: then it may be an old run, which no person has just
        begun.

        ``state``: anything but ``running`` is a reason not to move; ``run``: token of the
        collection run, '' if none is under way; ``wall_s``: now, s.
        """
        self.paused = state == 'paused'
        if self.silence_s('planner', wall_s) > self._heartbeat_s:
            self._planner_since_wall = wall_s
        is_new = bool(run) and run != self.run
        began_another = is_new and bool(self.run)
        if is_new:
            self.run, self._moved = run, False
            if wall_s - self._planner_since_wall >= KNOWN_S:
                self.say(Word.BEGUN)
        self.note_alive('planner', '' if state == 'running' else f'planner is {state}', wall_s)
        return began_another

    def set(self, name: str, reason: str) -> None:
        """Set an origin's reason not to move, '' for none; this is no sign of life.

        ``name``: the origin, such as one of `OBSERVED`.
        """
        self._reasons[name] = reason

    def reason(self, name: str) -> str:
        """Return an origin's reason not to move, or ''.

        ``name``: the origin; '' also if nothing was heard of it.
        """
        return self._reasons.get(name, '')

    def was_right(self, name: str) -> bool:
        """Whether an origin was observed, and gave no reason against a motion.

        False if nothing was heard of it; ``name``: the origin.
        """
        return self._reasons.get(name) == ''

    def look(self, wall_s: float) -> None:
        """Correct the times of the last signs of life for a pause of this process.

        Nodes were not silent in it. A pause is more than `OWN_PAUSE_S` between two calls; the
        times are shifted by all of that, but not into the future. ``wall_s``: now, s.
        """
        last, self._looked_wall = self._looked_wall, wall_s
        if last is None or wall_s - last <= OWN_PAUSE_S:
            return
        pause = wall_s - last
        # Signs of life since then are shifted too, but not into the future.
        self._seen = {name: min(seen + pause, wall_s) for name, seen in self._seen.items()}

    def silence_s(self, name: str, wall_s: float) -> float:
        """Return the time since the last sign of life, s; infinite if there was none.

        ``name``: one of `NAMES`; ``wall_s``: now, s.
        """
        return wall_s - self._seen[name] if name in self._seen else np.inf

    def fell_silent(self, name: str, wall_s: float) -> str:
        """Message that a node has been silent for more than `heartbeat_s`; else ''.

        '' also if it has never given a sign of life. ``name``: one of `NAMES`; ``wall_s``:
        now, s.
        """
        if name in self._seen and self.silence_s(name, wall_s) > self._heartbeat_s:
            return f'no sign of {name} for {self._heartbeat_s:g} s'
        return ''

    @property
    def collecting(self) -> bool:
        """Whether the planner's last state is ``running``, with a person's consent to move.

        Consent that is held, as something is in the way, counts.
        """
        runs = 'planner' in self._seen and not self.reason('planner')
        return runs and self.consent is not Consent.ASKED

    def note_moved(self) -> None:
        """Note that the arm is moved: from then on a reason not to move interrupts this run."""
        self._moved = True

    def interrupted(self, since_wall_s: float) -> None:
        """Process that no process like this one has watched the arm since a time.

        The consent counts as held from then on, unless a person is asked for it already;
        `look_at_interruption` decides whether a person has to go on. ``since_wall_s``: wall
        time, s.
        """
        self._held_since_wall, self._released = since_wall_s, False
        self.say(Word.HINDERED)

    def stopped_on_its_way(self, wall_s: float) -> None:
        """Set a given consent to move to `Consent.HELD`: the arm stops with no reason not to move.

        Held from ``wall_s``, now, s. `look_at_interruption` then gives it again, or asks for a
        person, who must call /remaster/collect. Nothing happens if the consent is not given.
        """
        if self.consent is Consent.GIVEN:
            self._held_since_wall, self._released = wall_s, self._is_released
            self.say(Word.HINDERED)

    @property
    def _is_released(self) -> bool:
        """Whether the robot's safety circuit is known, and reports no stop."""
        return self.was_right('safety') and not self.reason('safety_link')

    def revoke(self, why: str) -> None:
        """Withdraw the consent to move until a person calls /remaster/collect.

        ``why``: reason for people.
        """
        self._must_collect = why
        self.say(Word.REVOKED)

    def say(self, word: Word) -> None:
        """Change the consent to move by the table `states.CONSENT`.

        An event without a row changes nothing.
        """
        self.consent = after(CONSENT, self.consent, word)

    def look_at_interruption(self, wall_s: float) -> None:
        """Hold the consent to move while there is a reason not to; after too long, ask a person.

        It is held here only if the arm was moved in this run, and given again once there is no
        reason. If it was held for more than `resume_alone_s` (with 0: at all), a person may
        stand beside the arm, and must call /remaster/collect; not if no run is known, or if
        the robot reported all of that time that its safety circuit does not stop it.
        ``wall_s``: now, s.
        """
        released = self._is_released
        reason = self._hindrance(wall_s)
        if self.consent is Consent.GIVEN and reason and self._moved:
            self._held_since_wall, self._released = wall_s, released
            self.say(Word.HINDERED)
        if self.consent is not Consent.HELD:
            return
        self._released &= released
        lasted_s = wall_s - self._held_since_wall
        # With 0 none is short enough, also one that is looked at twice at the same time.
        too_long = lasted_s > self._resume_alone_s or not self._resume_alone_s
        if self.run and not self._released and too_long:
            self._must_collect = (
                'the collection was interrupted'
                f'{f" for more than {self._resume_alone_s:g} s" if self._resume_alone_s else ""}'
                f'{f" ({reason})" if reason else ""}'
            )
            self.say(Word.TOO_LONG)
        elif not reason:
            self.say(Word.FREE)

    def blocked(self, wall_s: float) -> str:
        """Return the first reason not to move (silence, trouble, a person's consent), or ''.

        ``wall_s``: now, s.
        """
        return self._hindrance(wall_s) or self.asks_for_collect

    @property
    def asks_for_collect(self) -> str:
        """Why nothing moves before a person calls /remaster/collect; '' if that is not needed."""
        asked = self.consent is Consent.ASKED
        return f'{self._must_collect}: /remaster/collect goes on' if asked else ''

    def _hindrance(self, wall_s: float) -> str:
        """First reason not to move, or '' if there is none: silent nodes, all in one text, first.

        Then reasons in the order of `NAMES` and `OBSERVED`. Silent: no sign of life for more
        than `heartbeat_s`, or none ever. ``wall_s``: now, s of wall time.
        """
        limit = self._heartbeat_s
        silent = [name for name in NAMES if self.silence_s(name, wall_s) > limit]
        if silent:
            return f'no sign of {", ".join(silent)} for {limit:g} s'
        return next(filter(None, map(self.reason, (*NAMES, *OBSERVED))), '')
