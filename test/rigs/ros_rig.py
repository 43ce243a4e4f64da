# SPDX-License-Identifier: Apache-2.0
"""Tests of real processes: each has a DDS domain, a ROS_HOME and processes of its own."""

import atexit
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path

import pytest
from rigs.forked_nodes import NodeProcess

ROOT = Path(__file__).parents[2]
LAST_DOMAIN = 101
"""The UDP ports of higher ones are those that Linux gives to any program."""
DOMAINS_HELD = 4
"""A test uses at most so many at a time."""
FOUND_S = 0.5
"""A service may find its caller so much later than it is found; an answer before that is lost."""
AGAIN_S = 30.0
"""Who is not answered calls again after so long."""
WORK = ('/remaster/fit', '/remaster/discover')
"""Services that answer when their work is done."""
PATIENCE = 4.0
"""What is waited for takes so many times as long at the most as a test says: a process that has a
tenth of a processor is no failure."""


def free_domains(first: int = 1, last: int = LAST_DOMAIN) -> Iterator[int]:
    """Yield DDS domains that no other test run on this computer has.

    A domain is reserved by a socket of its name, which the kernel removes with the process. The
    last few are held; those before them are free again.
    """
    reservations: deque[socket.socket] = deque()
    count = last - first + 1
    try:
        # Each run begins elsewhere: a domain given back a moment ago is not taken at once.
        for domain in cycle(first + (os.getpid() + i) % count for i in range(count)):
            reservation = socket.socket(socket.AF_UNIX)
            try:
                reservation.bind(f'\0remaster_test_domain_{domain}')
            except OSError:
                reservation.close()
                continue
            reservations.append(reservation)
            if len(reservations) > DOMAINS_HELD:
                reservations.popleft().close()
            yield domain
    finally:
        for reservation in reservations:
            reservation.close()


domains = free_domains()
_of_this_process = free_domains(215, 231)
atexit.register(_of_this_process.close)
OWN_DOMAIN = next(_of_this_process)
"""Of nodes in this process, which no other one has at the same time. Never that of the user's
shell, in which an arm may be: the ports of domains from 215 on are above those that Linux gives to
any program, and few use them."""


@pytest.fixture(scope='module')
def ros_environment(tmp_path_factory):
    """Return an environment with a DDS domain and a ROS_HOME of its own, on this machine only."""
    pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
    return {
        **os.environ,
        'PYTHONPATH': path,
        'ROS_DOMAIN_ID': str(next(domains)),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        # A halt is kept there: none of another test's.
        'ROS_HOME': str(tmp_path_factory.mktemp('ros_home')),
    }


@pytest.fixture
def start(ros_environment):
    """Return a function that starts `python -m MODULE …`; whatever runs is ended with the test."""
    running = []

    def begin(module, *args, **options):
        kind = NodeProcess if module.startswith('remaster_ros.nodes.') else subprocess.Popen
        process = kind(
            [sys.executable, '-m', module, *map(str, args)],
            env=ros_environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )
        running.append(process)
        return process

    yield begin
    for process in running:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for process in running:
        try:
            process.communicate(timeout=15 * PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


@pytest.fixture
def client(ros_environment):
    """Return a node in the test's own DDS domain that is spun by hand."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(ros_environment['ROS_DOMAIN_ID']))
    node = rclpy.create_node('test_client', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    node.spin_some = lambda: executor.spin_once(timeout_sec=0.02)
    yield node
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


def node_arguments(params_file=None, **values):
    """Return the arguments that give a node its parameters."""
    args = ['--ros-args']
    if params_file is not None:
        args += ['--params-file', str(params_file)]
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        args += ['-p', f'{name}:={text}']
    return args


def wait_until(condition, timeout_s, what):
    """Poll until `condition()` holds; fail the test where it takes `PATIENCE` times this long."""
    timeout_s *= PATIENCE
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f'waited {timeout_s:.0f} s in vain for {what}'
        time.sleep(0.05)


def found(*callers):
    """Wait until services and their callers have found each other."""
    for caller in callers:
        assert caller.wait_for_service(timeout_sec=20.0 * PATIENCE), caller.srv_name
    time.sleep(FOUND_S)


ASKED = 'the arm is not reported where the last command led'
"""So the bridge asks a person who ends a halt to compare the pad with what is reported."""


def clear_halt(client):
    """End a halt as a person does, who is asked where the arm is and has looked."""
    response = call(client, '/remaster/clear_halt')
    if response.message.startswith(ASKED):
        response = call(client, '/remaster/clear_halt')
    return response


def call(client, service, timeout_s=120):
    """Call a Trigger service and return its response, the first that comes.

    As a person does, it is called again where nobody answers: a node that was killed a moment ago
    is still listed, and the one started in its place may not have been found yet.
    """
    from std_srvs.srv import Trigger

    caller = client.create_client(Trigger, service)
    found(caller)
    futures = []
    began = time.monotonic()
    while not any(future.done() for future in futures):
        waited_s = time.monotonic() - began
        assert waited_s < timeout_s * PATIENCE, f'no answer of {service}'
        if not futures or (waited_s >= AGAIN_S * len(futures) and service not in WORK):
            futures.append(caller.call_async(Trigger.Request()))
        client.spin_some()
    return next(future.result() for future in futures if future.done())
