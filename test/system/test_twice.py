# SPDX-License-Identifier: Apache-2.0
"""The same node twice on one cell: the second ends with an error line and status 2."""

import signal
import time

import pytest
from rigs.ros_rig import node_arguments, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

TWICE = ('robot_bridge', 'pose_planner', 'recorder', 'optimizer')


@pytest.fixture
def said(client):
    """Return the last summary of each node by its full name."""
    from remaster_ros.nodes.status import listen

    summaries = {}

    def summary(name, message, values):
        summaries[values.get('node', name)] = values

    listen(client, lambda event: None, summary)
    return summaries


def until(client, condition, timeout_s, what):
    def turn():
        for _ in range(5):
            client.spin_some()
        return condition()

    wait_until(turn, timeout_s, what)


def begin(start, node, tmp_path, number, *more):
    session = tmp_path / f'session_{number}'
    values = {'session': session}
    if node == 'robot_bridge':
        values = {'cell': 'demo', 'emergency_stop_topic': 'none'}
    return start(f'remaster_ros.nodes.{node}', *node_arguments(**values), *more)


@pytest.mark.parametrize(
    'node', [TWICE[0], *(pytest.param(node, marks=pytest.mark.qualify) for node in TWICE[1:])]
)
def test_on_one_computer(start, client, said, tmp_path, node):
    """At once, by the lock; a killed one is followed at once; a namespace is another cell."""
    first = begin(start, node, tmp_path, 1)
    until(client, lambda: f'/{node}' in said, 60, node)
    second = begin(start, node, tmp_path, 2)
    out, err = second.communicate(timeout=900)
    assert second.returncode == 2, out + err
    domain = client.context.get_domain_id()
    assert [line for line in err.splitlines() if line.startswith('error:')] == [
        f'error: /{node} is running already in ROS domain {domain} (process {first.pid}); '
        'end that one, or give this one a namespace (__ns:=/…) or a domain (ROS_DOMAIN_ID) of '
        'its own'
    ]
    assert 'Traceback' not in err
    assert first.poll() is None

    first.send_signal(signal.SIGKILL)
    first.wait()
    third = begin(start, node, tmp_path, 3)
    elsewhere = begin(start, node, tmp_path, 4, '-r', '__ns:=/elsewhere')
    started = said[f'/{node}']['started']
    until(client, lambda: said[f'/{node}']['started'] != started, 60, 'the one started again')
    watched = time.monotonic()
    until(client, lambda: time.monotonic() > watched + 3.0, 10, 'time')
    assert third.poll() is None, third.communicate()
    assert elsewhere.poll() is None, elsewhere.communicate()


UNLOCKED = """
import importlib, sys
from pathlib import Path
from remaster_ros.nodes import runtime_files
host, node = sys.argv[1:3]
# As on another computer: the lock is not seen, the DDS domain is the same.
runtime_files.runtime_folder = lambda: Path(host)
sys.exit(importlib.import_module('remaster_ros.nodes.' + node).main(sys.argv[2:]))
"""


@pytest.fixture
def start_elsewhere(ros_environment, tmp_path):
    """Return a function that starts a node as if on a computer of its own."""
    import subprocess
    import sys

    running = []

    def begin(node, *args):
        host = tmp_path / f'host_{len(running)}'
        host.mkdir()
        args = [
            *args,
            *(
                node_arguments(cell='demo', emergency_stop_topic='none')
                if node == 'robot_bridge'
                else []
            ),
        ]
        process = subprocess.Popen(
            [sys.executable, '-c', UNLOCKED, str(host), node, *map(str, args)],
            env=ros_environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        return process

    yield begin
    for process in running:
        process.kill()
        process.communicate()


@pytest.mark.qualify
@pytest.mark.parametrize('node', ['robot_bridge', 'optimizer'])
def test_on_two_computers(start_elsewhere, client, said, node):
    """By what the two publish: the one that has been running for less time ends."""
    first = start_elsewhere(node)
    until(client, lambda: float(said.get(f'/{node}', {}).get('uptime_s', 0)) > 2.0, 60, node)
    second = start_elsewhere(node)
    out, err = second.communicate(timeout=900)
    assert second.returncode == 2, out + err
    (line,) = (line for line in err.splitlines() if line.startswith('error:'))
    assert f'/{node} is running already in this ROS domain, for ' in line
    watched = time.monotonic()
    until(client, lambda: time.monotonic() > watched + 2.0, 10, 'time')
    assert first.poll() is None, first.communicate()

    # Started again at once after a kill: nobody is refused, though DDS still lists the dead one.
    first.kill()
    first.wait()
    third = start_elsewhere(node)
    started = said[f'/{node}']['started']
    until(client, lambda: said[f'/{node}']['started'] != started, 60, 'the one started again')
    watched = time.monotonic()
    until(client, lambda: time.monotonic() > watched + 3.0, 10, 'time')
    assert third.poll() is None, third.communicate()


def test_two_started_at_once_on_two_computers(start_elsewhere, client, said):
    both = [start_elsewhere('optimizer'), start_elsewhere('optimizer')]
    until(client, lambda: any(p.poll() is not None for p in both), 60, 'one of them to end')
    watched = time.monotonic()
    until(client, lambda: time.monotonic() > watched + 3.0, 10, 'time')
    assert sorted(str(p.poll()) for p in both) == ['2', 'None']


def test_alone(client):
    """True after 1.5 s of listening, without a rival; what was recorded of one is none."""
    from std_msgs.msg import String

    from remaster_ros.collection.events import Alive, EventRecord, encode
    from remaster_ros.nodes.status import NodeStatus, Summary

    status = NodeStatus(client, lambda: Summary('ok', '', {}))
    until(client, lambda: status.alone_since is not None, 10, 'its own summary')
    assert not status.alone(time.monotonic())
    until(client, lambda: status.alone(time.monotonic()), 10, 'to be alone')
    assert 1.5 <= time.monotonic() - status.alone_since < 3.0
    # As a replay publishes it: the name is this node's, the publisher is not.
    for uptime_s in (5000.0, 5001.0, 5002.0):
        record = EventRecord(node='/test_client', body=Alive(), started='1', uptime_s=uptime_s)
        status._events.publish(String(data=encode(record)))
        client.spin_some()
    assert status.alone(time.monotonic())
