# SPDX-License-Identifier: Apache-2.0
"""Several markers of a tool in one frame: files, fit and search."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.designed_sessions import measured

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.discovery.discover import discover_session
from remaster_ros.planning.expected_sensors import ExpectedSensor
from remaster_ros.reports.fit_json import read_fit
from remaster_ros.reports.result_folder import save_fit
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.reader import read_session, write_session

CELL = read_cell('demo')
CHAIN = CELL.chain()
SEED = 41
BODY = {
    'a': np.array([0.1, 0, 0]),
    'b': np.array([-0.1, 0, 0]),
    'c': np.array([0, 0.1, 0]),
    'd': np.array([0, 0, 0.06]),
}


def bar(*names, frame_sigma_m=0.0):
    markers = {name: BODY[name] for name in names}
    place = np.array([1.9, 0, 1.3])
    return (ExpectedSensor('bar', place, markers, frame_sigma_m=frame_sigma_m),)


@pytest.fixture(scope='module')
def configurations():
    scene = CELL.planning_scene(CHAIN)
    poses = scene.plan(30, scene.rough_R, np.random.default_rng(1)).poses
    q = np.concatenate([pose.solutions[:3] for pose in poses])
    return q, np.repeat(np.arange(len(poses)), [len(pose.solutions[:3]) for pose in poses])


def test_markers_of_a_frame_make_the_offsets_more_certain_and_the_intervals_hold(configurations):
    print('seed', SEED)
    rng = np.random.default_rng(SEED)
    inner = range(1, 6)
    stds, inside_count = {}, 0
    for names in (('a',), ('a', 'b', 'c', 'd')):
        spread = []
        for _ in range(15):
            session, offsets = measured(CHAIN, CELL.urdf_text, configurations, bar(*names), rng)
            found = estimate(Problem.of(session))
            free = found.posterior.free.tolist()
            std = np.sqrt(np.diag(found.mode.covariance))[[free.index(j) for j in inner]]
            error = found.model.offsets(found.model.natural(found.mode.z)) - offsets
            error = error[1:6]
            inside_count += int(np.sum(np.abs(error) < 1.96 * std))
            spread.append(std)
        stds[len(names)] = np.sqrt(np.mean(np.square(spread)))
    assert stds[4] < 0.6 * stds[1]
    # 95 % of 150; 132 or fewer come by chance in less than 1 of 1,000 cases.
    assert inside_count > 132


def errors(session, offsets):
    """Return the inner offsets' errors in standard deviations, and the noise of the channel."""
    found = estimate(Problem.of(session))
    free = found.posterior.free.tolist()
    std = np.sqrt(np.diag(found.mode.covariance))[[free.index(joint) for joint in range(1, 6)]]
    x = found.model.natural(found.mode.z)
    noise = found.posterior.noise(found.mode.eta)
    parts = noise.sigma[0], noise.pose_sigma[0], noise.frame_sigma[0]
    return (found.model.offsets(x) - offsets)[1:6] / std, parts


@pytest.mark.parametrize(
    'hidden',
    [
        pytest.param(0.0, id='all seen', marks=pytest.mark.qualify),
        pytest.param(0.3, id='30 % hidden'),
    ],
)
def test_noise_that_a_frame_shares_is_found_and_the_intervals_hold(configurations, hidden):
    """Of 1,000 intervals of 200 sessions 939, with markers hidden 961, held; 676 without it."""
    print('seed', SEED)
    rng = np.random.default_rng(SEED)
    few = configurations[1] < 12
    chosen = configurations[0][few], configurations[1][few]
    sensors = bar('a', 'b', 'c', 'd', frame_sigma_m=0.2e-3)
    z, noise = [], []
    for _ in range(20):
        session, offsets = measured(CHAIN, CELL.urdf_text, chosen, sensors, rng)
        seen = rng.random(len(session.measurements)) >= hidden
        scaled, parts = errors(session.select(seen), offsets)
        z.append(scaled)
        noise.append(parts)
    np.testing.assert_allclose(np.median(noise, axis=0), (0.1e-3, 0.2e-3, 0.2e-3), rtol=0.3)
    # 95 % of 100; 86 or fewer come by chance in less than 1 of 1,000 cases.
    assert np.sum(np.abs(z) < 1.96) > 86
    # A joint's errors are as large as they are said to be: 20 sessions, chi-squared at 1 in 1,000.
    assert np.sqrt(np.mean(np.square(z))) < 1.35


def test_without_the_frames_the_same_sessions_are_too_certain(configurations):
    """What the third level is for: the same rows as if every marker were measured by itself."""
    print('seed', SEED)
    rng = np.random.default_rng(SEED)
    sensors = bar('a', 'b', 'c', 'd', frame_sigma_m=0.2e-3)
    z = []
    for _ in range(8):
        session, offsets = measured(CHAIN, CELL.urdf_text, configurations, sensors, rng)
        frameless_rows = replace(session.measurements, frame=None)
        z.append(errors(replace(session, measurements=frameless_rows), offsets)[0])
    assert np.sqrt(np.mean(np.square(z))) > 1.4


@pytest.mark.qualify
def test_frames_of_four_markers_go_through_file_fit_and_search(configurations, tmp_path):
    print('seed', SEED)
    rng = np.random.default_rng(SEED)
    sensors = bar(*BODY, frame_sigma_m=0.2e-3)
    made, offsets = measured(CHAIN, CELL.urdf_text, configurations, sensors, rng)
    made.measurements.is_validation[:] = made.measurements.pose % 4 == 3
    made = replace(made, further_markers={'bar': ('b', 'c', 'd')})
    write_session(tmp_path / 'session', made)
    session = read_session(tmp_path / 'session')
    assert session.marker_names == ('a', 'b', 'c', 'd')
    assert len(session.measurements) == 4 * len(configurations[0])
    assert session.further_markers == {'bar': ('b', 'c', 'd')}
    np.testing.assert_array_equal(session.measurements.frame, made.measurements.frame)
    found = fit_session(session, rng=np.random.default_rng(0))
    z = ((found.joint_offsets - offsets) / found.joint_offsets_std)[1:6]
    assert np.max(np.abs(z)) < 4.0
    save_fit(found, tmp_path / 'fit')
    noise = read_fit(tmp_path / 'fit' / 'fit.json').noise['bar']
    for key, level in (('sigma_m', 1e-4), ('pose_sigma_m', 2e-4), ('frame_sigma_m', 2e-4)):
        assert getattr(noise, key) == pytest.approx(level, rel=0.4), key
    assert noise.frame_std_m < 0.5 * noise.frame_sigma_m
    assert found.sampler.converged, found.sampler.message
    assert found.accuracy['validation']['relative']['after']['mean_mm'] < 0.6
    # Nothing is wrong with the arm: errors that four rows share are no cause.
    assert discover_session(session, rng=np.random.default_rng(0)).verdict == 'none'
