# SPDX-License-Identifier: Apache-2.0
"""State of the planner (idle, running, paused, stopped, complete or failed), and its run.

Each /remaster/collect begins a run, identified by a token, which recorder and bridge keep in
memory. A killed planner resumes by itself only a run that still lives, which both of them must
confirm: a person may stand beside an arm that has not moved for a while.
"""

from __future__ import annotations

from remaster_ros.collection.events import BridgeState, RecorderState

NOT_LIVING = 'its run was in another boot of this computer, or was ended'


class CollectionRun:
    """State of the planner, and the token of its run of the collection.

    Parameters
    ----------
    resume_within_s
        Longest time without a planner after which a run is resumed, s.

    Attributes
    ----------
    state
        As in `events.PlannerState`, without ``held``.
    why
        Why the planner is in that state or waits; ''.
    token
        Of the run under way, '' for none.
    left
        Token of the run of a killed planner, until it is known whether that run still lives.
    """

    def __init__(self, resume_within_s: float) -> None:
        self._resume_within_s = resume_within_s
        self.state, self.why, self.token, self.left = 'idle', '', '', ''

    def resume(self, state: str, token: str, progress: str) -> None:
        """Restore the state that the last planner process wrote: `complete`, or else `idle`.

        For a new object. If that state was ``running``, its token goes to `left`, for
        `take_up`. Unless the state is ``complete``, `why` says that the planner waits for
        /remaster/collect. ``state``, ``token``: as last written; ``progress``: of the
        collection, text for `why`.
        """
        if state == 'complete':
            self.state = state
            return
        self.left = token if state == 'running' else ''
        self.why = _waits(progress, '' if state == 'running' else f'it was {state}')

    def take_up(
        self,
        silence_s: float | None,
        bridge: BridgeState | None,
        recorder: RecorderState | None,
        progress: str,
    ) -> bool:
        """Resume the run of a killed planner if it still lives; return whether that is decided.

        It lives if the planner was silent for at most `resume_within_s`, bridge and recorder
        hold the token `left`, and neither a halt nor a changed setup asks for a person. Then
        `state` is ``running``; else `why` has the reason. Not decided before the first states
        of both, unless the silence rules it out. Once it is decided, `left` is ''.

        ``silence_s``: time since that planner renewed its liveness file, s; None if it did not
        in this boot of the computer, or has ended the run; ``bridge, recorder``: last states,
        None before the first; ``progress``: of the collection, as text.
        """
        reason = ''
        if silence_s is None:
            reason = NOT_LIVING
        elif silence_s > self._resume_within_s:
            reason = f'its run has been without a planner for {silence_s:.0f} s'
        elif bridge is None or recorder is None:
            self.why = 'waiting for robot_bridge and recorder to confirm the run'
            return False
        else:
            other_peers = [peer.sender for peer in (bridge, recorder) if peer.run != self.left]
            if other_peers:
                reason = f'{" and ".join(other_peers)} did not take part in its run'
            elif bridge.halted:
                reason = f'the arm is halted: {bridge.halted}'
            elif bridge.asks_for_collect:
                reason = bridge.asks_for_collect
            elif recorder.changed_run in (self.left, ''):
                reason = recorder.changed
        token, self.left = self.left, ''
        if reason:
            self.why = _waits(progress, reason)
        elif token:
            self.state, self.why, self.token = 'running', '', token
        return True

    def refusal(
        self,
        bridge: BridgeState | None,
        recorder: RecorderState | None,
        *,
        has_joints: bool,
        further: str | None = None,
    ) -> str:
        """Return why /remaster/collect does not begin or resume a run; '' if it does.

        ``bridge, recorder``: last states, None before the first; ``has_joints``: whether the
        arm's configuration is known; ``further``: of a complete collection, why no
        measurements are added to it, or '' if some are; None if no addition was requested:
        then a complete one is refused.
        """
        if not has_joints:
            return 'no joint_states yet: is the robot running?'
        if self.state == 'complete' and further:
            return f'the collection is complete: {further}'
        if self.state == 'failed' or (self.state == 'complete' and further is None):
            return f'the collection is {self.state}: {self.why or "start anew"}'
        if bridge is not None and bridge.halted:
            return f'the arm is halted: {bridge.halted}; /remaster/clear_halt, then collect'
        if recorder is not None and recorder.exit_status == 'complete' and further is None:
            return "the recorder's session is complete; give it a new folder"
        if recorder is not None and recorder.changed_run == '':
            return 'the recorder was started just now; try again in a second'
        return ''

    def collect(self, new_token: str) -> None:
        """Begin a run with this token; a run that is ``running`` goes on with its own.

        The state is ``running`` then, and `left` and `why` are ''.
        """
        self.left = ''
        if self.state != 'running':
            self.token = new_token
        self.state, self.why = 'running', ''

    def pause(self) -> bool:
        """End the run as ``paused``, also that of `left`; return whether the state is ``paused``.

        True too if it was paused before; another state is not changed.
        """
        if self.left or self.state == 'running':
            self.left = ''
            self.end('paused')
        return self.state == 'paused'

    def stop(self) -> None:
        """End the run as ``stopped``; the remaining poses can be collected in another run."""
        self.left = ''
        self.end('stopped')

    def end(self, state: str, why: str = '', *, only_from: str = '') -> bool:
        """End the run in a state, without a token; return whether that was done.

        False, and nothing is changed, if the state is not `only_from` ('' for any). ``why``:
        for people.
        """
        if only_from and self.state != only_from:
            return False
        self.state, self.why, self.token = state, why, ''
        return True


def _waits(progress: str, reason: str) -> str:
    """Return a message on a planner that waits for /remaster/collect.

    ``progress``: of the collection; ``reason``: why it waits, '' if there is nothing to say.
    """
    return f'{progress}; /remaster/collect goes on{f" ({reason})" if reason else ""}'
