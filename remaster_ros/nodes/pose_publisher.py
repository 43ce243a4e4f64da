"""Publish a pose with all its joint solutions to bridge and recorder."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.events import PoseAnnounced
from remaster_ros.collection.message_fields import stamp_key
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.nodes.messages import duration_of
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.status import LEASED, NodeStatus
from remaster_ros.nodes.waypoints import waypoints_message
from remaster_ros.planning.tour_order import PoseVisit

LISTENERS = ('robot_bridge', 'recorder')
"""Nodes that a pose is announced to. A viewer or `ros2 topic echo` stands for none of them."""


class PosePublisher:
    """Publishes poses, and the stop that takes them back.

    Parameters
    ----------
    node
        The planner.
    chain
        Its arm.
    """

    def __init__(self, node: RemasterNode, chain: SerialChain) -> None:
        self._node, self._chain = node, chain
        self._poses = node.create_publisher(PoseStamped, 'remaster/target_pose', LEASED)
        self._waypoints = node.create_publisher(
            JointTrajectory, 'remaster/joint_waypoints', LEASED
        )
        self._solutions = node.create_publisher(
            JointTrajectory, 'remaster/joint_solutions', LEASED
        )

    @property
    def subscribers(self) -> int:
        """How many nodes subscribe to the solutions, without those that only look on."""
        found = self._node.get_subscriptions_info_by_topic(self._solutions.topic_name)
        others = sum(info.node_name not in LISTENERS for info in found)
        return int(self._solutions.get_subscription_count()) - others

    def stop(self) -> None:
        """Take the pose back, on which the bridge stops the arm."""
        self._solutions.publish(JointTrajectory(joint_names=list(self._chain.joint_names)))

    def announce(self, stop: PoseVisit, plan: str, status: NodeStatus, *, last: bool) -> str:
        """Publish a pose with what is left of its solutions; return the announcement's stamp.

        Parameters
        ----------
        plan
            The plan that poses and solutions are numbered by.
        last
            Whether it is the last reference of a round.
        """
        pose = PoseStamped()
        pose.header.stamp = self._node.get_clock().now().to_msg()
        pose.header.frame_id = self._chain.base_link
        key = stamp_key(pose.header.stamp)
        # The event goes first: the recorder must have the pose before the arm gets there.
        status.event(
            PoseAnnounced(
                stamp=key, pose=stop.pose, split=stop.split, ids=stop.ids, plan=plan, last=last
            )
        )
        position, orientation = pose.pose.position, pose.pose.orientation
        position.x, position.y, position.z = map(float, stop.T_R_T[:3, 3])
        quaternion = transforms.quaternion_xyzw(stop.T_R_T[:3, :3])
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, quaternion)
        self._poses.publish(pose)
        # Before the solutions: with those the bridge begins to move.
        self._waypoints.publish(waypoints_message(stop, self._chain.joint_names, pose.header))
        message = JointTrajectory(joint_names=list(self._chain.joint_names))
        message.header = pose.header
        message.points = [
            JointTrajectoryPoint(positions=q.tolist(), time_from_start=duration_of(i + 1.0))
            for i, q in enumerate(stop.solutions)
        ]
        self._solutions.publish(message)
        return key
