# SPDX-License-Identifier: Apache-2.0
"""What of the measurement is taken out of what a robot can load."""

import numpy as np
import pytest
from worlds.discovery_scenes import session_with

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.discovery import explain
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.discovery.geometry_model import geometry_model
from remaster_ros.reports.discovery_json import discovery_content
from remaster_ros.reports.loadable import loadable
from remaster_ros.reports.result_lines import discovery_lines


def test_only_a_certain_error_of_the_measurement_is_taken_out(monkeypatch):
    """One that may be nothing is no reason to give the arm other lengths."""
    session = session_with(
        41, poses=18, validation=10, sensor=lambda s: 4e-3 * s.measurements.position
    )

    def found() -> Discovery:
        return discover_session(session, rng=np.random.default_rng(0))

    with monkeypatch.context() as doubting:
        doubting.setattr(explain, 'CERTAIN', np.inf)
        doubtful = found()
    certain = found()
    for result in certain, doubtful:
        assert result.geometry is not None
        assert [e.name for e in result.effects if e.of_measurement] == ['sensor_scale']
    assert all(e.is_taken_out for e in certain.effects if e.of_measurement)
    assert any('scale' in name for name in certain.alone.theta_names)
    assert doubtful.alone.theta_names == ()
    plain = geometry_model(estimate(Problem.of(session)))
    np.testing.assert_allclose(doubtful.geometry.errors, plain.errors, atol=1e-9)
    assert np.abs(certain.geometry.errors - plain.errors).max() > 1e-4
    # The table and the files tell the same.
    row = next(row for row in loadable(doubtful) if row.result == 'geometry')
    held_out = session.measurements.is_validation
    mean_mm = 1e3 * np.linalg.norm(plain.errors[held_out], axis=1).mean()
    assert row.held_out_mean_mm == pytest.approx(mean_mm, abs=1e-3)
    lines = [line for line in discovery_lines(discovery_content(certain)) if 'to load' in line]
    assert all('measuring errors taken out' in line for line in lines)
