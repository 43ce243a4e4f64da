# SPDX-License-Identifier: Apache-2.0
"""Measured orientations: their errors, their share in the offsets, and whether they agree.

For sensors that measure full poses. Eq. 17 of Van Wyk et al. compares the distances between joint
solutions of a pose as measured and as modelled; here the angles between them are compared, which
need neither registration nor the position of the body on the tool. Eq. 18 compares points after
registration; here orientations are compared. The orientation of the body on the tool, R_T_B, is
taken from the fitted rows, as its origin is: it absorbs an offset of the last joint, and the
registration one of the first.

The share of the orientations in the offsets is their part of the information at the mode. Two
estimates of one truth, of the positions alone and of all, differ by no more than noise allows:
their difference has the covariance of the one less that of the other (Hausman 1978,
doi:10.2307/1913827).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.model import Model
from remaster_ros.kinematics.transforms import mean_quaternion_xyzw
from remaster_ros.types import FloatArray, IntArray, Measurements

# Smallest share of the remaining variance that the orientations remove, in a direction in which
# both estimates can be compared.
LEAST_ADDED = 0.01
# Smallest information, with parameters scaled to 1, above rounding.
ROUNDING = 1e-12
METRICS = ('relative_orientation', 'post_registration_orientation')


@dataclass(frozen=True, eq=False)
class OrientationInformation:
    """Information of the orientations on the offsets of k joints."""

    # Standard deviation of the offsets by the positions alone, rad or m, (k,); 0 if an offset is
    # held, infinite if the positions do not determine it
    std_without: FloatArray
    # Change of the offsets by the orientations, rad or m, (k,); 0 if an offset is held or if the
    # positions alone do not determine it
    shift: FloatArray
    p_value: float  # Probability of a shift as large by noise


def orientation_information(mode: Mode) -> OrientationInformation | None:
    """Comparison of a fit with that of the positions alone, linear about its mode.

    None if no orientations are fitted. If the positions alone do not determine the parameters,
    ``std_without`` is infinite, ``shift`` 0 and ``p_value`` 1.
    """
    posterior = mode.linearisation.posterior
    if not posterior.rows.turning:
        return None
    f, points = len(posterior.free), mode.of_points.linearisation
    groups = len(points.grams)
    weights = 1.0 / posterior.variances(mode.eta)[:groups]
    gram = np.tensordot(weights, points.grams, axes=1) + mode.linearisation.prior
    std, shift = np.zeros(posterior.model.joints), np.zeros(posterior.model.joints)
    joints = np.flatnonzero(posterior.free < posterior.model.joints)
    where = posterior.free[joints]
    # How bodies stand is a matter of orientations.
    point_parameters = ~np.isin(
        posterior.free, np.arange(posterior.model.markers_end, posterior.model.core)
    )
    used = np.flatnonzero(point_parameters | (np.diag(gram)[:f] > 0.0))
    scale = np.sqrt(np.diag(gram)[used])
    scaled = gram[np.ix_(used, used)] / np.outer(scale, scale)
    if not np.all(scale > 0.0) or np.linalg.eigvalsh(scaled)[0] < ROUNDING:
        std[where] = np.inf
        return OrientationInformation(std, shift, 1.0)
    covariance = np.zeros((f, f))
    covariance[np.ix_(used, used)] = np.linalg.inv(scaled) / np.outer(scale, scale)
    std[where] = np.sqrt(np.diag(covariance)[joints])
    full_pull = mode.linearisation.gram(mode.eta)[:f, f]
    difference = covariance @ gram[:f, f] - mode.covariance @ full_pull
    shift[where] = -difference[joints]
    joint_covariance = covariance[np.ix_(joints, joints)]
    root = np.linalg.cholesky(joint_covariance)
    inner = np.linalg.inv(root)
    added = inner @ (joint_covariance - mode.covariance[np.ix_(joints, joints)]) @ inner.T
    values, vectors = np.linalg.eigh(added)
    kept = values > LEAST_ADDED
    square = np.sum((vectors.T @ (inner @ shift[where]))[kept] ** 2 / values[kept])
    return OrientationInformation(
        std, shift, float(scipy.special.chdtrc(max(int(kept.sum()), 1), square))
    )


class ToolOrientations(NamedTuple):
    """Modelled R_N_T of every row with offsets at zero and as estimated, (n, 3, 3) each."""

    before: FloatArray
    after: FloatArray


def tool_orientations(
    model: Model, measurements: Measurements, before: FloatArray, after: FloatArray
) -> ToolOrientations | None:
    """Modelled orientations of the tool in the sensors' frames.

    None if no orientation was measured.

    ``model``: with an extension the result is None, as an extension displaces points but has no
    rotations; ``measurements``: n observations; ``before, after``: pinned parameters with offsets
    at zero and as estimated, (size,).
    """
    if measurements.orientation is None or model.extension is not None:
        return None
    return ToolOrientations(*(_modelled(model, measurements, z) for z in (before, after)))


def _modelled(model: Model, measurements: Measurements, z: FloatArray) -> FloatArray:
    """Orientation of the tool in each row's sensor frame, (n, 3, 3), by pinned parameters z."""
    x = model.natural(z)
    R_R_T = model.chain.forward(measurements.q, model.offsets(x))[:, :3, :3]
    R_R_N = model.T_R_N(x)[measurements.sensor, :3, :3]
    turned: FloatArray = np.swapaxes(R_R_N, 1, 2) @ R_R_T
    return turned


