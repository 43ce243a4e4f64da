# SPDX-License-Identifier: Apache-2.0
"""Were two sessions measured with one arm? Their zero-offsets, fitted one by one, tell.

A joint fit of two arms gives the offsets of neither, and a smaller error all the same. With the
offsets δ₁ and δ₂ of the sessions, and their covariances C₁ and C₂ widened by what the model leaves
out, one arm has::

    δ₁ − δ₂ ~ N(0, C₁ + C₂ + (B₁ − B₂) S (B₁ − B₂)' + f² (B₁ S B₁' + B₂ S B₂'))

where B = (A'WA + P)⁻¹ A'WZ is the response of the offsets to links and axes Z off their drawing,
with the variances S of its tolerance. The arm has the same ones in both sessions, so that only
the difference of the responses counts, and a share f of either: no arm is its drawing by lengths
and tilts alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtrc

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.gauge_words import listed
from remaster_ros.calibration.identifiability import OPEN_ANGLE
from remaster_ros.calibration.result import robust_std
from remaster_ros.calibration.smooth_functions import of_links, spread_poses, whitened
from remaster_ros.types import BoolArray, FloatArray

# How often sessions of one arm are told apart.
FALSE = 1e-4
# So many standard deviations apart an offset is another one.
APART = 3.0
# Share of what links and axes off their drawing do to an offset that two sessions need not have
# alike.
OWN_SHARE = 0.3


@dataclass(frozen=True)
class OffsetsApart:
    """Zero-offsets of two sessions side by side; j joints that both determine."""

    joints: tuple[str, ...]
    sigmas: FloatArray  # Second less first over the standard deviation of the difference, (j,)
    p_value: float  # Of the differences of one arm, all joints together

    @property
    def differ(self) -> bool:
        """Whether the sessions have other offsets."""
        return self.p_value < FALSE

    @property
    def mostly(self) -> bool:
        """Whether half of the offsets or more are others, as of another arm."""
        return self.differ and bool(2 * np.sum(np.abs(self.sigmas) > APART) >= len(self.sigmas))

    @property
    def words(self) -> str:
        """Return the joints that differ, each with its difference in standard deviations."""
        shown = [
            f'{joint} by {abs(by):.0f}'
            for joint, by in zip(self.joints, self.sigmas, strict=True)
            if abs(by) > APART
        ]
        if not shown:
            return f'{listed(self.joints)} taken together'
        return f'{listed(shown)} standard deviations'


def offsets_apart(one: Estimate, other: Estimate) -> OffsetsApart | None:
    """Compare the zero-offsets of two sessions of the same robot description.

    Returns None where no joint's offset is determined by both.
    """
    sides = [_Side.of(found) for found in (one, other)]
    known = np.logical_and(*(side.known for side in sides))
    if not known.any():
        return None
    size = np.maximum(*(side.size for side in sides))
    first, second = (side.response * size for side in sides)
    own = first @ first.T + second @ second.T
    apart = first - second
    variance = sides[0].covariance + sides[1].covariance + apart @ apart.T + OWN_SHARE**2 * own
    variance = variance[np.ix_(known, known)]
    difference = (sides[1].offsets - sides[0].offsets)[known]
    scale = np.sqrt(np.diag(variance))
    sigmas = difference / scale
    root = cho_factor(variance / np.outer(scale, scale), lower=True)
    square = float(sigmas @ cho_solve(root, sigmas))
    names = one.problem.chain.joint_names
    return OffsetsApart(
        tuple(names[joint] for joint in np.flatnonzero(known)),
        sigmas,
        float(chdtrc(len(sigmas), square)),
    )


@dataclass(frozen=True, eq=False)
class _Side:
    """The zero-offsets of a session, rad or m; k joints, m links and axes."""

    offsets: FloatArray  # (k,)
    known: BoolArray  # Whether the session determines each, (k,)
    covariance: FloatArray  # Widened by what the model leaves out, (k, k)
    response: FloatArray  # Of each offset to a metre or radian of each link and axis, (k, m)
    size: FloatArray  # Of each link and axis off its drawing, m or rad, (m,)

    @classmethod
    def of(cls, found: Estimate) -> _Side:
        mode, problem = found.mode.of_points, found.problem
        posterior = mode.linearisation.posterior
        model, free = posterior.model, posterior.free
        joints = np.flatnonzero(free < model.joints)
        where = free[joints]
        k = model.joints
        covariance = np.zeros((k, k))
        covariance[np.ix_(where, where)] = mode.covariance[np.ix_(joints, joints)]
        std = np.sqrt(np.diag(covariance))
        times = np.ones(k)
        times[where] = np.maximum(1.0, robust_std(mode, problem.measurements)[where] / std[where])
        rows = spread_poses(posterior.rows.of_points)
        links, tilts = of_links(mode, rows)
        white = whitened(mode, rows, {'links': links, 'tilts': tilts})
        own = white['model'].reshape(-1, len(free))
        further = np.concatenate((white['links'], white['tilts']), axis=2)
        gram = own.T @ own + mode.linearisation.prior[: len(free), : len(free)]
        scale = np.sqrt(np.diag(gram))
        root = cho_factor(gram / np.outer(scale, scale), lower=True)
        pull = own.T @ further.reshape(len(own), -1) / scale[:, None]
        response = np.zeros((k, further.shape[2]))
        response[where] = (cho_solve(root, pull) / scale[:, None])[joints]
        tolerance = problem.priors.geometry_tolerance_m
        lever = np.sqrt(np.mean(np.sum(tilts**2, axis=1), axis=0))
        # An axis through the marker moves nothing.
        lever = np.maximum(lever, 1e-3)
        return cls(
            model.offsets(mode.z),
            (std > 0.0) & (times * std < OPEN_ANGLE * problem.chain.per_radian),
            times[:, None] * covariance * times,
            response,
            np.concatenate((np.full(links.shape[2], tolerance), tolerance / lever)),
        )
