"""The paper's metrics on cases that can be done by hand."""

from __future__ import annotations

import numpy as np
import pytest

from remaster_ros.core.accuracy import (
    Predictive,
    accuracy_of,
    relative_errors,
    solution_pairs,
    summary,
    theoretical_errors,
)
from remaster_ros.core.types import Measurements


def measurements(pose, position, sensor=None, marker=None, configuration=None) -> Measurements:
    n = len(pose)
    zeros = np.zeros(n, dtype=np.int64)
    return Measurements(
        observation=np.arange(n),
        pose=np.asarray(pose),
        configuration=np.arange(n) if configuration is None else np.asarray(configuration),
        is_validation=np.zeros(n, dtype=bool),
        stamp_s=np.arange(n, dtype=float),
        sensor=zeros if sensor is None else np.asarray(sensor),
        marker=zeros if marker is None else np.asarray(marker),
        q=np.zeros((n, 2)),
        from_q=np.full((n, 2), np.nan),
        position=np.asarray(position, dtype=float),
        std=np.full((n, 3), np.nan),
        samples=np.full(n, -1),
        temperature_c=np.full(n, np.nan),
    )


def test_relative_error_compares_distances_of_all_pairs_of_a_pose() -> None:
    measured = [[0, 0, 0], [3, 4, 0], [0, 0, 2], [9, 9, 9]]
    rows = measurements([0, 0, 0, 1], measured)
    modelled = np.array([[0, 0, 0], [0, 4, 0], [0, 0, 2], [0, 0, 0]], dtype=float)
    # Distances measured 5, 2, sqrt(29); modelled 4, 2, sqrt(20); pose 1 has no pair.
    expected = [1.0, 0.0, np.sqrt(29.0) - np.sqrt(20.0)]
    np.testing.assert_allclose(relative_errors(rows, modelled), expected)


def test_relative_error_does_not_depend_on_the_frame() -> None:
    rng = np.random.default_rng(1)
    rows = measurements([0, 0, 1, 1, 1], rng.standard_normal((5, 3)))
    modelled = rng.standard_normal((5, 3))
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    moved = modelled @ turn.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(relative_errors(rows, moved), relative_errors(rows, modelled))


def test_pairs_have_one_sensor_one_marker_and_two_configurations() -> None:
    rows = measurements(
        [0, 0, 0, 0, 0, 0],
        np.zeros((6, 3)),
        sensor=[0, 1, 0, 1, 0, 0],
        marker=[0, 0, 0, 0, 1, 0],
        configuration=[0, 0, 1, 1, 2, 1],
    )
    pairs = {tuple(pair) for pair in solution_pairs(rows).tolist()}
    # Rows 2 and 5 are one configuration measured twice, row 4 another marker.
    assert pairs == {(0, 2), (0, 5), (1, 3)}


def test_the_paper_s_number_of_pairs() -> None:
    """Every pose of m solutions gives m (m - 1) / 2 distances."""
    poses = np.repeat([0, 1, 2], [5, 4, 1])
    assert len(solution_pairs(measurements(poses, np.zeros((10, 3))))) == 10 + 6


def test_summary_in_millimetres() -> None:
    values = np.linspace(0.0, 1e-3, 1001)
    found = summary(values)
    assert found['mean_mm'] == pytest.approx(0.5)
    assert found['interval95_mm'] == pytest.approx([0.025, 0.975])


def test_theoretical_error_of_a_known_spread() -> None:
    """Draws one metre to the side, no noise: all of the distances are known."""
    predictive = Predictive(
        predict=lambda points: np.repeat(points[:, None, :], 4, axis=1),
        before=np.array([0.0, 0.0, 3.0]),
        after=np.zeros(3),
        draws=np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]),
        sigma=np.zeros((2, 4)),
        pose_sigma=np.zeros((2, 4)),
        group=np.array([0, 0, 1, 1]),
    )
    before, after, offsets_only = theoretical_errors(predictive, np.random.default_rng(0))
    np.testing.assert_allclose(before, np.sqrt(10.0))
    np.testing.assert_allclose(after, 1.0)
    np.testing.assert_allclose(offsets_only, 1.0)


def test_theoretical_error_adds_both_parts_of_the_noise() -> None:
    """Length of a 3-D normal error: mean sigma sqrt(8 / pi); 60,000 values, 5 standard errors."""
    draws = 3000
    predictive = Predictive(
        predict=lambda points: np.zeros((len(points), 20, 3)),
        before=np.zeros(1),
        after=np.zeros(1),
        draws=np.zeros((draws, 1)),
        sigma=np.full((draws, 20), 0.6e-3),
        pose_sigma=np.full((draws, 20), 0.8e-3),
        group=np.arange(20),
    )
    _, after, offsets_only = theoretical_errors(predictive, np.random.default_rng(1))
    assert np.all(offsets_only == 0.0)
    assert after.mean() == pytest.approx(1e-3 * np.sqrt(8.0 / np.pi), rel=0.01)


def test_what_a_session_does_not_allow_is_null_with_a_reason() -> None:
    rows = measurements([0, 1, 2], [[1e-3, 0, 0], [0, 2e-3, 0], [0, 0, 3e-3]])
    nothing = np.zeros((3, 3))
    found = accuracy_of(rows, nothing, nothing, None, np.random.default_rng(0))
    assert found is not None
    assert found['relative']['before'] is None
    assert 'two joint solutions' in found['relative']['why']
    assert found['post_registration']['after']['mean_mm'] == pytest.approx(2.0)
    assert found['theoretical']['after_offsets_only'] is None
    empty = rows.select(np.zeros(3, dtype=bool))
    assert accuracy_of(empty, nothing[:0], nothing[:0], None, np.random.default_rng(0)) is None
