# SPDX-License-Identifier: Apache-2.0
"""Of two nodes of one name exactly one goes on, whatever the order of their messages."""

import pytest

from remaster_ros.motion.rivalry import LISTEN_S, DuplicateNodeCheck


def settle(a_started_s, b_started_s, ids=('1', '2'), delay_s=0.0, turns=3):
    """Let two nodes exchange summaries; return which of them must end."""
    nodes = DuplicateNodeCheck(ids[0]), DuplicateNodeCheck(ids[1])
    begun = a_started_s, b_started_s
    ends = [False, False]
    for turn in range(turns):
        sent_s = 10.0 + 0.5 * turn
        last_seen_s = sent_s + delay_s
        for me, other in ((0, 1), (1, 0)):
            ends[me] |= nodes[me].update_other(
                ids[other], sent_s - begun[other], last_seen_s - begun[me], last_seen_s
            )
    return ends


@pytest.mark.parametrize('delay_s', [0.0, 0.01, 0.2, 0.45])
@pytest.mark.parametrize(
    'apart_s', [0.0, 0.01, 0.3, 0.49, 0.5, 0.51, 0.9, 0.99, 1.01, 1.49, 1.6, 1.9, 9.0]
)
@pytest.mark.parametrize('ids', [('1', '2'), ('2', '1')])
def test_never_both_go_on(delay_s, apart_s, ids):
    ends = settle(0.0, apart_s, ids, delay_s)
    assert any(ends)
    if apart_s > 2.0 or ids == ('1', '2'):
        # One clock, or a clear difference: the later one alone.
        assert ends == [False, True]


def test_the_last_words_of_a_killed_process_end_nobody():
    """One message of a node that had run for long, after its successor was started."""
    node = DuplicateNodeCheck('2')
    node.update_own(0.0)
    assert not node.update_other('1', 5000.0, 0.6, 0.6)
    # The same once more, as a late copy.
    assert not node.update_other('1', 5000.0, 0.7, 0.7)
    assert node.update_other('1', 5000.5, 1.1, 1.1)


def test_alone_only_after_listening_and_without_a_rival():
    node = DuplicateNodeCheck('1')
    assert not node.alone(100.0)
    node.update_own(100.0)
    node.update_own(101.0)
    assert not node.alone(100.0 + LISTEN_S - 0.01)
    assert node.alone(100.0 + LISTEN_S)
    node.update_other('2', 1.0, 50.0, 110.0)
    assert not node.alone(111.0)
    assert node.alone(110.0 + LISTEN_S)


def test_a_rival_before_it_has_heard_itself_does_not_count_as_listening():
    node = DuplicateNodeCheck('1')
    node.update_other('2', 1.0, 50.0, 10.0)
    assert node.alone_since_s is None


@pytest.mark.parametrize(
    ('identity', 'rival', 'uptime_s', 'ends'),
    [
        # At the difference up to which the identities decide, and at that which decides alone.
        ('2', '1', 2.5, True),
        ('1', '2', 2.5, True),
        ('1', '2', 1.5, False),
        ('2', '1', 1.5, True),
        ('2', '1', -0.5, True),
        # Its own summary come back is no rival.
        ('1', '1', 1.0, False),
    ],
)
def test_differences_that_are_the_bounds_themselves(identity, rival, uptime_s, ends):
    node = DuplicateNodeCheck(identity)
    node.update_own(0.0)
    # Both have been running for two seconds more.
    assert not node.update_other(rival, 2.0 + uptime_s - 0.5, 2.5, 2.5)
    assert node.update_other(rival, 2.0 + uptime_s, 3.0, 3.0) is ends
