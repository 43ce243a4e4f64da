# SPDX-License-Identifier: Apache-2.0
"""How the admitted commands reach the arm's controller: by its topic, or as goals of its action.

Both are of one controller, ``…/joint_trajectory`` and ``…/follow_joint_trajectory``, and carry the
same trajectory. A goal replaces the one before it as a newer message on the topic does, so that an
arm is stopped by a goal too, along its line. A goal is cancelled only where no command is to
follow, or where the controller does not take the stop: a controller that cancels a goal holds the
arm where it is just then (joint_trajectory_controller: at once, whatever its speed).
"""

from __future__ import annotations

import importlib
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_action_status_default
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.errors import InputError
from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.following import path_tolerance
from remaster_ros.nodes.messages import duration_of
from remaster_ros.nodes.qos import UNNAMED
from remaster_ros.nodes.status import LEASED, RELIABLE
from remaster_ros.sensors.registry import kind_of
from remaster_ros.types import FloatArray

COMMANDS = 'joint_trajectory_controller/joint_trajectory'
COPIES = 'remaster/recorded/joint_trajectory'
"""Where goals are published for those who listen to commands (the bag, a tracker): nothing moves
by it."""
LISTENERS = ('robot_bridge', 'recorder')
"""Nodes of this package that subscribe to the commands; those of sensors do so as well."""
CODES = {
    'INVALID_GOAL': 'it cannot be followed',
    'INVALID_JOINTS': 'its joints are not those of the controller',
    'OLD_HEADER_TIMESTAMP': 'it is over already',
    'PATH_TOLERANCE_VIOLATED': 'the arm left its path',
    'GOAL_TOLERANCE_VIOLATED': 'the arm did not reach its end in time',
}
"""What a controller may give as the reason: constants of the result, and what they mean."""
UNDER_WAY = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING)
OVER = (CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID, CancelGoal.Response.ERROR_GOAL_TERMINATED)
"""Answers to the cancelling of a goal that is over."""
LATEST = 3
"""So many goals of a move may be under way: the newest, one that it replaces, one that is late."""
EXPIRES_S = 0.4
"""A command that has not come to the controller's host for so long is not sent again, s: after a
cable was out it would lead an arm that has stopped since, by a jump to where it would be. The stop
of the piece before one that is sent when it is due begins later than that (`motion.pieces`)."""
STATE_TYPE = 'control_msgs/msg/JointTrajectoryControllerState'
LAST_ANSWER_WALL_S = 0.5
"""A bridge that ends waits so long for the answer to its last stop, s: much longer than a request
and its answer take on one computer, and no one who ends it notices."""


def action_of(topic: str) -> str:
    """Return the action of the controller that has this topic of commands.

    The last part of `topic` is replaced: ``a/joint_trajectory`` -> ``a/follow_joint_trajectory``.
    """
    return f'{topic.rpartition("/")[0]}/follow_joint_trajectory'


class ForeignGoals:
    """Watch for goals that other clients than the bridge have sent to the controller's action."""

    def __init__(self, node: Node) -> None:
        self.own: set[bytes] = set()
        self._action = action_of(node.resolve_topic_name(COMMANDS))
        self._active: set[bytes] = set()
        self._earlier: set[bytes] = set()
        node.create_subscription(
            GoalStatusArray,
            f'{self._action}/_action/status',
            self._on_status,
            qos_profile_action_status_default,
        )

    def _on_status(self, message: GoalStatusArray) -> None:
        """Keep the identifiers of the goals that are under way at the controller (`UNDER_WAY`)."""
        self._active = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status in UNDER_WAY
        }

    def begin(self) -> None:
        """Ignore the goals that are under way now; count only those that come later.

        joint_trajectory_controller may list a goal that was replaced as under way until the
        next one comes, such as a goal of a bridge that has ended. If such a goal really moves
        the arm, the bridge commands nothing before the arm stands.
        """
        self._earlier = set(self._active)

    def trouble(self) -> str:
        """Return a sentence that another client has a goal under way; '' if none has.

        Goals in `own`, and those that were under way at the last `begin`, do not count.
        """
        if self._active <= self.own | self._earlier:
            return ''
        return f'another client has sent a goal to {self._action}: end that client'


