# SPDX-License-Identifier: Apache-2.0
"""Checks day by day: what has changed is found and named, and nothing where nothing has."""

import numpy as np
import pytest
from worlds.checked_arms import NOISE_M, CheckedArm

from remaster_ros.compensation.checking import (
    ALARM,
    bayes_factors,
    detectable_m,
    evidence,
    judge,
    seen,
)
from remaster_ros.kinematics.transforms import apply, rotation_vector_to_matrix, transform

BEFORE = 20


def test_the_odds_are_those_of_the_two_means_integrated_out():
    """Against numerical integration: means flat, variance 1/σ², change normal (g = 4 std)."""
    rng = np.random.default_rng(2)
    x = rng.standard_normal(7) + np.where(np.arange(7) >= 4, 2.0, 0.0)
    sigma = np.geomspace(0.05, 50.0, 4001)
    log_step = np.log(sigma[1] / sigma[0])

    def likelihood(spread):
        # Of all but the common mean, which is flat: covariance I + spread² of the second part.
        part = (np.arange(7) >= 4).astype(float)
        covariance = np.eye(7) + spread**2 * np.outer(part, part)
        inverse = np.linalg.inv(covariance)
        ones = np.ones(7)
        mean = (ones @ inverse @ x) / (ones @ inverse @ ones)
        square = (x - mean) @ inverse @ (x - mean)
        norm = np.linalg.slogdet(covariance)[1] + np.log(ones @ inverse @ ones)
        values = -6.0 * np.log(sigma) - 0.5 * norm - 0.5 * square / sigma**2
        return np.exp(values).sum() * log_step

    assert bayes_factors(x)[0][3] == pytest.approx(likelihood(4.0) / likelihood(0.0), rel=1e-6)


def test_evidence_exceeds_100_in_one_of_100_at_most_however_often_it_is_looked_at():
    """2000 arms over 60 checks: 2 would be the bound times 0.1; more than 33 has p < 0.003."""
    seed = 4
    print('seed', seed)
    x = np.random.default_rng(seed).standard_normal((2000, 60))
    ever = np.zeros(2000, bool)
    for days in range(2, 61):
        ever |= evidence(x[:, :days]) >= ALARM
    assert ever.sum() <= 33


def test_chosen_poses_see_less_than_random_ones():
    """0.17 mm at 0.1 mm of noise, as the trial had; no joint is seen worse than another."""
    arm = CheckedArm(5)
    chosen = 1e3 * NOISE_M * arm.sizes
    assert np.isnan(chosen[0])
    assert np.all(chosen[1:] < 0.18)
    assert np.nanmax(chosen) < 1.1 * np.nanmin(chosen)
    look = seen(arm.found, arm.check())
    again = 1e3 * detectable_m(look.joints, look.lever_m, NOISE_M)
    np.testing.assert_allclose(again[1:], chosen[1:], rtol=0.3)


@pytest.mark.parametrize('name', ['iiwa7', 'six'])
def test_a_changed_joint_is_found_and_named(name):
    """0.2 mm at the tool, 5.5 std of a check, within 8; each joint but the first."""
    arm = CheckedArm(6, name)
    before = arm.days(BEFORE)
    assert judge(arm.found, before).verdict == 'unchanged'
    for joint in range(1, arm.true.joints):
        found = judge(arm.found, before + arm.days(8, arm.joint(joint, 2e-4)))
        assert found.verdict == ('unclear' if found.tool_moved else 'changed')
        assert joint in found.changed
        # The last joint turns the marker about itself: only that one looks like it.
        assert not found.tool_moved or joint == arm.true.joints - 1
        assert abs(found.since - BEFORE) <= 1
        if found.changed == (joint,):
            unchanged_joints = [
                result for i, result in enumerate(found.joints) if i not in (0, joint)
            ]
            assert all(abs(result.change) < 4.5 * result.std for result in unchanged_joints)
        changed_joint = found.joints[joint]
        assert changed_joint.change * changed_joint.lever_m == pytest.approx(
            2e-4, abs=4 * changed_joint.std * changed_joint.lever_m
        )


def test_a_marker_that_was_moved_is_no_joint():
    arm = CheckedArm(7)
    found = judge(arm.found, arm.days(BEFORE) + arm.days(5, arm.marker(4e-4)))
    assert found.verdict == 'setup_moved'
    assert found.tool_moved
    assert found.changed == ()


def test_a_sensor_that_was_moved_is_no_change_of_the_arm():
    arm = CheckedArm(8)
    days = arm.days(6)
    T = transform(
        rotation_vector_to_matrix(np.array([0.0, 0.002, 0.1])), np.array([0.1, 0.0, 0.0])
    )
    moved = days[-1]
    days[-1] = type(moved)(moved.q, moved.sensor, moved.marker, apply(T, moved.position))
    found = judge(arm.found, days)
    assert found.verdict == 'setup_moved'
    assert not found.tool_moved
    assert found.moved_m > 0.05
    # It stays there: the next check is none of a moved sensor.
    again = arm.check()
    days.append(type(again)(again.q, again.sensor, again.marker, apply(T, again.position)))
    assert judge(arm.found, days).verdict == 'unchanged'


@pytest.mark.parametrize('days', [0, 1, 2, 10])
def test_a_large_change_asks_for_another_check_at_once(days):
    """1 mm at the tool: in the first check against the correction, later against the others."""
    arm = CheckedArm(9)
    found = judge(arm.found, arm.days(days) + arm.days(1, arm.joint(2, 1e-3)))
    assert found.verdict in ('unclear', 'changed')
    assert found.again or found.changed == (2,)


def test_checks_at_once_come_to_an_end():
    """A change of 3 std of a check, about what matters: no number of checks at once decides it."""
    arm = CheckedArm(11)
    days = arm.days(BEFORE)
    asked, verdicts = [], set()
    for _ in range(24):
        days += arm.days(1, arm.joint(2, 1.1e-4))
        found = judge(arm.found, days)
        asked.append(found.again)
        verdicts.add(found.verdict)
    assert 'unclear' in verdicts
    assert any(asked)
    for i in range(len(asked) - 2):
        assert not all(asked[i : i + 3]), 'at once for the third time in a row'


@pytest.mark.parametrize('arms', [10, pytest.param(40, marks=pytest.mark.qualify)])
def test_nothing_is_found_where_nothing_is(arms):
    """12 checks each, every one of which is judged: the bound is 0.4 alarms of 40."""
    seed = 10
    print('seed', seed)
    alarms = again = 0
    for number in range(arms):
        arm = CheckedArm(1000 * seed + number)
        days = arm.days(12)
        found = [judge(arm.found, days[:count]) for count in (1, 2, 3, 4, 6, 9, 12)]
        alarms += any(each.verdict in ('changed', 'setup_moved') for each in found)
        again += sum(each.again for each in found)
    print(alarms, again)
    assert alarms <= arms / 20
    assert again <= 7 * arms / 20, 'one in twenty checks at most'


def test_several_readings_of_a_pose_are_one():
    arm = CheckedArm(11)
    first_check, second_check = arm.check(), arm.check()
    both = type(first_check)(
        np.concatenate((first_check.q, second_check.q)),
        first_check.sensor + second_check.sensor,
        first_check.marker + second_check.marker,
        np.concatenate((first_check.position, second_check.position)),
    ).merged(arm.found.chain)
    np.testing.assert_allclose(both.position, 0.5 * (first_check.position + second_check.position))
    assert both.sensor == first_check.sensor
