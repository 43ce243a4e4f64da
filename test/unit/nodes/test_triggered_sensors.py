# SPDX-License-Identifier: Apache-2.0
"""Measurements asked for: again where question or answer was lost; clients are stand-ins."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from remaster_ros.collection.pairing import Pairing, SensorRules
from remaster_ros.nodes import measure_services
from remaster_ros.types import MarkerReading

pytestmark = pytest.mark.ros

Q = np.zeros(7)


class Client:
    """Answers when told to."""

    srv_name = '/laser_tracker/measure'

    def __init__(self):
        self.there, self.asked = True, []

    def service_is_ready(self):
        return self.there

    def call_async(self, request):
        future = SimpleNamespace(answer=None)
        future.done = lambda: future.answer is not None
        future.result = lambda: future.answer
        self.asked.append(future)
        return future

    def answer(self, success, message=''):
        self.asked[-1].answer = SimpleNamespace(success=success, message=message)


@pytest.fixture
def scene():
    """Shots of one tracker, a pairing for it, and a clock that is set by hand."""
    clock = SimpleNamespace(now=100.0)
    client = Client()
    rules = SensorRules('tracker', 'smr', single_shot=True, timeout_s=60.0)
    pairing = Pairing(10.0, Q, (rules,))
    asking = measure_services.TriggeredSensors({'tracker': client})

    def look(at, absent=()):
        clock.now = at
        asking.look(pairing, dict.fromkeys(absent, 'why'), clock.now)
        return len(client.asked)

    return SimpleNamespace(client=client, pairing=pairing, look=look)


def test_one_question_for_one_reading(scene):
    assert scene.look(100.0) == 1
    assert scene.look(140.0) == 1, 'an instrument takes its time'


def test_a_refusal_counts_after_a_moment(scene):
    scene.look(100.0)
    scene.client.answer(False, 'no reflector')
    scene.look(101.0)
    scene.look(102.0)
    assert not scene.pairing.decided
    scene.look(102.1)
    assert scene.pairing.decided['tracker'].detail == 'no reflector'


def test_who_was_absent_is_asked_again_even_after_a_refusal(scene):
    scene.look(100.0)
    scene.client.answer(False, 'the instrument is gone')
    assert scene.look(100.5, ['tracker']) == 1
    assert scene.look(101.0) == 2
    scene.look(110.0)
    assert not scene.pairing.decided


def test_a_reading_that_was_lost_on_its_way_is_asked_for_again(scene):
    scene.look(100.0)
    scene.client.answer(True)
    assert scene.look(105.0) == 1
    assert scene.look(106.0) == 1
    assert scene.look(106.1) == 1
    assert scene.look(106.2) == 2
    scene.client.answer(True)
    scene.pairing.add_reading('tracker', MarkerReading(12.0, np.zeros(3)))
    scene.look(107.0)
    assert scene.look(120.0) == 2, 'it has come, only a report of the joints is missing'


def test_a_service_that_is_not_there_is_waited_for_longer_than_a_heartbeat(scene):
    scene.client.there = False
    assert scene.look(100.0) == 0
    scene.look(105.0)
    assert not scene.pairing.decided
    scene.client.there = True
    assert scene.look(105.1) == 1


def test_a_service_that_never_comes_is_named(scene):
    scene.client.there = False
    scene.look(100.0)
    scene.look(105.1)
    assert '/laser_tracker/measure is not there' in scene.pairing.decided['tracker'].detail
