# SPDX-License-Identifier: Apache-2.0
"""Capture times: jitter of the arrival drops out, a restarted device is followed."""

import numpy as np
import pytest

from remaster_ros.sensors.clock_offset import ClockMapping


def test_jitter_of_the_arrival_drops_out():
    rng = np.random.default_rng(4)
    mapping, errors = ClockMapping(), []
    for i in range(1000):
        device = i / 120
        true = 1e6 + device
        arrival = true + 0.004 + 1e-3 + rng.exponential(0.02)
        errors.append(mapping.capture_time(device, 0.004, arrival) - true)
    # Known age 4 ms, fixed hop 1 ms, jitter 20 ms on average: what stays is near the hop.
    assert np.all(np.array(errors[200:]) < 0.0025)
    assert np.all(np.array(errors) >= 0.001 - 1e-9)


def test_a_simulated_clock_that_lags_does_not_pull_the_stamps_back():
    """Ticks 10 times a second, and one in a hundred hangs for two seconds."""
    rng = np.random.default_rng(5)
    mapping, errors = ClockMapping(simulated=True), []
    for i in range(2000):
        device = i / 60
        lag = 2.0 if i % 100 == 50 else rng.uniform(0, 0.1)
        errors.append(mapping.capture_time(device, 0.0, 100.0 + device + 0.01 - lag))
        errors[-1] -= 100.0 + device
    assert np.all(np.abs(errors[200:]) < 0.1)


def test_a_restarted_device_is_followed_at_once():
    mapping = ClockMapping()
    mapping.capture_time(500.0, 0.0, 1000.0)
    assert mapping.capture_time(0.1, 0.0, 1001.0) == pytest.approx(1001.0)


def test_a_slow_drift_is_followed_within_the_window():
    mapping = ClockMapping(window=120)
    for i in range(12000):
        device = i / 120
        error = mapping.capture_time(device, 0.0, 50.0 + 1.0001 * device) - (
            50.0 + 1.0001 * device
        )
    assert abs(error) <= 1.01e-4
