# SPDX-License-Identifier: Apache-2.0
"""Two complete cells in two namespaces of one DDS domain: neither affects the other."""

import socket

import numpy as np
import pytest
import yaml
from rigs.ros_rig import ROOT, call, wait_until

from remaster_ros.demo.processes import free_ports
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.world import World

pytestmark = [pytest.mark.qualify, pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

SEEDS = {'left': 21, 'right': 22}


def _plain(value):
    return value if isinstance(value, int | float) else str(value)


class OneCell:
    """The nodes of one cell in a namespace, each without a World of its own named to it."""

    def __init__(self, start, client, folder, name):
        from diagnostic_msgs.msg import DiagnosticArray

        from remaster_ros.nodes.status import RELIABLE, summary_receiver

        self.name, self.session, self.said = name, folder / name, {}
        client.create_subscription(
            DiagnosticArray,
            f'/{name}/remaster/status',
            summary_receiver(self._summary),
            RELIABLE,
        )
        command, data = free_ports(socket.SOCK_DGRAM, socket.SOCK_DGRAM)
        ports = {'command_port': command, 'data_port': data}
        parameters = {
            'fake_robot': {'rate': 10.0, 'seed': SEEDS[name]},
            'fake_optitrack': ports,
            'optitrack_markers': ports,
            'pose_planner': {
                'session': self.session,
                'optimization_candidates': 2,
                'validation_candidates': 0,
                'registration_candidates': 6,
                'reference_every': 0,
            },
            'robot_bridge': {'simulated_clock_rate': 10.0},
            'recorder': {
                'session': self.session,
                'require': 'mocap',
                'simulated_clock_rate': 10.0,
            },
        }
        self.processes = {}
        for node, values in parameters.items():
            args = ['--ros-args', '-r', f'__ns:=/{name}', '-r', '/clock:=clock']
            args += ['--params-file', ROOT / 'config' / 'fake.yaml']
            # On the command line a node's name has no namespace, so that the values are in a file.
            overrides = folder / f'{name}_{node}.yaml'
            section = {'ros__parameters': {key: _plain(value) for key, value in values.items()}}
            overrides.write_text(yaml.safe_dump({f'/{name}/{node}': section}))
            args += ['--params-file', overrides]
            self.processes[node] = start(f'remaster_ros.nodes.{node}', *args)

    def _summary(self, node, message, values):
        assert values['node'] == f'/{self.name}/{node}'
        self.said[node] = {'message': message, **values}

    def says(self, node, key):
        """Return a value of a node's last summary."""
        return self.said.get(node, {}).get(key, '')

    def check(self, folder):
        """Every row is where this cell's own hidden World has its marker."""
        session = read_session(self.session)
        (path,) = folder.glob(f'remaster_world_*.{self.name}')
        world = World.open(path)
        assert world.seed == SEEDS[self.name]
        chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
        m = session.measurements
        assert len(m) > 3
        expected = world.truth.without_noise(chain, 'mocap', m.q)
        assert np.all(np.linalg.norm(m.position - expected, axis=1) < 0.4e-3)
        world.close()


def test_two_cells_in_one_domain(start, client, tmp_path, ros_environment):
    worlds = tmp_path / 'worlds'
    worlds.mkdir()
    ros_environment['TMPDIR'] = str(worlds)
    cells = [OneCell(start, client, tmp_path, name) for name in SEEDS]

    def until(condition, what, timeout_s=150):
        def turn():
            for _ in range(20):
                client.spin_some()
            for cell in cells:
                for node, process in cell.processes.items():
                    assert process.poll() is None, (cell.name, node, process.communicate())
            return condition()

        wait_until(turn, timeout_s, what)

    left, right = cells
    until(
        lambda: all(cell.says('pose_planner', 'robot') == 'heard' for cell in cells),
        'both arms',
    )
    # The left one alone is asked; the right one must not move for it.
    response = call(client, '/left/remaster/collect')
    assert response.success, response.message
    until(lambda: int(left.says('recorder', 'mocap_accepted') or 0) > 1, 'the left cell')
    assert right.says('pose_planner', 'state') == 'idle'
    assert right.says('robot_bridge', 'commanded') == '0'
    assert call(client, '/right/remaster/collect').success
    until(
        lambda: all(cell.says('recorder', 'exit_status') == 'complete' for cell in cells),
        'both to be complete',
    )
    # No topic has publishers or subscribers of both cells.
    for topic, kinds in client.get_topic_names_and_types():
        if topic in ('/rosout', '/parameter_events'):
            continue
        ends = client.get_publishers_info_by_topic(topic)
        ends += client.get_subscriptions_info_by_topic(topic)
        spaces = {end.node_namespace for end in ends if end.node_name != 'test_client'}
        assert len(spaces) <= 1, (topic, kinds, spaces)
        assert all(topic.startswith(f'{space}/') for space in spaces), (topic, spaces)
    for cell in cells:
        cell.check(worlds)
    topics = BagReader(left.session / 'bag').topics
    assert {'/joint_states', '/optitrack/marker', '/remaster/settled'} <= set(topics)
    assert not [topic for topic in topics if 'left' in topic or 'right' in topic]
