# SPDX-License-Identifier: Apache-2.0
"""What can be changed while a node runs changes, checked; all else is refused with the reason.

By the parameter services, and by `ros2 param set` where there is one.
"""

import shutil
import subprocess
import sys
import time

import pytest
from rigs.ros_rig import FOUND_S, node_arguments, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

# A node with a live parameter, another one, and a change that it refuses.
NODE = """
import sys
from dataclasses import dataclass
from remaster_ros.errors import InputError
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run

@dataclass(frozen=True)
class Parameters:
    share: float = parameter(0.3, 'a share', low=0.01, high=1.0, live=True)
    name: str = parameter('a', 'a name', live=True)
    fixed: int = parameter(3, 'fixed')

class Live(RemasterNode):
    def __init__(self):
        super().__init__('live')
        self.p = declare(self, Parameters, self.change)

    def change(self, new):
        if new.name == 'moving':
            raise InputError('live: the arm moves; try again when it stands')
        self.p = new
        print(new.share, new.name, new.fixed, flush=True)

sys.exit(run(Live))
"""


@pytest.fixture
def live(ros_environment):
    process = subprocess.Popen(
        [sys.executable, '-c', NODE, '--ros-args', '-p', 'share:=0.5'],
        env=ros_environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    yield process
    process.kill()
    process.communicate()


def answer(client, future):
    deadline = time.monotonic() + 20.0
    while not future.done():
        assert time.monotonic() < deadline, 'no answer'
        client.spin_some()
    return future.result()


@pytest.fixture
def parameters(client):
    """Return a function that sets parameters of a node at once: whether it did, and why not."""
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient

    def set_them(node, **values):
        service = AsyncParameterClient(client, node)
        wait_until(lambda: client.spin_some() or service.services_are_ready(), 40, node)
        time.sleep(FOUND_S)
        wanted = [Parameter(name, value=value) for name, value in values.items()]
        result = answer(client, service.set_parameters_atomically(wanted)).result
        return result.successful, result.reason

    def get(node, name):
        service = AsyncParameterClient(client, node)
        time.sleep(FOUND_S)
        return answer(client, service.get_parameters([name])).values[0]

    set_them.get = get
    return set_them


def test_a_live_parameter_is_changed_and_checked(parameters, live):
    assert parameters('live', share=0.1) == (True, '')
    assert live.stdout.readline().split() == ['0.1', 'a', '3']
    assert parameters('live', share=0.2, name='b') == (True, '')
    assert live.stdout.readline().split() == ['0.2', 'b', '3']
    done, why = parameters('live', share=0.4, name='moving')
    assert (done, why) == (False, 'live: the arm moves; try again when it stands')
    assert not parameters('live', share=1.5)[0]
    assert not parameters('live', share='fast')[0]
    assert parameters.get('live', 'share').double_value == 0.2
    done, why = parameters('live', fixed=4)
    assert not done
    assert 'read-only' in why
    # Neither half of a change that is refused holds.
    assert not parameters('live', share=0.9, use_sim_time=True)[0]
    assert parameters.get('live', 'share').double_value == 0.2


@pytest.mark.parametrize(
    ('node', 'values'),
    [
        ('recorder', {'settle_s': 1.0}),
        ('recorder', {'use_sim_time': True}),
        ('optimizer', {'seed': 3}),
        ('pose_planner', {'seed': 3}),
    ],
)
def test_what_would_change_nothing_is_refused(start, parameters, tmp_path, node, values):
    start(f'remaster_ros.nodes.{node}', *node_arguments(session=tmp_path / 'session'))
    done, why = parameters(node, **values)
    assert not done
    assert 'read' in why
    (name,) = values
    assert name in why


@pytest.mark.skipif(shutil.which('ros2') is None, reason='no ros2 command line here')
def test_the_real_command_line(start, ros_environment, live, client):
    wait_until(lambda: client.spin_some() or 'live' in client.get_node_names(), 40, 'the node')

    def ros2(*args):
        return subprocess.run(
            ['ros2', 'param', 'set', '/live', *args],
            env=ros_environment, capture_output=True, text=True, timeout=900, check=False,
        )  # fmt: skip

    assert 'successful' in ros2('share', '0.1').stdout
    assert live.stdout.readline().split()[0] == '0.1'
    refused = ros2('fixed', '4')
    assert 'successful' not in refused.stdout
    assert 'read-only' in refused.stdout + refused.stderr
