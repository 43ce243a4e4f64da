# SPDX-License-Identifier: Apache-2.0
"""A pause, then faults in the middle of a whole run of real nodes: the reason, and its end.

The faults are injected into the fakes' hidden World one after the other; what each kind does to
each node is in test_fault_rows.py, to each device in test/integration/test_device_faults.py.
"""

import signal
import time

import numpy as np
import pytest
from rigs.ros_rig import call, clear_halt, wait_until

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.faults import inject
from remaster_ros.simulation.setup import make_world

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

SEED = 5


class Listener:
    """What the nodes say, and how fast the arm moves."""

    def __init__(self, client):
        from sensor_msgs.msg import JointState

        from remaster_ros.nodes.status import listen

        self.client = client
        self.summaries, self.events, self.speeds = {}, [], []
        listen(client, lambda record: self.events.append(record.body), self._summary)
        # The latest one only: a test that lags behind must not look at the past.
        client.create_subscription(JointState, '/joint_states', self._state, 1)

    def _summary(self, node, message, values):
        self.summaries[node] = message

    def _state(self, message):
        self.speeds.append((time.monotonic(), np.max(np.abs(message.velocity))))

    def until(self, condition, timeout_s, what):
        def turn():
            for _ in range(20):
                self.client.spin_some()
            return condition()

        wait_until(turn, timeout_s, what)

    def says(self, node, text, timeout_s=60):
        self.until(lambda: text in self.summaries.get(node, ''), timeout_s, f'{node}: {text}')

    def moves(self):
        """Wait until the arm is on its way."""
        self.speeds.clear()
        self.until(lambda: self.speeds and self.speeds[-1][1] > 0.1, 90, 'a moving arm')

    def stands(self, seconds=1.5):
        """Watch an arm that must stand still, after a second of wall time to come to rest."""
        began = time.monotonic()
        self.until(lambda: time.monotonic() > began + 1.0, 10, 'time')
        self.speeds.clear()
        began = time.monotonic()
        self.until(lambda: time.monotonic() > began + seconds, 10, 'time')
        assert not self.speeds or max(speed for _, speed in self.speeds) < 1e-3


def test_one_fault_after_the_other_and_the_run_completes(start, client, tmp_path, ros_environment):
    hidden, out = tmp_path / 'hidden', tmp_path / 'out'
    hidden.mkdir()
    ros_environment['TMPDIR'] = str(hidden)
    demo = start(
        'remaster_ros.cli.main', 'demo', '--out', out, '--candidates', '4', '--no-figures',
        # With the live page it bears that the arm is halted: a person, here, may be at it.
        '--seed', SEED, '--watch',
    )  # fmt: skip
    listener = Listener(client)
    rows = out / 'session' / 'observations.csv'
    listener.until(
        lambda: (rows.exists() and rows.read_text().count('\n') > 2) or demo.poll() is not None,
        180,
        'the first observations',
    )
    assert demo.poll() is None, demo.communicate()
    (world,) = hidden.glob('remaster_world_*')

    listener.moves()
    assert call(client, '/remaster/pause').success
    listener.stands()
    before = rows.read_text()
    listener.stands()
    assert rows.read_text() == before
    assert call(client, '/remaster/collect').success

    def halted_until_a_person_clears_it():
        inject(world, {})
        listener.stands()
        assert call(client, '/remaster/collect').success is False
        assert clear_halt(client).success
        listener.stands()
        assert call(client, '/remaster/collect').success

    cases = [
        ({'robot': {'nan': 1}}, 'robot_bridge', 'joint_states are not finite'),
        ({'robot': {'renamed': 1}}, 'robot_bridge', "none of the cell's joints"),
        ({'robot': {'off': 1}}, 'robot_bridge', 'no sign of robot'),
        ({'mocap': {'stopped': 1}}, 'recorder', 'waiting for mocap: no frame for'),
        ({'tracker': {'off': 1}}, 'recorder', 'waiting for tracker'),
    ]
    for faults, node, reason in cases:
        listener.moves()
        inject(world, faults)
        listener.says(node, reason)
        listener.stands()
        if 'robot' in faults:
            halted_until_a_person_clears_it()
        else:
            inject(world, {})

    listener.moves()
    inject(world, {'robot': {'estop': 1}})
    # On its way, before it had begun, at the end of a piece, or between them: it is halted.
    reasons = ('the robot ', 'the arm stands ')
    listener.until(
        lambda: any(text in listener.summaries.get('pose_planner', '') for text in reasons),
        90,
        'a halt',
    )
    halted_until_a_person_clears_it()

    listener.moves()
    inject(world, {'mocap': {'swapped': 0.2}})
    swapped = 'mocap: swapped'
    listener.until(
        lambda: any(swapped in getattr(event, 'reason', '') for event in listener.events),
        90,
        swapped,
    )
    inject(world, {})

    def complete():
        assert demo.poll() is None, demo.communicate()
        return 'exit_status: complete' in (out / 'session' / 'session.yaml').read_text()

    listener.until(complete, 600, 'the collection to complete')
    # What follows is the fit, which is tested elsewhere.
    demo.send_signal(signal.SIGINT)
    demo.communicate(timeout=30)
    # No wrong observation: each against the truth of this seed.
    truth = make_world(tmp_path / 'world', read_cell('demo'), SEED, 10.0).truth
    session = read_session(out / 'session')
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    m = session.measurements
    for index, name in enumerate(session.sensor_names):
        mine = m.sensor == index
        expected = truth.without_noise(chain, name, m.q[mine])
        assert np.linalg.norm(m.position[mine] - expected, axis=1).max() < 0.3e-3
    # Once each; and only the swapped marker cost a reading.
    pairs = list(zip(m.configuration.tolist(), m.sensor.tolist()))
    assert len(set(pairs)) == len(pairs)
    assert len(set(m.configuration.tolist())) > 8
    # No two configurations of a pose within 1 mrad of each other.
    first = m.sensor == 0
    for pose in set(m.pose.tolist()):
        q = m.q[first & (m.pose == pose)]
        distance = np.max(np.abs(q[:, None] - q), axis=-1)
        assert np.all(distance[~np.eye(len(q), dtype=bool)] > 1e-3)
    for log in (out / 'log').iterdir():
        assert 'Traceback' not in log.read_text(), log
