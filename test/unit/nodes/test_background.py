# SPDX-License-Identifier: Apache-2.0
"""Slow work beside a node's callbacks."""

import threading
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_rig import PATIENCE_S

from remaster_ros.errors import InputError
from remaster_ros.nodes.background import Background, PlanningThread

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]


@pytest.fixture
def node(own_nodes):
    made = own_nodes.make('worker')
    made.spin_until = own_nodes.until
    return made


def test_work_is_done_elsewhere_and_its_result_taken_here(node):
    background, here, seen = Background(node), threading.get_ident(), []
    for number in range(3):
        background.submit(
            lambda n=number: (n, threading.get_ident()),
            lambda result: seen.append((*result, threading.get_ident())),
        )
    began = time.monotonic()
    node.spin_until(lambda: len(seen) == 3)
    assert time.monotonic() - began < 0.4, 'the node was not woken'
    assert [n for n, _, _ in seen] == [0, 1, 2]
    assert all(there != here and taken == here for _, there, taken in seen)
    assert not background._results
    background.close()
    assert not background._thread.is_alive()


def test_what_fails_is_a_result_too_and_the_next_is_done(node):
    background, seen = Background(node), []

    def fails():
        raise ValueError('boom')

    background.submit(fails, seen.append)
    background.submit(lambda: 7, seen.append)
    node.spin_until(lambda: len(seen) == 2)
    assert isinstance(seen[0], ValueError)
    assert seen[1] == 7
    background.close()


def test_its_end_waits_for_what_is_left_to_do(node):
    background, done = Background(node), []
    for number in range(3):
        background.submit(lambda n=number: time.sleep(0.05) or done.append(n), print)
    background.close()
    assert done == [0, 1, 2]


def test_its_end_does_not_wait_for_ever(node):
    """And what ends later finds no node: no error in the thread, nothing taken."""
    background, go, seen = Background(node), threading.Event(), []
    background.submit(lambda: go.wait(PATIENCE_S), seen.append)
    began = time.monotonic()
    background.close(0.1)
    assert 0.05 < time.monotonic() - began < 2.0
    node.destroy_node()
    go.set()
    # pytest turns an exception in a thread into an error of the test.
    background._thread.join(PATIENCE_S)
    assert not background._thread.is_alive()
    assert not seen


def test_a_process_need_not_wait_for_it(node):
    background = Background(node)
    assert background._thread.daemon
    background.close()


def test_what_is_planned_is_for_the_arm_that_asked(node):
    background, asked = PlanningThread(Background(node)), []

    def wait_for(what, q, job):
        found = None

        def there():
            nonlocal found
            found = background.ask(what, q, job)
            return found is not None

        node.spin_until(there)
        return found[0]

    def job(name):
        return lambda: asked.append(name) or name

    here, there = np.zeros(3), np.full(3, 0.1)
    assert background.ask('pose 1', here, job('first')) is None
    # Meanwhile the arm has been moved: the first answer is of no use.
    assert wait_for('pose 1', there, job('second')) == 'second'
    assert asked == ['first', 'second']
    assert background.ask('pose 1', here, job('third')) is None
    assert wait_for('pose 2', here, job('fourth')) == 'fourth'
    assert wait_for('end', here, lambda: None) is None

    def fails():
        raise InputError('no way')

    with pytest.raises(InputError, match='no way'):
        wait_for('bad', here, fails)
    assert wait_for('bad', here, job('again')) == 'again'
