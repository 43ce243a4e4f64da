# SPDX-License-Identifier: Apache-2.0
"""A slow drift of checks is told with its size and what is to be done, and none where none is."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.checked_arms import NOISE_M, CheckedArm

from remaster_ros.cli.check import content_of
from remaster_ros.compensation.checking import POWER_STD, SMALLEST_M, judge
from remaster_ros.compensation.drift import RATES, drift
from remaster_ros.compensation.iso9283 import IsoFigures

BEFORE, JOINT = 20, 2
DAY_S = 86_400.0
# 28 November 2026, noon UTC.
FIRST_S = 1_795_867_200.0
NOT_VISITED = IsoFigures((1,), np.zeros(0), np.zeros(0))


def test_the_odds_are_those_of_the_slope_integrated_out():
    """Against numerical integration: mean flat, variance 1/σ², slopes normal; from the start."""
    rng = np.random.default_rng(3)
    x, days = rng.standard_normal(3) + 1.5 * np.arange(3.0), np.array([0.0, 1.0, 3.0])
    sigma = np.geomspace(1e-3, 1e6, 20001)

    def likelihood(line, rate):
        inverse = np.linalg.inv(np.eye(3) + rate**2 * np.outer(line, line))
        ones = np.ones(3)
        mean = (ones @ inverse @ x) / (ones @ inverse @ ones)
        square = (x - mean) @ inverse @ (x - mean)
        norm = np.log(ones @ inverse @ ones) - np.linalg.slogdet(inverse)[1]
        values = -2.0 * np.log(sigma) - 0.5 * norm - 0.5 * square / sigma**2
        return np.exp(values).sum()

    plain = likelihood(np.zeros(3), 0.0)
    first, second = (
        np.mean([likelihood(np.maximum(0.0, days - at), rate) for rate in RATES]) / plain
        for at in days[:2]
    )
    # Half for the first check, a quarter for the second, the rest for an onset still to come.
    expected = 0.5 * first + 0.25 * second + 0.25
    assert drift(x, days).evidence == pytest.approx(expected, rel=1e-6)


def test_evidence_of_a_drift_exceeds_100_in_one_of_100_at_most():
    """300 series of 60, looked at every third day: more than 9 have p < 0.001."""
    x = np.random.default_rng(4).standard_normal((300, 60))
    days = np.arange(60.0)
    ever = [max(drift(series[:T], days[:T]).evidence for T in range(3, 61, 3)) for series in x]
    assert np.sum(np.array(ever) >= 100.0) <= 9


def drifting(arm, days, per_day_m):
    """Return daily checks of an arm that has begun to drift."""
    return [
        replace(
            arm.check(arm.joint(JOINT, per_day_m * max(0, day - BEFORE))),
            when_s=FIRST_S + day * DAY_S,
        )
        for day in range(days)
    ]


def said(arm, checks):
    """Return the answer to checks as JSON has it."""
    found = judge(arm.found, checks)
    names = [f'day{i + 1}' for i in range(len(checks))]
    return content_of(found, arm.found.chain, names, 1e3 * SMALLEST_M, NOT_VISITED)


def test_a_drift_is_told_before_it_matters_and_named_when_it_does():
    """To 6 standard deviations of a check in 60 days, of which what matters are 2.7."""
    arm = CheckedArm(31)
    per_day_m = 6.0 * NOISE_M * arm.sizes[JOINT] / POWER_STD / 60.0
    checks = drifting(arm, BEFORE + 60, per_day_m)
    early = next(
        content
        for count in range(BEFORE + 6, BEFORE + 50, 2)
        if (content := said(arm, checks[:count]))['trend'] is not None
    )
    print(early['text'])
    assert early['trend']['kind'] == 'drift'
    assert 'joint_3' in early['trend']['joints']
    assert not early['check_again']
    assert early['text'].startswith('Drifting: joint_3')
    assert ' days' in early['text']
    assert early['text'].endswith(f'Next check on {early["next_check"]}.')
    newest = FIRST_S + (early['checks'] - 1) * DAY_S
    ahead = (np.datetime64(early['next_check']) - np.datetime64(int(newest), 's')) / DAY_S
    assert 0 <= ahead.astype(float) <= 31
    late = said(arm, checks)
    assert late['verdict'] == 'changed'
    assert 'joint_3' in late['changed']
    assert late['text'].startswith('Has drifted since check')
    moved = 1e3 * per_day_m * 59
    assert late['joints'][JOINT]['change_mm'] == pytest.approx(moved, abs=0.08)


def test_without_times_a_drift_is_in_checks():
    arm = CheckedArm(32)
    checks = [replace(check, when_s=np.nan) for check in drifting(arm, BEFORE + 40, 4e-6)]
    found = said(arm, checks)
    assert found['next_check'] is None
    assert found['next_in_checks'] >= 1
    assert ' checks' in found['text'] or 'Has drifted' in found['text']


def test_a_jump_about_as_large_as_what_matters_comes_to_an_end():
    """Three standard deviations of a check: its size is told, and no check at once asked for."""
    arm = CheckedArm(33)
    days = arm.days(30)
    size_m = 3.0 * NOISE_M * arm.sizes[JOINT] / POWER_STD
    days += arm.days(40, arm.joint(JOINT, size_m))
    found = said(arm, days)
    assert not found['check_again']
    named = found['changed'] or found['trend']['joints']
    assert 'joint_3' in named
    if found['trend'] is not None:
        assert found['trend']['size_mm'] == pytest.approx(1e3 * size_m, abs=0.06)
        assert 'has changed by' in found['text']
        assert 'matters (0.1 mm)' in found['text']


@pytest.mark.parametrize('seed', [34, 35])
def test_nothing_drifts_where_nothing_does(seed):
    arm = CheckedArm(seed)
    checks = drifting(arm, 60, 0.0)
    for count in (10, 20, 40, 60):
        assert said(arm, checks[:count])['trend'] is None
