"""The bridge as the only thing between a plan and a real arm: limits, heartbeat, order."""

import time

import numpy as np
import pytest
from conftest import wait_until

from remaster_ros.storage.cell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]

CHAIN = read_cell('demo').chain()
HOME = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0])


class Surroundings:
    """Stands in for planner, recorder and a robot that is wherever it was last told to be."""

    def __init__(self, client):
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.status import RELIABLE, TOPIC, receiver

        self.client = client
        self.q, self.rng = HOME.copy(), np.random.default_rng(1)
        self.commands, self.events, self.settled = [], [], []
        self.talking = {'pose_planner', 'recorder'}
        self.states = client.create_publisher(JointState, '/joint_states', RELIABLE)
        self.status = client.create_publisher(DiagnosticArray, TOPIC, RELIABLE)
        self.solutions = client.create_publisher(
            JointTrajectory, '/remaster/joint_solutions', RELIABLE
        )
        self.listen()
        client.create_subscription(JointState, '/remaster/settled', self.settled.append, RELIABLE)
        self.summaries = {}
        client.create_subscription(
            DiagnosticArray, TOPIC, receiver(self.events.append, self._summary), RELIABLE
        )
        self._spoken = 0.0

    def _summary(self, node, message, values):
        self.summaries[node] = message

    def listen(self):
        """Be a controller."""
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.status import RELIABLE

        topic = '/joint_trajectory_controller/joint_trajectory'
        self.controller = self.client.create_subscription(
            JointTrajectory, topic, self._obey, RELIABLE
        )

    def _obey(self, message):
        columns = [list(message.joint_names).index(name) for name in CHAIN.joint_names]
        target = np.array(message.points[-1].positions)[columns]
        # The probe before the first move goes a micrometre.
        if np.max(np.abs(target - self.q)) > 1e-4:
            self.commands.append(message)
            self.q = target

    def say(self, name, **values):
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        self.status.publish(DiagnosticArray(status=[DiagnosticStatus(name=name, values=pairs)]))

    def live(self):
        """One turn: joint states in reverse order, heartbeats of those that still talk."""
        from sensor_msgs.msg import JointState

        q = self.q + self.rng.normal(0.0, 1e-6, 7)
        message = JointState(name=list(CHAIN.joint_names)[::-1], position=q[::-1].tolist())
        message.header.stamp = self.client.get_clock().now().to_msg()
        self.states.publish(message)
        if time.monotonic() - self._spoken > 0.3:
            self._spoken = time.monotonic()
            for name in self.talking:
                self.say(name, state='running')
        self.client.spin_some()

    def send(self, solutions):
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        message = JointTrajectory(joint_names=list(CHAIN.joint_names))
        message.header.stamp = self.client.get_clock().now().to_msg()
        message.points = [JointTrajectoryPoint(positions=list(map(float, q))) for q in solutions]
        self.solutions.publish(message)
        return f'{message.header.stamp.sec}.{message.header.stamp.nanosec:09d}'

    def until(self, condition, timeout_s, what):
        def turn():
            self.live()
            return condition()

        wait_until(turn, timeout_s, what)


@pytest.fixture
def around(start, client):
    start(
        'remaster_ros.nodes.robot_bridge',
        '--ros-args', '-p', 'settle_s:=0.5', '-p', 'heartbeat_s:=1.0', '-p', 'speed_share:=1.0',
    )  # fmt: skip
    surroundings = Surroundings(client)
    surroundings.until(
        lambda: (
            surroundings.solutions.get_subscription_count() == 1
            and surroundings.states.get_subscription_count() == 1
        ),
        30,
        'the bridge',
    )
    for _ in range(50):
        surroundings.live()
    surroundings.commands.clear()
    return surroundings


def test_nothing_outside_the_limits_is_ever_commanded(around):
    """Outside by 0.1 degree, far outside, not a number: refused by name; the good one is not."""
    outside, far, nothing = HOME.copy(), HOME.copy(), HOME.copy()
    outside[1] = CHAIN.upper[1] + np.deg2rad(0.1)
    far[6] = -20.0
    nothing[3] = np.nan
    good = HOME + 0.2
    stamp = around.send([outside, far, nothing, good])
    around.until(lambda: around.settled, 30, 'the good solution')
    refused = [e for e in around.events if e.event == 'failed']
    assert [e.values['solution'] for e in refused] == ['0', '1', '2']
    for event, joint in zip(refused, ('joint_2', 'joint_7', 'joint_4')):
        assert event.values['reason'].startswith(joint)
        assert event.values['stamp'] == stamp
    assert len(around.commands) == 1
    points = np.array([point.positions for point in around.commands[0].points])
    assert np.all((points >= CHAIN.lower) & (points <= CHAIN.upper))
    np.testing.assert_allclose(points[-1], good)
    assert list(around.commands[0].points[-1].velocities) == [0.0] * 7
    np.testing.assert_allclose(around.settled[0].position, good, atol=1e-5)


def test_one_configuration_at_a_time_and_only_after_the_recorder_has_spoken(around):
    first, second = HOME + 0.1, HOME - 0.1
    stamp = around.send([first, second])
    around.until(lambda: around.settled, 30, 'the first solution')
    waited = time.monotonic()
    around.until(lambda: time.monotonic() > waited + 1.5, 10, 'time')
    assert len(around.commands) == 1, 'it went on without the recorder'
    around.say('recorder: configuration', stamp=stamp, solution=0, result='recorded')
    around.until(lambda: len(around.settled) == 2, 30, 'the second solution')
    np.testing.assert_allclose(around.settled[1].position, second, atol=1e-5)


@pytest.mark.parametrize('silent', ['pose_planner', 'recorder'])
def test_silence_holds_the_arm_and_speech_lets_it_go_on(around, silent):
    around.talking.discard(silent)
    quiet = time.monotonic()
    around.until(lambda: time.monotonic() > quiet + 1.5, 10, 'time')
    around.commands.clear()
    around.send([HOME + 0.1])
    asked = time.monotonic()
    around.until(lambda: time.monotonic() > asked + 1.0, 10, 'time')
    assert not around.commands
    around.talking.add(silent)
    around.until(lambda: around.settled, 30, 'the solution, once everyone is heard')


def test_nothing_is_commanded_before_a_controller_listens(around):
    """As after a restart of either: a command that nobody hears would count as one dropped."""
    around.client.destroy_subscription(around.controller)
    silent = 'no controller listens to'
    around.until(lambda: silent in around.summaries.get('robot_bridge', ''), 30, 'the reason')
    around.send([HOME + 0.1])
    asked = time.monotonic()
    around.until(lambda: time.monotonic() > asked + 1.0, 10, 'time')
    assert not [event for event in around.events if event.event == 'commanded']
    around.listen()
    around.until(lambda: around.settled, 30, 'the solution')
    assert len(around.commands) == 1
