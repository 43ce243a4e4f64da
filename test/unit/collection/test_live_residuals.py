# SPDX-License-Identifier: Apache-2.0
"""Residuals beside a session: paired by settling, registered by least squares."""

from __future__ import annotations

import numpy as np
import pytest

from remaster_ros.collection.live_residuals import FEWEST, LiveResiduals
from remaster_ros.kinematics.transforms import apply, inverse, matrix_from_rpy, transform
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()
PLACES = {name: np.array(position) for name, position in CELL.markers.items()}
MARKERS = {'mocap': {'sir': PLACES['sir']}, 'tracker': {'smr': PLACES['smr']}}
T_R_N = transform(matrix_from_rpy(np.array([0.1, 0.2, 2.0])), np.array([1.9, 0.1, 1.3]))


def measured(rng, count, offsets=None, sigma_m=1e-4):
    """Return residuals after `count` configurations of an arm with these zero-offsets."""
    residuals = LiveResiduals(CHAIN, MARKERS)
    for _ in range(count):
        q = rng.uniform(-1.0, 1.0, len(CHAIN))
        residuals.settled(q)
        truth = apply(inverse(T_R_N), CHAIN.positions(q, PLACES['sir'], offsets))
        for _ in range(10):
            residuals.reading('mocap', 'sir', truth + rng.normal(0.0, sigma_m, 3))
        residuals.ended(recorded=True)
    return residuals


def test_a_perfect_arm_leaves_the_noise_of_the_mean():
    residuals = measured(np.random.default_rng(1), 60)
    norms = residuals.norms_m('mocap')
    assert len(norms) == 60
    # Three axes of sigma / sqrt(10), less the six parameters of the registration.
    assert np.sqrt(np.mean(norms**2)) == pytest.approx(1e-4 * np.sqrt(0.3), rel=0.15)
    assert len(residuals.norms_m('tracker')) == 0


def test_offsets_show_and_go_with_the_fit():
    offsets = np.deg2rad([0.0, 0.3, 0.0, -0.4, 0.2, 0.0, 0.0])
    residuals = measured(np.random.default_rng(2), 30, offsets)
    assert np.median(residuals.norms_m('mocap')) > 1e-3
    assert not residuals.corrected
    residuals.use_offsets(offsets)
    assert np.median(residuals.norms_m('mocap')) < 2e-4
    assert residuals.corrected


def test_points_are_those_in_the_base():
    rng = np.random.default_rng(3)
    residuals = LiveResiduals(CHAIN, MARKERS)
    expected = []
    for _ in range(FEWEST):
        q = rng.uniform(-1.0, 1.0, len(CHAIN))
        expected.append(CHAIN.positions(q, PLACES['smr']))
        residuals.settled(q)
        residuals.reading('tracker', 'smr', apply(inverse(T_R_N), expected[-1]))
        residuals.ended(recorded=True)
    assert np.allclose(residuals.points_R('tracker'), expected, atol=1e-9)


def test_what_was_not_recorded_or_came_in_motion_does_not_count():
    residuals = measured(np.random.default_rng(4), FEWEST - 1)
    residuals.reading('mocap', 'sir', np.array([9.0, 9.0, 9.0]))
    residuals.settled(np.zeros(len(CHAIN)))
    residuals.reading('mocap', 'sir', np.array([9.0, 9.0, 9.0]))
    residuals.reading('mocap', 'sir', np.array([np.nan, 0.0, 0.0]))
    residuals.ended(recorded=False)
    residuals.ended(recorded=True)
    assert len(residuals.norms_m('mocap')) == 0


def test_the_markers_of_one_frame_share_a_registration():
    rng, residuals = np.random.default_rng(5), LiveResiduals(CHAIN, {'mocap': PLACES})
    moved = {'sir': np.zeros(3), 'smr': np.array([0.0, 0.0, 1e-3])}
    for _ in range(20):
        q = rng.uniform(-1.0, 1.0, len(CHAIN))
        residuals.settled(q)
        for marker, by_m in moved.items():
            truth = CHAIN.positions(q, PLACES[marker] + by_m)
            residuals.reading('mocap', marker, apply(inverse(T_R_N), truth))
        residuals.ended(recorded=True)
    norms = residuals.norms_m('mocap')
    assert len(norms) == 40
    # Half of the millimetre stays with each of them, as only one of them was moved.
    assert np.median(norms) == pytest.approx(0.5e-3, rel=0.2)
    residuals.use_markers({'smr': PLACES['smr'] + moved['smr'], 'other': np.zeros(3)})
    assert np.max(residuals.norms_m('mocap')) < 1e-9
