# SPDX-License-Identifier: Apache-2.0
"""What the planner does: idle, running, paused, stopped, complete or failed; and in which run.

Each /remaster/collect begins a run, named by a token. Recorder and bridge hold the token in
memory. A planner that was killed goes on by itself only in a run that still lives, which both of
them must confirm: a person may stand beside an arm that has not moved for a while.
"""

from __future__ import annotations

from remaster_ros.collection.events import BridgeState, RecorderState

NOT_LIVING = 'its run was in another boot of this computer, or was ended'


class CollectionRun:
    """The state of the planner and the token of its run.

    Parameters
    ----------
    resume_within_s
        A run that has been without a planner for longer is not gone on with, s.

    Attributes
    ----------
    state
        As in `events.PlannerState`, without ``held``.
    why
        Why the planner is in that state or waits; ''.
    token
        Of the run under way, '' for none.
    left
        Token of the run of a planner before this one, until it is known whether that still lives.
    """

    def __init__(self, resume_within_s: float) -> None:
        self._resume_within_s = resume_within_s
        self.state, self.why, self.token, self.left = 'idle', '', '', ''

    def resume(self, state: str, token: str, progress: str) -> None:
        """Take up what a planner before this one did.

        Parameters
        ----------
        state, token
            As it last wrote them down.
        progress
            How far the collection is, as text.
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
        """Go on with the run that was left, if it still lives; return whether that is decided.

        Parameters
        ----------
        silence_s
            For how long the planner of that run has given no sign of life, s; None where it gave
            none in this boot of the computer, or has ended the run.
        bridge, recorder
            Their last states; None before the first.
        progress
            How far the collection is, as text.
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
            others = [peer.sender for peer in (bridge, recorder) if peer.run != self.left]
            if others:
                reason = f'{" and ".join(others)} did not take part in its run'
            elif bridge.halted:
                reason = f'the arm is halted: {bridge.halted}'
            elif bridge.asks_for_collect:
                reason = bridge.asks_for_collect
            elif recorder.changed_run in (self.left, ''):
                reason = recorder.changed
        left, self.left = self.left, ''
        if reason:
            self.why = _waits(progress, reason)
        elif left:
            self.state, self.why, self.token = 'running', '', left
        return True

    def refusal(
        self,
        bridge: BridgeState | None,
        recorder: RecorderState | None,
        *,
        has_joints: bool,
        further: str | None = None,
    ) -> str:
        """Return why /remaster/collect does not begin or go on; ''.

        Parameters
        ----------
        bridge, recorder
            Their last states; None before the first.
        has_joints
            Whether it is known where the arm is.
        further
            Why nothing can be measured further behind a complete collection, '' where something
            can; None where that is not asked.
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
        """Begin a run with this token, unless one is under way."""
        self.left = ''
        if self.state != 'running':
            self.token = new_token
        self.state, self.why = 'running', ''

    def pause(self) -> bool:
        """Pause, also a run that would have gone on by itself; return whether it is paused."""
        if self.left or self.state == 'running':
            self.left = ''
            self.end('paused')
        return self.state == 'paused'

    def stop(self) -> None:
        """End the run; what is left can be collected in another one."""
        self.left = ''
        self.end('stopped')

    def end(self, state: str, why: str = '', *, only_from: str = '') -> bool:
        """End the run in a state; return False where it is not in the state `only_from`."""
        if only_from and self.state != only_from:
            return False
        self.state, self.why, self.token = state, why, ''
        return True


def _waits(progress: str, reason: str) -> str:
    """Return that, and why, the planner does not go on by itself."""
    return f'{progress}; /remaster/collect goes on{f" ({reason})" if reason else ""}'
