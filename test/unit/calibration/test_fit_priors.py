# SPDX-License-Identifier: Apache-2.0
"""Priors that a user gives take part in the fit, and are reported where they decide."""

import numpy as np
import pytest
from worlds.calibration_scenes import scene

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.types import BasePrior, Priors


@pytest.fixture(scope='module')
def measured():
    return scene(61, poses=15)


def test_a_prior_on_joint_1_determines_it_and_is_reported(measured) -> None:
    session, _ = measured
    priors = Priors(joint_offsets={'joint_1': (0.004, 0.001)})
    result = fit_session(session, rng=np.random.default_rng(1), priors=priors)
    assert not result.identifiable[0]
    assert result.gauge[0].fixed_by == 'the prior on joint_1, 0.0572958 deg'
    # The data do not determine it: the posterior is the prior, to five standard errors.
    assert result.joint_offsets[0] == pytest.approx(0.004, abs=5 * 0.001 / np.sqrt(2500))
    assert result.joint_offsets_std[0] == pytest.approx(0.001, rel=0.1)


def test_a_measured_marker_tightens_the_last_joint(measured) -> None:
    session, truth = measured
    usual = fit_session(session, rng=np.random.default_rng(2))
    priors = Priors(markers={'sir': (truth.markers['sir'], 2e-5)})
    known = fit_session(session, rng=np.random.default_rng(2), priors=priors)
    assert known.joint_offsets_std[6] < 0.5 * usual.joint_offsets_std[6]
    assert 'the prior on marker sir, 0.02 mm per axis' in known.why[6]
    error = known.joint_offsets - truth.joint_offsets
    # Four and a half standard deviations: 1 in 20,000 over the joints but the first.
    assert np.all(np.abs(error[1:]) < 4.5 * known.joint_offsets_std[1:])


def test_a_known_base_frame_replaces_the_session_s(measured) -> None:
    session, truth = measured
    T = truth.sensors['mocap'].T_R_N
    base = BasePrior(T[:3, 3], quaternion_xyzw(T[:3, :3]), 1e-3, 1e-3)
    gauge = estimate(Problem.of(session, Priors(base={'mocap': base}))).gauge
    assert gauge.held.tolist() == []
    assert gauge.directions[0].fixed_by == 'the prior on the base frame of mocap'


@pytest.mark.parametrize(
    ('priors', 'words'),
    [
        (Priors(joint_offsets={'joint_9': (0.0, 1.0)}), "joint 'joint_9'"),
        (Priors(markers={'ball': (np.zeros(3), 1.0)}), "marker 'ball'"),
        (Priors(base={'eye': BasePrior(np.zeros(3), np.eye(4)[3], 1.0, 1.0)}), "sensor 'eye'"),
    ],
)
def test_priors_on_what_is_not_there_are_refused(measured, priors, words: str) -> None:
    with pytest.raises(InputError, match=words):
        fit_session(measured[0], rng=np.random.default_rng(3), priors=priors)


def test_the_paper_s_model_takes_no_priors(measured) -> None:
    with pytest.raises(InputError, match='fast sampler'):
        fit_session(measured[0], rng=np.random.default_rng(4), sampler='paper', priors=Priors())
