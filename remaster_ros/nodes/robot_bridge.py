"""Command the joint solutions of a pose one by one; say when the arm has settled.

The bridge never commands outside the joint limits, one configuration at a time, and only while
planner, recorder and robot are heard from and the planner says ``running``. After a configuration
has settled the arm stays until the recorder has said what became of it. The rules are those of
`remaster_ros.core.visiting`; this is their ROS shell.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InputError
from remaster_ros.core.motion import MotionLimits, Waypoint
from remaster_ros.core.settling import SettleRules
from remaster_ros.core.types import FloatArray
from remaster_ros.core.visiting import (
    PROBE,
    Action,
    Drive,
    Failed,
    Halted,
    Settled,
    Stop,
    Visitor,
    VisitRules,
)
from remaster_ros.nodes.messages import JointOrder, duration_of, seconds, stamp_key, stamp_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import RELIABLE, Event, Status, listen
from remaster_ros.storage.cell import read_cell
from remaster_ros.storage.results import joint_offsets_rad, read_fit

COMMANDS = '/joint_trajectory_controller/joint_trajectory'
MATCHED_WALL_S = 0.5
"""So much later than ours the controller's side of a DDS match may come."""


@dataclass(frozen=True)
class Parameters:
    """Parameters of the bridge."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    speed_share: float = parameter(
        0.3, 'share of each joint velocity limit that is used', low=0.01, high=1.0
    )
    offsets: str = parameter(
        '',
        'fit.json whose joint offsets shift the joint limits; empty for offsets not known yet',
    )
    settle_s: float = parameter(
        3.0, 'how long the arm must stand still before a reading', unit='s', low=0.1, high=60.0
    )
    arrive_tolerance: float = parameter(
        2e-3, 'largest distance of a joint from its target', unit='rad', low=1e-6, high=0.1
    )
    still_tolerance: float = parameter(
        2e-4, 'largest spread of a joint position while still', unit='rad', low=1e-7, high=0.01
    )
    arrive_timeout_s: float = parameter(
        10.0, 'beyond the expected motion and settle: not arrived', unit='s', low=1.0, high=600.0
    )
    answer_timeout_s: float = parameter(
        180.0,
        "longest wait for the recorder's word on a settled configuration",
        unit='s',
        low=1.0,
        high=3600.0,
    )
    heartbeat_s: float = parameter(
        3.0,
        'longest silence of planner, recorder or robot, wall time',
        unit='s',
        low=0.5,
        high=60.0,
    )
    stall_s: float = parameter(
        1.0,
        'an arm that stands for so long and not at its target has been stopped',
        unit='s',
        low=0.2,
        high=60.0,
    )
    reaction_s: float = parameter(
        2.0,
        'how long a command may take to be seen in joint_states, wall time',
        unit='s',
        low=0.1,
        high=60.0,
    )
    emergency_stop_topic: str = parameter(
        '', "std_msgs/Bool, true while the robot's own safety stops it; empty where there is none"
    )


class RobotBridge(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('robot_bridge')
        self.p = declare(self, Parameters)
        self.chain = read_cell(self.p.cell).chain()
        limits = MotionLimits.of(self.chain, self.p.speed_share, self._offsets(self.chain))
        self._visitor = Visitor(limits, self._rules())
        self._order = JointOrder(self.chain.joint_names)
        self._pose_stamp = ''
        self._settled_wall = time.monotonic()
        self.counts = {'commanded': 0, 'settled': 0, 'failed': 0, 'stopped': 0}
        self._controller = self.create_publisher(JointTrajectory, COMMANDS, RELIABLE)
        # Since when a controller listens; a command before that would be lost.
        self._listened_wall: float | None = None
        self._settled = self.create_publisher(JointState, '/remaster/settled', RELIABLE)
        self.status = Status(self, self._summary)
        self.create_subscription(JointState, '/joint_states', self._on_joint_state, RELIABLE)
        self.create_subscription(
            JointTrajectory, '/remaster/joint_solutions', self._on_solutions, RELIABLE
        )
        if self.p.emergency_stop_topic:
            self.create_subscription(
                Bool, self.p.emergency_stop_topic, self._on_emergency_stop, RELIABLE
            )
        listen(self, self._on_event, self._on_summary)
        self.create_timer(0.1, self._watch, clock=self.status.steady)

    def _offsets(self, chain: SerialChain) -> FloatArray | None:
        """Return the offsets in use, rad, (k,); what a fit could not tell counts as none."""
        if not self.p.offsets:
            return None
        offsets, std = joint_offsets_rad(read_fit(self.p.offsets), chain.joint_names)
        return np.where(std > 0.0, offsets, 0.0)

    def _rules(self) -> VisitRules:
        p = self.p
        return VisitRules(
            settle=SettleRules(p.settle_s, p.arrive_tolerance, p.still_tolerance),
            arrive_timeout_s=p.arrive_timeout_s,
            answer_timeout_s=p.answer_timeout_s,
            heartbeat_s=p.heartbeat_s,
            stall_s=p.stall_s,
            reaction_s=p.reaction_s,
        )

    # What comes in

    def _on_summary(self, node: str, message: str, values: dict[str, str]) -> None:
        now = time.monotonic()
        if node == 'pose_planner':
            self._do(self._visitor.planner_says(values.get('state', 'unknown'), now))
        elif node == 'recorder':
            self._do(self._visitor.recorder_says(values.get('waiting_for', ''), now))

    def _on_event(self, event: Event) -> None:
        if (event.node, event.event) != ('recorder', 'configuration'):
            return
        solution = event.values.get('solution', '')
        if event.values.get('stamp') == self._pose_stamp and solution.isdecimal():
            self._do(self._visitor.answered(int(solution), time.monotonic()))

    def _on_solutions(self, message: JointTrajectory) -> None:
        try:
            columns = [list(message.joint_names).index(name) for name in self.chain.joint_names]
            solutions = [[point.positions[c] for c in columns] for point in message.points]
        except (ValueError, IndexError):
            self.get_logger().error(
                f'joint_solutions dropped: they are for {", ".join(message.joint_names)}, '
                f'the cell has {", ".join(self.chain.joint_names)}'
            )
            return
        self._pose_stamp = stamp_key(message.header.stamp)
        targets = np.reshape(np.array(solutions, float), (-1, len(self.chain)))
        self._do(self._visitor.plan(targets, time.monotonic()))

    def _on_joint_state(self, message: JointState) -> None:
        now = time.monotonic()
        if self._listened_wall is None or now - self._listened_wall < MATCHED_WALL_S:
            self._do(self._visitor.unreadable(f'no controller listens to {COMMANDS}', now))
            return
        try:
            q = self._order.positions(message)
        except InputError as error:
            self._do(self._visitor.unreadable(str(error), now))
            return
        self._do(self._visitor.report(seconds(message.header.stamp), q, now))

    def _on_emergency_stop(self, message: Bool) -> None:
        self._do(self._visitor.emergency(message.data, time.monotonic()))

    def _watch(self) -> None:
        if not self._controller.get_subscription_count():
            self._listened_wall = None
        elif self._listened_wall is None:
            self._listened_wall = time.monotonic()
        self._do(self._visitor.tick(time.monotonic()))

    # What goes out

    def _do(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case Drive():
                    self._drive(action)
                case Stop():
                    self._stop(action)
                case Settled():
                    self._announce(action)
                case Failed(solution, reason):
                    self.counts['failed'] += 1
                    self._event('failed', reason, 'warn', solution=solution, reason=reason)
                case Halted(reason):
                    self._event('halted', reason, 'error')
                    self.status.publish()

    def _drive(self, drive: Drive) -> None:
        self._send(drive.waypoints)
        if drive.solution == PROBE:
            return
        self.counts['commanded'] += 1
        self._event(
            'commanded',
            f'solution {drive.solution} commanded',
            solution=drive.solution,
            since_settled_wall_s=f'{time.monotonic() - self._settled_wall:.6f}',
        )

    def _stop(self, stop: Stop) -> None:
        self._send((stop.waypoint,))
        self.counts['stopped'] += 1
        self._event('stopped', stop.reason, 'warn')
        self.get_logger().info(f'stopping the arm: {stop.reason}')

    def _send(self, waypoints: tuple[Waypoint, ...]) -> None:
        # A stop is a trajectory too: an empty one is refused by some versions of
        # joint_trajectory_controller, and the arm goes on.
        message = JointTrajectory(joint_names=list(self.chain.joint_names))
        message.points = [
            JointTrajectoryPoint(
                positions=point.q.tolist(),
                velocities=point.velocity.tolist(),
                time_from_start=duration_of(point.time_s),
            )
            for point in waypoints
        ]
        self._controller.publish(message)

    def _announce(self, settled: Settled) -> None:
        self._settled_wall = time.monotonic()
        self.counts['settled'] += 1
        message = JointState(name=list(self.chain.joint_names), position=settled.q.tolist())
        message.header.stamp = stamp_of(settled.stamp_s)
        self._settled.publish(message)
        self._event(
            'settled',
            f'solution {settled.solution} settled',
            solution=settled.solution,
            motion_s=f'{settled.motion_s:.6f}',
            settle_s=f'{settled.settle_s:.6f}',
        )

    def _event(self, event: str, message: str, level: str = 'ok', **values: Any) -> None:
        self.status.event(event, message, level=level, stamp=self._pose_stamp, **values)

    def _summary(self) -> tuple[str, str, dict[str, Any]]:
        blocked = self._visitor.blocked(time.monotonic())
        text = 'moving or measuring' if self._visitor.busy else 'waiting for a pose'
        values = {
            **self.counts,
            'halted': self._visitor.halted,
            'joints_age_s': f'{self._visitor.report_age_s(time.monotonic()):.1f}',
            'joints_trouble': self._visitor.trouble,
            # By it the planner sees whether a bridge that was started again knows the pose.
            'pose': self._pose_stamp,
        }
        return ('warn' if blocked else 'ok'), blocked or text, values

    def close(self) -> None:
        """Leave the arm standing still."""
        self._do(self._visitor.planner_says('gone: the bridge stops', time.monotonic()))


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RobotBridge, args)


if __name__ == '__main__':
    raise SystemExit(main())
