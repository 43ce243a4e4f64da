# SPDX-License-Identifier: Apache-2.0
"""Errors that follow the place before a sensor, too weak for the search, are reported."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
from worlds.discovery_scenes import residuals_of, session_with

from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.guard import Unexplained
from remaster_ros.discovery.omnibus import errors_by_place
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.types import FloatArray

SIGNIFICANCE = 0.001
BEND_M = 0.16e-3


def with_errors(data: Residuals, errors: FloatArray) -> Residuals:
    """Return the residuals with other errors (n, 3) in the rows worked on."""
    full = data.full_errors.copy()
    full[data.rows.source] = errors
    return replace(data, errors=errors, full_errors=full)


def found_in(data: Residuals, significance: float = SIGNIFICANCE) -> list[Unexplained]:
    solution = solve(data, ())
    assert solution is not None
    return list(errors_by_place(data, solution, significance))


def noise(data: Residuals, rng: np.random.Generator) -> FloatArray:
    """0.1 mm in each row, 0.05 mm in all rows of a sensor at a pose."""
    rows = data.rows
    of_pose = rng.standard_normal((len(rows.group_size), 3))[rows.group_of_row]
    return 0.1e-3 * rng.standard_normal((len(data), 3)) + 0.05e-3 * of_pose


def bent_half(data: Residuals, sensor: int) -> FloatArray:
    """Return what half a bent lens adds to the errors, `BEND_M` RMS before absorption."""
    span = dict(data.rows.spans)[sensor]
    across = data.rows.target[span, 0] - np.median(data.rows.target[span, 0])
    bend = np.maximum(across, 0.0) ** 2
    errors = np.zeros((len(data), 3))
    errors[span] = np.outer(bend, (1.0, 0.3, 0.5)) / np.sqrt(1.34 * np.mean(bend**2))
    return BEND_M * errors


@pytest.mark.parametrize('sensor', [0, 1])
def test_half_a_bent_lens_is_located_at_its_sensor(sensor):
    data = residuals_of(session_with(51, sensor_count=2, pose_sigma_m=0.05e-3))
    bent = bent_half(data, sensor)
    kept = bent - np.einsum('nip,p->ni', data.base, np.einsum('nip,ni->p', data.base, bent))
    size_m = np.sqrt(np.mean(np.sum(kept[dict(data.rows.spans)[sensor]] ** 2, axis=1)))
    right = 0
    for seed in range(6):
        rng = np.random.default_rng([seed, sensor])
        entries = found_in(with_errors(data, noise(data, rng) + bent))
        names = [
            name for name in data.context.sensor_names if any(name in e.next for e in entries)
        ]
        assert names in ([], [data.context.sensor_names[sensor]]), (seed, entries)
        for entry in entries:
            right += 1
            assert (entry.where, entry.driver) == ('sensor_frame', 'position')
            assert entry.size_m == pytest.approx(size_m, rel=0.5)
    assert right >= 5


def test_rounding_is_no_structure():
    data = residuals_of(session_with(53, sensor_count=2, sigma_m=0.0, pose_sigma_m=0.0))
    assert np.abs(data.errors).max() < 1e-6
    assert found_in(data, significance=1.0) == []


def test_noise_fires_as_often_as_stated():
    data = residuals_of(session_with(52, sensor_count=2, pose_sigma_m=0.05e-3))
    rng = np.random.default_rng(7)
    trials, share = 60, 0.1
    fired = sum(len(found_in(with_errors(data, noise(data, rng)), share)) for _ in range(trials))
    # Two sensors are tested in each.
    least, most = binom.interval(0.999, 2 * trials, share)
    assert least <= fired <= most
