# SPDX-License-Identifier: Apache-2.0
"""The robot bridge in the test's process, on a clock that the test moves on, and a peer.

The peer is what the bridge works between: planner, recorder, robot and controller, as a node in a
context of its own. Every message crosses DDS; both nodes are spun by hand. Of the bridge nothing
is replaced but the wall clock of its modules.
"""

import time
from types import SimpleNamespace

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from hostile.arm import HostileArm
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rigs.ros_rig import OWN_DOMAIN
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Header, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.events import (
    STATES,
    ConfigurationEnded,
    EventRecord,
    PlannerState,
    RecorderState,
    decode,
    encode,
)
from remaster_ros.collection.message_fields import seconds
from remaster_ros.motion.states import Arm
from remaster_ros.nodes import (
    arm_states,
    emergency_link,
    rivals,
    robot_bridge,
    simulated_clock,
    status,
)
from remaster_ros.nodes.messages import waypoints_message
from remaster_ros.planning.tour_order import PoseVisit
from remaster_ros.session.bridge_files import LastCommandFile
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN, MODEL = CELL.chain(), CELL.model()
HOME = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0])
FAST = {
    'settle_s': 0.3,
    'heartbeat_s': 1.0,
    'reaction_s': 1.0,
    'speed_share': 1.0,
    'cartesian_speed_limit_m_s': 0.5,
    'emergency_stop_topic': 'robot/released',
    # Whole moves: each is one command. What comes in pieces has tests of its own.
    'horizon_s': 0.0,
}
"""Parameters of a bridge whose decisions come soon."""
PATIENCE_S = 30.0
"""So long a message or a path check may take on a busy machine, s."""
STEP_S = 0.02


class LogBook:
    """A node's logger that keeps what is written, and else is the node's own."""

    def __init__(self, logger, lines):
        self._logger, self._lines = logger, lines

    def __getattr__(self, name):
        if name not in ('info', 'warning', 'error'):
            return getattr(self._logger, name)
        return lambda text: self._lines.append((name, text))


class CountedBridge(robot_bridge.RobotBridge):
    """The bridge, which counts what it has taken in and sent."""

    def __init__(self):
        self.taken = dict.fromkeys(('states', 'records', 'solutions', 'ways'), 0)
        self.published = self.sent = 0
        self.logged = []
        try:
            super().__init__()
        except BaseException:
            # A process would end now, and its lock with it.
            self.destroy_node()
            raise
        publish = self.status.event

        def event(body):
            publish(body)
            self.sent += 1

        self.status.event = event

    def get_logger(self):
        return LogBook(super().get_logger(), self.logged)

    def _on_joint_state(self, message, info):
        super()._on_joint_state(message, info)
        self.taken['states'] += 1

    def _on_record(self, record):
        super()._on_record(record)
        self.taken['records'] += record.node != '/robot_bridge'

    def _on_solutions(self, message):
        super()._on_solutions(message)
        self.taken['solutions'] += 1

    def _on_waypoints(self, message):
        super()._on_waypoints(message)
        self.taken['ways'] += 1

    def _publish(self, *how):
        super()._publish(*how)
        self.published += 1

    def _summary(self):
        self.summarised = super()._summary()
        return self.summarised