class ControllerStates:
    """Whether the controller publishes its state as joint_trajectory_controller does.

    Such a controller is known to keep the time stamps of trajectories.
    """

    def __init__(self, node: Node) -> None:
        place = node.resolve_topic_name(COMMANDS).rpartition('/')[0]
        self._node, self._topic = node, f'{place}/controller_state'

    def is_there(self) -> bool:
        """Return whether the topic controller_state has a publisher of type `STATE_TYPE` now.

        The type is read from the ROS graph: control_msgs need not be installed.
        """
        if not self._node.count_publishers(self._topic):
            return False
        found = self._node.get_publishers_info_by_topic(self._topic)
        return any(info.topic_type == STATE_TYPE for info in found)


def _expiring(profile: QoSProfile) -> QoSProfile:
    """Return a QoS profile whose messages expire after `EXPIRES_S` (lifespan).

    Depth, reliability and liveliness are those of `profile`; all else is the default.
    """
    return QoSProfile(
        depth=profile.depth,
        reliability=profile.reliability,
        liveliness=profile.liveliness,
        liveliness_lease_duration=profile.liveliness_lease_duration,
        lifespan=Duration(seconds=EXPIRES_S),
    )


class TopicLink:
    """Link to the arm's controller by its command topic.

    ``simulated``: whether a simulation waits for its nodes: then commands do not expire.
    Attributes: ``missing``: sentence for when no controller listens.
    """

    def __init__(self, node: Node, *, simulated: bool = False) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(COMMANDS)
        profile = LEASED if simulated else _expiring(LEASED)
        self._publisher = node.create_publisher(JointTrajectory, COMMANDS, profile)
        self.missing = f'no controller listens to {self._topic}'

    def matched(self) -> bool:
        """Whether the command topic has a subscriber."""
        return bool(self._publisher.get_subscription_count())

    def listens(self) -> bool:
        """Whether a node that is no recorder, bridge or sensor node subscribes to the commands."""
        if not self.matched():
            return False
        found = self._node.get_subscriptions_info_by_topic(self._topic)
        names = [info.node_name for info in found]
        return any(name not in LISTENERS and not kind_of(name) for name in names)

    def rival(self) -> str:
        """Return '': who else publishes commands is counted elsewhere (`nodes.rivals`)."""
        return ''

    def send(self, message: JointTrajectory, kind: str) -> None:
        """Publish a trajectory that the motion gate has admitted, at once.

        ``kind``: move, renewal or stop, which makes no difference here.
        """
        self._publisher.publish(message)

    def cancel(self) -> None:
        """Do nothing: a trajectory that was published on a topic cannot be cancelled."""

    def close(self) -> None:
        """Do nothing: a message that was published is sent."""


@dataclass(eq=False)
class _Goal:
    """A goal sent to the controller; `handle` is None until the controller has accepted it."""

    key: bytes = field(default_factory=lambda: uuid.uuid4().bytes)
    handle: Any = None
    cancelled: bool = False
    over: bool = False


