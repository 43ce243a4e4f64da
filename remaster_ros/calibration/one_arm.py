# SPDX-License-Identifier: Apache-2.0
"""Test whether two sessions were measured with one arm, by the zero-offsets of either session.

A joint fit of two arms gives the offsets of neither, with a smaller error all the same. With the
offsets δ₁ and δ₂ of the sessions, and their covariances C₁ and C₂ widened by errors outside the
model, one arm has::

  δ₁ − δ₂ ~ N(0, C₁ + C₂ + (B₁ − B₂) S (B₁ − B₂)' + f² (B₁ S B₁' + B₂ S B₂'))

where B = (A'WA + P)⁻¹ A'WZ is the response of the offsets to deviations Z of links and axes from
their drawing, with the variances S of its tolerance. The arm has the same deviations in both
sessions, so that only the difference of the responses counts, and a share f of either: lengths and
tilts do not describe all of an arm's deviations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtrc

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.gauge_words import listed
from remaster_ros.calibration.identifiability import OPEN_ANGLE
from remaster_ros.calibration.robust_std import robust_std
from remaster_ros.calibration.smooth_functions import of_links, spread_poses, whitened
from remaster_ros.types import BoolArray, FloatArray

# Probability that sessions of one arm are taken for sessions of two.
FALSE = 1e-4
# Difference of an offset between two arms, in standard deviations.
DIFFERENT_SIGMAS = 3.0
# Share f of the offsets' response to links and axes off their drawing that differs by session.
SESSION_SHARE = 0.3


@dataclass(frozen=True)
class OffsetDifferences:
    """Differences of the zero-offsets of two sessions; j joints that both determine."""

    joints: tuple[str, ...]
    sigmas: FloatArray  # Differences, second less first, over their standard deviations, (j,)
    p_value: float  # Probability of such differences with one arm, all joints together

    @property
    def differ(self) -> bool:
        """Whether the two sessions have different offsets: ``p_value`` below 1e-4 (`FALSE`)."""
        return self.p_value < FALSE

    @property
    def mostly(self) -> bool:
        """Whether the offsets `differ`, half of them or more by over 3 standard deviations."""
        return self.differ and bool(
            2 * np.sum(np.abs(self.sigmas) > DIFFERENT_SIGMAS) >= len(self.sigmas)
        )

    @property
    def words(self) -> str:
        """Joints that differ by over 3 standard deviations, as text, with that number of each.

        Such as 'a by 4 and b by 7 standard deviations'; 'a, b and c taken together', with all
        joints, if there is no such joint.
        """
        shown = [
            f'{joint} by {abs(by):.0f}'
            for joint, by in zip(self.joints, self.sigmas, strict=True)
            if abs(by) > DIFFERENT_SIGMAS
        ]
        if not shown:
            return f'{listed(self.joints)} taken together'
        return f'{listed(shown)} standard deviations'


def offset_differences(first: Estimate, second: Estimate) -> OffsetDifferences | None:
    """Differences of the zero-offsets of two sessions of the same robot description.

    Second less first. None if no joint's offset is determined by both, to a standard deviation of
    1 degree (`OPEN_ANGLE`, times ``per_radian`` for a slide).
    """
    sessions = [_SessionOffsets.of(found) for found in (first, second)]
    known = np.logical_and(*(session.known for session in sessions))
    if not known.any():
        return None
    size = np.maximum(*(session.size for session in sessions))
    responses = [session.response * size for session in sessions]
    either = sum(response @ response.T for response in responses)
    between = responses[0] - responses[1]
    variance = sessions[0].covariance + sessions[1].covariance
    variance += between @ between.T + SESSION_SHARE**2 * either
    variance = variance[np.ix_(known, known)]
    difference = (sessions[1].offsets - sessions[0].offsets)[known]
    scale = np.sqrt(np.diag(variance))
    sigmas = difference / scale
    root = cho_factor(variance / np.outer(scale, scale), lower=True)
    square = float(sigmas @ cho_solve(root, sigmas))
    names = first.problem.chain.joint_names
    return OffsetDifferences(
        tuple(names[joint] for joint in np.flatnonzero(known)),
        sigmas,
        float(chdtrc(len(sigmas), square)),
    )


@dataclass(frozen=True, eq=False)
class _SessionOffsets:
    """Zero-offsets of a session, rad or m, and their response to errors of the arm's geometry.

    k joints, m geometric errors.
    """

    offsets: FloatArray  # (k,)
    known: BoolArray  # Whether the session determines each, (k,)
    covariance: FloatArray  # Widened by errors outside the model, (k, k)
    # Change of each offset by a metre or radian of each link and axis, (k, m)
    response: FloatArray
    size: FloatArray  # Deviation of each link and axis from its drawing, m or rad, (m,)

    @classmethod
    def of(cls, found: Estimate) -> _SessionOffsets:
        """Zero-offsets of a fit, with covariance, and their response to geometric errors.

        Geometric errors are a displacement and a tilt of each joint's frame. Standard
        deviations are at least those with smooth errors outside the model (`robust_std`).
        """
        mode, problem = found.mode.of_points, found.problem
        posterior = mode.linearisation.posterior
        model, free = posterior.model, posterior.free
        joints = np.flatnonzero(free < model.joints)
        indices = free[joints]
        k = model.joints
        covariance = np.zeros((k, k))
        covariance[np.ix_(indices, indices)] = mode.covariance[np.ix_(joints, joints)]
        std = np.sqrt(np.diag(covariance))
        widening = np.ones(k)
        widening[indices] = np.maximum(
            1.0, robust_std(mode, problem.measurements)[indices] / std[indices]
        )
        rows = spread_poses(posterior.rows.of_points)
        links, tilts = of_links(mode, rows)
        white = whitened(mode, rows, {'links': links, 'tilts': tilts})
        model_columns = white['model'].reshape(-1, len(free))
        link_columns = np.concatenate((white['links'], white['tilts']), axis=2)
        gram = model_columns.T @ model_columns + mode.linearisation.prior[: len(free), : len(free)]
        scale = np.sqrt(np.diag(gram))
        root = cho_factor(gram / np.outer(scale, scale), lower=True)
        pull = model_columns.T @ link_columns.reshape(len(model_columns), -1) / scale[:, None]
        response = np.zeros((k, link_columns.shape[2]))
        response[indices] = (cho_solve(root, pull) / scale[:, None])[joints]
        tolerance = problem.priors.geometry_tolerance_m
        lever = np.sqrt(np.mean(np.sum(tilts**2, axis=1), axis=0))
        # An axis through the marker moves nothing.
        lever = np.maximum(lever, 1e-3)
        return cls(
            model.offsets(mode.z),
            (std > 0.0) & (widening * std < OPEN_ANGLE * problem.chain.per_radian),
            widening[:, None] * covariance * widening,
            response,
            np.concatenate((np.full(links.shape[2], tolerance), tolerance / lever)),
        )
