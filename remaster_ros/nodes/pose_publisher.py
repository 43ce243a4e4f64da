"""Announce a pose to bridge and recorder, and again until both know it."""

from __future__ import annotations

import time

from geometry_msgs.msg import PoseStamped
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.events import (
    BridgeState,
    EventRecord,
    PoseAnnounced,
    RecorderState,
)
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.nodes.messages import duration_of, stamp_key
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.status import LEASED, NodeStatus
from remaster_ros.nodes.waypoints import waypoints_message
from remaster_ros.planning.tour_order import PoseVisit

ANNOUNCE_WALL_S = 5.0
"""Who does not know an announcement so long after it has missed it, wall time."""
MATCH_WALL_S = 0.5
"""The other side of a match comes so much later than ours at most, wall time."""


class PosePublisher:
    """Publishes poses with their joint solutions, and follows who knows them.

    Attributes
    ----------
    stamp
        Of the last announcement, by which the others name it; '' where the pose is to be announced
        anew.
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
        # The last states of those that must know the pose under way, and when they came.
        self.bridge: BridgeState | None = None
        self.recorder: RecorderState | None = None
        self._seen: dict[str, tuple[float, str, str]] = {}
        # Stamp of each announcement of the open pose -> its solutions, in the order announced.
        self._ids: dict[str, tuple[int, ...]] = {}
        self.stamp, self._published_wall = '', 0.0
        # Which start of each peer was there to hear it.
        self._told: dict[str, str] = {}
        self._matched_wall: float | None = None

    def take(self, record: EventRecord) -> None:
        """Take a state of bridge or recorder."""
        match record.body:
            case BridgeState() as state:
                self.bridge = state
            case RecorderState() as state:
                self.recorder = state
            case _:
                return
        self._seen[state.sender] = time.monotonic(), record.started, state.pose

    def matched(self) -> bool:
        """Whether bridge and recorder are there for the next pose; DDS takes its time to match."""
        if self._solutions.get_subscription_count() < 2 or len(self._seen) < 2:
            self._matched_wall = None
            return False
        if self._matched_wall is None:
            self._matched_wall = time.monotonic()
        return time.monotonic() - self._matched_wall > MATCH_WALL_S

    def ids(self, stamp: str) -> tuple[int, ...] | None:
        """Return the solutions of an announcement of the open pose; None if it is none."""
        return self._ids.get(stamp)

    def close(self) -> None:
        """Be done with the open pose."""
        self._ids, self.stamp = {}, ''

    def stop(self) -> None:
        """Tell the bridge to stop; whoever goes on announces what is left of the pose again."""
        self._solutions.publish(JointTrajectory(joint_names=list(self._chain.joint_names)))
        self.stamp = ''

    def is_lost(self) -> bool:
        """Whether the open pose is to be announced (again): somebody does not know it."""
        if not self.stamp:
            return True
        if self.recorder is not None and self.recorder.state == 'measuring':
            return False
        missed_wall = self._published_wall + ANNOUNCE_WALL_S
        return any(
            pose != self.stamp and (started != self._told.get(node) or seen_wall > missed_wall)
            for node, (seen_wall, started, pose) in self._seen.items()
        )

    def announce(self, stop: PoseVisit, plan: str, status: NodeStatus, last: bool = False) -> None:
        """Publish a pose with what is left of its solutions.

        Parameters
        ----------
        last
            Whether it is the last reference of a round.
        """
        stamp = self._node.get_clock().now().to_msg()
        self.stamp, self._published_wall = stamp_key(stamp), time.monotonic()
        self._ids[self.stamp] = stop.ids
        self._told = {node: started for node, (_, started, _) in self._seen.items()}
        # The event goes first: the recorder must know the pose before the arm gets there.
        status.event(
            PoseAnnounced(
                stamp=self.stamp,
                pose=stop.pose,
                split=stop.split,
                ids=tuple(stop.ids),
                plan=plan,
                last=last,
            )
        )
        pose = PoseStamped()
        pose.header.stamp, pose.header.frame_id = stamp, self._chain.base_link
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
