"""Standstill and robot time: whether reports prove that an arm stands."""

import numpy as np
import pytest
from following_arm import AT, RULES, see

from remaster_ros.motion.following import (
    FRESH_S,
    JITTER_S,
    LATENCY_S,
    STANDING_S,
    allowed_lag_s,
)
from remaster_ros.motion.trajectory import REST_S


def test_robot_time_goes_by_the_stamps():
    seen = see(100.0, AT, wall=7.0)
    assert (seen.time, seen.stamp, seen.wall) == (100.0, 100.0, 7.0)
    seen = see(100.5, AT, wall=7.25, last=seen)
    assert seen.time == 100.5
    assert seen.now(7.5, 2.0) == 101.0
    assert seen.now(7.25, 9.0) == 100.5


@pytest.mark.parametrize(('passed', 'stands'), [(0.125, False), (STANDING_S, True)])
def test_how_long_an_arm_must_stand(passed, stands):
    seen = see(8.0 + passed, AT, wall=8.0, last=see(8.0, AT, wall=8.0))
    assert seen.stands(8.0) == stands


@pytest.mark.parametrize(('moved', 'stands'), [(2.0**-12, True), (2.0**-11, False)])
@pytest.mark.parametrize('side', [1.0, -1.0])
def test_what_counts_as_standing(moved, stands, side):
    seen = see(8.0, AT)
    seen = see(8.25, np.add(AT, [0.0, side * moved]), last=seen)
    assert seen.stands(8.25) == stands
    assert seen.stands_since == (8.0 if stands else 8.25)
    np.testing.assert_array_equal(
        seen.stands_at, AT if stands else np.add(AT, [0.0, side * moved])
    )


def test_an_arm_that_creeps_does_not_stand():
    seen = see(8.0, AT)
    for i in range(1, 50):
        seen = see(8.0 + i * 0.125, np.add(AT, [i * 2.0**-12, 0.0]), last=seen)
        assert not seen.stands(seen.wall)


@pytest.mark.parametrize(('gap', 'stands'), [(0.5, True), (0.625, False)])
def test_a_gap_begins_the_standstill_anew(gap, stands):
    seen = see(8.0 + gap, AT, last=see(8.0, AT))
    assert seen.stands(seen.wall) == stands
    assert seen.time == 8.0 + gap


def test_an_old_report_proves_nothing():
    seen = see(8.5, AT, wall=8.5, last=see(8.25, AT))
    assert seen.is_fresh(8.5 + FRESH_S - 1e-6)
    assert seen.stands(8.5 + FRESH_S - 1e-6)
    assert not seen.is_fresh(8.5 + FRESH_S + 1e-6)
    assert not seen.stands(8.5 + FRESH_S + 1e-6)


def test_the_lag_that_is_allowed():
    assert allowed_lag_s(RULES, 1.0) == pytest.approx(RULES.lag_s + LATENCY_S)
    assert allowed_lag_s(RULES, 0.2) == pytest.approx(RULES.lag_s + LATENCY_S)
    assert allowed_lag_s(RULES, 20.0) == pytest.approx(RULES.lag_s + 20 * LATENCY_S)
    # So that an arm is never on two lines at once.
    assert allowed_lag_s(RULES, 1.0) + JITTER_S < REST_S
