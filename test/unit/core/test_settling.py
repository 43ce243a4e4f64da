"""Settling: still means still, at the target, for the whole time, and seen all the while."""

import numpy as np
import pytest

from remaster_ros.core.settling import SettleDetector, SettleRules

RULES = SettleRules(settle_s=3.0, arrive_tolerance=2e-3, still_tolerance=2e-4, max_gap_s=0.5)
TARGET = np.array([0.5, -1.0])


def feed(detector, times, positions):
    """States of the detector after each report."""
    return [detector.update(t, np.array(q)) for t, q in zip(times, positions)]


def test_a_still_arm_settles_after_exactly_the_settle_time():
    times = np.arange(0, 4, 0.02)
    states = feed(SettleDetector(TARGET, RULES), times, np.tile(TARGET, (len(times), 1)))
    first = times[states.index('settled')]
    assert 3.0 <= first <= 3.02 + 1e-9
    assert set(states[1 : states.index('settled')]) == {'settling'}


def test_noise_within_the_tolerance_does_not_delay():
    rng = np.random.default_rng(1)
    times = np.arange(0, 4, 0.02)
    q = TARGET + rng.uniform(-0.9e-4, 0.9e-4, (len(times), 2))
    states = feed(SettleDetector(TARGET, RULES), times, q)
    assert states[int(3.04 / 0.02)] == 'settled'


def test_a_slow_drift_is_not_still():
    """0.5 mrad in 3 s is far below any velocity threshold, and still no standstill."""
    times = np.arange(0, 10, 0.02)
    q = TARGET + np.outer(times, [1.7e-4, 0.0]) - [1e-3, 0]
    assert 'settled' not in feed(SettleDetector(TARGET, RULES), times, q)


def test_a_jolt_starts_the_waiting_anew():
    times = np.arange(0, 7, 0.02)
    q = np.tile(TARGET, (len(times), 1))
    q[100] += 1e-3
    states = feed(SettleDetector(TARGET, RULES), times, q)
    assert times[states.index('settled')] == pytest.approx(times[101] + 3.0, abs=0.03)


def test_an_arm_that_stands_elsewhere_never_settles():
    times = np.arange(0, 5, 0.02)
    states = feed(SettleDetector(TARGET, RULES), times, np.tile(TARGET + 0.01, (len(times), 1)))
    assert 'settled' not in states
    assert states[-1] == 'elsewhere'


@pytest.mark.parametrize('gap', [-1.0, 1.0])
def test_nobody_vouches_for_what_was_not_seen(gap):
    """Silence longer than max_gap_s, or a clock that jumps back, starts the waiting anew."""
    times = np.concatenate([np.arange(0, 2, 0.02), np.arange(0, 4, 0.02) + 2 + gap])
    states = feed(SettleDetector(TARGET, RULES), times, np.tile(TARGET, (len(times), 1)))
    settled = times[states.index('settled')]
    assert settled >= 2 + gap + 3.0 - 1e-9


def test_not_a_number_is_no_position():
    detector = SettleDetector(TARGET, RULES)
    times = np.arange(0, 5, 0.02)
    q = np.tile(TARGET, (len(times), 1))
    q[50, 1] = np.nan
    states = feed(detector, times, q)
    assert states[50] == 'moving'
    assert times[states.index('settled')] == pytest.approx(times[51] + 3.0, abs=0.03)


def test_the_mean_is_over_the_standstill_only():
    detector = SettleDetector(TARGET, RULES)
    feed(detector, [0.0, 0.1], [TARGET - 0.1, TARGET - 0.05])
    feed(detector, np.arange(0.2, 3.4, 0.1), np.tile(TARGET + 5e-5, (32, 1)))
    np.testing.assert_allclose(detector.mean, TARGET + 5e-5, atol=1e-12)
