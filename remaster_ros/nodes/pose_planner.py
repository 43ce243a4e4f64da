"""Plan poses in front of the sensors; publish them one by one, each with all its joint solutions.

``/remaster/collect`` starts or resumes; ``/remaster/pause`` and ``/remaster/stop`` hold the arm.
Without a registration of every sensor the first poses serve the three-point registration.

The plan, the pose under way and what became of each configuration are in the session folder
before the arm moves. A planner that was killed goes on by itself where it was; where bridge or
recorder were, it announces what is left of the pose again.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.core import transforms
from remaster_ros.core.collision import ArmCapsules
from remaster_ros.core.errors import InputError, InsufficientDataError, RemasterError
from remaster_ros.core.inverse import InverseKinematics
from remaster_ros.core.planning import Plan, candidate_poses, plan_poses
from remaster_ros.core.tour import REGISTRATION, Stop, Tour, registration_tour
from remaster_ros.core.types import FloatArray
from remaster_ros.nodes.clearance import Clearance
from remaster_ros.nodes.messages import JointOrder, duration_of, stamp_key, transform_array
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import LATCHED, RELIABLE, Event, Status, listen
from remaster_ros.storage.cell import read_cell
from remaster_ros.storage.plan_book import PlanBook

PEERS = ('robot_bridge', 'recorder')
ANNOUNCE_WALL_S = 5.0
"""Who does not know an announcement so long after it has missed it, wall time."""
RETRY_WALL_S = 1.0
"""How often a full disk is tried again, wall time."""


@dataclass(frozen=True)
class Parameters:
    """Parameters of the planner."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    optimization_candidates: int = parameter(
        60, 'candidate poses that the offsets are fitted on', low=1, high=10000
    )
    validation_candidates: int = parameter(
        60, 'candidate poses that the gain is proved on', low=0, high=10000
    )
    registration_candidates: int = parameter(
        12, 'candidate poses for the three-point registration', low=3, high=1000
    )
    seed: int = parameter(0, 'seed of the Latin hypercube', low=0)
    session: str = parameter(
        'session', "folder of the recorder's session, where the plan is kept (plan.jsonl)"
    )
    resume_within_s: float = parameter(
        30.0,
        'a planner killed while collecting that is started again within this time goes on by '
        'itself; later it waits for /remaster/collect',
        unit='s',
        low=0.0,
        high=3600.0,
    )
    limit_margin_deg: float = parameter(
        1.0, 'distance kept from the joint limits', unit='deg', low=0.0, high=45.0
    )


@dataclass(frozen=True)
class _Peer:
    """The last summary of a node that must know the pose under way."""

    heard_wall: float
    values: dict[str, str]


