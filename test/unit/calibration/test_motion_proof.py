# SPDX-License-Identifier: Apache-2.0
"""Standstills beside motion: no claim where both err alike, one where motion lacks something."""

from dataclasses import replace

import numpy as np
import pytest

from remaster_ros.calibration.dynamics import friction_share
from remaster_ros.calibration.motion_proof import LEVEL, motion_proof
from remaster_ros.types import Measurements

POSES, SEGMENTS, ROWS, MARKERS = 8, 25, 5, 4
SIGMA_M = 2e-5


def rows():
    """Return held-out rows: standstills first, then segments of motion, four markers each."""
    frames = POSES + SEGMENTS * ROWS
    pose = np.concatenate((np.arange(POSES), POSES + np.repeat(np.arange(SEGMENTS), ROWS)))
    number = np.repeat(np.arange(frames), MARKERS)
    n = len(number)
    velocity = np.where(number[:, None] < POSES, 0.0, np.full((n, 2), 0.3))
    return replace(
        Measurements.empty(2),
        observation=np.arange(n),
        pose=pose[number],
        configuration=number,
        is_validation=np.ones(n, bool),
        stamp_s=number.astype(float),
        sensor=np.zeros(n, np.int64),
        marker=np.tile(np.arange(MARKERS), frames),
        q=np.zeros((n, 2)),
        from_q=np.zeros((n, 2)),
        position=np.zeros((n, 3)),
        std=np.full((n, 3), np.nan),
        samples=np.full(n, 12),
        temperature_c=np.full(n, np.nan),
        velocity=velocity,
        acceleration=np.zeros((n, 2)),
    )


def errors_of(m, rng, further_m=0.0):
    """Return errors common to a pose or segment, of the markers, and more at standstill."""
    common = rng.normal(0.0, SIGMA_M, (POSES + SEGMENTS, 3))
    common[:POSES] += rng.normal(0.0, further_m, (POSES, 3))
    return common[m.pose] + rng.normal(0.0, SIGMA_M, (len(m), 3))


def proof(seed, further_m=0.0, friction_m=0.0):
    m, rng = rows(), np.random.default_rng(seed)
    variance = np.where(m.pose < POSES, 3.0 * friction_m**2, 0.0)
    return motion_proof(m, errors_of(m, rng, further_m), np.full(len(m), 0.2), variance)


def test_sessions_whose_model_holds_are_seldom_doubted():
    """By the F test one in a hundred would be; 400 of them, and a binomial bound of 1 in 1,000."""
    print('seeds 0 to 399')
    doubted = sum(proof(seed).disagree for seed in range(400))
    assert doubted <= 13
    assert LEVEL == 0.01


def test_what_is_only_at_standstill_is_seen():
    print('seeds 0 to 99')
    assert sum(proof(seed, further_m=2.0 * SIGMA_M).disagree for seed in range(100)) >= 95
    # What is not known of the friction at rest explains as much.
    explained = [proof(seed, 2.0 * SIGMA_M, 2.0 * SIGMA_M).disagree for seed in range(100)]
    assert sum(explained) <= 5


def test_its_sentences():
    good, bad = proof(1), proof(1, further_m=10.0 * SIGMA_M)
    assert good.poses == POSES
    assert good.fastest_mm_s == pytest.approx(200.0)
    assert 'never fitted' in good.words
    assert good.words.endswith('the model of the motion holds.')
    assert bad.standstill_mm > 4.0 * bad.motion_mm
    assert f'{bad.standstill_mm:.3f} mm' in bad.words
    assert 'speed_share' in bad.words


def test_without_motion_or_with_few_standstills_nothing_is_judged():
    m = rows()
    zero = np.zeros(len(m))
    errors = np.zeros((len(m), 3))
    assert motion_proof(replace(m, velocity=None), errors, zero, zero) is None
    assert motion_proof(replace(m, is_validation=m.pose >= POSES - 2), errors, zero, zero) is None


def share_at_rest(turned, rest_angle=0.2, travel=3e-4):
    """Return the share of the friction of one joint at rest that turned last at a place."""
    zero = np.zeros((1, 1))
    place, way = np.array([[rest_angle]]), np.array([[turned]])
    return friction_share(np.zeros(1), place, zero, zero, np.array([travel]), way)[0, 0]


@pytest.mark.parametrize('turned', [0.1, 0.2004, 0.1999, 0.20002])
def test_friction_at_rest_is_that_of_the_last_turn(turned):
    """Dahl's model: from far away to where it turned, and back to where it rests."""
    share, travel, place = 0.0, 3e-4, 0.2
    side = np.sign(turned - place)
    for start, end in ((turned - 0.05 * side, turned), (turned, place)):
        along = np.sign(end - start)
        share = along + (share - along) * np.exp(-abs(end - start) / travel)
    assert share_at_rest(turned) == pytest.approx(share, abs=1e-9)


def test_without_a_known_turn_there_is_no_friction_at_rest():
    assert share_at_rest(np.nan) == 0.0
