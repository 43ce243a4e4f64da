# SPDX-License-Identifier: Apache-2.0
"""Settling: still means still, at the target, for the whole time, and seen all the while."""

import numpy as np
import pytest

from remaster_ros.motion.settling import SettleDetector, SettleRules

RULES = SettleRules(settle_s=3.0, arrive_tolerance=2e-3, still_tolerance=2e-4, max_gap_s=0.5)
TARGET = np.array([0.5, -1.0])
TIMES = np.arange(0.0, 10.0, 0.02)


def feed(detector, times, positions):
    """States of the detector after each report."""
    return [detector.update(t, np.array(q)) for t, q in zip(times, positions)]


def at_100(distance):
    """Return a way that has one report elsewhere, two seconds after the first."""
    return np.where(np.arange(len(TIMES)) == 100, distance, 0.0)


@pytest.mark.parametrize(
    ('way', 'settled_s'),
    [
        (0.0 * TIMES, 3.0),
        # Noise within the tolerance.
        (np.random.default_rng(1).uniform(-0.9e-4, 0.9e-4, len(TIMES)), 3.0),
        # 0.5 mrad in 3 s is far below any velocity threshold, and still no standstill.
        (1.7e-4 * TIMES - 1e-3, None),
        # A jolt, and what is no position, start the waiting anew.
        (at_100(1e-3), 5.02),
        (at_100(np.nan), 5.02),
        # Elsewhere.
        (0.01 + 0.0 * TIMES, None),
    ],
)
def test_an_arm_settles_once_it_stood_still_at_its_target_for_the_whole_time(way, settled_s):
    states = feed(SettleDetector(TARGET, RULES), TIMES, TARGET + np.outer(way, [0.0, 1.0]))
    if settled_s is None:
        assert 'settled' not in states
    else:
        assert settled_s <= TIMES[states.index('settled')] <= settled_s + 0.03
        assert states[100] == ('moving' if np.isnan(way[100]) else 'settling')


@pytest.mark.parametrize('gap', [-1.0, 1.0])
def test_nobody_vouches_for_what_was_not_seen(gap):
    """Silence longer than max_gap_s, or a clock that jumps back, starts the waiting anew."""
    times = np.concatenate([np.arange(0, 2, 0.02), np.arange(0, 4, 0.02) + 2 + gap])
    states = feed(SettleDetector(TARGET, RULES), times, np.tile(TARGET, (len(times), 1)))
    assert times[states.index('settled')] >= 2 + gap + 3.0 - 1e-9


# Numbers that are exact in binary, so that a boundary is one.
EXACT = SettleRules(
    settle_s=1.0, arrive_tolerance=2.0**-8, still_tolerance=2.0**-12, max_gap_s=0.5
)
AT = np.array([0.5, -1.0])


def states_at(stamps, distances=None):
    """States of a new detector; distances: of joint 1 from the target in each report."""
    distances = np.zeros(len(stamps)) if distances is None else np.array(distances)
    q = AT + np.outer(distances, [1.0, 0.0])
    return feed(SettleDetector(AT, EXACT), stamps, q)


def test_it_has_settled_when_the_time_is_over_and_not_before():
    assert states_at([8.0, 8.5, 8.75, 9.0]) == ['settling', 'settling', 'settling', 'settled']


def test_elsewhere_is_said_when_the_time_is_over_and_moving_before():
    distance = 2.0**-7
    assert states_at([8.0, 8.5, 8.75, 9.0], [distance] * 4) == [
        'moving',
        'moving',
        'moving',
        'elsewhere',
    ]
    assert states_at([8.0], [2.0**-8]) == ['settling'], 'the tolerance itself is at the target'


@pytest.mark.parametrize(('gap', 'state'), [(0.5, 'settled'), (0.625, 'settling')])
def test_the_longest_gap_is_still_seen(gap, state):
    assert states_at([8.0, 8.5, 8.5 + gap, 9.125])[-1] == state


@pytest.mark.parametrize(('back', 'state'), [(0.0, 'settled'), (0.125, 'settling')])
def test_two_reports_of_one_time_are_no_jump_of_the_clock(back, state):
    assert states_at([8.0, 8.5, 8.5 - back, 8.75, 9.0])[-1] == state


@pytest.mark.parametrize(('moved', 'state'), [(2.0**-12, 'settled'), (2.0**-11, 'settling')])
def test_what_counts_as_still(moved, state):
    assert states_at([8.0, 8.5, 9.0], [0.0, moved, 0.0])[-1] == state


def test_since_when_and_where():
    detector = SettleDetector(AT, EXACT)
    assert detector.still_since is None
    feed(detector, [8.0, 8.25, 8.5], [AT, AT + 2.0**-13, AT + 2.0**-12])
    assert detector.still_since == 8.0
    np.testing.assert_array_equal(detector.mean, AT + 2.0**-13)
    detector.update(8.75, np.array([np.nan, 0.0]))
    assert detector.still_since is None


def test_the_mean_is_over_the_standstill_only():
    detector = SettleDetector(TARGET, RULES)
    feed(detector, [0.0, 0.1], [TARGET - 0.1, TARGET - 0.05])
    feed(detector, np.arange(0.2, 3.4, 0.1), np.tile(TARGET + 5e-5, (32, 1)))
    np.testing.assert_allclose(detector.mean, TARGET + 5e-5, atol=1e-12)
