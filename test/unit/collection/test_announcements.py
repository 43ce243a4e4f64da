# SPDX-License-Identifier: Apache-2.0
"""A pose that bridge or recorder missed is announced again; times are arguments."""

import pytest

from remaster_ros.collection.announcements import (
    ANNOUNCE_WALL_S,
    LONGEST_WALL_S,
    MATCH_WALL_S,
    Announcements,
    Lack,
)
from remaster_ros.collection.events import (
    Alive,
    BridgeState,
    EventRecord,
    PlannerState,
    RecorderState,
)
from remaster_ros.collection.peers import Peers


class Bench:
    """The planner's side, with both peers there and matched."""

    def __init__(self, announced='7.0'):
        self.peers, self.now = Peers(()), 100.0
        self.known = Announcements(self.peers)
        self.started = {'robot_bridge': 'first', 'recorder': 'first'}
        self.bridge()
        self.recorder()
        if announced:
            self.announce(announced)

    def take(self, body):
        record = EventRecord(node=f'/{body.sender}', body=body, started=self.started[body.sender])
        self.peers.take(record, self.now)

    def bridge(self, pose=''):
        self.take(BridgeState(halted='', pose=pose))

    def recorder(self, pose='', state='waiting'):
        self.take(RecorderState(waiting_for='', pose=pose, state=state))

    def announce(self, stamp):
        self.known.announced(stamp, self.now)


def test_it_waits_until_both_are_matched_for_a_while():
    known = Announcements(Peers(()))
    assert not known.matched(2, 0.0)
    bench = Bench()
    assert not bench.known.matched(1, 100.0)
    assert not bench.known.matched(2, 101.0)
    assert not bench.known.matched(2, 101.0 + MATCH_WALL_S)
    assert bench.known.matched(2, 101.1 + MATCH_WALL_S)
    assert not bench.known.matched(1, 102.0)
    assert not bench.known.matched(2, 103.0), 'from the beginning again'


def test_other_nodes_are_no_peers():
    peers = Peers(())
    known = Announcements(peers)
    for name, body in (('optimizer', Alive()), ('pose_planner', PlannerState(state='', run=''))):
        peers.take(EventRecord(node=f'/{name}', body=body), 0.0)
    known.matched(2, 0.0)
    assert not known.matched(2, 9.0)
    assert (peers.bridge, peers.recorder) == (None, None)


def test_a_pose_that_both_know_is_not_lost():
    bench = Bench()
    assert bench.known.lack() is Lack.NOTHING, 'their states are still on their way'
    bench.now += ANNOUNCE_WALL_S + 1.0
    bench.bridge('7.0')
    bench.recorder('7.0')
    assert bench.known.lack() is Lack.NOTHING


@pytest.mark.parametrize('name', ['bridge', 'recorder'])
def test_who_does_not_know_it_after_a_while_has_missed_it(name):
    bench = Bench()
    bench.bridge('7.0')
    bench.recorder('7.0')
    getattr(bench, name)('')
    assert bench.known.lack() is Lack.NOTHING
    bench.now += ANNOUNCE_WALL_S + 0.1
    getattr(bench, name)('')
    assert bench.known.lack() is Lack.LATE, 'it lags, and was not started anew'


@pytest.mark.parametrize('node', ['robot_bridge', 'recorder'])
def test_who_was_started_after_it_has_missed_it(node):
    bench = Bench()
    bench.bridge('7.0')
    bench.recorder('7.0')
    bench.started[node] = 'second'
    bench.bridge('' if node == 'robot_bridge' else '7.0')
    bench.recorder('' if node == 'recorder' else '7.0')
    assert bench.known.lack() is Lack.ANEW
    bench.announce('8.0')
    assert bench.known.lack() is Lack.NOTHING


def test_nothing_is_announced_while_the_recorder_measures():
    bench = Bench()
    bench.now += ANNOUNCE_WALL_S + 1.0
    bench.bridge('')
    bench.recorder('7.0', state='measuring')
    assert bench.known.lack() is Lack.NOTHING
    bench.recorder('7.0')
    assert bench.known.lack() is Lack.LATE


def test_a_pose_that_was_taken_back_is_announced_anew():
    bench = Bench(announced='')
    assert bench.known.lack() is Lack.ANEW, 'not announced yet'
    bench.announce('7.0')
    bench.known.retract()
    bench.recorder('7.0', state='measuring')
    assert bench.known.lack() is Lack.NOTHING, 'what is being measured is not left'
    bench.recorder('7.0')
    assert bench.known.lack() is Lack.ANEW


def test_a_node_that_lags_more_and_more_gets_one_announcement_ever_more_rarely():
    """What is sent again delays what a busy node has still to take."""
    bench, repeated_wall = Bench(), []
    bench.bridge('7.0')
    began_wall = bench.now
    while bench.now < began_wall + 10.0 * LONGEST_WALL_S:
        bench.now += 0.5
        bench.recorder('6.0')
        lack = bench.known.lack()
        assert lack is not Lack.ANEW, 'another stamp is another pose for the bridge'
        if lack is Lack.LATE:
            repeated_wall.append(bench.now)
            bench.announce(bench.known.stamp)
    waits = [b - a for a, b in zip([began_wall, *repeated_wall], repeated_wall)]
    assert waits == sorted(waits)
    assert waits[0] < ANNOUNCE_WALL_S + 1.0
    assert LONGEST_WALL_S <= waits[-1] < LONGEST_WALL_S + 1.0
    bench.recorder('7.0')
    assert bench.known.lack() is Lack.NOTHING
    # The next pose begins with the shortest wait.
    bench.announce('8.0')
    bench.bridge('8.0')
    bench.now += ANNOUNCE_WALL_S + 0.1
    bench.recorder('7.0')
    assert bench.known.lack() is Lack.LATE
