"""Nodes without the demo around them: whom the arm waits for, and a disk that fills up."""

import resource
import socket
from contextlib import contextmanager

import numpy as np
import pytest
from conftest import ROOT, call, node_arguments, wait_until

from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.nodes.demo import free_ports
from remaster_ros.session.bag import BagReader
from remaster_ros.session.journal import read_journal
from remaster_ros.session.reader import read_session
from remaster_ros.session.workcell import read_cell
from remaster_ros.simulation.faults import inject
from remaster_ros.simulation.setup import make_world

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]

SEED = 11


class Cell:
    """A small collection of real nodes on fake devices, and what they say."""

    def __init__(self, start, client, folder, require, sensors, candidates=2, reference_every=0):
        from remaster_ros.nodes.status import listen

        self.client, self.folder, self.session = client, folder, folder / 'session'
        print('seed', SEED)
        self.world = make_world(folder / 'world', read_cell('demo'), SEED, 10.0)
        self.said, self.messages, self.results, self.events = {}, {}, [], []
        listen(client, self._event, self._summary)
        command, data, tracker = free_ports(
            socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM
        )
        own = {
            'fake_robot': {'world': folder / 'world'},
            'pose_planner': {
                'session': self.session,
                'optimization_candidates': candidates,
                'validation_candidates': 1,
                'registration_candidates': 6,
                'reference_every': reference_every,
            },
            'robot_bridge': {},
            'recorder': {'session': self.session, 'require': require},
        }
        if 'mocap' in sensors:
            ports = {'command_port': command, 'data_port': data}
            own['fake_optitrack'] = {'world': folder / 'world', **ports}
            own['optitrack_markers'] = ports
        if 'tracker' in sensors:
            own['fake_laser_tracker'] = {'world': folder / 'world', 'port': tracker}
            own['laser_tracker_markers'] = {'port': tracker}
        common = ROOT / 'config' / 'fake.yaml'

        def begin(name):
            # By the node's name, which in the file counts more than none.
            values = {f'{name}:{key}': value for key, value in own[name].items()}
            return start(f'remaster_ros.nodes.{name}', *node_arguments(common, **values))

        self._begin = begin
        self.nodes = {name: begin(name) for name in own}
        self.until(lambda: self.said.get('pose_planner', {}).get('robot') == 'heard', 'the robot')
        response = call(client, '/remaster/collect')
        assert response.success, response.message

    def kill_and_start(self, name):
        self.nodes[name].kill()
        self.nodes[name].wait()
        self.nodes[name] = self._begin(name)

    def _summary(self, node, message, values):
        self.said[node], self.messages[node] = values, message

    def _event(self, event):
        self.events.append(event)
        if (event.node, event.event) == ('recorder', 'configuration'):
            self.results.append(event.values['result'])

    def until(self, condition, what, timeout_s=120):
        def turn():
            for _ in range(20):
                self.client.spin_some()
            for name, process in self.nodes.items():
                assert process.poll() is None, (name, process.communicate())
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

    def check(self, session):
        """Each row once, and where the truth has its marker."""
        chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
        m, truth = session.measurements, self.world.truth
        for index, name in enumerate(session.sensor_names):
            sensor, mine = truth.sensors[name], m.sensor == index
            marker_R = chain.positions(m.q[mine], sensor.marker, truth.joint_offsets)
            expected = transforms.apply(transforms.inverse(sensor.T_R_N), marker_R)
            assert np.all(np.linalg.norm(m.position[mine] - expected, axis=1) < 0.4e-3), name
        pairs = list(zip(m.configuration.tolist(), m.sensor.tolist()))
        assert len(set(pairs)) == len(pairs)
        tours = [r for r in read_journal(self.session / 'plan.jsonl').records if 'plans' in r]
        planned = sum(len(p['solutions']) for s in tours[-1]['plans'].values() for p in s['poses'])
        assert len(set(m.configuration.tolist())) == planned > 3


@contextmanager
def no_room(process):
    """Nothing that this process writes can become longer, as on a full disk."""
    before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1, before[1]))
    try:
        yield
    finally:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, before)


def test_one_required_sensor_is_enough_and_a_full_disk_is_waited_for(start, client, tmp_path):
    """The tracker is not there at all; then recorder and planner have no room to write."""
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'])
    cell.until(lambda: cell.results.count('recorded') > 4, 'the first configurations')

    with no_room(cell.nodes['recorder']):
        cell.until(lambda: 'room on the disk' in cell.recorder('waiting_for'), 'the reason')
        assert 'journal.jsonl: cannot be written' in cell.recorder('waiting_for')
        acknowledged = len(cell.results)
        held = f'waiting for {cell.recorder("waiting_for")}'
        cell.until(lambda: cell.messages['robot_bridge'] == held, 'the bridge')
        recorded = len(read_session(cell.session).measurements)
        assert recorded == int(cell.recorder('observations'))
        assert len(cell.results) == acknowledged
    cell.until(lambda: len(cell.results) > acknowledged, 'the next configuration')
    with no_room(cell.nodes['pose_planner']):
        cell.until(lambda: 'room on the disk' in cell.messages['pose_planner'], 'the reason')
        cell.until(lambda: cell.messages['robot_bridge'] == 'planner is held', 'the bridge')

    session = cell.complete()
    cell.check(session)
    assert cell.recorder('waiting_for') == ''
    assert session.sensor_names == ('mocap', 'tracker')
    assert set(session.measurements.sensor.tolist()) == {0}
    assert cell.recorder('bag_dropped') == '0'
    # Also what came while there was no room.
    settled = [m for m in BagReader(cell.session / 'bag') if m.topic == '/remaster/settled']
    assert len(settled) >= len(cell.results)


