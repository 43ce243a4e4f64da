# SPDX-License-Identifier: Apache-2.0
"""Accuracy of any session of a robot with given zero-offsets: `remaster accuracy`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from remaster_ros.calibration.accuracy import accuracy_of
from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Estimate, Problem, mode_at_offsets
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.linearisation import linearise
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.orientation_accuracy import tool_orientations
from remaster_ros.calibration.predictive_accuracy import Predictive
from remaster_ros.errors import InputError
from remaster_ros.types import FloatArray, Session

DRAWS = 2000


@dataclass(frozen=True)
class OffsetsJudgement:
    """Accuracy of a session without and with given offsets."""

    accuracy: dict[str, Any]  # The three metrics before and after, as fit.json has them
    # (observation, reason) of each gross error, which is neither fitted nor in the metrics of the
    # optimization rows
    left_out: tuple[tuple[int, str], ...]


def accuracy_with_offsets(
    session: Session,
    joint_offsets: FloatArray,
    joint_offsets_std: FloatArray | None,
    rng: np.random.Generator,
) -> OffsetsJudgement:
    """Compare a session with the robot without and with given zero-offsets.

    Registrations and markers are fitted to the session's optimization rows (to all rows if it has
    none), once with the offsets at zero and once with the given ones, and applied to all rows.
    Offsets that a registration or a marker absorbs, such as that of joint 1, therefore do not
    count.

    The theoretical metric (section V-C of Van Wyk et al.) draws the offsets from independent
    Gaussians about the given ones, and registrations and markers from their posterior given these
    offsets. Correlations between the offsets are not in fit.json.

    Parameters
    ----------
    session
        Any session of this robot.
    joint_offsets
        rad, (k,).
    joint_offsets_std
        rad, (k,); 0 for joints that are not identifiable, which are not drawn. None for no
        theoretical metric.
    rng
        Source of all randomness.

    Raises
    ------
    InputError
        Offsets of another robot.
    InsufficientDataError
        A session that does not determine registrations and markers.
    """
    if not np.any(~session.measurements.is_validation):
        everything = np.zeros(len(session.measurements), dtype=bool)
        session = replace(
            session, measurements=replace(session.measurements, is_validation=everything)
        )
    problem = Problem.of(session)
    for values in (joint_offsets, joint_offsets_std):
        if values is not None and np.shape(values) != (len(problem.chain),):
            raise InputError(
                f'{np.size(values)} zero-offsets for a robot of {len(problem.chain)} joints'
            )
    found = sound_estimate(session)
    model = found.model
    given = mode_at_offsets(found.mode, np.asarray(joint_offsets, dtype=float))
    predicted_before = predicted_rows(problem, model, found.before.z)
    predicted_after = predicted_rows(problem, model, given.z)
    predictive = None
    if joint_offsets_std is not None:
        predictive = Predictive(
            model=model,
            after=given.z,
            draws=_draws(found, given, joint_offsets_std, rng),
            sigma=np.tile(
                found.posterior.noise_model.total_noise(found.posterior.noise(given.eta)),
                (DRAWS, 1, 1),
            ),
        )
    accuracy = accuracy_of(
        problem.measurements,
        found.kept,
        predicted_before,
        predicted_after,
        None if predictive is None else (predictive, found.before.z),
        rng,
        tool_orientations(model, problem.measurements, found.before.z, given.z),
    )
    observation = problem.measurements.observation
    left_out = tuple((int(observation[row]), why) for row, why in found.left_out)
    return OffsetsJudgement(accuracy, left_out)


def _draws(
    found: Estimate, given: Mode, joint_offsets_std: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Draws of offsets, and of registrations and markers given them, pinned, (2000, size).

    Offsets of the inner joints are independent Gaussians about ``given`` with the stds, rad or m,
    (k,); the others follow from the linearised posterior at ``given``.
    """
    model = found.model
    joints = np.arange(1, model.joints - 1)
    # In pinned coordinates the outer two joints move nothing.
    joints = joints[joint_offsets_std[joints] > 0.0]
    nuisance = np.arange(model.joints, model.size)
    everything = replace(found.posterior, free=np.arange(model.size), reference=given.z)
    information = linearise(everything, given.z).gram(given.eta)[:-1, :-1]
    scale = 1.0 / np.sqrt(np.diag(information)[nuisance])
    factor = np.linalg.cholesky(information[np.ix_(nuisance, nuisance)] * np.outer(scale, scale))

    shift = joint_offsets_std[joints] * rng.standard_normal((DRAWS, len(joints)))
    pull = shift @ (information[np.ix_(joints, nuisance)] * scale)
    noise = rng.standard_normal((DRAWS, len(nuisance)))
    answer = np.linalg.solve(factor.T, noise.T - np.linalg.solve(factor, pull.T)).T * scale
    draws = np.tile(given.z, (DRAWS, 1))
    draws[:, joints] += shift
    draws[:, nuisance] += answer
    return draws
