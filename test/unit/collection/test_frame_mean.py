# SPDX-License-Identifier: Apache-2.0
"""A reading of frames, some of which are not of the marker: right, with the others' scatter."""

import numpy as np
import pytest
from pairing_feed import STREAM, Q

from remaster_ros.collection.pairing import PairedReading, Pairing, Rejection
from remaster_ros.collection.still_frames import of_the_marker
from remaster_ros.types import MarkerReading

TRUE = np.array([0.3, -0.2, 2.5])
SIGMA = np.array([0.03e-3, 0.03e-3, 0.1e-3])


def decided(positions, rules=STREAM):
    """Return what becomes of frames over one dwell."""
    pairing = Pairing(10.0, Q, (rules,))
    stamps = 10.0 + (np.arange(len(positions)) + 1) * rules.dwell_s / len(positions)
    for stamp, position in zip(stamps, positions, strict=True):
        pairing.add_reading(rules.sensor, MarkerReading(stamp, position))
    pairing.add_reading(rules.sensor, MarkerReading(10.0 + 2.0 * rules.dwell_s, TRUE))
    pairing.add_joint_state(10.0 + 2.0 * rules.dwell_s, Q)
    return pairing.decided[rules.sensor]


def frames(rng, count=60):
    return TRUE + SIGMA * rng.standard_normal((count, 3))


@pytest.mark.parametrize('by', [48.0, 1.0, 0.05, 5e-3, 2e-3])
def test_a_damaged_frame_is_left_out_and_counted(by):
    rng = np.random.default_rng(7)
    for _ in range(50):
        good = frames(rng)
        positions = good.copy()
        bad = rng.choice(60, 3, replace=False)
        direction = rng.standard_normal((3, 3))
        positions[bad] += by * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        reading = decided(positions)
        assert isinstance(reading, PairedReading), reading
        assert reading.dropped == 3
        assert reading.samples == 57
        good_frames = np.delete(good, bad, axis=0)
        np.testing.assert_allclose(reading.position, good_frames.mean(axis=0), rtol=0, atol=1e-12)
        np.testing.assert_allclose(reading.std, good_frames.std(axis=0, ddof=1), rtol=1e-9)


def test_many_such_frames_are_a_reason_and_no_reading():
    rng = np.random.default_rng(8)
    positions = frames(rng)
    positions[::5] += [0.0, 0.04, 0.0]
    rejection = decided(positions)
    assert isinstance(rejection, Rejection)
    assert rejection.reason == 'scattered'
    assert '12 of 60 frames are far from the others' in rejection.detail


def test_of_few_frames_none_may_be_missing():
    rng = np.random.default_rng(9)
    positions = frames(rng, 5)
    positions[2] += 1.0
    assert decided(positions).reason == 'scattered'
    assert decided(frames(rng, 5)).samples == 5


@pytest.mark.parametrize('count', [5, 8, 15, 60, 240])
@pytest.mark.parametrize('sigma', [(0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 4.0)])
def test_of_normal_noise_next_to_nothing_is_left_out(count, sigma):
    """One reading in 1,000 loses a frame by the noise; 15 of 3,000 would be 4 times that.

    Poisson of mean 3 (9 where five frames lie along a line): above 24 once in 30,000 runs.
    """
    rng = np.random.default_rng(count)
    touched = sum(
        not of_the_marker(1e-4 * np.array(sigma) * rng.standard_normal((count, 3))).all()
        for _ in range(3000)
    )
    assert touched <= 24


@pytest.mark.parametrize('count', [8, 60])
def test_the_mean_is_as_sure_as_its_standard_deviation_states(count):
    """Coverage of 95 % intervals (Student's t) in 3 × 2,000 trials: ± 4 of its own errors."""
    from scipy import stats

    rng = np.random.default_rng(count)
    covered, errors = 0, []
    wide = stats.t.ppf(0.975, count - 1)
    for _ in range(2000):
        positions = frames(rng, count)
        kept = positions[of_the_marker(positions)]
        error = kept.mean(axis=0) - TRUE
        covered += np.sum(np.abs(error) <= wide * kept.std(axis=0, ddof=1) / np.sqrt(len(kept)))
        errors.append(error / (SIGMA / np.sqrt(count)))
    assert abs(covered / 6000 - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 6000)
    # Efficiency: the variance of the mean itself, to 4 of the errors of this estimate.
    assert np.var(errors) < 1.0 + 4.0 * np.sqrt(2.0 / 6000)


def test_frames_without_any_scatter_are_kept():
    assert of_the_marker(np.tile(TRUE, (10, 1))).all()
    positions = np.tile(TRUE, (10, 1))
    positions[3] += 2e-3
    assert of_the_marker(positions).tolist() == [i != 3 for i in range(10)]