def test_any_sensor_is_enough(start, client, tmp_path):
    """The bar stops for good in the middle: the tracker alone goes on, and nobody waits."""
    cell = Cell(start, client, tmp_path, 'any', ['mocap', 'tracker'])
    cell.until(lambda: int(cell.recorder('observations') or 0) > 1, 'the first configurations')
    inject(tmp_path / 'world', {'mocap': {'off': 1}})
    session = cell.complete()
    cell.check(session)
    assert set(session.measurements.sensor.tolist()) == {0, 1}
    assert session.measurements.sensor[-1] == 1


def test_a_collection_goes_on_where_the_tracker_does_not_see_its_marker(start, client, tmp_path):
    """Planner and recorder die before the registration is complete, and the beam is broken.

    Only the next pose can show the marker again: a preflight that waits for it waits for ever.
    """
    cell = Cell(start, client, tmp_path, 'all', ['mocap', 'tracker'])
    cell.until(lambda: cell.results.count('recorded') == 1, 'the first registration pose')
    inject(tmp_path / 'world', {'tracker': {'search_fails': 1}})
    cell.kill_and_start('recorder')
    cell.said.pop('pose_planner', None)
    cell.kill_and_start('pose_planner')
    # With both gone nobody is left who took part in the run: a person has to begin it again.
    cell.until(
        lambda: cell.said.get('pose_planner', {}).get('resuming') == 'no', 'the decision to wait'
    )
    assert cell.said['pose_planner']['state'] == 'idle'
    assert call(client, '/remaster/collect').success
    cell.until(lambda: 'partial' in cell.results, 'the next pose')
    inject(tmp_path / 'world', {})
    cell.check(cell.complete())


def test_a_settled_arm_is_read_though_its_pose_is_heard_of_later(start, client, tmp_path):
    """Topics overtake each other: /remaster/settled comes before what the planner announced."""
    from geometry_msgs.msg import PointStamped
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    from remaster_ros.nodes.messages import stamp_key
    from remaster_ros.nodes.status import RELIABLE, NodeStatus, listen

    cell = read_cell('demo')
    names, rng = cell.chain().joint_names, np.random.default_rng(SEED)
    print('seed', SEED)
    q = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0])
    heard, counts = [], {}
    listen(client, heard.append, lambda node, message, values: counts.update(values))
    publishers = {
        topic: client.create_publisher(kind, topic, RELIABLE)
        for topic, kind in (
            ('/joint_states', JointState),
            ('/remaster/settled', JointState),
            ('/remaster/joint_solutions', JointTrajectory),
            (cell.sensors['mocap'].topic, PointStamped),
        )
    }
    start(
        'remaster_ros.nodes.recorder',
        *node_arguments(session=tmp_path / 'session', require='mocap', call_measure=False),
    )

    def joints():
        message = JointState(name=list(names), position=(q + rng.normal(0, 1e-6, 7)).tolist())
        message.header.stamp = client.get_clock().now().to_msg()
        return message

    def live():
        publishers['/joint_states'].publish(joints())
        point = PointStamped()
        point.header.stamp = client.get_clock().now().to_msg()
        point.point.x, point.point.y, point.point.z = rng.normal(2.0, 1e-5, 3)
        publishers[cell.sensors['mocap'].topic].publish(point)
        client.spin_some()

    def until(condition, what):
        wait_until(lambda: live() or condition(), 60, what)

    until(lambda: counts.get('read_age_s_mocap', 'inf') == '0.0', 'the recorder')
    publishers['/remaster/settled'].publish(joints())
    until(lambda: counts.get('settled_unknown') == '1', 'a pose that nobody knows')
    solutions = JointTrajectory(joint_names=list(names))
    solutions.header.stamp = client.get_clock().now().to_msg()
    solutions.points = [JointTrajectoryPoint(positions=q.tolist())]
    publishers['/remaster/joint_solutions'].publish(solutions)
    status = NodeStatus(client, lambda: ('ok', '', {}))
    until(lambda: client.count_subscribers('/remaster/status') > 1, 'the status')
    stamp = stamp_key(solutions.header.stamp)
    values = {'pose': 0, 'split': 'optimization', 'solutions': 1, 'ids': '0', 'plan': 'p'}
    status._send('pose_planner: pose', 'ok', '', {**values, 'stamp': stamp})
    until(lambda: any(event.event == 'configuration' for event in heard), 'its end')
    (end,) = (event for event in heard if event.event == 'configuration')
    assert (end.values['stamp'], end.values['result']) == (stamp, 'recorded'), end
