# SPDX-License-Identifier: Apache-2.0
"""All real nodes, and a man in the middle between the bridge and the fake robot.

The fake robot's topics are remapped away; what the bridge hears and what the robot obeys passes
through the relay, which spoils it and keeps every command for the judge of `hostile.judge`.
"""

import socket
import time

import numpy as np
import pytest
from rigs.ros_rig import ROOT, call, clear_halt, node_arguments, wait_until

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
pytest.importorskip('pinocchio', reason='the judge needs pinocchio (pip install .[test])')

from hostile.arm import Command
from hostile.judge import GRACE_S, Judge, Rules, after
from hostile.lines import RELIABLE
from hostile.scene import demo_body

from remaster_ros.demo.processes import free_ports
from remaster_ros.session.bridge_files import LastCommandFile
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.setup import make_world

pytestmark = [pytest.mark.qualify, pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

SEED = 21
JOINTS, COMMANDS = '/joint_states', '/joint_trajectory_controller/joint_trajectory'


class Relay:
    """Between the bridge and the robot; spun by hand through `client`."""

    def __init__(self, client, world):
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.status import listen

        self.client, self._world, self.spoil = client, world, lambda message: message
        self.commands, self.said, self.q, self.v = [], {}, None, None
        self._names = read_cell('demo').chain().joint_names
        self._states = client.create_publisher(JointState, JOINTS, RELIABLE)
        self._robot = client.create_publisher(JointTrajectory, f'/mitm{COMMANDS}', RELIABLE)
        client.create_subscription(JointState, f'/mitm{JOINTS}', self._on_state, RELIABLE)
        client.create_subscription(JointTrajectory, COMMANDS, self._on_command, RELIABLE)
        listen(client, lambda event: None, self._on_summary)

    def _on_summary(self, node, message, values):
        self.said[node] = {'message': message, **values}

    def _on_state(self, message):
        columns = [list(message.name).index(name) for name in self._names]
        self.q = np.array(message.position)[columns]
        self.v = np.array(message.velocity)[columns]
        spoiled = self.spoil(message)
        if spoiled is not None:
            self._states.publish(spoiled)

    def _on_command(self, message):
        columns = [list(message.joint_names).index(name) for name in self._names]
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
        q = np.array([p.positions for p in message.points])[:, columns]
        v = np.array([p.velocities for p in message.points])[:, columns]
        stamp, now = message.header.stamp, time.monotonic()
        # The pieces of a move share a stamp, of world time, which runs as the wall clock does.
        since_s = self._world.now() - (stamp.sec + 1e-9 * stamp.nanosec)
        begins_s = now - since_s if stamp.sec else None
        self.commands.append(
            Command(now, np.array(times), q, v, None, self.q, self.v, begins_s=begins_s)
        )
        self._robot.publish(message)

    def moves(self):
        return self.v is not None and np.max(np.abs(self.v)) > 0.1

    def halted(self):
        return self.said.get('robot_bridge', {}).get('halted', '')

    def until(self, condition, what, timeout_s=90):
        def turn():
            for _ in range(20):
                self.client.spin_some()
            return condition()

        try:
            wait_until(turn, timeout_s, what)
        except AssertionError:
            print({name: said['message'] for name, said in self.said.items()})
            raise

    def turn_for(self, seconds):
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end, 'time')

    def collect_until_it_moves(self):
        """Ask the planner to begin, or to go on, until the arm moves, as a person does.

        A run that a node has kept waiting for more than some seconds is ended by the planner: a
        bridge that has just come up, say, on a busy machine.
        """
        asked = -np.inf

        def moves():
            nonlocal asked
            planner = self.said.get('pose_planner', {}).get('state')
            if planner != 'running' and time.monotonic() > asked + 2.0:
                assert call(self.client, '/remaster/collect').success
                asked = time.monotonic()
            return self.moves()

        self.until(moves, 'a moving arm')

    def stays_halted(self, since):
        """No command comes to an arm that is halted."""
        self.turn_for(2.0)
        assert self.halted()
        assert not after(self.commands, since + GRACE_S, np.inf)


@pytest.fixture
def relay(start, client, ros_environment, tmp_path):
    # A halt outlives the bridge: not into the next test.
    ros_environment['ROS_HOME'] = str(tmp_path / 'ros_home')
    world = make_world(tmp_path / 'world', read_cell('demo'), SEED, 1.0)
    last = LastCommandFile('/robot_bridge', world.chain.joint_names, ros_environment)
    last.write(world.start_q, time.time_ns())
    command, data = free_ports(socket.SOCK_DGRAM, socket.SOCK_DGRAM)
    ports = {'command_port': command, 'data_port': data}
    parameters = {
        'fake_robot': {'world': tmp_path / 'world', 'joint_state_rate': 100.0},
        'fake_optitrack': {'world': tmp_path / 'world', **ports},
        'optitrack_markers': ports,
        'pose_planner': {
            'session': tmp_path / 'session',
            'optimization_candidates': 2,
            'validation_candidates': 1,
            'registration_candidates': 6,
            'reference_every': 0,
        },
        'robot_bridge': {'settle_s': 0.5, 'heartbeat_s': 1.0, 'cartesian_speed_limit_m_s': 0.25},
        'recorder': {'session': tmp_path / 'session', 'require': 'mocap', 'settle_s': 0.5},
    }
    # The world must not wait for reports that the relay keeps.
    for name in ('robot_bridge', 'recorder'):
        parameters[name]['simulated_clock_rate'] = 0.0
    between = Relay(client, world)
    for name, values in parameters.items():
        named = {f'{name}:{key}': value for key, value in values.items()}
        arguments = node_arguments(ROOT / 'config' / 'fake.yaml', **named)
        if name == 'fake_robot':
            arguments += ['-r', f'{JOINTS}:=/mitm{JOINTS}', '-r', f'{COMMANDS}:=/mitm{COMMANDS}']
        start(f'remaster_ros.nodes.{name}', *arguments)
    heard = lambda: between.said.get('pose_planner', {}).get('robot') == 'heard'  # noqa: E731
    between.until(heard, 'the robot')
    return between


def test_what_the_real_nodes_command_when_the_joint_states_are_spoiled(relay):
    """A wrapped joint, then silence, on the way; in between a person clears the halt."""

    def wrapped(message):
        positions = list(message.position)
        positions[message.name.index('joint_1')] += 2 * np.pi
        message.position = positions
        return message

    for spoil in (wrapped, lambda message: None):
        relay.collect_until_it_moves()
        since, relay.spoil = time.monotonic(), spoil
        relay.until(relay.halted, 'a halt', 10)
        relay.stays_halted(since)
        relay.spoil = lambda message: message
        response = clear_halt(relay.client)
        assert response.success, response.message
        relay.until(lambda: not relay.halted() and not relay.moves(), 'the halt to end')
        call(relay.client, '/remaster/pause')
        relay.turn_for(1.0)
    rules = Rules(speed_share=0.3, cartesian_m_s=0.25, acceleration=np.full(7, 5.0))
    judge = Judge(demo_body(), rules)
    judged = [judge.judge(command) for command in relay.commands]
    assert sum(j.kind == 'move' for j in judged) >= 2
    assert not [j.wrong(rules) for j in judged if j.wrong(rules)]