class Rig:
    """The bridge with everybody alive, and an arm that obeys.

    Attributes
    ----------
    wall
        The bridge's wall clock, s; the stamps of the robot and the node's clock follow it.
    alive
        Who publishes: planner, recorder, robot.
    state, waiting_for
        What planner and recorder publish of themselves.
    models
        By node, the arms that others than the bridge's compute with.
    names, order
        The joints' names, and in which order joint_states has them.
    first
        Whether no bridge before this one has led the arm to its home.
    chain
        The arm, where it is not the demo's.
    alter
        Changes a message of joint_states before it is published.
    commands, events, summaries, settled
        What came from the bridge; summaries as (level, message, values).
    """

    def __init__(
        self,
        monkeypatch,
        folder,
        home=HOME,
        controller=True,
        first=False,
        chain=CHAIN,
        **parameters,
    ):
        self.wall = 1000.0
        clock = SimpleNamespace(monotonic=lambda: self.wall, time_ns=time.time_ns)
        for module in (simulated_clock, status, rivals, arm_states, emergency_link):
            monkeypatch.setattr(module, 'time', clock)
        # The age of the last command follows the test's clock as well.
        dated = SimpleNamespace(monotonic=clock.monotonic, time_ns=self.time_ns)
        monkeypatch.setattr(robot_bridge, 'time', dated)
        monkeypatch.setenv('ROS_HOME', str(folder))
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        self.names = list(chain.joint_names)
        if not first:
            LastCommandFile('/robot_bridge', self.names).write(home, self.time_ns())
        self.order = np.random.default_rng(3).permutation(len(home))
        self.arm = HostileArm(home, self.wall)
        self.rng = np.random.default_rng(4)
        self.alive = {'planner', 'recorder', 'robot'}
        self.state, self.waiting_for, self.run_token = 'running', '', 'token'
        self.models = {}
        self.alter = lambda message: message
        self.commands, self.events, self.summaries, self.settled = [], [], [], []
        self.pose = 0
        self._told = self._watched = -np.inf
        self._closing = []
        self._open_peer(controller)
        self._open_bridge(parameters)

    def time_ns(self):
        """The system's clock of the bridge, ns: as far on as its wall clock."""
        return round(1e9 * (1.7e9 + self.wall))

    # Made and ended

    def _open_peer(self, controller):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=OWN_DOMAIN)
        self.peer = node = rclpy.create_node('peer', context=self.context)
        self._spinner = SingleThreadedExecutor(context=self.context)
        self._spinner.add_node(node)
        leased = status.LEASED
        self.states = node.create_publisher(JointState, 'joint_states', 200)
        self.said = node.create_publisher(String, 'remaster/events', 200)
        self.solutions = node.create_publisher(JointTrajectory, 'remaster/joint_solutions', leased)
        self.ways = node.create_publisher(JointTrajectory, 'remaster/joint_waypoints', leased)
        self.controller = None
        if controller:
            self.open_controller()
        node.create_subscription(
            JointState, 'remaster/settled', lambda m: self.settled.append(m), 200
        )
        node.create_subscription(DiagnosticArray, 'remaster/status', self._on_status, 200)
        node.create_subscription(String, 'remaster/events', self._on_record, 200)
        self.clear = node.create_client(Trigger, 'remaster/clear_halt')
        # The robot's own safety circuit, which stops nothing; a test may have another, or none.
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.released = node.create_publisher(Bool, FAST['emergency_stop_topic'], latched)
        self.released.publish(Bool(data=False))

    def open_controller(self, **qos):
        self.controller = self.peer.create_subscription(
            JointTrajectory,
            'joint_trajectory_controller/joint_trajectory',
            self._on_command,
            QoSProfile(depth=200, **qos),
        )

    def close_controller(self):
        self.peer.destroy_subscription(self.controller)

    def _open_bridge(self, parameters):
        args = ['--ros-args', '--log-level', 'error']
        for name, value in {'cell': 'demo', **FAST, **parameters}.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            args += ['-p', f'{name}:={text}'] if text else ['-p', f"{name}:=''"]
        rclpy.init(args=args, domain_id=OWN_DOMAIN)
        try:
            self.bridge = CountedBridge()
        except BaseException:
            rclpy.try_shutdown()
            self.bridge = None
            self.close()
            raise
        # All nodes are started with the bridge's cell, where a test has them no other.
        cell = self.bridge.p.cell
        self.model = MODEL if cell == 'demo' else read_cell(cell).model()
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.bridge)
        if not parameters.get('use_sim_time'):
            self.bridge.now_s = lambda: self.wall + 0.25
        ours = (self.states, self.said, self.solutions, self.ways)
        topics = {publisher.topic_name for publisher in ours}
        # Both sides of a match: what is sent before the other one has seen it may be lost.
        heard = [
            listener for listener in self.bridge.subscriptions if listener.topic_name in topics
        ]
        assert len(heard) >= len(ours)
        self.wait(
            lambda: (
                all(publisher.get_subscription_count() for publisher in ours)
                and all(subscription.get_publisher_count() for subscription in heard)
                and self.bridge.status._publisher.get_subscription_count()
                and self.bridge.status._events.get_subscription_count() > 2
                and self.bridge._settled.get_subscription_count()
            ),
            'the nodes to find each other',
        )
        if self.bridge.p.emergency_stop_topic == FAST['emergency_stop_topic']:
            self.wait(lambda: not self.bridge._emergency.trouble(), 'the safety circuit')

    def quiet(self):
        """End the bridge's timers: it looks and reports only when it is told to, or has to."""
        for timer in list(self.bridge.timers):
            timer.cancel()

    def close(self):
        self.end_bridge()
        if not self.context.ok():
            return
        self._spinner.shutdown()
        self.peer.destroy_node()
        rclpy.shutdown(context=self.context)

    def end_bridge(self):
        if self.bridge is not None:
            bridge, self.bridge = self.bridge, None
            bridge.close()
            self.executor.shutdown()
            bridge.destroy_node()
            rclpy.shutdown()

    # Spun by hand

    def spin(self, times=1):
        for _ in range(times):
            self.executor.spin_once(timeout_sec=0.0)
            self._spinner.spin_once(timeout_sec=0.0)

    def wait(self, condition, what='something'):
        """Spin both nodes, at a wall clock that stands, until the condition holds."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, f'waited in vain for {what}'
            self.executor.spin_once(timeout_sec=0.001)
            self._spinner.spin_once(timeout_sec=0.0)

    def taken(self, publisher, message, kind, count=1):
        """Publish, and wait until the bridge has taken it."""
        before = self.bridge.taken[kind]
        publisher.publish(message)
        end = time.monotonic() + PATIENCE_S
        while self.bridge.taken[kind] < before + count:
            assert time.monotonic() < end, f'the bridge did not take {kind}'
            self.executor.spin_once(timeout_sec=0.001)

    def step(self, dt=STEP_S):
        """Let a while pass: a report, now and then signs of life, a look at silence and graph."""
        self.wall += dt
        self.arm.advance(self.wall)
        if self.wall - self._told >= 0.4:
            self._told = self.wall
            if 'planner' in self.alive:
                self.say_planner()
            if 'recorder' in self.alive:
                self.say(RecorderState(waiting_for=self.waiting_for))
        if 'robot' in self.alive:
            self.report()
        if self.wall - self._watched >= robot_bridge.WATCH_WALL_S:
            self._watched = self.wall
            self.bridge._watch()
        self.flush()

    def flush(self):
        """Wait for the path that is looked for, and for what the bridge has published."""
        self.wait(lambda: self.bridge.supervisor.state is not Arm.ASKS, 'a path')
        self.wait(self._has_come, 'what the bridge has published')

    def _has_come(self):
        bridge = self.bridge
        return (
            (len(self.commands) == bridge.published or not self.controller)
            and len(self.events) == bridge.sent
            and len(self.settled) == bridge.counts['settled']
        )

    def run(self, seconds, until=None, dt=STEP_S):
        """Let so much time pass, or until a condition holds; it must, then."""
        end = self.wall + seconds
        while self.wall < end:
            self.step(dt)
            if until is not None and until():
                return
        assert until is None, f'waited {seconds} s of the clock in vain: {self.bridge._summary()}'

    def alone(self):
        """Let the bridge find that there is no other of its name."""
        self.bridge.status.publish()
        self.wait(lambda: self.bridge.status.alone_since is not None, 'its own summary')
        self.wall += 1.6
        self.bridge._watch()

    def ready(self):
        """Let the bridge find itself alone, its controller there and its arm standing."""
        self.alone()
        if self.controller is not None:
            self.wait(self.bridge._controller.matched, 'the controller')
        self.bridge._watch()
        self.wall += robot_bridge.MATCHED_WALL_S
        if self.bridge.p.emergency_stop_topic == 'none':
            # A bridge that was away was an interruption: a person goes on.
            self.run(1.5)
            self.say_planner('stopped')
            self.say_planner('running')
        self.run(2.5, lambda: not self.bridge.supervisor.blocked(self.wall))
        return self

    # What is said to it

    def report(self, **changes):
        """Publish where the arm is."""
        q = self.arm.q + self.rng.normal(0.0, 1e-6, len(self.arm.q))
        names = [self.names[i] for i in self.order]
        message = JointState(name=names, position=q[self.order].tolist())
        message.header.stamp = stamp(self.wall)
        for key, value in changes.items():
            setattr(message, key, value)
        message = self.alter(message)
        if message is not None:
            self.taken(self.states, message, 'states')

    def say(self, body):
        """Publish a state or an event in the name of the node that publishes it."""
        node = f'/{body.sender or "optimizer"}'
        record = EventRecord(node=node, body=body, model=self.models.get(node, self.model))
        self.taken(self.said, String(data=encode(record)), 'records')

    def say_planner(self, state=None):
        if state == 'running' != self.state:
            # A person's /remaster/collect.
            self.run_token += ', another'
        self.state = state or self.state
        token = self.run_token if self.state == 'running' else ''
        self.say(PlannerState(state=self.state, run=token))

    def plan(self, *targets, names=None, ways=None, ways_stamp=None):
        """Publish a pose with these solutions, and waypoints by solution; returns its stamp."""
        self.pose += 1
        names = self.names if names is None else names
        header = stamp(self.pose)
        if ways is not None:
            message = JointTrajectory(joint_names=self.names)
            message.header.stamp = header if ways_stamp is None else stamp(ways_stamp)
            message.points = [point(q, solution + 1) for solution, way in ways for q in way]
            self.taken(self.ways, message, 'ways')
        message = JointTrajectory(joint_names=names)
        message.header.stamp = header
        message.points = [point(q) for q in targets]
        self.taken(self.solutions, message, 'solutions')
        self.flush()
        return f'{self.pose}.000000000'

    def plan_curve(self, spline_points, shares):
        """Publish a pose that is reached by a curve through these points; returns its stamp."""
        *through, target = spline_points
        visit = PoseVisit(
            0,
            'validation',
            np.eye(4),
            target[None],
            0,
            (0,),
            (np.array(through),),
            shares=(shares[:-1],),
        )
        self.pose += 1
        header = Header(stamp=stamp(self.pose))
        self.taken(self.ways, waypoints_message(visit, self.names, header), 'ways')
        message = JointTrajectory(header=header, joint_names=self.names, points=[point(target)])
        self.taken(self.solutions, message, 'solutions')
        self.flush()

    def answer(self, stamp_key, solution):
        self.say(ConfigurationEnded(stamp=stamp_key, solution=solution, result='recorded'))

    def call_clear(self):
        self.wait(self.clear.service_is_ready, 'the service')
        future = self.clear.call_async(Trigger.Request())
        self.wait(future.done, 'the answer of clear_halt')
        return future.result()

    # What it said

    def summary(self):
        """Let it publish its summary; return level, message, values."""
        count = len(self.summaries)
        self.bridge.status.publish()
        level, message, values, state = self.bridge.summarised
        shown = {**status.pairs(state), **{key: str(value) for key, value in values.items()}}
        expected = level, message, shown

        def has_come():
            # An older one may still be on its way.
            level, message, values = (
                self.summaries[-1] if len(self.summaries) > count else expected
            )
            same = {key: values.get(key) for key in expected[2]} == expected[2]
            return len(self.summaries) > count and (level, message) == expected[:2] and same

        self.wait(has_come, 'a summary')
        return self.summaries[-1]

    def named(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    def moves(self):
        """The commands of more than the micrometre of the probe."""
        return [c for c in self.commands if np.max(np.abs(c.q - c.start_q)) > 1e-4]

    def logged(self):
        """What it wrote, without the pairs of bodies that are never looked at."""
        return [line for line in self.bridge.logged if not line[1].startswith('collisions: ')]

    def reason(self, name):
        return self.bridge.supervisor._interlocks.reason(name)

    def halted(self):
        return self.bridge.supervisor.halted

    def go(self, target, speed=0.05, **options):
        """Send the arm off and let it get into motion; returns the pose's stamp."""
        named = self.plan(target, **options)
        self.run(8.0, lambda: self.moves() and self.arm.speed() > speed)
        return named

    def settle(self, *targets, **options):
        """Send the arm somewhere and let it settle; returns the pose's stamp."""
        count = len(self.settled)
        named = self.plan(*targets, **options)
        self.run(30.0, lambda: len(self.settled) > count)
        return named

    def _on_command(self, message):
        times = np.array([seconds(p.time_from_start) for p in message.points])
        assert list(message.joint_names) == self.names
        assert all(not len(p.accelerations) and not len(p.effort) for p in message.points)
        q = np.array([p.positions for p in message.points])
        v = np.array([p.velocities for p in message.points])
        begins_s = seconds(message.header.stamp) or None
        self.commands.append(self.arm.take(self.wall, times, q, v, begins_s=begins_s))

    def _on_status(self, array):
        for item in array.status:
            values = {pair.key: pair.value for pair in item.values}
            if item.name == 'robot_bridge':
                level = {b'\x00': 'ok', b'\x01': 'warn', b'\x02': 'error'}[item.level]
                self.summaries.append((level, item.message, values))

    def _on_record(self, message):
        if '"/robot_bridge"' in message.data:
            body = decode(message.data).body
            self.events += [] if isinstance(body, STATES) else [body]


def stamp(time_s):
    nanoseconds = round(time_s * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def point(q, number=0):
    made = JointTrajectoryPoint(positions=[float(value) for value in q])
    made.time_from_start.sec = number
    return made
