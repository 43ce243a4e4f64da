# SPDX-License-Identifier: Apache-2.0
"""A bridge process between stand-ins and a hostile arm, over real DDS.

`Lines` are the man in the middle: what becomes of joint states on their way out, and of commands
on their way in. `Bench` runs them in threads of the test's process, with the planner's and the
recorder's messages, and starts, pauses and kills the bridge.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from hostile.arm import Command, HostileArm
from hostile.lines import (
    COMMANDS,
    EMERGENCY,
    INTRUDER,
    LATCHED,
    LEASED,
    RELIABLE,
    STATUS_PERIOD_S,
    Lines,
    Seen,
)
from hostile.process import BridgeProcess
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rigs.ros_rig import ASKED
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.events import (
    STATES,
    ConfigurationEnded,
    Event,
    EventRecord,
    PlannerState,
    RecorderState,
    SolutionSettled,
    State,
    decode,
    encode,
)
from remaster_ros.session.bridge_files import HaltFile, LastCommandFile
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import FloatArray


class Bench(BridgeProcess):
    """The bridge's surroundings.

    Parameters
    ----------
    environment
        Of the bridge's process: its DDS domain, its path, its ROS_HOME.
    names
        The arm's joints, base to tip.
    home
        Where it stands first, rad, (k,).
    rng
        Source of all randomness.
    parameters
        Of the bridge.
    log
        The bridge's output is appended there.
    rate
        joint_states a second.
    arm
        Options of `HostileArm`.
    """

    def __init__(
        self,
        environment: dict[str, str],
        names: Sequence[str],
        home: FloatArray,
        rng: np.random.Generator,
        parameters: dict[str, Any],
        log: Path,
        rate: float = 100.0,
        clock_s: float = 0.0,
        stamp_noise_s: float = 0.0,
        **arm: bool,
    ) -> None:
        super().__init__(environment, parameters, log)
        self.names, self.rng = list(names), rng
        self.arm = HostileArm(home, time.monotonic(), **arm)
        self.calm = Lines(clock_s=clock_s, stamp_noise_s=stamp_noise_s)
        self.lines = self.calm
        self.seen = Seen()
        self.planner, self.waiting_for, self.silent = 'waiting', '', set[str]()
        self._runs = 0
        self.model = read_cell(parameters['cell']).model()
        self.emergency_shown: bool | None = None
        self.answers = True
        self.worst_gap_s = 0.0
        self.running_since: list[tuple[float, str]] = [(0.0, 'waiting')]
        self.order = rng.permutation(len(home))
        self.period_s = 1.0 / rate
        self._once: list[Callable[[FloatArray], FloatArray]] = []
        self._due: list[tuple[float, int, JointState]] = []
        self._due_commands: list[tuple[float, int, JointTrajectory]] = []
        self._numbers = itertools.count()
        self._frozen: FloatArray | None = None
        self._stopped_stamp: float | None = None
        self._ending = threading.Event()
        self._led_to(home)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=int(environment['ROS_DOMAIN_ID']))
        self._open()

    def _led_to(self, q: FloatArray) -> None:
        """Let the bridge that is started next find that one before it has led the arm there."""
        file = LastCommandFile('/robot_bridge', self.names, self.environment)
        file.write(q, time.time_ns())

    def _open(self) -> None:
        self.node = node = rclpy.create_node('hostile_controller', context=self._context)
        self.intruder = rclpy.create_node(INTRUDER, context=self._context)
        self._states = node.create_publisher(JointState, '/joint_states', RELIABLE)
        self._records = node.create_publisher(String, '/remaster/events', RELIABLE)
        self._poses = node.create_publisher(PoseStamped, '/remaster/target_pose', LEASED)
        self._solutions = node.create_publisher(
            JointTrajectory, '/remaster/joint_solutions', LEASED
        )
        self._waypoints = node.create_publisher(
            JointTrajectory, '/remaster/joint_waypoints', LEASED
        )
        # Only where the bridge is configured for it: without messages on it nothing moves.
        self._emergency = node.create_publisher(Bool, EMERGENCY, LATCHED)
        node.create_subscription(JointTrajectory, COMMANDS, self._on_command, RELIABLE)
        node.create_subscription(
            JointState,
            '/remaster/settled',
            lambda m: self.seen.settled.append((time.monotonic(), np.array(m.position))),
            RELIABLE,
        )
        node.create_subscription(DiagnosticArray, '/remaster/status', self._on_status, RELIABLE)
        node.create_subscription(String, '/remaster/events', self._on_record, RELIABLE)
        self._clear = node.create_client(Trigger, '/remaster/clear_halt')
        self._set = node.create_client(SetParameters, '/robot_bridge/set_parameters')
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._threads = [
            threading.Thread(target=self._spin, daemon=True),
            threading.Thread(target=self._pump, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the bridge and everything here."""
        self.end()
        self._ending.set()
        for thread in self._threads:
            thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self.intruder.destroy_node()
        rclpy.shutdown(context=self._context)

    # What the test publishes and does

    def disturb(self, **values: Any) -> float:
        """Change the lines from now on; returns the time."""
        self._frozen = self._stopped_stamp = None
        self.lines = replace(self.lines, **values)
        return time.monotonic()

    def once(self, change: Callable[[FloatArray], FloatArray]) -> None:
        """Let `change` work on the next message of joint_states alone."""
        self._once.append(change)

    def peace(self) -> None:
        """End every disturbance; the emergency stop too."""
        self._frozen = self._stopped_stamp = None
        self.lines = self.calm
        self.silent.clear()
        self.waiting_for = ''
        if self.emergency_shown:
            self.emergency_shown = False
        if self.arm.emergency:
            self.arm.release(time.monotonic())

    def plan_state(self, state: str) -> float:
        """Let the planner be in a state, published at once; returns the time."""
        # The time before: the message may arrive before this thread runs again.
        now = time.monotonic()
        self.running_since.append((now, state))
        if state == 'running' != self.planner:
            # A person's /remaster/collect.
            self._runs += 1
        self.planner = state
        self._say_plan()
        return now

    def _say_plan(self) -> None:
        run = f'hostile {self._runs}' if self.planner == 'running' else ''
        self._say(PlannerState(state=self.planner, run=run))

    def was_running(self, time_s: float) -> bool:
        """Whether the planner's newest state at a time was running."""
        return [state for t, state in self.running_since if t <= time_s][-1] == 'running'

    def send(
        self, solutions: Sequence[FloatArray], curve: tuple[FloatArray, FloatArray] | None = None
    ) -> str:
        """Publish a pose with these solutions; returns its stamp as the events name it.

        ``curve``: by which the arm goes to the first solution: where it begins and what it goes
        through, rad, (n, k), and their shares, (n,); None for the straight way.
        """
        stamp = self._stamp(0.0)
        message = JointTrajectory(joint_names=self.names)
        message.header.stamp = stamp
        message.points = [JointTrajectoryPoint(positions=list(map(float, q))) for q in solutions]
        pose = PoseStamped()
        pose.header.stamp = stamp
        pose.header.frame_id = 'base_link'
        # No way around anything: the straight one to each solution, or a curve.
        ways = JointTrajectory(joint_names=self.names)
        ways.header.stamp = stamp
        if curve is not None:
            # As the planner's: the solution, and one and the share in parts of 1e9 - 2.
            ways.points = [
                JointTrajectoryPoint(
                    positions=list(map(float, q)),
                    time_from_start=Duration(sec=1, nanosec=1 + round(share * 999_999_998)),
                )
                for q, share in zip(*curve, strict=True)
            ]
        self._waypoints.publish(ways)
        self._poses.publish(pose)
        self._solutions.publish(message)
        return f'{stamp.sec}.{stamp.nanosec:09d}'

    def can_clear(self) -> bool:
        """Whether the bridge's service for that is known here."""
        return bool(self._clear.service_is_ready())

    def clear_halt(self, timeout_s: float = 5.0) -> bool | None:
        """Call the service as a person would; None where the bridge has none.

        Asked to compare the pad with what is reported, a person does, and calls again.
        """
        if not self.can_clear():
            return None
        for _ in range(2):
            future = self._clear.call_async(Trigger.Request())
            if not self.until(future.done, timeout_s):
                return False
            if not future.result().message.startswith(ASKED):
                break
        # It is kept by another thread of the bridge: not to be killed before that.
        kept = HaltFile('/robot_bridge', self.environment).read
        return future.result().success and self.until(lambda: not kept(), timeout_s)

    def set_parameter(self, name: str, value: float, timeout_s: float = 5.0) -> str:
        """Ask the bridge for another value; returns why it refuses, or is silent; ''."""
        kind = ParameterType.PARAMETER_DOUBLE
        wanted = Parameter(name=name, value=ParameterValue(type=kind, double_value=value))
        future = self._set.call_async(SetParameters.Request(parameters=[wanted]))
        if not self.until(future.done, timeout_s):
            return 'no answer'
        (result,) = future.result().results
        return '' if result.successful else result.reason

    def on_its_way(self) -> bool:
        """Whether the arm is in the middle of a move: one that is being stopped is not."""
        now = time.monotonic()
        begun = max(t for t, state in self.running_since if state == 'running')
        newest = self.commands_since(begun)[-1:]
        return bool(newest) and now < newest[0].end_s - 0.1 and self.arm.speed() > 0.05

    @property
    def up_since_s(self) -> float:
        """Time of the first summary of this bridge's process, s; infinite before it."""
        # What a process before it published may come after its start.
        shown = (t for t, *_ in self.seen.summaries if t > self.started_s + 0.5)
        return next(shown, np.inf)

    def up_for(self, duration_s: float) -> None:
        """Wait until the bridge and all around it have known each other for a while."""
        self.until(lambda: time.monotonic() > self.up_since_s + duration_s, 30.0)

    def gap(self) -> float:
        """Longest time since the last call in which nothing was published here, s."""
        gap, self.worst_gap_s = self.worst_gap_s, 0.0
        return gap

    def until(self, condition: Callable[[], Any], timeout_s: float) -> bool:
        """Wait for a condition; returns whether it came true in time."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def commands_since(self, time_s: float) -> list[Command]:
        """Return the bridge's commands that arrived after a time."""
        with self.arm.lock:
            found = [c for c in self.arm.commands if c.arrival_s > time_s]
        return [c for c in found if not c.foreign]

    def reset_arm(self, q: FloatArray) -> None:
        """Put the arm somewhere else; only while no bridge runs."""
        with self.arm.lock:
            old = self.arm
            self.arm = HostileArm(q, time.monotonic(), old.exact, old.open_loop, old.keeps_stamps)
            self.arm.commands = old.commands
        self._led_to(q)

    # Threads

    def _spin(self) -> None:
        while not self._ending.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def _pump(self) -> None:
        now = next_state = next_status = time.monotonic()
        while not self._ending.is_set():
            before, now = now, time.monotonic()
            self.worst_gap_s = max(self.worst_gap_s, now - before)
            self.arm.advance(now)
            if now >= next_state:
                next_state = max(next_state + self.period_s, now)
                self._report(now)
            while self._due and self._due[0][0] <= now:
                self._states.publish(heapq.heappop(self._due)[2])
            while self._due_commands and self._due_commands[0][0] <= now:
                self._obey(heapq.heappop(self._due_commands)[2], foreign=True)
            if now >= next_status:
                next_status = now + STATUS_PERIOD_S
                self._heartbeat()
            time.sleep(0.002)

    def _heartbeat(self) -> None:
        if 'pose_planner' not in self.silent:
            self._say_plan()
        if 'recorder' not in self.silent:
            self._say(RecorderState(run='hostile', waiting_for=self.waiting_for))
        if self.emergency_shown is not None:
            self._emergency.publish(Bool(data=self.emergency_shown))

    def show_emergency(self, stopped: bool) -> None:
        """Publish the robot's emergency stop state at once, and from now on."""
        self.emergency_shown = stopped
        self._emergency.publish(Bool(data=stopped))

    def _say(self, body: State | Event) -> None:
        record = EventRecord(
            node=f'/{body.sender}', body=body, stamp_ns=time.time_ns(), model=self.model
        )
        self._records.publish(String(data=encode(record)))

    def _stamp(self, ahead_s: float) -> Time:
        ns = time.time_ns() + round(1e9 * ahead_s)
        return Time(sec=ns // 10**9, nanosec=ns % 10**9)

    def state_message(self, q: FloatArray, v: FloatArray, ahead_s: float = 0.0) -> JointState:
        """Return joint states as this robot publishes them: its own order, noise of encoders."""
        q = q + self.rng.normal(0.0, 1e-6, len(q))
        message = JointState(name=[self.names[i] for i in self.order])
        message.position = q[self.order].tolist()
        message.velocity = v[self.order].tolist()
        message.header.stamp = self._stamp(ahead_s)
        return message

    def _report(self, now: float) -> None:
        lines, rng = self.lines, self.rng
        if lines.silent:
            return
        with self.arm.lock:
            q, v, sampled = self.arm.q, self.arm.v, self.arm.time_s
        if lines.frozen:
            if self._frozen is None:
                self._frozen = q
            q, v = self._frozen, np.zeros_like(v)
        if lines.wrap is not None:
            q = q + lines.wrap
        if lines.nan is not None:
            q = np.where(np.arange(len(q)) == lines.nan, np.nan, q)
        while self._once:
            q = self._once.pop()(q)
        # The stamp is the sample's own time, as joint_state_broadcaster gives it.
        sampled += lines.stamp_noise_s * rng.normal()
        if lines.stopped_stamps:
            if self._stopped_stamp is None:
                self._stopped_stamp = sampled
            sampled = self._stopped_stamp
        message = self.state_message(q, v, lines.clock_s + sampled - time.monotonic())
        message.name = [lines.prefix + name for name in message.name]
        if lines.twice:
            message.name = [*message.name, *message.name]
            message.position = [*message.position, *message.position]
            message.velocity = [*message.velocity, *message.velocity]
        for _ in range(2 if rng.random() < lines.double else 1):
            if rng.random() >= lines.loss:
                due = now + lines.delay_s + lines.jitter_s * rng.random()
                heapq.heappush(self._due, (due, next(self._numbers), message))

    def _on_command(self, message: JointTrajectory) -> None:
        now, lines = time.monotonic(), self.lines
        for _ in range(2 if lines.command_double else 1):
            if lines.command_delay_s == 0.0:
                self._obey(message)
            else:
                # It is judged by where the arm was when the bridge sent it.
                self._obey(message, withheld=True)
                due = now + lines.command_delay_s * (0.5 + self.rng.random())
                heapq.heappush(self._due_commands, (due, next(self._numbers), message))

    def _obey(
        self, message: JointTrajectory, withheld: bool = False, foreign: bool = False
    ) -> None:
        names = list(message.joint_names)
        columns = [names.index(name) for name in self.names]
        points = message.points

        def rows(key: str) -> FloatArray | None:
            if not all(len(getattr(point, key)) == len(names) for point in points):
                return None
            return np.array([getattr(point, key) for point in points])[:, columns]

        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points]
        q = rows('positions')
        if q is None or not len(q):
            return
        lost = withheld or self.rng.random() < self.lines.command_loss
        stamp = message.header.stamp
        # On the robot's clock, as that of joint_states.
        begins_s = stamp.sec + 1e-9 * stamp.nanosec - time.time() - self.calm.clock_s
        self.arm.take(
            time.monotonic(),
            np.array(times),
            q,
            rows('velocities'),
            rows('accelerations'),
            lost,
            foreign=foreign or message.header.frame_id == INTRUDER,
            begins_s=time.monotonic() + begins_s if stamp.sec else None,
        )

    def _on_status(self, array: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in array.status:
            if status.name == 'robot_bridge':
                values = {pair.key: pair.value for pair in status.values}
                self.seen.summaries.append((now, status.message, values))

    def _on_record(self, message: String) -> None:
        now = time.monotonic()
        if '"/robot_bridge"' not in message.data:
            return
        event = decode(message.data).body
        if isinstance(event, STATES):
            return
        self.seen.events.append((now, event))
        if isinstance(event, SolutionSettled) and self.answers:
            self.answer(event.stamp, event.solution)

    def answer(self, stamp: str, solution: int) -> None:
        """Say in the recorder's name that a configuration is recorded."""
        self._say(ConfigurationEnded(stamp=stamp, solution=solution, result='recorded'))
