# SPDX-License-Identifier: Apache-2.0
"""Held-out configurations that were fitted as well are counted, and prove nothing."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import scene

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.measured_again import SAME_RAD, MeasuredAgain
from remaster_ros.discovery.discover import discover_session
from remaster_ros.reports.discovery_json import discovery_content
from remaster_ros.reports.discovery_judgement import judgement
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.types import Measurements, Session


def again(m: Measurements, poses: int, away_rad: float = 0.0) -> Measurements:
    """Hold out the first poses of the fit once more, measured anew."""
    fitted = np.flatnonzero(~m.is_validation & np.isin(m.pose, np.unique(m.pose)[:poses]))
    rows = m.select(np.concatenate((np.arange(len(m)), fitted)))
    copy = np.arange(len(rows)) >= len(m)
    noise = 0.1e-3 * np.random.default_rng(0).standard_normal((len(rows), 3))
    return replace(
        rows,
        observation=np.arange(len(rows)),
        is_validation=rows.is_validation | copy,
        pose=rows.pose + 1000 * copy,
        configuration=rows.configuration + 1000 * copy,
        q=rows.q + away_rad * copy[:, None],
        position=rows.position + noise * copy[:, None],
    )


def healthy(validation: int) -> Session:
    return scene(12, poses=20, validation=validation, sigma_m=0.1e-3, pose_sigma_m=0.05e-3)[0]


@pytest.mark.parametrize(('distance', 'same'), [(0.8, True), (1.2, False)])
def test_configurations_are_compared_by_their_joint_angles(distance: float, same: bool) -> None:
    m = again(healthy(6).measurements, 4, distance * SAME_RAD)
    counted = MeasuredAgain.of(m)
    copies = len(np.unique(m.configuration[m.pose >= 1000]))
    assert counted.again == (copies if same else 0)
    assert counted.held_out == len(np.unique(m.configuration[m.is_validation]))
    assert bool(counted.words) == same


def test_poses_that_were_fitted_as_well_prove_nothing() -> None:
    session = healthy(0)
    session = replace(session, measurements=again(session.measurements, 12))
    judged = verdict(fit_session(session, rng=np.random.default_rng(1)))
    assert judged.mood == 'caution'
    assert 'on held-out poses, most of which were fitted as well' in judged.headline
    assert any('measure others and fit again' in point for point in judged.points)
    discovery = discover_session(session, rng=np.random.default_rng(1))
    assert discovery.verdict == 'none'
    page = judgement(discovery, None, discovery_content(discovery))
    assert page.mood == 'caution'
    assert any('were fitted as well' in point for point in page.doubts)


@pytest.mark.qualify
def test_a_few_of_many_are_said_and_no_more() -> None:
    session = healthy(15)
    assert verdict(fit_session(session, rng=np.random.default_rng(1))).mood == 'good'
    session = replace(session, measurements=again(session.measurements, 3))
    judged = verdict(fit_session(session, rng=np.random.default_rng(1)))
    assert judged.mood == 'good'
    assert any('were fitted as well' in point for point in judged.points)


def test_sessions_of_one_split_have_none() -> None:
    m = healthy(0).measurements
    assert MeasuredAgain.of(m) == MeasuredAgain(0, 0)
    held_out = replace(m, is_validation=np.ones(len(m), bool))
    assert MeasuredAgain.of(held_out).words == ''
