# SPDX-License-Identifier: Apache-2.0
"""The paper's metrics on cases that can be done by hand."""

import numpy as np
import pytest
from worlds.measured_rows import measured_rows

from remaster_ros.calibration import accuracy
from remaster_ros.calibration.accuracy import (
    accuracy_of,
    relative_errors,
    solution_pairs,
    summary,
)
from remaster_ros.types import Measurements

RNG = np.random.default_rng(0)


def measurements(pose, position, **columns) -> Measurements:
    return measured_rows(np.zeros((len(pose), 2)), position, pose=pose, **columns)


def test_relative_error_compares_distances_of_all_pairs_of_a_pose() -> None:
    measured = [[0, 0, 0], [3, 4, 0], [0, 0, 2], [9, 9, 9]]
    rows = measurements([0, 0, 0, 1], measured)
    modelled = np.array([[0, 0, 0], [0, 4, 0], [0, 0, 2], [0, 0, 0]], dtype=float)
    # Distances measured 5, 2, sqrt(29); modelled 4, 2, sqrt(20); pose 1 has no pair.
    expected = [1.0, 0.0, np.sqrt(29.0) - np.sqrt(20.0)]
    np.testing.assert_allclose(
        relative_errors(rows, modelled, solution_pairs(rows, RNG)), expected
    )


def test_relative_error_does_not_depend_on_the_frame() -> None:
    rng = np.random.default_rng(1)
    rows = measurements([0, 0, 1, 1, 1], rng.standard_normal((5, 3)))
    modelled = rng.standard_normal((5, 3))
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    moved = modelled @ turn.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(
        relative_errors(rows, moved, solution_pairs(rows, RNG)),
        relative_errors(rows, modelled, solution_pairs(rows, RNG)),
    )


def test_pairs_have_one_sensor_one_marker_and_two_configurations() -> None:
    rows = measurements(
        [0, 0, 0, 0, 0, 0],
        np.zeros((6, 3)),
        sensor=[0, 1, 0, 1, 0, 0],
        marker=[0, 0, 0, 0, 1, 0],
        configuration=[0, 0, 1, 1, 2, 1],
    )
    pairs = {tuple(pair) for pair in solution_pairs(rows, RNG).tolist()}
    # Rows 2 and 5 are one configuration measured twice, row 4 another marker.
    assert pairs == {(0, 2), (0, 5), (1, 3)}


def test_the_paper_s_number_of_pairs() -> None:
    """Every pose of m solutions gives m (m - 1) / 2 distances."""
    poses = np.repeat([0, 1, 2], [5, 4, 1])
    assert len(solution_pairs(measurements(poses, np.zeros((10, 3))), RNG)) == 10 + 6


def test_summary_in_millimetres() -> None:
    values = np.linspace(0.0, 1e-3, 1001)
    found = summary(values)
    assert found['mean_mm'] == pytest.approx(0.5)
    assert found['interval95_mm'] == pytest.approx([0.025, 0.975])


def test_more_pairs_than_the_limit_are_drawn_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    """300 rows at two poses: 4 of 5 pairs lie in the larger one, ± 5 standard errors."""
    monkeypatch.setattr(accuracy, 'MOST_PAIRS', 4000)
    rows = measurements(np.repeat([7, 3], [200, 100]), np.zeros((300, 3)))
    pairs = solution_pairs(rows, np.random.default_rng(4))
    assert len(pairs) == 4000
    assert np.all(pairs[:, 0] < pairs[:, 1])
    assert np.all(rows.pose[pairs[:, 0]] == rows.pose[pairs[:, 1]])
    share = np.mean(rows.pose[pairs[:, 0]] == 7)
    expected = 199 * 200 / (199 * 200 + 99 * 100)
    assert share == pytest.approx(expected, abs=5 * np.sqrt(expected * (1 - expected) / 4000))


def test_what_a_session_does_not_allow_is_null_with_a_reason() -> None:
    rows = measurements([0, 1, 2], [[1e-3, 0, 0], [0, 2e-3, 0], [0, 0, 3e-3]])
    nothing = np.zeros((3, 3))
    both = accuracy_of(rows, np.arange(3), nothing, nothing, None, RNG)
    assert both['validation'] is None
    found = both['optimization']
    assert found['relative']['before'] is None
    assert 'two joint solutions' in found['relative']['why']
    assert found['post_registration']['after']['mean_mm'] == pytest.approx(2.0)
    for name in ('theoretical', 'paper_theoretical_random'):
        assert found[name]['after_offsets_only'] is None
        assert 'posterior' in found[name]['why']
