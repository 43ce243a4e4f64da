# SPDX-License-Identifier: Apache-2.0
"""A sensor whose points are mirrored is refused by name, and no other."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import scene

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import Session


def mirrored(session: Session, sensor: int, signs: tuple[int, int, int]) -> Session:
    m = session.measurements
    turned = np.where((m.sensor == sensor)[:, None], np.array(signs), 1) * m.position
    return replace(session, measurements=replace(m, position=turned))


@pytest.mark.parametrize(('poses', 'seed'), [(6, 1), (30, 2)])
@pytest.mark.parametrize('signs', [(1, -1, 1), (-1, -1, -1)])
def test_a_mirrored_sensor_is_named_with_the_remedy(poses, seed, signs) -> None:
    session, _ = scene(seed, poses=poses, sensor_count=2)
    with pytest.raises(
        InsufficientDataError, match=r"'tracker'.*mirrored.*right-handed"
    ) as caught:
        estimate(Problem.of(mirrored(session, 1, signs)))
    assert 'mocap' not in str(caught.value)


def test_two_axes_turned_round_are_a_turn_of_the_sensor() -> None:
    session, truth = scene(3, poses=20)
    found = estimate(Problem.of(mirrored(session, 0, (-1, -1, 1))))
    std = np.sqrt(np.diag(found.mode.covariance))[: len(found.posterior.free)]
    joints = found.posterior.free[found.posterior.free < 6]
    error = found.mode.z[joints] - truth.joint_offsets[joints]
    assert np.all(np.abs(error) < 5.0 * std[: len(joints)])


@pytest.mark.parametrize('joint', [1, 3, 4])
def test_a_joint_that_turns_the_other_way_is_not_called_a_mirrored_sensor(joint) -> None:
    session, _ = scene(4, poses=30)
    q = session.measurements.q.copy()
    q[:, joint] *= -1.0
    with pytest.raises(InsufficientDataError) as caught:
        estimate(Problem.of(replace(session, measurements=replace(session.measurements, q=q))))
    assert 'check units, joint order and signs' in str(caught.value)
