# SPDX-License-Identifier: Apache-2.0
"""A simulated session is what its truth says, and looks like a recorded one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN, MARKERS, URDF, random_poses, scene, sensors

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import apply
from remaster_ros.simulation.simulated_session import simulate_session


def test_without_noise_it_measures_the_true_robot() -> None:
    session, truth = scene(
        51, poses=5, validation=3, sensor_count=2, sigma_m=0.0, pose_sigma_m=0.0
    )
    rows = session.measurements
    for index, (name, sensor) in enumerate(truth.sensors.items()):
        mine = rows.sensor == index
        points = CHAIN.positions(
            rows.q[mine], truth.markers[session.sensors[name]], truth.joint_offsets
        )
        np.testing.assert_allclose(apply(sensor.T_R_N, rows.position[mine]), points, atol=1e-12)
    assert set(rows.pose[rows.is_validation]).isdisjoint(rows.pose[~rows.is_validation])
    assert len(set(rows.pose)) == 8


def test_noise_has_the_two_parts_asked_for() -> None:
    """150 poses: the estimates of sigma and pose_sigma are good to 3 % and 6 %; five of those."""
    session, truth = scene(52, poses=150, sigma_m=0.2e-3, pose_sigma_m=0.7e-3)
    rows = session.measurements
    points = CHAIN.positions(rows.q, truth.markers['sir'], truth.joint_offsets)
    errors = apply(truth.sensors['mocap'].T_R_N, rows.position) - points
    poses = [errors[rows.pose == pose] for pose in np.unique(rows.pose)]
    within = np.sum([np.sum((e - e.mean(axis=0)) ** 2) for e in poses])
    spare = 3 * sum(len(e) - 1 for e in poses)
    assert np.sqrt(within / spare) == pytest.approx(0.2e-3, rel=0.15)
    means = np.array([e.mean(axis=0) for e in poses])
    assert means.std() == pytest.approx(0.7e-3, rel=0.3)


def test_outliers_are_in_the_truth_and_nowhere_else() -> None:
    session, truth = scene(53, poses=40, outlier_share=0.05, outlier_m=0.02)
    rows = session.measurements
    points = CHAIN.positions(rows.q, truth.markers['sir'], truth.joint_offsets)
    errors = np.linalg.norm(apply(truth.sensors['mocap'].T_R_N, rows.position) - points, axis=1)
    assert truth.outliers
    assert sorted(np.flatnonzero(errors > 0.01)) == sorted(truth.outliers)


def test_the_same_seed_gives_the_same_session() -> None:
    first, second = (scene(54, poses=4)[0].measurements for _ in range(2))
    np.testing.assert_array_equal(first.position, second.position)


def test_it_survives_the_disk(tmp_path: Path) -> None:
    from remaster_ros.session.records.reader import read_session, write_session

    session, _ = scene(55, poses=4, validation=2, sensor_count=2)
    write_session(tmp_path / 'session', session)
    again = read_session(tmp_path / 'session')
    np.testing.assert_allclose(
        again.measurements.position, session.measurements.position, atol=1e-9
    )
    assert again.marker_std_m == session.marker_std_m


def test_wrong_input_is_named() -> None:
    rng = np.random.default_rng(1)
    poses = random_poses(2, rng)
    good = sensors(rng)
    with pytest.raises(InputError, match="marker 'sir'"):
        simulate_session(CHAIN, URDF, rng, poses=poses, sensors=good, markers={})
    with pytest.raises(InputError, match='nothing to simulate'):
        simulate_session(CHAIN, URDF, rng, poses=[], sensors=good, markers=MARKERS)
    with pytest.raises(InputError, match='7 joints'):
        simulate_session(CHAIN, URDF, rng, poses=[poses[0][:, :6]], sensors=good, markers=MARKERS)


def test_given_offsets_are_used() -> None:
    rng = np.random.default_rng(2)
    offsets = np.linspace(-0.01, 0.01, 7)
    sensor = {name: replace(s, sigma_m=0.0) for name, s in sensors(rng).items()}
    _, truth = simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=random_poses(2, rng),
        sensors=sensor,
        markers=MARKERS,
        joint_offsets=offsets,
    )
    np.testing.assert_array_equal(truth.joint_offsets, offsets)


def test_reflectors_that_are_measured_one_after_another_share_no_frame() -> None:
    rng = np.random.default_rng(5)
    two = sensors(rng, 2)
    two['mocap'] = replace(two['mocap'], further={'smr': 2})
    two['tracker'] = replace(two['tracker'], further={'sir': 2}, single_shot=True)
    session, _ = simulate_session(
        CHAIN, URDF, rng, poses=random_poses(4, rng), sensors=two, markers=MARKERS
    )
    rows = session.measurements
    shot = rows.sensor == session.sensor_names.index('tracker')
    assert np.all(rows.frame[shot] == -1)
    np.testing.assert_array_equal(rows.frame[~shot], rows.configuration[~shot])
    assert len(rows) == 4 * len(set(rows.configuration.tolist()))
