# SPDX-License-Identifier: Apache-2.0
"""Orientation errors beside eq. 17 and 18, where a sensor measures full poses."""

from dataclasses import replace

import numpy as np
import pytest

import remaster_ros
from remaster_ros.calibration.evaluate_offsets import OffsetsJudgement, accuracy_with_offsets
from remaster_ros.calibration.orientation_accuracy import METRICS
from remaster_ros.cli.accuracy import table
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_rpy, quaternion_xyzw
from remaster_ros.reports.fit_page import accuracy_rows
from remaster_ros.reports.schemas import Accuracy

SIGMA_RAD = 0.2e-3
# Of the angle of three axes with this noise each (Maxwell).
NOISE_DEG = np.rad2deg(SIGMA_RAD * np.sqrt(8.0 / np.pi))


def oriented(made, R_T_B, seed):
    """Return the session of a simulated run whose bar measures a body's orientation, too."""
    rng = np.random.default_rng(seed)
    session, truth = made.session, made.truth
    m = session.measurements
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    R_R_T = chain.forward(m.q, truth.joint_offsets)[:, :3, :3]
    R_R_N = truth.sensors['mocap'].T_R_N[:3, :3]
    noise = [matrix_from_rpy(SIGMA_RAD * rng.standard_normal(3)) for _ in m.q]
    xyzw = [quaternion_xyzw(R_R_N.T @ R @ R_T_B @ turn) for R, turn in zip(R_R_T, noise)]
    mocap = m.sensor == session.sensor_names.index('mocap')
    orientation = np.where(mocap[:, None], xyzw, np.nan)
    # A dwell without an orientation now and then.
    orientation[::11] = np.nan
    return replace(session, measurements=replace(m, orientation=orientation))


@pytest.fixture(scope='module')
def made():
    print('seed 3')
    return remaster_ros.simulate(poses=16, validation_poses=8, seed=3)


def test_the_error_falls_to_the_noise_with_the_offsets_and_from_its_own_size_without(made):
    session = oriented(made, matrix_from_rpy(np.array([0.4, -0.2, 1.1])), 1)
    found = remaster_ros.fit(session)
    # What the offsets of the inner joints alone turn the tool by, roughly.
    size_deg = np.rad2deg(np.linalg.norm(made.truth.joint_offsets[1:6]))
    for split in ('optimization', 'validation'):
        metrics = found.accuracy[split]
        before, after = (metrics[METRICS[1]][side]['mean_deg'] for side in ('before', 'after'))
        assert 0.2 * size_deg < before < 2.0 * size_deg
        assert NOISE_DEG / 1.3 < after < 1.6 * NOISE_DEG
        low, high = metrics[METRICS[1]]['after']['interval95_deg']
        assert low < after < high
        before, after = (metrics[METRICS[0]][side]['mean_deg'] for side in ('before', 'after'))
        assert after < 2.0 * NOISE_DEG < before
    rows = accuracy_rows(Accuracy(**found.accuracy))
    assert sum(row['angular'] for row in rows) == 4
    lines = table(OffsetsJudgement(found.accuracy, ()))
    assert lines.count(' deg') == 8


def judged(session, made):
    """Return the metrics with the true offsets, without those that need draws."""
    offsets = made.truth.joint_offsets
    return accuracy_with_offsets(session, offsets, None, np.random.default_rng(0)).accuracy


def test_how_the_body_stands_on_the_tool_makes_no_difference(made):
    pairs = [
        judged(oriented(made, matrix_from_rpy(np.array(rpy)), 2), made)
        for rpy in ((0.0, 0.0, 0.0), (3.0, 1.2, -2.0))
    ]
    for metric in METRICS:
        plain_deg, turned_deg = (
            accuracy['validation'][metric]['before']['mean_deg'] for accuracy in pairs
        )
        # The noise is turned with the body, and differs.
        assert plain_deg == pytest.approx(turned_deg, rel=0.05)


def test_without_orientations_there_are_no_metrics_of_them(made):
    plain = judged(made.session, made)
    turned = judged(oriented(made, np.eye(3), 4), made)
    for split in ('optimization', 'validation'):
        assert not plain[split].keys() & set(METRICS)
        # Registrations and markers are fitted to the orientations as well.
        for metric, sides in plain[split].items():
            for side in ('before', 'after'):
                if isinstance(sides, dict) and sides.get(side):
                    mean = sides[side]['mean_mm']
                    assert turned[split][metric][side]['mean_mm'] == pytest.approx(mean, rel=0.1)
    rows = accuracy_rows(Accuracy(**plain))
    assert not any(row['angular'] for row in rows)