class ActionLink:
    """Link to the arm's controller by its FollowJointTrajectory action.

    ``rules``: tolerances and timeouts of the supervisor, which the goals state too;
    ``foreign``: gets the identifiers of the goals sent here; ``failed``: called with the
    reason if the controller refuses the newest goal, or gives it up.
    Raises InputError: control_msgs is not installed.
    """

    def __init__(
        self,
        node: Node,
        rules: SupervisorRules,
        foreign: ForeignGoals,
        failed: Callable[[str], None],
    ) -> None:
        self._action_type, self._tolerance_type = control_messages()
        self._node, self._rules, self._foreign, self._failed = node, rules, foreign, failed
        self._action = action_of(node.resolve_topic_name(COMMANDS))
        self._client = ActionClient(node, self._action_type, self._action)
        self._copies = node.create_publisher(JointTrajectory, COPIES, RELIABLE)
        # The last move and the stops of it. Before a move the arm stands: earlier ones are over.
        self._goals: list[_Goal] = []
        self._speeds: FloatArray = np.zeros(0)
        self._awaited: list[Future] = []
        self.missing = f'no controller has the action {self._action}'

    def matched(self) -> bool:
        """Whether an action server is there, with all its services and topics."""
        return bool(self._client.server_is_ready())

    listens = matched

    def rival(self) -> str:
        """Return a sentence on the other nodes that are clients of the action; '' for none."""
        service = f'{self._action}/_action/send_goal'
        if self._node.count_clients(service) <= 1:
            return ''
        own_node = self._node.get_name(), self._node.get_namespace()
        found = []
        for name, namespace in self._node.get_node_names_and_namespaces():
            if (name, namespace) == own_node or name == UNNAMED:
                continue
            try:
                clients = self._node.get_client_names_and_types_by_node(name, namespace)
            except RuntimeError:  # It has gone meanwhile.
                continue
            if any(client == service for client, _ in clients):
                found.append(f'{namespace.rstrip("/")}/{name}')
        if not found:
            # Of this bridge before it was killed: that there is one of its name is seen elsewhere.
            return ''
        return (
            f'other clients of {self._action}, where the bridge may be the only one: '
            f'{", ".join(sorted(found))}; end them (those of a killed process are listed for '
            'some 20 s)'
        )

    def send(self, message: JointTrajectory, kind: str) -> None:
        """Send a trajectory that the motion gate has admitted, in place of the one under way.

        ``kind``: ``move`` (forgets earlier goals), ``renewal`` or ``stop``, whose tolerances
        differ. Returns at once; a refusal comes by `failed`. A copy is published on `COPIES`.
        """
        names, rules = message.joint_names, self._rules
        # rad or m, as the positions.
        end = np.full(len(names), rules.settle.arrive_tolerance) * rules.units.per_radian
        if kind == 'stop':
            # No target: where on its line the arm comes to rest is enough.
            end = path_tolerance(np.zeros(len(names)), rules)
        else:
            speeds = np.max(np.abs([point.velocities for point in message.points]), axis=0)
            if kind == 'move':
                self._goals.clear()
                self._speeds = np.zeros(len(names))
            # A stop begins with the speeds of its move.
            self._speeds = np.maximum(self._speeds, speeds)
            # Those that were replaced are over, and only the last ones may not have been yet.
            del self._goals[:-LATEST]
        goal = self._action_type.Goal(
            trajectory=message,
            path_tolerance=self._tolerances(names, path_tolerance(self._speeds, rules)),
            goal_tolerance=self._tolerances(names, end),
            # The bridge gives up first, by the same rule.
            goal_time_tolerance=duration_of(rules.arrive_timeout_s),
        )
        sent = _Goal()
        self._goals.append(sent)
        self._foreign.own.add(sent.key)
        key = GoalInfo().goal_id
        key.uuid = np.frombuffer(sent.key, dtype=np.uint8)
        self._await(self._client.send_goal_async(goal, goal_uuid=key), self._on_answer, sent)
        self._copies.publish(message)

    def cancel(self) -> None:
        """Cancel all goals, so that the controller holds the arm; no command is to follow.

        Returns at once; a goal that is not accepted yet is cancelled once it is.
        """
        for goal in self._goals:
            if goal.handle is not None and not (goal.cancelled or goal.over):
                self._await(goal.handle.cancel_goal_async(), self._on_cancelled, goal)
            goal.cancelled = True

    def close(self) -> None:
        """Wait for outstanding answers of the controller, `LAST_ANSWER_WALL_S` at most.

        Callbacks run meanwhile: if the controller refuses a stop, all goals are cancelled.
        """
        executor, end = self._node.executor, time.monotonic() + LAST_ANSWER_WALL_S
        while executor is not None and self._awaited and self._node.context.ok():
            if time.monotonic() > end:
                return
            executor.spin_once(timeout_sec=0.01)

    def _tolerances(self, names: Sequence[str], values: FloatArray) -> list[Any]:
        """Return a JointTolerance message of each joint, with its position tolerance alone.

        ``names``: joints; ``values``: their tolerances, rad or m, (k,).
        """
        pairs = zip(names, values, strict=True)
        return [self._tolerance_type(name=name, position=float(value)) for name, value in pairs]

    def _await(self, future: Future, done: Callable[[_Goal, Any], None], goal: _Goal) -> None:
        """Call `done` with the goal and the result of `future` once it is there.

        Until then it counts as outstanding, and `close` waits for it.
        """
        self._awaited.append(future)
        future.add_done_callback(partial(self._take, done, goal))

    def _take(self, done: Callable[[_Goal, Any], None], goal: _Goal, future: Future) -> None:
        """Call `done` with the goal and the result of `future`, which is no longer outstanding.

        `done` is not called if the future was cancelled or its result is None.
        """
        self._awaited.remove(future)
        if not future.cancelled() and future.result() is not None:
            done(goal, future.result())

    def _on_answer(self, goal: _Goal, handle: Any) -> None:
        """Process whether the controller accepts a goal; give up the command if it refuses.

        A refused goal of an earlier move is ignored. An accepted goal that was to be cancelled
        meanwhile is cancelled now.
        """
        if not handle.accepted:
            if goal in self._goals:
                self._goals.remove(goal)
                self._give_up(f'{self._action}: the controller refuses a command; its log has why')
            return
        goal.handle = handle
        handle.get_result_async().add_done_callback(partial(self._on_result, goal))
        if goal.cancelled:
            goal.cancelled = False
            self.cancel()

    def _on_result(self, goal: _Goal, future: Future) -> None:
        """Give up if the newest goal failed; replaced and cancelled goals are no failures.

        The reason names the result's error code (`CODES`) and the controller's text.
        """
        goal.over = True
        # A goal that was replaced ends as cancelled: that is how it is meant.
        newest = bool(self._goals) and goal is self._goals[-1]
        if future.result() is None or not newest or goal.cancelled:
            return
        status, result = future.result().status, future.result().result
        if status == GoalStatus.STATUS_SUCCEEDED and result.error_code == result.SUCCESSFUL:
            return
        number = result.error_code
        named = (f'{k}: {v}' for k, v in CODES.items() if getattr(result, k) == number)
        why = next(named, f'error {number}' if number else '')
        if status == GoalStatus.STATUS_CANCELED:
            why = 'cancelled or replaced by another client'
        why = '; '.join(filter(None, (why, result.error_string))) or 'without a reason'
        self._give_up(f'{self._action}: the controller has given up a command ({why})')

    def _give_up(self, why: str) -> None:
        """Cancel all goals, and call `failed` with the reason."""
        # What it had before may still be under way: an arm that refuses to be stopped, say.
        self.cancel()
        self._failed(why)

    def _on_cancelled(self, goal: _Goal, response: CancelGoal.Response) -> None:
        """Log an error if the controller refuses to cancel a goal that is not over."""
        if not response.goals_canceling and response.return_code not in OVER:
            self._node.get_logger().error(
                f'{self._action}: the controller refuses to cancel a command; if the arm moves, '
                'use the emergency stop'
            )


def control_messages() -> tuple[Any, Any]:
    """Return the types FollowJointTrajectory and JointTolerance of control_msgs.

    Raises InputError, with how to install it, if control_msgs is missing.
    """
    try:
        action = importlib.import_module('control_msgs.action').FollowJointTrajectory
        return action, importlib.import_module('control_msgs.msg').JointTolerance
    except ImportError:
        raise InputError(
            'command_interface is action, and control_msgs is not installed: '
            'apt install ros-jazzy-control-msgs (there is no wheel of it), or set '
            'command_interface to topic'
        ) from None
