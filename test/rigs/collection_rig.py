# SPDX-License-Identifier: Apache-2.0
"""A small collection of real nodes on fake devices, without the demo around them."""

import socket
from collections import Counter

import numpy as np
from rigs.ros_rig import ROOT, call, node_arguments, wait_until

from remaster_ros.collection.events import ConfigurationEnded
from remaster_ros.demo.processes import free_ports
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.journal import read_journal
from remaster_ros.session.records.plan_journal import read_plan
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.setup import make_world

SEED = 11
SHORT = {'settle_s': 1.0}
FAST, SLOW = {'speed_share': 0.6}, {'speed_share': 0.3}
"""Of a collection, a node's time goes into what the arm and the sensors publish meanwhile."""


class Cell:
    """A small collection of real nodes on fake devices, and what they publish.

    `foreign` gives sensors that are read from the topic of a node of another package: sensor ->
    (message type, topic), as in the cell file. `by_action` gives the arm's controller the action
    FollowJointTrajectory in place of the topic. `compensation` is that of the bridge,
    and `judged` what the planner has arms judged by.
    """

    def __init__(
        self,
        start,
        client,
        folder,
        require,
        sensors,
        candidates=2,
        reference_every=0,
        cell='demo',
        held_out=1,
        collect=True,
        rate=10.0,
        foreign=None,
        discovery='',
        hidden=(),
        by_action=False,
        compensation='',
        judged=None,
    ):
        from remaster_ros.nodes.controller_link import COMMANDS
        from remaster_ros.nodes.status import listen

        self.client, self.folder, self.session = client, folder, folder / 'session'
        print('seed', SEED)
        self.world = make_world(folder / 'world', read_cell(cell), SEED, rate, hidden)
        self.said, self.messages, self.results, self.events = {}, {}, [], []
        listen(client, self._record, self._summary)
        command, data, tracker = free_ports(
            socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM
        )
        # Who stops it on its way has to meet it there.
        speed = SLOW if by_action else FAST
        parameters = {
            'fake_robot': {'world': folder / 'world'},
            'pose_planner': {
                'session': self.session,
                'optimization_candidates': candidates,
                'validation_candidates': held_out,
                'registration_candidates': 6,
                'reference_every': reference_every,
                'discovery': discovery or folder / 'discovery',
                # A process starts as late as a busy machine lets it.
                'resume_within_s': 600.0,
                **speed,
            },
            'robot_bridge': {'simulated_clock_rate': rate, **SHORT, **speed},
            'recorder': {
                'session': self.session,
                'require': require,
                'simulated_clock_rate': rate,
                **SHORT,
            },
        }
        if by_action:
            parameters['robot_bridge']['command_interface'] = 'action'
        if compensation:
            parameters['robot_bridge']['compensation'] = compensation
            parameters['pose_planner']['compensation'] = compensation
        parameters['pose_planner'] |= judged or {}
        if 'mocap' in sensors:
            ports = {'command_port': command, 'data_port': data}
            parameters['fake_optitrack'] = {'world': folder / 'world', 'rate': 12.0, **ports}
            parameters['optitrack_markers'] = ports
        if 'tracker' in sensors:
            parameters['fake_laser_tracker'] = {'world': folder / 'world', 'port': tracker}
            parameters['laser_tracker_markers'] = {'port': tracker}
        for sensor in foreign or {}:
            # Of a world that runs ten times as fast as its messages travel.
            values = {'sensor': sensor, 'max_age_s': 20.0, 'always_sends': sensor == 'mocap'}
            # No section of the shipped file is for nodes of this name.
            values['use_sim_time'] = True
            parameters[f'topic_markers_{sensor}'] = values
        for name in parameters.keys() - {'fake_robot', 'fake_optitrack', 'fake_laser_tracker'}:
            parameters[name]['cell'] = cell
        common = ROOT / 'config' / 'fake.yaml'

        def begin(name):
            if name == 'action_adapter':
                sim_time = node_arguments(use_sim_time=True)
                return start('rigs.action_adapter', *sim_time, cwd=ROOT / 'test')
            if name.startswith('vendor_'):
                sensor = name.removeprefix('vendor_')
                where = folder / 'world', sensor, *foreign[sensor]
                return start('rigs.foreign_source', *where, cwd=ROOT / 'test')
            # By the node's name, which in the file counts more than none.
            values = {f'{name}:{key}': value for key, value in parameters[name].items()}
            arguments = node_arguments(common, **values)
            if name.startswith('topic_markers'):
                return start(
                    'remaster_ros.nodes.sensor_markers', *arguments, '-r', f'__node:={name}'
                )
            if by_action and name == 'fake_robot':
                arguments += ['-r', f'{COMMANDS}:=arm/joint_trajectory']
            return start(f'remaster_ros.nodes.{name}', *arguments)

        self._begin = begin
        self.nodes = {name: begin(name) for name in parameters}
        self.nodes |= {f'vendor_{name}': begin(f'vendor_{name}') for name in foreign or {}}
        if by_action:
            self.nodes['action_adapter'] = begin('action_adapter')
        self.until(lambda: self.said.get('pose_planner', {}).get('robot') == 'heard', 'the robot')
        if collect:
            response = call(client, '/remaster/collect')
            assert response.success, response.message

    def kill_and_start(self, name):
        self.nodes[name].kill()
        self.nodes[name].wait()
        self.nodes[name] = self._begin(name)

    def told_to_stand(self):
        """Wait until the bridge says anew that the planner runs nothing, or that it has halted.

        What it said last may be of a moment before, when there was still something to command.
        """

        def bridge_stands():
            message = self.messages.get('robot_bridge', '')
            halted = message and self.said['robot_bridge']['halted']
            return halted or 'planner is ' in message

        self.messages.pop('robot_bridge', None)
        self.until(bridge_stands, 'the bridge')

    def _summary(self, node, message, values):
        self.said[node], self.messages[node] = values, message

    def _record(self, record):
        self.events.append(record.body)
        if isinstance(record.body, ConfigurationEnded):
            self.results.append(record.body.result)

    def until(self, condition, what, timeout_s=120):
        def turn():
            for _ in range(20):
                self.client.spin_some()
            for name, process in self.nodes.items():
                assert process.poll() is None, (name, process.returncode, process.communicate())
            return condition()

        try:
            wait_until(turn, timeout_s, what)
        except AssertionError:
            print(self.messages, self.said)
            raise

    def recorder(self, key):
        return self.said.get('recorder', {}).get(key, '')

    def complete(self):
        self.until(lambda: self.recorder('exit_status') == 'complete', 'the end')
        return read_session(self.session)

    def check(self, session, lost=0):
        """Each row once, where the truth has its marker; up to ``lost`` configurations lost."""
        chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
        m, truth = session.measurements, self.world.truth
        seen = list(zip(m.sensor.tolist(), m.marker.tolist()))
        for sensor, marker in sorted(set(seen)):
            mine = (m.sensor == sensor) & (m.marker == marker)
            names = session.sensor_names[sensor], session.marker_names[marker]
            expected = truth.without_noise(chain, names[0], m.q[mine], names[1])
            assert np.all(np.linalg.norm(m.position[mine] - expected, axis=1) < 0.4e-3), names
        pairs = list(zip(m.configuration.tolist(), seen))
        assert len(set(pairs)) == len(pairs)
        count, planned = len(set(m.configuration.tolist())), self.planned()
        assert planned > 3
        assert planned - lost <= count <= planned, (count, planned, lost)

    def ended(self, session):
        """Return what the plan says became of its configurations: outcome -> how many."""
        chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
        return Counter(read_plan(self.session, chain).outcomes.values())

    def planned(self):
        """Return how many configurations the collection has, with what is measured further."""
        tours = [r for r in read_journal(self.session / 'plan.jsonl').records if 'plans' in r]
        collected = [tour for tour in tours if 'optimization' in tour['plans']] or tours[-1:]
        plans = [plan for tour in collected for plan in tour['plans'].values()]
        return sum(len(pose['solutions']) for plan in plans for pose in plan['poses'])
