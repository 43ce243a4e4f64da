# SPDX-License-Identifier: Apache-2.0
"""Liveness of sensors: silent, not ready, back again."""

import math

from remaster_ros.motion.liveness import Liveness


def test_silent_or_not_ready_is_absent_and_says_why():
    liveness = Liveness(['mocap', 'tracker'], 3.0)
    assert liveness.absent(100.0) == {}, 'a bag without status has no absent sensor'
    liveness.node_reports('mocap', True, '', 10.0)
    liveness.node_reports('tracker', False, 'warming up', 10.0)
    liveness.node_reports('stranger', False, 'whatever', 10.0)
    assert liveness.reports == {'mocap': 1, 'tracker': 1}
    assert liveness.absent(13.0) == {'tracker': 'warming up'}
    silent = 'its node has been silent for 3 s'
    assert liveness.absent(13.1) == {'mocap': silent, 'tracker': silent}
    liveness.node_reports('tracker', True, 'an old trouble', 14.0)
    assert liveness.absent(14.0) == {'mocap': silent}
    liveness.node_reports('tracker', False, '', 14.0)
    assert liveness.absent(14.0)['tracker'] == 'not ready'
    assert liveness.reports == {'mocap': 1, 'tracker': 3}


def test_readings_are_counted_and_dated():
    liveness = Liveness(['mocap'], 3.0)
    assert liveness.read_age_s('mocap', 5.0) == math.inf
    liveness.reads('mocap', 5.0)
    liveness.reads('mocap', 6.0)
    assert liveness.readings == {'mocap': 2}
    assert liveness.read_age_s('mocap', 6.5) == 0.5


def test_a_stream_whose_node_was_started_again_is_there_with_its_first_reading():
    liveness = Liveness(['mocap', 'tracker'], 3.0, ['mocap'])
    why = {'mocap': 'no reading since its node was started'}
    for started in ('first', 'second'):
        for sensor in ('mocap', 'tracker'):
            liveness.node_reports(sensor, True, '', 10.0, started)
        assert liveness.absent(10.0) == why
        liveness.node_reports('mocap', True, '', 10.5, started)
        assert liveness.absent(10.5) == why
        liveness.reads('mocap', 10.6)
        assert liveness.absent(10.6) == {}
        liveness.node_reports('mocap', True, '', 11.0, started)
        assert liveness.absent(11.0) == {}
    liveness.node_reports('mocap', True, '', 12.0, 'third')
    liveness.node_reports('mocap', True, 'hidden', 12.5, 'third', hidden=True)
    assert liveness.absent(12.5) == {}, 'moving on shows it again'


def test_what_has_not_been_heard_yet_is_absent_for_a_while_where_it_is_required():
    liveness = Liveness(['mocap', 'tracker'], 3.0, since_s=10.0)
    liveness.reads('tracker', 10.1)
    assert liveness.absent(19.9) == {}, 'one that is not required is not given up for that'
    unheard = {'mocap': 'its node has not reported yet'}
    assert liveness.absent(19.9, ['mocap', 'tracker']) == unheard
    assert liveness.absent(20.0, ['mocap', 'tracker']) == {}, 'a bag of readings without status'
    liveness.node_reports('mocap', True, '', 11.0)
    assert liveness.absent(11.0, ['mocap', 'tracker']) == {}


def test_an_instrument_whose_node_was_started_again_needs_a_moment_where_it_is_required():
    liveness = Liveness(['tracker'], 3.0)
    liveness.node_reports('tracker', True, '', 10.0, 'first')
    assert liveness.absent(10.0, ['tracker']) == {}
    liveness.node_reports('tracker', True, '', 11.0, 'second')
    liveness.node_reports('tracker', True, '', 11.5, 'second')
    assert liveness.absent(11.9) == {}
    assert liveness.absent(11.9, ['tracker']) == {
        'tracker': 'its node has just been started again'
    }
    assert liveness.absent(12.0, ['tracker']) == {}