def orientation_accuracy(
    measurements: Measurements,
    modelled: ToolOrientations,
    fitted: IntArray,
    chosen: IntArray,
    pairs: IntArray,
) -> dict[str, Any]:
    """Errors of orientations with offsets at zero and as estimated, as fit.json has them, degrees.

    Keys 'post_registration_orientation' and 'relative_orientation', each with 'before' and
    'after'; {} if the chosen rows have no orientation, and None with a reason ``why`` in place
    of the relative numbers without pairs. ``measurements``: n observations; ``modelled``:
    orientations of the same rows; ``fitted``: rows that determine R_T_B of every sensor and
    marker; ``chosen``: rows that are judged; ``pairs``: joint solutions of the same pose, (m,
    2).
    """
    assert measurements.orientation is not None
    seen = np.all(np.isfinite(measurements.orientation), axis=1)
    body = np.stack((measurements.sensor, measurements.marker))
    sides: dict[str, dict[str, Any]] = {name: {} for name in METRICS}
    both = pairs[seen[pairs].all(axis=1)]
    for side, R_N_T in modelled._asdict().items():
        absolute: list[FloatArray] = []
        for which in np.unique(body[:, chosen], axis=1).T:
            selection = seen & np.all(body == which[:, None], axis=0)
            known, judged = fitted[selection[fitted]], chosen[selection[chosen]]
            if len(known) == 0 or len(judged) == 0:
                continue
            turns = _inverse_of(R_N_T[known]) * _measured(measurements, known)
            R_T_B = Rotation.from_quat(mean_quaternion_xyzw(turns.as_quat()))
            expected = Rotation.from_matrix(R_N_T[judged]) * R_T_B
            absolute.append((expected.inv() * _measured(measurements, judged)).magnitude())
        if not absolute:
            return {}
        sides['post_registration_orientation'][side] = _summary(np.concatenate(absolute))
        if len(both) > 0:
            i, j = both.T
            measured = (_measured(measurements, i).inv() * _measured(measurements, j)).magnitude()
            turned = (_inverse_of(R_N_T[i]) * Rotation.from_matrix(R_N_T[j])).magnitude()
            sides['relative_orientation'][side] = _summary(np.abs(measured - turned))
    if len(both) == 0:
        why = 'no pose has two joint solutions at which the same sensor measured the orientation'
        sides['relative_orientation'] = {'before': None, 'after': None, 'why': why}
    return sides


def _measured(measurements: Measurements, rows: IntArray) -> Rotation:
    """Measured orientations R_N_B of some rows (indices); the session has to have them."""
    assert measurements.orientation is not None
    return Rotation.from_quat(measurements.orientation[rows])


def _inverse_of(matrices: FloatArray) -> Rotation:
    """Inverse rotations of matrices (n, 3, 3)."""
    return Rotation.from_matrix(matrices).inv()


def _summary(angles: FloatArray) -> dict[str, Any]:
    """Mean and 95 % interval of angles in rad as ``mean_deg`` and ``interval95_deg``."""
    low, high = np.rad2deg(np.quantile(angles, (0.025, 0.975)))
    return {
        'mean_deg': float(np.rad2deg(angles.mean())),
        'interval95_deg': [float(low), float(high)],
    }
