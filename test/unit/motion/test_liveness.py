"""Liveness of sensors: silent, not ready, back again."""

import math

from remaster_ros.motion.liveness import Liveness


def test_silent_or_not_ready_is_absent_and_says_why():
    presence = Liveness(['mocap', 'tracker'], 3.0)
    assert presence.absent(100.0) == {}, 'a bag without status has no absent sensor'
    presence.says('mocap', True, '', 10.0)
    presence.says('tracker', False, 'warming up', 10.0)
    presence.says('stranger', False, 'whatever', 10.0)
    assert presence.words == {'mocap': 1, 'tracker': 1}
    assert presence.absent(13.0) == {'tracker': 'warming up'}
    silent = 'its node has been silent for 3 s'
    assert presence.absent(13.1) == {'mocap': silent, 'tracker': silent}
    presence.says('tracker', True, 'an old trouble', 14.0)
    assert presence.absent(14.0) == {'mocap': silent}
    presence.says('tracker', False, '', 14.0)
    assert presence.absent(14.0)['tracker'] == 'not ready'


def test_readings_are_counted_and_dated():
    presence = Liveness(['mocap'], 3.0)
    assert presence.read_age_s('mocap', 5.0) == math.inf
    presence.reads('mocap', 5.0)
    presence.reads('mocap', 6.0)
    assert presence.readings == {'mocap': 2}
    assert presence.read_age_s('mocap', 6.5) == 0.5


def test_a_stream_whose_node_was_started_again_is_there_with_its_first_reading():
    presence = Liveness(['mocap', 'tracker'], 3.0, ['mocap'])
    why = {'mocap': 'no reading since its node was started'}
    for started in ('first', 'second'):
        for sensor in ('mocap', 'tracker'):
            presence.says(sensor, True, '', 10.0, started)
        assert presence.absent(10.0) == why
        presence.says('mocap', True, '', 10.5, started)
        assert presence.absent(10.5) == why
        presence.reads('mocap', 10.6)
        assert presence.absent(10.6) == {}
        presence.says('mocap', True, '', 11.0, started)
        assert presence.absent(11.0) == {}
    presence.says('mocap', True, '', 12.0, 'third')
    presence.says('mocap', True, 'hidden', 12.5, 'third', hidden=True)
    assert presence.absent(12.5) == {}, 'moving on shows it again'


def test_what_has_not_been_heard_yet_is_absent_for_a_while_where_it_is_required():
    presence = Liveness(['mocap', 'tracker'], 3.0, since_s=10.0)
    presence.reads('tracker', 10.1)
    assert presence.absent(19.9) == {}, 'one that is not required is not given up for that'
    unheard = {'mocap': 'its node has not been heard yet'}
    assert presence.absent(19.9, ['mocap', 'tracker']) == unheard
    assert presence.absent(20.0, ['mocap', 'tracker']) == {}, 'a bag of readings without status'
    presence.says('mocap', True, '', 11.0)
    assert presence.absent(11.0, ['mocap', 'tracker']) == {}


def test_an_instrument_whose_node_was_started_again_needs_a_moment_where_it_is_required():
    presence = Liveness(['tracker'], 3.0)
    presence.says('tracker', True, '', 10.0, 'first')
    assert presence.absent(10.0, ['tracker']) == {}
    presence.says('tracker', True, '', 11.0, 'second')
    presence.says('tracker', True, '', 11.5, 'second')
    assert presence.absent(11.9) == {}
    assert presence.absent(11.9, ['tracker']) == {
        'tracker': 'its node has just been started again'
    }
    assert presence.absent(12.0, ['tracker']) == {}
