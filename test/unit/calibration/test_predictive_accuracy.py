# SPDX-License-Identifier: Apache-2.0
"""Section V-C on posteriors whose distances are known."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN, extension, scene

from remaster_ros.calibration import predictive_accuracy
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.predictive_accuracy import (
    Predictive,
    predicted_accuracy,
    random_configurations,
    theoretical_distances,
    tool_places,
)
from remaster_ros.types import Measurements

DRAWS = 300


@pytest.fixture(scope='module')
def seen() -> Measurements:
    session, _ = scene(300, poses=12, sensor_count=2)
    return session.measurements


def predictive(size_of: dict[str, float], sigma_m: float = 0.0) -> Predictive:
    """Return draws of the named parameters with these std about zero, all else fixed."""
    model = Model(
        CHAIN,
        ('mocap', 'tracker'),
        ('sir', 'smr'),
        np.tile(np.eye(4), (2, 1, 1)),
        np.zeros((2, 3)),
    )
    rng = np.random.default_rng(7)
    after = model.vector(np.zeros(7), np.array([[0.1, 0.0, 0.02], [-0.1, 0.0, 0.02]]))
    draws = np.tile(after, (DRAWS, 1))
    for name, std in size_of.items():
        draws[:, model.names.index(name)] += std * rng.standard_normal(DRAWS)
    return Predictive(model, after, draws, np.full((DRAWS, 2, 2), sigma_m))


def distances(given: Predictive, seen: Measurements, seed: int = 0):
    everything = np.arange(len(seen))
    rng = np.random.default_rng(seed)
    return theoretical_distances(given, given.after, seen, everything, rng)


def test_a_shift_of_the_registration_is_the_distance(seen: Measurements) -> None:
    """Along one axis: |N(0, std)| for the invariant version, nothing for the paper's."""
    shifts = {'registration.mocap.x': 1e-3, 'registration.tracker.x': 1e-3}
    invariant, paper = distances(predictive(shifts), seen)
    # 300 draws know the mean of |x| to 4.4 %: five standard errors.
    assert invariant.after.mean() == pytest.approx(1e-3 * np.sqrt(2 / np.pi), rel=0.22)
    np.testing.assert_allclose(paper.after, 0.0, atol=1e-12)


def test_an_offset_of_joint_1_counts_in_the_papers_version_alone(seen: Measurements) -> None:
    given = predictive({'joint_1': 1e-3})
    given = replace(given, draws=given.draws + np.eye(given.model.size)[0] * 0.01)
    invariant, paper = distances(given, seen)
    np.testing.assert_allclose(invariant.before, 0.0, atol=1e-12)
    lever = np.hypot(*CHAIN.positions(seen.q, np.array([0.1, 0.0, 0.02]))[:, :2].T)
    assert paper.before.mean() == pytest.approx(0.01 * lever.mean(), rel=0.1)
    # After: about the mean of the draws, so only their spread of 1 mrad is left.
    assert paper.after.mean() < 0.15 * paper.before.mean()


def test_an_inner_offset_counts_alike_in_both(seen: Measurements) -> None:
    invariant, paper = distances(predictive({'joint_4': 1e-3}), seen)
    for name in ('before', 'after_offsets_only'):
        assert getattr(invariant, name).mean() == pytest.approx(
            getattr(paper, name).mean(), rel=0.02
        )


def test_noise_has_the_length_of_a_3_d_normal_error(seen: Measurements) -> None:
    """Mean sigma sqrt(8 / pi): some 100,000 pairs know it to 0.14 %; seven standard errors."""
    invariant, paper = distances(predictive({}, sigma_m=1e-3), seen)
    for found in (invariant, paper):
        assert found.after.mean() == pytest.approx(1e-3 * np.sqrt(8.0 / np.pi), rel=0.01)
        np.testing.assert_allclose(found.after_offsets_only, 0.0, atol=1e-12)


def test_noise_along_the_line_of_sight_alone_is_as_long_as_one_axis(seen: Measurements) -> None:
    """Mean sigma sqrt(2 / pi): 100,000 pairs know it to 0.24 %; five standard errors."""
    given = predictive({})
    sensors_at = np.tile(np.eye(4), (2, 1, 1))
    sensors_at[:, :3, 3] = [2.0, 1.0, 0.5]
    given = replace(
        given,
        model=replace(given.model, reference=sensors_at),
        sigma=np.full((DRAWS, 2, 2), 1e-3) * [1.0, 0.0],
    )
    invariant, _ = distances(given, seen)
    assert invariant.after.mean() == pytest.approx(1e-3 * np.sqrt(2.0 / np.pi), rel=0.012)


