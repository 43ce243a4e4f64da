# SPDX-License-Identifier: Apache-2.0
"""What a fit knows with the noise integrated out, and how much more data a goal takes."""

from functools import lru_cache

import numpy as np
import pytest
from worlds.designed_sessions import measured
from worlds.stopping_scene import world

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.precision import NoiseMixture, Precision
from remaster_ros.collection.stopping_rule import so_far

SEED = 3


@lru_cache
def session(count):
    of = world(1)
    drawn = measured(of.chain, of.urdf, (of.q, of.pose), of.sensors, np.random.default_rng(SEED))
    return so_far(drawn[0], count)[0]


def precision(count=24, counting=None):
    found = estimate(Problem.of(session(count)))
    everywhere = np.ones(len(session(count).measurements), bool)
    rng = np.random.default_rng(0)
    return Precision.of(found, everywhere if counting is None else counting, rng)


def test_the_standard_deviations_are_those_of_the_draws_of_a_fit():
    print('seed', SEED)
    drawn = fit_session(session(24), rng=np.random.default_rng(1))
    found = precision(24)
    assert found.joint_std[0] is None
    inner = np.array(found.joint_std[1:6], dtype=float)
    # Both to a percent or two.
    np.testing.assert_allclose(inner, drawn.joint_offsets_std[1:6], rtol=0.06)


def test_few_data_leave_the_noise_open_and_the_parameters_with_it():
    found = estimate(Problem.of(session(8)))
    total = NoiseMixture.of(found.mode, np.random.default_rng(0)).total
    ratio = np.sqrt(np.diag(total) / np.diag(found.mode.covariance))
    assert np.all(ratio[:5] > 1.0)
    assert np.median(ratio[:5]) > 1.05


def test_so_many_times_the_data_reach_a_goal_and_not_fewer():
    few, many_poses = precision(24), precision(48)
    times = few.times_the_data(many_poses.joint_rms, None)
    # The second half of the poses tells about as much as the first.
    assert 1.5 < times < 3.0
    assert few.times_the_data(few.joint_rms * 1.001, few.tool_rms * 1.001) == 1.0
    assert few.times_the_data(None, few.tool_rms / 2) == pytest.approx(4.0, rel=0.25)
    assert few.times_the_data(few.joint_rms / 1000, None) == np.inf


def test_without_a_row_in_the_box_nothing_is_known_of_the_tool():
    found = precision(24, np.zeros(24, bool))
    assert found.tool is None
    assert found.tool_rms == np.inf
    assert np.isfinite(found.joint_rms)
