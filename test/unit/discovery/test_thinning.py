# SPDX-License-Identifier: Apache-2.0
"""A large session is searched in part, evenly; a small one as it is."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN
from worlds.discovery_scenes import at_joint, discovered, session_with

from remaster_ros.discovery import discover, residuals
from remaster_ros.discovery.thinning import FEWEST_POSES, MOST_ROWS, draw_rows, of_spread_poses
from remaster_ros.types import Measurements


def measurements(poses, rows, sensors=1, rare=0):
    """Return rows of poses in the order of time; `rare` poses are seen by another sensor too."""
    pose = np.repeat(np.arange(poses), rows * sensors)
    sensor = np.tile(np.repeat(np.arange(sensors), rows), poses)
    extra = np.linspace(0, poses - 1, rare).astype(int)
    pose = np.concatenate((pose, extra))
    sensor = np.concatenate((sensor, np.full(rare, sensors)))
    order = np.argsort(pose, kind='stable')
    pose, sensor = pose[order], sensor[order]
    n = len(pose)
    return replace(
        Measurements.empty(2), pose=pose, sensor=sensor, stamp_s=np.arange(n, dtype=float)
    )


def rng():
    return np.random.default_rng(7)


def test_few_rows_are_all_searched_and_no_random_number_is_drawn():
    m = measurements(100, 5)
    rows, unused = np.arange(3, 500), rng()
    assert draw_rows(m, rows, unused, most=497) is rows
    assert unused.random() == rng().random()


def test_whole_poses_are_drawn_evenly_over_time():
    m = measurements(20_000, 5)
    rows = np.arange(len(m.pose))
    drawn = draw_rows(m, rows, rng(), most=10_000)
    assert len(drawn) == 10_000
    poses, count = np.unique(m.pose[drawn], return_counts=True)
    assert set(count.tolist()) == {5}, 'whole poses'
    assert (np.diff(np.searchsorted(poses, np.arange(0, 20_001, 1000))) == 100).all()
    assert len(set(np.diff(poses).tolist())) > 5, 'no comb that a periodic effect could hide in'
    assert (np.diff(drawn) > 0).all()


@pytest.mark.parametrize('every', [2, 3, 4, 5])
@pytest.mark.parametrize('markers', [1, 2, 3, 4, 5])
def test_spread_poses_are_no_comb(every, markers):
    """Of two sensors that measure by turns, and of markers of which each pose has the next."""
    m = measurements(every * MOST_ROWS // 2, 1, sensors=2)
    m = replace(m, marker=m.pose % markers)
    drawn = of_spread_poses(m, np.arange(len(m.pose)))
    assert 0.99 * MOST_ROWS < len(drawn) < 1.01 * MOST_ROWS
    assert len(set(m.pose[drawn].tolist())) == len(drawn) // 2, 'whole poses'
    share = np.bincount(m.marker[drawn], minlength=markers) * markers / len(drawn)
    assert np.abs(share - 1.0).max() < 0.05
    assert of_spread_poses(m, np.arange(MOST_ROWS)).tolist() == list(range(MOST_ROWS))


def test_few_poses_with_many_rows_are_all_kept():
    m = measurements(60, 1000, sensors=2)
    drawn = draw_rows(m, np.arange(len(m.pose)), rng(), most=12_000)
    groups = np.unique(m.pose[drawn] * 2 + m.sensor[drawn], return_counts=True)
    assert len(groups[0]) == 120
    assert set(groups[1].tolist()) == {100}


def test_of_many_poses_with_many_rows_some_rows_of_some_poses_are_drawn():
    """However the rows lie, about as many are drawn as were asked for."""
    for rows in (11, 20, 100):
        m = measurements(100_000 // rows, rows)
        drawn = draw_rows(m, np.arange(len(m.pose)), rng(), most=5000)
        poses, count = np.unique(m.pose[drawn], return_counts=True)
        assert len(poses) == FEWEST_POSES
        assert (np.diff(poses) > 0).all()
        assert poses[-1] - poses[0] > 0.99 * (100_000 // rows)
        assert count.min() >= 2
        assert 4500 <= len(drawn) <= 5500


def test_a_sensor_that_is_rarely_there_keeps_its_poses():
    m = measurements(20_000, 5, rare=400)
    drawn = draw_rows(m, np.arange(len(m.pose)), rng(), most=10_000)
    assert np.sum(m.sensor[drawn] == 1) == 400
    assert len(drawn) < 10_000 + FEWEST_POSES * 6


def test_only_rows_that_were_given_are_drawn():
    m = measurements(20_000, 5)
    rows = np.flatnonzero(m.pose % 4 == 1)
    drawn = draw_rows(m, rows, rng(), most=5000)
    assert np.isin(drawn, rows).all()
    assert len(drawn) == 5000


def sagging(session):
    return at_joint(2, 5e-5 * CHAIN.gravity_torque(session.measurements.q)[:, 1])


@pytest.mark.qualify
def test_a_part_tells_the_cause_and_the_other_rows_confirm_it(monkeypatch):
    session = session_with(21, sagging, poses=120)
    full_result = discovered(session)
    assert full_result.thinning is None
    monkeypatch.setattr(discover, 'draw_rows', partial(draw_rows, most=250))
    part = discovered(session)
    for found in (full_result, part):
        assert [(e.name, e.joints) for e in found.effects] == [('joint_compliance', (2,))]
    thinning = part.thinning
    fitted = int(np.sum(~session.measurements.is_validation))
    assert 200 < thinning.searched < 300 < thinning.rows <= fitted
    assert len(part.residuals) == thinning.searched
    assert thinning.others_rms_after_m < 0.8 * thinning.others_rms_before_m
    (parameter,), (other,) = part.effects[0].parameters, full_result.effects[0].parameters
    assert abs(parameter.value - 5e-5) < 4.0 * parameter.std
    # Fewer rows were searched; what was found is fitted to all of them.
    assert abs(parameter.value - other.value) < other.std
    assert 0.8 < parameter.std / other.std < 1.25


@pytest.mark.qualify
def test_nothing_in_a_part_is_nothing_in_the_rest(monkeypatch):
    monkeypatch.setattr(discover, 'draw_rows', partial(draw_rows, most=250))
    part = discovered(session_with(22, poses=120))
    assert part.effects == ()
    assert part.thinning.others_rms_after_m == part.thinning.others_rms_before_m


@pytest.mark.qualify
def test_forgotten_displacements_are_computed_again(monkeypatch):
    """What is kept is bounded in bytes; the results are the same."""
    session = session_with(21, sagging)
    kept = discovered(session)
    monkeypatch.setattr(residuals, 'KEPT_BYTES', 1)
    forgotten = discovered(session)
    assert len(forgotten.residuals._displacements) == 1
    for parameter, other in zip(
        forgotten.effects[0].parameters, kept.effects[0].parameters, strict=True
    ):
        # But for rounding: products are summed in another order.
        assert (parameter.value, parameter.std) == pytest.approx(
            (other.value, other.std), rel=1e-9
        )
    assert forgotten.solution.log_evidence == pytest.approx(kept.solution.log_evidence, rel=1e-9)


@pytest.mark.qualify
def test_what_a_fit_leaves_does_not_depend_on_blocks(monkeypatch):
    found = discovered(session_with(21, sagging))
    data, solution = found.residuals, found.solution
    full_residuals = data.unexplained(solution)
    blocks = type(data.context).blocks
    monkeypatch.setattr(type(data.context), 'blocks', lambda scene: blocks(scene, 7))
    np.testing.assert_allclose(data.unexplained(solution), full_residuals, rtol=0.0, atol=1e-12)