def test_all_draws_and_rows_are_used(seen: Measurements) -> None:
    """One draw of 300 is a metre off; with fewer draws than rows it is still among the pairs."""
    given = predictive({})
    given.draws[17, given.model.names.index('registration.mocap.y')] = 1.0
    given.draws[17, given.model.names.index('registration.tracker.y')] = 1.0
    invariant, _ = distances(given, seen)
    assert np.mean(invariant.after > 0.5) == pytest.approx(1 / DRAWS, rel=1e-6)


def test_a_large_session_is_thinned(seen: Measurements, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictive_accuracy, 'PAIRS', 1000)
    monkeypatch.setattr(predictive_accuracy, 'MOST_ROWS', 20)
    invariant, paper = distances(predictive({'joint_4': 1e-3}), seen)
    assert len(invariant.after) == len(paper.before) == 1000


def test_random_configurations_fill_the_joint_limits(seen: Measurements) -> None:
    model = predictive({}).model
    rows = random_configurations(model, seen, 2000, np.random.default_rng(3))
    assert np.all(CHAIN.within_limits(rows.q))
    # 2000 uniform values: the outermost lie within 0.5 % of the limits but for a chance of 1e-3.
    width = CHAIN.upper - CHAIN.lower
    assert np.all(rows.q.min(axis=0) < CHAIN.lower + 0.005 * width)
    assert np.all(rows.q.max(axis=0) > CHAIN.upper - 0.005 * width)
    np.testing.assert_array_equal(np.bincount(rows.sensor), [1000, 1000])
    followed = dict(zip(seen.sensor.tolist(), seen.marker.tolist(), strict=True))
    assert all(followed[s] == m for s, m in zip(rows.sensor, rows.marker, strict=True))


def test_further_effects_stay_out_of_random_configurations(seen: Measurements) -> None:
    bare = predictive({'joint_4': 1e-3})
    n = len(seen)
    shifting = extension(
        ('shift',),
        ('m',),
        np.zeros((n, 7, 1)),
        np.ones((n, 3, 1)),
        np.zeros((n, 3)),
        np.zeros(1),
        np.zeros((1, 1)),
    )
    given = replace(
        bare,
        model=replace(bare.model, extension=shifting),
        after=np.append(bare.after, 0.0),
        draws=np.column_stack((bare.draws, np.full(DRAWS, 1e-3))),
    )
    invariant, _ = distances(given, seen)
    bare_distances, _ = distances(bare, seen)
    assert invariant.after.mean() > 2 * bare_distances.after.mean()
    same, _ = distances(given.without_extension(), seen)
    np.testing.assert_array_equal(same.after, bare_distances.after)


def test_the_map_has_the_error_that_a_joint_makes_at_each_place(seen: Measurements) -> None:
    """One joint with an uncertain offset: what a small turn of it moves, at each place."""
    given = predictive({'joint_2': 1e-3})
    found = predicted_accuracy(given, seen, 200, np.random.default_rng(1))
    q = random_configurations(given.model, seen, 200, np.random.default_rng(1)).q
    for place, error, joints in zip(found.place, found.error, q, strict=True):
        turned = [
            CHAIN.positions(joints, marker, np.eye(7)[1] * angle)
            for marker in ([0.1, 0.0, 0.02], [-0.1, 0.0, 0.02])
            for angle in (0.0, 1e-3)
        ]
        still = [turned[0], turned[2]]
        which = int(np.argmin([np.linalg.norm(place - point) for point in still]))
        np.testing.assert_allclose(place, still[which], atol=1e-12)
        moved = np.linalg.norm(turned[2 * which + 1] - turned[2 * which])
        # 300 draws know the mean of |x| to 4.4 %: five standard errors.
        assert error == pytest.approx(moved * np.sqrt(2 / np.pi), rel=0.22)


def test_the_places_of_one_configuration(seen: Measurements) -> None:
    given = predictive({'joint_4': 1e-3}, sigma_m=2e-4)
    row = 5
    found = tool_places(given, seen, row, DRAWS, np.random.default_rng(1))
    marker = [0.1, 0.0, 0.02] if seen.marker[row] == 0 else [-0.1, 0.0, 0.02]
    np.testing.assert_allclose(found.before, CHAIN.positions(seen.q[row], marker), atol=1e-12)
    applied = CHAIN.positions(seen.q[row], marker, given.mean_offsets)
    np.testing.assert_allclose(found.after, applied, atol=1e-12)
    # One joint turns the marker along a line; noise is a ball about it.
    about = found.drawn - found.drawn.mean(axis=0)
    sizes = np.linalg.svd(about, compute_uv=False)
    assert sizes[1] < 0.01 * sizes[0]
    # 900 numbers know a standard deviation to 2.4 %: five of them.
    assert np.std(found.noisy - found.drawn) == pytest.approx(2e-4, rel=0.12)
