# SPDX-License-Identifier: Apache-2.0
"""Errors along a path: found, and taken apart into independent ones."""

import numpy as np
import pytest

from remaster_ros.calibration.dynamics import friction_share
from remaster_ros.calibration.extension import Extension, Term
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.noise import Noise, NoiseModel
from remaster_ros.calibration.path_noise import ORDERS, PathNoise, scatterless
from remaster_ros.types import Measurements

FRAMES, MARKERS = 60, 3


@pytest.fixture
def rows():
    n = FRAMES * MARKERS
    frame = np.repeat(np.arange(FRAMES), MARKERS)
    m = Measurements.empty(2)
    columns = {name: value for name, value in vars(m).items() if value is not None}
    columns = {
        name: np.zeros((n, *value.shape[1:]), value.dtype) for name, value in columns.items()
    }
    columns |= {
        'observation': np.arange(n),
        'pose': frame // 5,
        'frame': frame,
        'marker': np.tile(np.arange(MARKERS), FRAMES),
    }
    return Rows.of(Measurements(**columns), np.arange(n), np.eye(4)[None])


def noise_of(frames, order):
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(0.0, 0.02, (frames, 3)), axis=0)
    unit = np.ones(1)
    return PathNoise(
        np.repeat(path, MARKERS, axis=0),
        np.zeros((frames * MARKERS, 9)),
        0.9 * unit,
        0.5 * unit,
        0.1 * unit,
        0.5 * unit,
        unit,
        np.array([order]),
    )


@pytest.mark.parametrize('order', range(len(ORDERS)))
def test_correlated_errors_become_independent(rows, order):
    """The covariance of errors with these correlations, decorrelated, is that without them."""
    noise = noise_of(FRAMES, order)
    source = np.arange(0, len(rows), MARKERS)
    of_frames, of_markers = noise.of_frames(0, source), noise.of_markers(0, source)
    member = np.repeat(np.eye(FRAMES), MARKERS, axis=0)
    centering = np.eye(MARKERS) - 1.0 / MARKERS
    covariance = 0.25 * member @ of_frames @ member.T + np.kron(of_markers, centering)
    along = rows.along_path(noise)
    white = along.decorrelated(np.repeat(np.eye(len(rows))[:, None, :], 3, axis=1))[:, 0, :]
    scatter = 1.0 - scatterless(of_frames), 1.0 - scatterless(of_markers)
    expected = 0.25 * scatter[0] * member @ member.T
    expected += scatter[1] * np.kron(np.eye(FRAMES), centering)
    np.testing.assert_allclose(white @ covariance @ white.T, expected, atol=1e-9)


def test_sums_and_whitened_rows_agree(rows):
    """Sums of squares, Gram matrices and whitened rows are of the same decorrelated errors."""
    rng = np.random.default_rng(2)
    along = rows.along_path(noise_of(FRAMES, 2))
    model = NoiseModel.of(along, np.eye(4)[None])
    noise = Noise(np.array([1.0]), np.array([0.5]), np.array([0.3]))
    errors = rng.standard_normal((len(rows), 3))
    chi = np.sum(model.sums_of_squares(errors) / model.variances(noise))
    white = model.whitened(errors, noise)
    assert np.sum(white**2) == pytest.approx(chi)
    gram = model.gram(lambda rows, where: errors[where][:, :, None], 1)[:, 0, 0]
    np.testing.assert_allclose(gram, model.sums_of_squares(errors), rtol=1e-9)
    plain = NoiseModel.of(rows, np.eye(4)[None])
    assert not np.allclose(plain.sums_of_squares(errors), model.sums_of_squares(errors))


def test_some_rows_by_themselves_are_not_decorrelated(rows):
    along = rows.along_path(noise_of(FRAMES, 1))
    assert along.of_groups(0, 3).decorrelation == ()
    assert along.of_groups(0, len(rows.group_start)) is along


def test_friction_turns_round_within_its_travel():
    """Against the model's equation in steps of a thousandth of a row, also across reversals."""
    travel = 4e-4
    seconds = 0.1 * np.arange(100)
    fine = np.arange(-0.05, 9.95, 1e-4)

    def path(t):
        return 0.01 * np.sin(1.3 * t + 0.4), 0.013 * np.cos(1.3 * t + 0.4)

    q, v = path(seconds)
    a = -(1.3**2) * q
    found = friction_share(seconds, q[:, None], v[:, None], a[:, None], np.array([travel]))[:, 0]
    share, shares = np.sign(v[0]), []
    for speed in path(fine)[1]:
        share += 1e-4 * (speed - abs(speed) * share) / travel
        shares.append(share)
    expected = np.array(shares).reshape(100, 1000).mean(axis=1)
    # What it has come with is known after its first row only.
    np.testing.assert_allclose(found[1:], expected[1:], atol=0.02)
    assert np.abs(np.diff(expected)).max() > 0.5


def test_of_a_joint_that_hardly_moves_no_friction_is_known():
    """The noise of its speed has a sign, and friction has none; another joint moves."""
    rng = np.random.default_rng(3)
    seconds = 0.1 * np.arange(40)
    v = np.stack((0.2 + 0.1 * np.sin(seconds), rng.normal(0.0, 1e-5, 40)), axis=1)
    q = np.cumsum(0.1 * v, axis=0)
    q[:, 1] = rng.normal(0.0, 1e-6, 40)
    shares = friction_share(seconds, q, v, np.zeros_like(v), np.full(2, 1e-3))
    assert np.all(shares[1:, 0] > 0.99)
    assert np.max(np.abs(shares[:, 1])) < 0.1


def test_parameters_of_motion_stand_behind_those_of_causes():
    def extension(names, of_motion):
        count = len(names)
        terms = tuple(Term(slice(i, i + 1), i, np.full((3, 1), i + 1.0)) for i in range(count))
        return Extension(
            names, ('rad',) * count, terms, np.zeros((3, 3)), np.zeros(count),
            np.diag(np.arange(1.0, count + 1.0)), of_motion=of_motion,
        )  # fmt: skip

    causes, motion = extension(('a', 'b'), False), extension(('clock',), True)
    both = causes.with_motion(motion)
    assert both.names == ('a', 'b', 'clock')
    assert not both.of_motion
    np.testing.assert_array_equal(np.diag(both.prior_precision), [1.0, 2.0, 1.0])
    turned = both.turns(np.array([1.0, 10.0, 100.0]), np.arange(3))
    np.testing.assert_array_equal(turned[0], [101.0] * 3)
    np.testing.assert_array_equal(turned[1], [20.0] * 3)
    assert causes.with_motion(None) is causes
    assert causes.with_motion(causes) is causes
