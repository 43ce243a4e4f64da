# SPDX-License-Identifier: Apache-2.0
"""Publish a pose with all its joint solutions to bridge and recorder."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from rclpy.publisher import Publisher
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.announcements import PEERS
from remaster_ros.collection.events import PoseAnnounced
from remaster_ros.collection.message_fields import CORRECTED, stamp_key
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.nodes.messages import (
    duration_of,
    waypoints_message,
    write_place,
)
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.status import (
    LEASED,
    NodeStatus,
)
from remaster_ros.planning.tour_order import PoseVisit


class PosePublisher:
    """Publishes poses with their joint solutions, and requests to stop the arm."""

    def __init__(self, node: RemasterNode, chain: SerialChain) -> None:
        self._node, self._chain = node, chain
        self._poses = node.create_publisher(PoseStamped, 'remaster/target_pose', LEASED)
        self._waypoints = node.create_publisher(
            JointTrajectory, 'remaster/joint_waypoints', LEASED
        )
        self._solutions = node.create_publisher(
            JointTrajectory, 'remaster/joint_solutions', LEASED
        )
        # Event of the last announcement, and its messages with their publishers.
        self._event: PoseAnnounced | None = None
        self._messages: list[tuple[Publisher, PoseStamped | JointTrajectory]] = []

    @property
    def subscribers(self) -> int:
        """Number of the nodes in `PEERS` that subscribe to the solutions; viewers excluded."""
        subscriptions = self._node.get_subscriptions_info_by_topic(self._solutions.topic_name)
        viewers = sum(info.node_name not in PEERS for info in subscriptions)
        return int(self._solutions.get_subscription_count()) - viewers

    def stop(self) -> None:
        """Publish solutions without a point, at which the bridge stops the arm."""
        self._solutions.publish(JointTrajectory(joint_names=list(self._chain.joint_names)))

    def announce(self, visit: PoseVisit, plan: str, status: NodeStatus, *, last: bool) -> str:
        """Publish a visit and its event; return the stamp of the announcement as its key.

        A visit without solutions (`ids`) is published as an event alone.

        ``plan``: identifier of the plan that numbers pose and solutions; ``last``: whether the
        visit is to the last reference of a round.
        """
        pose = PoseStamped()
        pose.header.stamp = self._node.get_clock().now().to_msg()
        pose.header.frame_id = self._chain.base_link
        key = stamp_key(pose.header.stamp)
        self._event = PoseAnnounced(
            stamp=key,
            pose=visit.pose,
            split=visit.split,
            ids=visit.ids,
            unreached=visit.unreached,
            plan=plan,
            last=last,
        )
        write_place(visit.T_R_T, pose.pose.position, pose.pose.orientation)
        prefix = CORRECTED.get(visit.correction, '')
        names = [f'{prefix}{name}' for name in self._chain.joint_names]
        message = JointTrajectory(joint_names=names)
        message.header = pose.header
        message.points = [
            JointTrajectoryPoint(positions=q.tolist(), time_from_start=duration_of(i + 1.0))
            for i, q in enumerate(visit.solutions)
        ]
        # The solutions last: they start the motion. A message without solutions would be a stop.
        waypoints = waypoints_message(visit, self._chain.joint_names, pose.header)
        self._messages = [
            (self._poses, pose),
            (self._waypoints, waypoints),
            (self._solutions, message),
        ] * bool(visit.ids)
        self.repeat(status)
        return key

    def repeat(self, status: NodeStatus) -> None:
        """Publish the last announcement again, unchanged, its event first.

        There must be one, else AssertionError.
        """
        assert self._event is not None
        # The event first: the recorder needs the pose before the arm arrives.
        status.event(self._event)
        for publisher, message in self._messages:
            publisher.publish(message)
