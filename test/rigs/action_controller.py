# SPDX-License-Identifier: Apache-2.0
"""A server of FollowJointTrajectory that does with goals what joint_trajectory_controller does.

A goal takes the place of the one before it, of which nothing is heard any more: the real one may
list it as under way until the next comes. A cancelling of the goal under way holds the arm; one of
an earlier goal changes nothing.
"""

from __future__ import annotations

import importlib
import sys

import pytest
from rigs import control_messages


def follow_joint_trajectory():
    """Return the action, control_msgs' own where it is installed; skip where it cannot be made."""
    pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
    try:
        folder = control_messages.control_messages()
    except LookupError as error:
        pytest.skip(str(error), allow_module_level=True)
    if folder is not None and str(folder) not in sys.path:
        sys.path.append(str(folder))
        importlib.invalidate_caches()
    return importlib.import_module('control_msgs.action').FollowJointTrajectory


class ActionController:
    """The action of a controller, on a node that is spun.

    Attributes
    ----------
    goals, cancelled
        The requests that came, refused ones among them, and how many goals under way were
        cancelled.
    refuses
        Whether it refuses a request.
    cancels
        Whether it lets a goal be cancelled.
    replaces
        Whether a goal takes the place of the one under way; else it waits for ever behind it.
    """

    def __init__(self, node, name, obey, hold, now):
        from rclpy.action import ActionServer

        self._action = follow_joint_trajectory()
        self._node, self._obey, self._hold, self._now = node, obey, hold, now
        self.goals, self.cancelled = [], 0
        self.refuses = lambda goal: False
        self.cancels = self.replaces = True
        self._active = self._end_s = None
        self._server = ActionServer(
            node,
            self._action,
            name,
            lambda handle: self._action.Result(),
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )

    def close(self):
        self._server.destroy()

    def _on_goal(self, goal):
        from rclpy.action import GoalResponse

        self.goals.append(goal)
        return GoalResponse.REJECT if self.refuses(goal) else GoalResponse.ACCEPT

    def _on_accepted(self, handle):
        if self._active is not None and not self.replaces:
            return
        trajectory = handle.request.trajectory
        last = trajectory.points[-1].time_from_start
        self._active, self._end_s = handle, self._now() + last.sec + 1e-9 * last.nanosec
        self._obey(trajectory)

    def _on_cancel(self, handle):
        from rclpy.action import CancelResponse

        if not self.cancels:
            return CancelResponse.REJECT
        if handle is self._active:
            self.cancelled += 1
            self._hold()
            self._active = None
        # When the request is answered, its state is to be cancelled.
        self._node.executor.create_task(lambda: handle.execute(self._cancelled))
        return CancelResponse.ACCEPT

    def _cancelled(self, handle):
        handle.canceled()
        return self._action.Result()

    def look(self):
        """Report that the trajectory is over, if it is."""
        if self._active is not None and self._now() >= self._end_s:
            self.end()

    def end(self, code=0, text=''):
        """End the goal under way: success, or with the name of a constant of the result."""
        handle, self._active = self._active, None
        result = self._action.Result(error_string=text)
        result.error_code = getattr(result, code) if code else result.SUCCESSFUL

        def ended(handle):
            handle.abort() if code else handle.succeed()
            return result

        handle.execute(ended)
