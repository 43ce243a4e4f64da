# SPDX-License-Identifier: Apache-2.0
"""One noise engine for fit and discovery: sums, Gram matrices and whitening say the same."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from worlds.calibration_scenes import scene

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.noise import Noise, NoiseModel

SPLITS = [(), (0,), (0, 1)]


@cache
def rows_of_two_sensors() -> tuple[Rows, np.ndarray]:
    found = estimate(Problem.of(scene(61, poses=15, sensor_count=2)[0]))
    return found.posterior.rows, found.model.reference


@cache
def rows_of_frames() -> tuple[Rows, np.ndarray]:
    """Three markers in each frame of the first sensor, hidden from some poses' frames alike."""
    found = estimate(Problem.of(scene(61, poses=15, sensor_count=2)[0]))
    measurements = found.problem.measurements
    several = (measurements.sensor == 0) & (measurements.pose > 1)
    hidden = several & (measurements.pose % 4 == 0)
    source = np.concatenate((np.arange(len(measurements)), *[np.flatnonzero(several)] * 2))
    kept = np.ones(len(source), bool)
    kept[-int(several.sum()) :] = ~hidden[several]
    source = source[kept]
    frame = np.where(measurements.sensor == 0, measurements.configuration, -1)
    framed_rows = replace(measurements, frame=frame).select(source)
    rows = Rows.of(framed_rows, np.arange(len(framed_rows)), found.model.reference)
    return rows, found.model.reference


def a_noise(model: NoiseModel) -> Noise:
    """Every channel's own, so that a mistaken channel shows."""
    count = len(model.channels)
    sigma = 1e-4 * (1.0 + np.arange(count))
    pose_sigma = np.where(
        np.isin(np.arange(count), model.separable), 3e-4 / (1 + np.arange(count)), 0
    )
    framed = np.where(np.isin(np.arange(count), model.framed), 2e-4 / (1 + np.arange(count)), 0)
    return Noise(sigma, pose_sigma, framed)


@pytest.mark.parametrize('split', SPLITS)
@pytest.mark.parametrize('given', [rows_of_two_sensors, rows_of_frames])
def test_whitening_makes_noise_of_the_model_white(given, split):
    rows, reference = given()
    model = NoiseModel.of(rows, reference, split)
    noise = a_noise(model)
    seed = 3
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    values = np.zeros((len(rows), 3, 400))
    for index, channel in enumerate(model.channels):
        axes = slice(*channel.axes)
        shape = (len(rows), channel.dimension, 400)
        common = rng.standard_normal((len(rows.group_start), *shape[1:]))[rows.group_of_row]
        drawn = noise.pose_sigma[index] * common + noise.sigma[index] * rng.standard_normal(shape)
        of_frames = rng.standard_normal((len(rows.frame_start), *shape[1:]))
        drawn += noise.frame_sigma[index] * np.repeat(of_frames, rows.frame_size, axis=0)
        mine = dict(rows.spans)[channel.sensor]
        values[mine, axes] = drawn[mine]
    if model.frames is not None:
        values = np.swapaxes(model.frames, 1, 2) @ values
    white = model.whitened(values, noise).reshape(-1, 400)
    covariance = white @ white.T / 400
    assert np.diag(covariance).mean() == pytest.approx(1.0, abs=0.02)
    # Correlations within a pose are gone: what is left is chance, 1 / sqrt(400).
    off = covariance - np.diag(np.diag(covariance))
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize('split', SPLITS)
@pytest.mark.parametrize('given', [rows_of_two_sensors, rows_of_frames])
def test_sums_grams_and_whitening_are_of_one_likelihood(given, split):
    rows, reference = given()
    model = NoiseModel.of(rows, reference, split)
    noise = a_noise(model)
    vectors = np.random.default_rng(4).standard_normal((len(rows), 3, 5))
    grams = model.gram(lambda _, where: vectors[where], 5)
    sums = model.sums_of_squares(np.moveaxis(vectors, 2, 0))
    np.testing.assert_allclose(np.einsum('gcc->cg', grams), sums, rtol=1e-9)
    white = model.whitened(vectors, noise).reshape(-1, 5)
    weighted = np.tensordot(1.0 / model.variances(noise), grams, axes=1)
    np.testing.assert_allclose(white.T @ white, weighted, rtol=1e-9)
    assert model.freedom.sum() == 3 * len(rows)


def test_gram_matrices_do_not_depend_on_the_blocks(monkeypatch):
    rows, reference = rows_of_two_sensors()
    model = NoiseModel.of(rows, reference, (1,))
    vectors = np.random.default_rng(5).standard_normal((len(rows), 3, 4))
    full_gram = model.gram(lambda _, where: vectors[where], 4)
    monkeypatch.setattr('remaster_ros.calibration.noise.GRAM_ROWS', 7)
    np.testing.assert_allclose(
        model.gram(lambda _, where: vectors[where], 4), full_gram, rtol=1e-9
    )


@pytest.mark.parametrize('given', [rows_of_two_sensors, rows_of_frames])
def test_rows_are_whitened_some_at_a_time_to_where_they_are_wanted(given, monkeypatch):
    rows, reference = given()
    model = NoiseModel.of(rows, reference, ())
    noise = a_noise(model)
    vectors = np.random.default_rng(4).standard_normal((len(rows), 3, 5)).astype(np.float32)
    monkeypatch.setattr('remaster_ros.calibration.noise.WHITENED_ROWS', len(rows) + 1)
    full_rows = model.whitened(vectors, noise)
    monkeypatch.setattr('remaster_ros.calibration.noise.WHITENED_ROWS', 5)
    room = np.empty_like(vectors)
    assert model.whitened(vectors, noise, room) is room
    np.testing.assert_array_equal(room, full_rows)
