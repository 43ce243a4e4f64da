"""Command the joint solutions of a pose one by one; say when the arm has settled.

The bridge never commands outside the joint limits, one configuration at a time, and only while the
planner says ``running`` and is heard from. Settled is judged from joint_states. After a
configuration has settled the arm stays until the recorder has said what became of it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.core.errors import InputError
from remaster_ros.core.motion import MotionLimits
from remaster_ros.core.settling import SettleDetector, SettleRules
from remaster_ros.core.types import FloatArray
from remaster_ros.nodes.messages import JointOrder, duration_of, seconds, stamp_key, stamp_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import RELIABLE, Event, Status, listen
from remaster_ros.storage.cell import read_cell


@dataclass(frozen=True)
class Parameters:
    """Parameters of the bridge."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    speed_share: float = parameter(
        0.3, 'share of each joint velocity limit that is used', low=0.01, high=1.0
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


@dataclass
class _Visit:
    """One commanded configuration of the current pose."""

    solution: int
    target: FloatArray
    detector: SettleDetector
    commanded_s: float
    deadline_s: float
    settled: bool = False


class RobotBridge(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('robot_bridge')
        self.p = declare(self, Parameters)
        cell = read_cell(self.p.cell)
        self.chain = cell.chain()
        self.limits = MotionLimits.of(self.chain, self.p.speed_share)
        self._order = JointOrder(self.chain.joint_names)
        self._q: FloatArray | None = None
        self._now = 0.0
        self._heard = {'planner': 0.0, 'recorder': 0.0, 'robot': 0.0}
        self._planner_state = 'unknown'
        self._pose: JointTrajectory | None = None
        self._next = 0
        self._visit: _Visit | None = None
        self._held = False
        self._settled_wall = time.monotonic()
        self.counts = {'commanded': 0, 'settled': 0, 'failed': 0}
        self._trouble = ''
        self._controller = self.create_publisher(
            JointTrajectory, '/joint_trajectory_controller/joint_trajectory', RELIABLE
        )
        self._settled = self.create_publisher(JointState, '/remaster/settled', RELIABLE)
        self.create_subscription(JointState, '/joint_states', self._on_joint_state, RELIABLE)
        self.create_subscription(
            JointTrajectory, '/remaster/joint_solutions', self._on_solutions, RELIABLE
        )
        self.status = Status(self, self._summary)
        listen(self, self._on_event, self._on_summary)
        self.create_timer(0.1, self._watch, clock=self.status.steady)

    # What comes in

    def _on_summary(self, node: str, message: str, values: dict[str, str]) -> None:
        if node == 'pose_planner':
            self._heard['planner'] = time.monotonic()
            self._planner_state = values.get('state', 'unknown')
            if self._planner_state != 'running':
                self._hold(f'planner is {self._planner_state}')
        elif node == 'recorder':
            self._heard['recorder'] = time.monotonic()

    def _on_event(self, event: Event) -> None:
        visit, pose = self._visit, self._pose
        if event.node != 'recorder' or event.event != 'configuration' or visit is None:
            return
        if pose is None or event.values.get('stamp') != stamp_key(pose.header.stamp):
            return
        if event.values.get('solution') == str(visit.solution) and visit.settled:
            self._visit = None
            self._go_on()

    def _on_solutions(self, message: JointTrajectory) -> None:
        if not message.points:
            self._pose, self._visit = None, None
            self._hold('stopped')
            return
        columns = [list(message.joint_names).index(name) for name in self.chain.joint_names]
        for point in message.points:
            point.positions = [point.positions[column] for column in columns]
        self._pose, self._next, self._visit = message, 0, None
        self._go_on()

    def _on_joint_state(self, message: JointState) -> None:
        self._heard['robot'] = time.monotonic()
        try:
            q = self._order.positions(message)
        except InputError as error:
            self._trouble = str(error)
            return
        if not np.all(np.isfinite(q)):
            self._trouble = 'joint_states are not finite'
            return
        self._q, self._now, self._trouble = q, seconds(message.header.stamp), ''
        visit = self._visit
        if visit is None:
            return
        if visit.settled:
            if self._now > visit.deadline_s:
                self._fail(visit, 'the recorder did not say what became of it')
            return
        state = visit.detector.update(self._now, q)
        if state == 'settled':
            visit.settled, self._settled_wall = True, time.monotonic()
            visit.deadline_s = self._now + self.p.answer_timeout_s
            self.counts['settled'] += 1
            self._publish_settled(visit)
        elif self._now > visit.deadline_s:
            distance = np.max(np.abs(q - visit.target))
            where = f'{distance:.4f} rad from the target' if state == 'elsewhere' else 'not still'
            self._fail(visit, f'did not arrive and settle in time: {where}')

    # What goes out

    def _publish_settled(self, visit: _Visit) -> None:
        message = JointState(
            name=list(self.chain.joint_names), position=visit.detector.mean.tolist()
        )
        message.header.stamp = stamp_of(self._now)
        self._settled.publish(message)
        still = visit.detector.still_since or self._now
        self.status.event(
            'settled',
            f'solution {visit.solution} settled',
            stamp=self._stamp(),
            solution=visit.solution,
            motion_s=f'{still - visit.commanded_s:.6f}',
            settle_s=f'{self._now - still:.6f}',
        )

    def _fail(self, visit: _Visit, reason: str) -> None:
        self._visit = None
        self._report_failure(visit.solution, reason)
        self._go_on()

    def _report_failure(self, solution: int, reason: str) -> None:
        self.counts['failed'] += 1
        self.status.event(
            'failed', reason, level='warn', stamp=self._stamp(), solution=solution, reason=reason
        )

    def _stamp(self) -> str:
        return stamp_key(self._pose.header.stamp) if self._pose is not None else ''

    def _missing(self) -> str:
        """Who has been silent too long, or why the arm must not move; '' if it may."""
        now = time.monotonic()
        silent = [name for name, heard in self._heard.items() if now - heard > self.p.heartbeat_s]
        if silent:
            return f'no sign of {", ".join(silent)} for {self.p.heartbeat_s:g} s'
        if self._planner_state != 'running':
            return f'planner is {self._planner_state}'
        return self._trouble

    def _go_on(self) -> None:
        """Command the next solution of the pose, if the arm may move."""
        while self._pose is not None and self._visit is None:
            if self._next >= len(self._pose.points):
                return
            if self._q is None or self._missing():
                return
            solution, self._next = self._next, self._next + 1
            target = np.array(self._pose.points[solution].positions)
            outside = self.limits.outside(target)
            if outside:
                self._report_failure(solution, outside)
                continue
            self._command(solution, target)

    def _command(self, solution: int, target: FloatArray) -> None:
        assert self._q is not None
        trajectory = self.limits.trajectory(self._q, target)
        message = JointTrajectory(joint_names=list(self.chain.joint_names))
        message.points = [
            JointTrajectoryPoint(
                positions=point.q.tolist(),
                velocities=point.velocity.tolist(),
                time_from_start=duration_of(point.time_s),
            )
            for point in trajectory
        ]
        self._controller.publish(message)
        self._held = False
        rules = SettleRules(self.p.settle_s, self.p.arrive_tolerance, self.p.still_tolerance)
        deadline = self._now + trajectory[-1].time_s + self.p.settle_s + self.p.arrive_timeout_s
        self._visit = _Visit(solution, target, SettleDetector(target, rules), self._now, deadline)
        self.counts['commanded'] += 1
        self.status.event(
            'commanded',
            f'solution {solution} commanded',
            stamp=self._stamp(),
            solution=solution,
            since_settled_wall_s=f'{time.monotonic() - self._settled_wall:.6f}',
        )

    def _hold(self, reason: str) -> None:
        """Stop the arm where it is; the configuration under way is commanded again later.

        An arm that has settled stands already: its reading goes on, only no command follows it.
        """
        if self._visit is not None and self._visit.settled:
            return
        if not self._held:
            self._controller.publish(JointTrajectory(joint_names=list(self.chain.joint_names)))
            self._held = True
            self.get_logger().info(f'holding: {reason}')
        if self._visit is not None:
            self._next, self._visit = self._visit.solution, None

    def _watch(self) -> None:
        """Stop on silence; go on when everyone is back."""
        missing = self._missing()
        if missing and self._visit is not None:
            self._hold(missing)
        elif not missing:
            self._go_on()

    def _summary(self) -> tuple[str, str, dict[str, object]]:
        missing = self._missing()
        busy = self._visit is not None
        text = missing or ('moving or measuring' if busy else 'waiting for a pose')
        # By the pose the planner sees whether a bridge that was started again knows it.
        values = {**self.counts, 'held': self._held, 'pose': self._stamp()}
        return ('warn' if missing else 'ok'), text, values

    def close(self) -> None:
        """Leave the arm standing still."""
        if self._visit is not None and not self._visit.settled:
            self._hold('the bridge stops')


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RobotBridge, args)


if __name__ == '__main__':
    raise SystemExit(main())