class PosePlanner(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('pose_planner')
        self.p = declare(self, Parameters)
        self.cell = read_cell(self.p.cell)
        self.chain = self.cell.chain()
        self._order = JointOrder(self.chain.joint_names)
        self._q: FloatArray | None = None
        self.T_R_N: dict[str, FloatArray] = {}
        self.state, self.phase, self._why = 'idle', REGISTRATION, ''
        self._registered = self._described = False
        self._matched_wall: float | None = None
        self._inverse = InverseKinematics(self.chain, self.cell.held(self.chain))
        self._arm = ArmCapsules(self.chain, self.cell.link_radius_m)
        self.book = PlanBook(Path(self.p.session), self._settings(), self.chain)
        self._peers: dict[str, _Peer] = {}
        # Stamp of each announcement of the open pose -> its solutions, in the order announced.
        self._announced: dict[str, tuple[int, ...]] = {}
        self._stamp, self._published_wall, self._tried_wall = '', 0.0, 0.0
        # Which start of each peer was there to hear it.
        self._told: dict[str, str] = {}
        self._resume()
        self._poses = self.create_publisher(PoseStamped, '/remaster/target_pose', RELIABLE)
        self._solutions = self.create_publisher(
            JointTrajectory, '/remaster/joint_solutions', RELIABLE
        )
        self._joint_states: Subscription | None = self._listen_to_the_arm()
        self.create_subscription(JointState, '/remaster/settled', self._on_settled, RELIABLE)
        self.create_subscription(
            TransformStamped, '/remaster/registration', self._on_registration, LATCHED
        )
        for name in ('collect', 'pause', 'stop'):
            self.create_service(Trigger, f'/remaster/{name}', getattr(self, f'_on_{name}'))
        self.status = Status(self, self._summary)
        self._clearance, self._cleared = Clearance(self, self.cell), False
        listen(self, self._on_event, self._on_summary)
        self.create_timer(0.05, self._step, clock=self.status.steady)

    def _settings(self) -> dict[str, Any]:
        """Return what the plan depends on."""
        p = self.p
        return {
            'cell': hashlib.sha256(msgspec.json.encode(self.cell)).hexdigest(),
            'optimization_candidates': p.optimization_candidates,
            'validation_candidates': p.validation_candidates,
            'registration_candidates': p.registration_candidates,
            'seed': p.seed,
            'limit_margin_deg': p.limit_margin_deg,
        }

    def _resume(self) -> None:
        """Take up what a planner before this one has left."""
        book = self.book
        if book.tour is None:
            return
        if REGISTRATION not in book.tour.plans:
            self.phase = 'collection'
        if book.lost:
            self.get_logger().warning(book.lost)
        if book.state == 'complete':
            self.state = 'complete'
        elif book.state == 'running' and book.silent_s <= self.p.resume_within_s:
            self.state = 'running'
        else:
            self._why = f'{self._progress()}; /remaster/collect goes on'
        self.get_logger().warning(f'{book.path}: going on; {self._progress()}')

    def _progress(self) -> str:
        tour = self.book.tour
        poses = f'{tour.visited} of {sum(tour.poses.values())}' if tour else 'none'
        return (
            f'{poses} {self.phase} poses begun, {self.book.outcomes.total()} configurations done'
        )

    # Services

    def _on_collect(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        if self._q is None:
            response.message = 'no joint_states yet: is the robot running?'
            return response
        if self.state in ('complete', 'failed'):
            response.message = f'the collection is {self.state}: {self._why or "start anew"}'
            return response
        recorder = self._peers.get('recorder')
        if recorder is not None and recorder.values.get('exit_status') == 'complete':
            response.message = "the recorder's session is complete; give it a new folder"
            return response
        if self.state != 'running' and self._joint_states is None:
            # The arm may have been stopped, or moved by hand, since it last settled.
            self._joint_states = self._listen_to_the_arm()
        self._set_state('running')
        response.success = True
        response.message = 'collecting'
        return response

    def _on_pause(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        response.success = self.state in ('running', 'paused')
        response.message = 'paused' if response.success else f'not running, but {self.state}'
        if response.success:
            self._set_state('paused')
        return response

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        self._set_state('stopped')
        self._solutions.publish(JointTrajectory(joint_names=list(self.chain.joint_names)))
        # Whoever goes on announces what is left of the pose again.
        self._stamp = ''
        response.success, response.message = True, 'stopped'
        return response

    def _set_state(self, state: str, why: str = '') -> None:
        self.state, self._why = state, why
        self.book.say_state(state)
        self.status.publish()

    # What comes in

    def _listen_to_the_arm(self) -> Subscription:
        return self.create_subscription(
            JointState, '/joint_states', self._on_joint_state, RELIABLE
        )

    def _on_joint_state(self, message: JointState) -> None:
        """Learn where the arm is before the first pose; after that /remaster/settled says it."""
        self._on_settled(message)
        if self._q is not None and self._joint_states is not None:
            self.destroy_subscription(self._joint_states)
            self._joint_states = None

    def _on_settled(self, message: JointState) -> None:
        try:
            self._q = self._order.positions(message)
        except InputError as error:
            self._why = str(error)

    def _on_registration(self, message: TransformStamped) -> None:
        self.T_R_N[message.child_frame_id] = transform_array(message)

    def _on_event(self, event: Event) -> None:
        if (event.node, event.event) == ('robot_bridge', 'halted') and self.state == 'running':
            # It goes on when somebody has looked at the arm and calls /remaster/collect.
            self._set_state('paused', event.message)
            return
        final = (event.node, event.event) in (
            ('recorder', 'configuration'),
            ('robot_bridge', 'failed'),
        )
        ids = self._announced.get(event.values.get('stamp', '')) if final else None
        if ids is None or self.book.stop is None:
            return
        solution = ids[int(event.values['solution'])]
        result = event.values.get('result', 'failed')
        if event.values['stamp'] != self._stamp and result not in ('recorded', 'partial'):
            # It was announced again meanwhile, and will be visited again.
            return
        if solution in self.book.stop.ids:
            self._registered = event.values.get('registered') == 'yes'
            self.book.outcome(solution, result)
            self._step()

    def _on_summary(self, node: str, message: str, values: dict[str, str]) -> None:
        self._clearance.on_summary(node, message, values)
        if node not in PEERS:
            return
        self._peers[node] = _Peer(time.monotonic(), values)
        stop = self.book.stop
        if node != 'recorder' or stop is None or self.state in ('complete', 'failed'):
            return
        if values.get('plan') == self.book.id:
            # What became of a configuration may have been said while this planner was not there.
            pose, _, solutions = values.get('decided', '').partition(': ')
            for solution in map(int, solutions.split()):
                if pose == str(stop.pose) and solution in stop.ids:
                    self.book.outcome(solution, 'recorded')
                    self._stamp = ''

    # The tour

    def _step(self) -> None:
        """Publish the next pose once every solution of the last one has its outcome."""
        self.book.stay_alive()
        if self.book.trouble and not self._is_written():
            return
        if self.state != 'running' or self._q is None or not self._heard():
            return
        if not self._is_cleared():
            return
        try:
            self._check_session()
            stop = self.book.stop
            if stop is not None and stop.ids:
                if self._is_lost():
                    self._publish(stop)
                return
            stop = self._next_stop(self._q)
        except RemasterError as error:
            self._set_state('failed', str(error))
            self.get_logger().error(str(error))
            return
        if stop is not None:
            self._announced, self._stamp = {}, ''
            self.book.open_stop(stop)
            if not self.book.trouble:
                self._publish(stop)

    def _is_written(self) -> bool:
        """Whether the disk takes what it did not take before; looked at once a second."""
        now = time.monotonic()
        if now - self._tried_wall < RETRY_WALL_S:
            return False
        self._tried_wall = now
        self.book.write_out()
        self.status.publish()
        return not self.book.trouble

    def _check_session(self) -> None:
        """Refuse to add another plan's poses to a session."""
        values = self._peers['recorder'].values
        theirs = values.get('plan', '')
        if theirs not in ('', self.book.id) and values.get('observations') != '0':
            raise InputError(
                f'the session {values.get("session")} holds observations of another plan than '
                f'{self.book.path}; give the planner the same session folder as the recorder, or '
                'begin a new session'
            )

    def _is_lost(self) -> bool:
        """Whether the open pose is to be announced (again): somebody does not know it."""
        if not self._stamp:
            return True
        if self._peers['recorder'].values.get('state') == 'measuring':
            return False
        missed_wall = self._published_wall + ANNOUNCE_WALL_S
        return any(
            peer.values.get('pose') != self._stamp
            and (peer.values.get('started') != self._told[node] or peer.heard_wall > missed_wall)
            for node, peer in self._peers.items()
        )

    def _heard(self) -> bool:
        """Whether bridge and recorder are there for the next pose; DDS takes its time to match."""
        if self.clock_trouble:
            self._why = self.clock_trouble
            return False
        if self._solutions.get_subscription_count() >= 2 and len(self._peers) == len(PEERS):
            if self._matched_wall is None:
                self._matched_wall = time.monotonic()
            # The other side of a match comes a little later than ours.
            if time.monotonic() - self._matched_wall > 0.5:
                self._why = ''
                return True
        else:
            self._matched_wall = None
            self._why = 'waiting for robot_bridge and recorder'
        return False

    def _is_cleared(self) -> bool:
        """Whether the preflight has been passed, once, before the first motion."""
        if not self._cleared:
            findings = self._clearance.findings(seen_before=bool(self.T_R_N))
            self._cleared = not findings
            self._why = f'preflight: {"; ".join(findings)}' if findings else ''
        return self._cleared

    def _next_stop(self, q: FloatArray) -> Stop | None:
        if self.phase == REGISTRATION:
            return self._next_registration(q)
        if self.book.tour is None or REGISTRATION in self.book.tour.plans:
            self.book.begin(self._plan_collection())
        assert self.book.tour is not None
        stop = self.book.tour.next(q)
        if stop is None:
            self._set_state('complete')
        return stop

    def _next_registration(self, q: FloatArray) -> Stop | None:
        """Visit poses until the recorder has registered every sensor."""
        missing = [name for name in self._clearance.required() if name not in self.T_R_N]
        if not missing or (self.T_R_N and self._clearance.any_sensor):
            self.phase, self._why = 'collection', ''
            return self._next_stop(q)
        if self._registered:
            # The recorder said so; its transforms are on their way.
            return None
        if self.book.tour is None:
            aim = np.array(self.cell.sensors[self.cell.aim_at].rough_position_m)
            rough = {n: np.array(s.rough_position_m) for n, s in self.cell.sensors.items()}
            plan = self._plan(REGISTRATION, self.p.registration_candidates, aim, rough)
            markers = [np.array(self.cell.markers[s.marker]) for s in self.cell.sensors.values()]
            self.book.begin(registration_tour(self.chain, plan, markers))
        assert self.book.tour is not None
        stop = self.book.tour.next(q)
        if stop is None:
            raise InsufficientDataError(
                f'no registration of {", ".join(missing)} after {self.book.tour.visited} poses '
                f'({self._peers["recorder"].values.get("registration")}); the recorder counts why '
                'readings were rejected'
            )
        return stop

    def _plan(
        self, split: str, count: int, aim: FloatArray, sensors_R: dict[str, FloatArray]
    ) -> Plan:
        """Plan poses that face `aim` and that every sensor sees; positions in R, m, (3,)."""
        # Each split has its own draws: the same plan, whatever was planned before a restart.
        rng = np.random.default_rng([self.p.seed, *split.encode()])
        sights = self.cell.lines_of_sight(sensors_R)
        candidates = candidate_poses(count, self.cell.poses.ranges(), aim, rng)
        margin = np.deg2rad(self.p.limit_margin_deg)
        return plan_poses(self._inverse, self._arm, candidates, sights, margin)

    def _plan_collection(self) -> Tour:
        sensors = {name: T[:3, 3] for name, T in self.T_R_N.items()}
        # A sensor that is not required may have no registration.
        rough = np.array(self.cell.sensors[self.cell.aim_at].rough_position_m)
        aim = sensors.get(self.cell.aim_at, rough)
        counts = {
            'optimization': self.p.optimization_candidates,
            'validation': self.p.validation_candidates,
        }
        plans = {
            split: self._plan(split, count, aim, sensors)
            for split, count in counts.items()
            if count
        }
        tour = Tour(self.chain, plans)
        if not plans['optimization'].poses:
            raise InsufficientDataError(f'{tour.describe()}: no pose is left to fit on')
        return tour

    def _publish(self, stop: Stop) -> None:
        stamp = self.get_clock().now().to_msg()
        self._stamp, self._published_wall = stamp_key(stamp), time.monotonic()
        self._announced[self._stamp] = stop.ids
        self._told = {n: peer.values.get('started', '') for n, peer in self._peers.items()}
        tour = self.book.tour
        if tour is not None and self.phase != REGISTRATION and not self._described:
            self._described = True
            self.status.event('planned', tour.describe())
        # The event goes first: the recorder must know the pose before the arm gets there.
        self.status.event(
            'pose',
            f'pose {stop.pose} ({stop.split}): {len(stop.solutions)} solutions',
            stamp=self._stamp,
            pose=stop.pose,
            split=stop.split,
            solutions=len(stop.solutions),
            ids=' '.join(map(str, stop.ids)),
            plan=self.book.id,
        )
        pose = PoseStamped()
        pose.header.stamp, pose.header.frame_id = stamp, self.chain.base_link
        position, orientation = pose.pose.position, pose.pose.orientation
        position.x, position.y, position.z = map(float, stop.T_R_T[:3, 3])
        quaternion = transforms.quaternion_xyzw(stop.T_R_T[:3, :3])
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, quaternion)
        self._poses.publish(pose)
        message = JointTrajectory(joint_names=list(self.chain.joint_names))
        message.header = pose.header
        message.points = [
            JointTrajectoryPoint(positions=q.tolist(), time_from_start=duration_of(i + 1.0))
            for i, q in enumerate(stop.solutions)
        ]
        self._solutions.publish(message)

    def _summary(self) -> tuple[str, str, dict[str, Any]]:
        tour, outcomes = self.book.tour, self.book.outcomes
        full = f'waiting for room on the disk: {self.book.trouble}' if self.book.trouble else ''
        dropped = tour.dropped if tour and self.phase != REGISTRATION else {}
        values = {
            'state': 'held' if full and self.state == 'running' else self.state,
            'phase': self.phase,
            'robot': 'silent' if self._q is None else 'heard',
            'poses_done': tour.visited if tour else 0,
            'poses': sum(tour.poses.values()) if tour else 0,
            'configurations_done': outcomes.total(),
            'configurations': sum(tour.configurations.values()) if tour else 0,
            'plan': self.book.id,
            **{f'outcome_{name}': count for name, count in sorted(outcomes.items())},
            **{f'dropped_{name}': count for name, count in sorted(dropped.items())},
        }
        why = full or self._why
        level = 'error' if self.state == 'failed' else 'warn' if why else 'ok'
        return level, why or self.state, values

    def close(self) -> None:
        """Tell the bridge to stop: nobody plans any more."""
        if self.state == 'running':
            self._set_state('stopped')
        self.book.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(PosePlanner, args)


if __name__ == '__main__':
    raise SystemExit(main())
