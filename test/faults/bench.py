# SPDX-License-Identifier: Apache-2.0
"""Real nodes on fake devices in a ROS domain of their own, to spoil one part of it at a time.

Every node is a process of its own. The bench's own node observes (`faults.observer`),
publishes what strangers would, and, where asked, stands between two nodes and hands on what the
one tells the other, spoiled. An operator calls the services that a person would.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from faults.observer import Observer
from rigs.forked_nodes import NodeProcess
from rigs.ros_rig import ASKED, PATIENCE

from remaster_ros.collection.events import ConfigurationEnded, PoseAnnounced, SolutionSettled
from remaster_ros.demo.processes import free_ports
from remaster_ros.session.cells.workcell import config_path, read_cell
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.faults import inject
from remaster_ros.simulation.setup import make_world


class Relay:
    """Hand messages on, as they are or spoiled.

    Attributes
    ----------
    spoil
        Returns what becomes of a message; None hands it on.
    delay_s
        How much later it is handed on, wall time.
    """

    def __init__(self, node, topic: str, kind) -> None:
        from remaster_ros.nodes.status import LEASED, RELIABLE

        self.spoil: Callable | None = None
        self.delay_s, self._last = 0.0, None
        self._publisher = node.create_publisher(kind, topic, LEASED)
        node.create_subscription(kind, f'bench/{topic}', self._take, RELIABLE)

    def _take(self, message) -> None:
        self._last = message
        if self.delay_s:
            threading.Timer(self.delay_s, self._send, [message]).start()
        else:
            self._send(message)

    def _send(self, message) -> None:
        self._publisher.publish(self.spoil(message) if self.spoil else message)

    def say_again(self) -> None:
        """Send the last message again."""
        self._send(self._last)


ROOT = Path(__file__).parents[2]
SEED, SPEED_SHARE = 11, 0.2
SENSOR_OF = {'optitrack_markers': 'mocap', 'laser_tracker_markers': 'tracker'}
NODES = ('pose_planner', 'robot_bridge', 'recorder', *SENSOR_OF)
FAKES = ('fake_robot', 'fake_optitrack', 'fake_laser_tracker')
EMERGENCY = 'safety/emergency_stop'
RELAYED = {
    'pose_planner': 'remaster/joint_solutions',
    'robot_bridge': 'remaster/settled',
    'optitrack_markers': 'optitrack/marker',
    'laser_tracker_markers': 'laser_tracker/marker',
}
"""Node -> the topic between it and the others, where relays are wanted."""


def cell_of_several_markers(folder: Path) -> Path:
    """Write the cell of the demo, with two reflectors of the tracker and every pose visited."""
    text = config_path('cells/quick.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots')))
    text = text.replace('marker: smr\n', 'marker: smr\n    further_markers: {smr_2: 2}\n')
    text = text.replace('  smr: [-0.1', '  smr_2: [0.0, -0.09, 0.03]\n  smr: [-0.1')
    text = text.replace('design: optimal', 'design: latin_hypercube')
    path = folder / 'cell.yaml'
    lines = [line for line in text.splitlines() if not line.startswith('  joint_std')]
    path.write_text('\n'.join(lines), encoding='utf-8')
    return path


class Bench:
    """One collection of real nodes.

    Parameters
    ----------
    folder
        Everything that is written.
    domain
        ROS_DOMAIN_ID.
    relays
        Whether the bench stands between the nodes.
    emergency
        Whether the bridge is given an `emergency_stop_topic`, which the bench publishes.
    require
        Of the recorder.
    candidates
        Candidate poses for optimization.
    reference_every
        Of the planner; 0 for a collection without references.
    several_markers
        Whether the bar measures three markers, and the tracker two reflectors.
    rate
        World time over wall time. Above 1 the world waits for the bridge and the recorder; at 1 it
        waits for neither, as no real arm does.
    """

    def __init__(
        self, folder: Path, domain: int, *, relays=False, emergency=False, require='all',
        candidates=32, reference_every=0, several_markers=False, rate=4.0,
    ) -> None:  # fmt: skip
        self.folder, self.session, self.rate = folder, folder / 'session', rate
        self._cell = str(cell_of_several_markers(folder)) if several_markers else 'demo'
        self.world = make_world(folder / 'world', read_cell(self._cell), SEED, rate)
        (folder / 'log').mkdir()
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
        self._environment = {
            **os.environ,
            'PYTHONPATH': path,
            'ROS_DOMAIN_ID': str(domain),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_HOME': str(folder / 'home'),
            'OMP_NUM_THREADS': '1',
        }
        command, data, tracker = free_ports(
            socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM
        )
        ports = {'command_port': command, 'data_port': data}
        hidden = {'world': str(folder / 'world')}
        self._values = {
            # Faults begin between two messages of the clock: as fine as the page has it.
            'fake_robot': {**hidden, 'clock_rate': 100.0, 'joint_state_rate': 20.0},
            'fake_optitrack': {**hidden, **ports, 'rate': 20.0},
            'fake_laser_tracker': {**hidden, 'port': tracker},
            'pose_planner': {
                'session': str(self.session), 'optimization_candidates': candidates,
                'validation_candidates': 1, 'registration_candidates': 6, 'seed': SEED,
                'reference_every': reference_every, 'resume_within_s': 600.0,
            },
            'robot_bridge': {
                'speed_share': SPEED_SHARE, 'settle_s': 0.6, 'answer_timeout_s': 30.0,
                **({'emergency_stop_topic': EMERGENCY} if emergency else {}),
            },
            'recorder': {'session': str(self.session), 'require': require, 'bag': False},
            'optitrack_markers': ports,
            'laser_tracker_markers': {'port': tracker},
        }  # fmt: skip
        if rate == 1.0:
            for name in ('robot_bridge', 'recorder'):
                self._values[name]['simulated_clock_rate'] = 0.0
        self.processes: dict[str, subprocess.Popen] = {}
        self._callers: dict[str, object] = {}
        self.relays: dict[str, Relay] = {}
        self.strangers: list = []
        self._open_node(domain)
        if relays:
            self._open_relays()
        if emergency:
            self._open_emergency()
        for name in (*FAKES, *NODES):
            self.start(name)

    # The bench's own node

    def _open_node(self, domain: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node('stranger', context=self._context)
        self.observer = Observer(self.node, self.world, SPEED_SHARE)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _open_relays(self) -> None:
        import rclpy
        from geometry_msgs.msg import PointStamped
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.status import RELIABLE

        # The planner waits until nodes of these names listen to it.
        self._listeners = [
            rclpy.create_node(name, namespace='bench', context=self._context)
            for name in ('robot_bridge', 'recorder')
        ]
        for node in self._listeners:
            node.create_subscription(JointTrajectory, RELAYED['pose_planner'], print, RELIABLE)
        kinds = {'pose_planner': JointTrajectory, 'robot_bridge': JointState}
        for name, topic in RELAYED.items():
            self.relays[name] = Relay(self.node, topic, kinds.get(name, PointStamped))

    def _open_emergency(self) -> None:
        from std_msgs.msg import Bool

        self.pressed: bool | None = False
        publisher = self.node.create_publisher(Bool, EMERGENCY, 10)

        def tell() -> None:
            if self.pressed is not None:
                publisher.publish(Bool(data=self.pressed))

        self.node.create_timer(0.2, tell)

    def foreign(self, topic: str, kind):
        """Return a publisher of the bench's own on a topic that belongs to another."""
        publisher = self.node.create_publisher(kind, topic, 10)
        self.strangers.append(publisher)
        return publisher

    # Processes

    def start(self, name: str) -> None:
        """Start a node (again)."""
        command = [sys.executable, '-m', f'remaster_ros.nodes.{name}', '--ros-args']
        command += ['--params-file', str(config_path('fake.yaml'))]
        values = {} if name in FAKES else {'cell': self._cell}
        for key, value in {**values, **self._values[name]}.items():
            command += ['-p', f'{name}:{key}:={json.dumps(value)}']
        if name in self.relays:
            topic = RELAYED[name]
            for written in (topic, f'/{topic}'):
                command += ['-r', f'{written}:=/bench/{topic}']
        with (self.folder / 'log' / f'{name}.log').open('ab') as log:
            self.processes[name] = NodeProcess(
                command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                env=self._environment,
            )  # fmt: skip

    def send(self, name: str, signum: int) -> None:
        """Send a signal to a node's process."""
        self.processes[name].send_signal(signum)

    def kill(self, name: str) -> None:
        """End a node as SIGKILL does."""
        self.processes[name].kill()
        self.processes[name].wait()

    def stutter(self, name: str, seconds: float, on_s: float = 0.06, off_s: float = 0.06) -> None:
        """Let a node run only now and then, as on a machine that is far too busy."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.send(name, signal.SIGSTOP)
            time.sleep(off_s)
            self.send(name, signal.SIGCONT)
            time.sleep(on_s)

    def inject(self, **devices: dict[str, float]) -> None:
        """Replace the faults of the fakes; with none they end."""
        inject(self.world.folder, devices)

    # Time

    def until(self, condition: Callable[[], object], timeout_s: float, what: str) -> None:
        """Wait; fail where it takes longer, or where a process has ended by itself."""
        deadline = time.monotonic() + PATIENCE * timeout_s
        while not condition():
            for name, process in self.processes.items():
                status = process.poll()
                assert status is None or status < 0, f'{name} ended: {self._log(name)}'
            said = {name: latest[1] for name, latest in self.observer.latest.items()}
            assert time.monotonic() < deadline, f'waited {timeout_s} s for {what}: {said}'
            time.sleep(0.01)

    def _log(self, name: str) -> str:
        return (self.folder / 'log' / f'{name}.log').read_text()[-500:]

    def begin(self) -> None:
        """Wait for the nodes, begin, and see the registration through."""
        says = self.observer.says
        self.until(lambda: says('pose_planner', 'robot') == 'heard', 90, 'the robot')
        self.call('collect')

        halts: list[str] = []

        def registered() -> bool:
            if self.halted:
                # A machine that is far too busy as the nodes start; no row has begun yet.
                halts.append(self.halted)
                assert len(halts) <= 3, f'halted without a fault: {halts}'
                time.sleep(1.0)
                self.operate()
            return says('pose_planner', 'phase') == 'collection'

        self.until(registered, 120, 'a registration')

    def under_way(self) -> None:
        """Wait until the arm is on its way, and goes on for more than half a second."""
        began = time.monotonic()

        def on_its_way() -> bool:
            moves = [c for c in self.observer.since(began) if c.is_move]
            if not moves:
                return False
            # A long move comes in pieces, of the same stamp.
            first_s = next(c.wall_s for c in moves if c.stamp_s == moves[-1].stamp_s)
            now = time.monotonic()
            left_s = self.observer.left_s(moves[-1]) - (now - moves[-1].wall_s) * self.rate
            return (now - first_s) * self.rate > 1.0 and left_s > 0.6 * self.rate

        self.until(on_its_way, 60, 'a long move')

    def settled(self) -> None:
        """Wait until a reading begins."""
        began = time.monotonic()
        found = self.observer.find
        self.until(lambda: found(SolutionSettled, since_s=began), 60, 'a reading')

    def left(self) -> int:
        """Return how many configurations are still to be visited."""
        says = self.observer.says
        planned = int(says('pose_planner', 'configurations') or 0)
        return planned - int(says('pose_planner', 'configurations_done') or 0)

    # The operator

    def call(self, service: str, timeout_s: float = 10.0):
        """Call a service of the planner or the bridge; None where it does not answer."""
        from std_srvs.srv import Trigger

        if service not in self._callers:
            self._callers[service] = self.node.create_client(Trigger, f'remaster/{service}')
        caller = self._callers[service]
        if not caller.wait_for_service(timeout_sec=timeout_s):
            return None
        future = caller.call_async(Trigger.Request())
        deadline = time.monotonic() + timeout_s
        while not future.done() and time.monotonic() < deadline:
            time.sleep(0.01)
        return future.result() if future.done() else None

    @property
    def halted(self) -> str:
        """Why the bridge keeps the arm where it is; ''."""
        return self.observer.says('robot_bridge', 'halted')

    @property
    def planner(self) -> str:
        """The planner's state."""
        return self.observer.says('pose_planner', 'state')

    def operate(self) -> list[str]:
        """Do what a person does who has looked at the arm; return what it took."""
        took = []
        if self.halted:
            response = self.call('clear_halt')
            if response is not None and response.message.startswith(ASKED):
                # The person has compared the pad with what is reported.
                response = self.call('clear_halt')
            if response is None or not response.success:
                return []
            took.append('clear_halt')
            cleared = time.monotonic()
            self.until(lambda: not self.halted, 5, 'the end of the halt')
            latest = self.observer.latest

            def stands() -> bool:
                # The bridge wants to hear of a planner that does not run before it runs again.
                if latest['pose_planner'][0] < cleared:
                    return False
                if self.planner == 'running':
                    self.call('pause', 2.0)
                return self.planner != 'running'

            self.until(stands, 20, 'a planner that does not run')
            time.sleep(0.2)
        if self.planner != 'running':
            response = self.call('collect')
            if response is None or not response.success:
                # It was started just now: the operator tries again.
                return took
            took.append('collect')
            self.until(lambda: self.planner == 'running', 5, 'the collection')
        return took

    # The end

    def close(self) -> None:
        """End every process, and the node."""
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + 8.0
        for process in self.processes.values():
            try:
                process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        import rclpy

        self._executor.shutdown()
        self._thread.join(5.0)
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
        self.world.close()

    def check_session(self) -> None:
        """Assert that each row is where the truth has its marker, once, and none is missing."""
        session, truth = read_session(self.session), self.world.truth
        m, chain = session.measurements, self.world.chain
        for index, number in np.unique(np.stack((m.sensor, m.marker)), axis=1).T:
            mine = (m.sensor == index) & (m.marker == number)
            name, marker = session.sensor_names[index], session.marker_names[number]
            expected = truth.without_noise(chain, name, m.q[mine], marker)
            wrong = np.linalg.norm(m.position[mine] - expected, axis=1)
            assert np.all(wrong < 1e-3), (name, marker, wrong.max())
        readings = list(zip(m.configuration.tolist(), m.sensor.tolist(), m.marker.tolist()))
        assert len(set(readings)) == len(readings), 'recorded twice'
        poses = {
            event.stamp: event
            for _, event in self.observer.find(PoseAnnounced)
            if event.split != 'registration'
        }
        recorded = set()
        for _, event in self.observer.find(ConfigurationEnded):
            announced = poses.get(event.stamp)
            # A stranger's answers, which are among what is injected, are no recording.
            if announced is not None and event.result == 'recorded':
                recorded.add((announced.pose, announced.ids[event.solution]))
        assert len(set(m.configuration.tolist())) >= len(recorded), 'lost'
        for log in (self.folder / 'log').iterdir():
            assert 'Traceback' not in log.read_text(), log
