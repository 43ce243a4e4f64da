"""The posterior by its second-order expansion: the cost of a draw does not depend on the data.

About the mode, with steps d of the free parameters, the errors are e = e0 - J d - ½ d' H d but for
terms of third order. Their sums of squares are quadratic forms of the features [d, 1, d_i d_j],
whose Gram matrices are computed once for each cell of the noise model. So thousands of proposals
are evaluated in milliseconds, whatever the number of observations.

Effects of an extension enter linearly; what they have in common with other parameters at second
order is left out. How far the result is from the exact density is measured in every run, by
`log_density_error`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.priors import prior_rows
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix
from remaster_ros.types import FloatArray, IntArray

# Products of parameters that move the errors by less than this many standard deviations, in the
# norm over all observations, a posterior standard deviation away from the mode.
NEGLIGIBLE = 1e-4
# Of their products with each other, of fourth order, only those of larger ones count.
NEGLIGIBLE_SQUARED = 1e-3
# Proposals evaluated at a time: more fall out of the processor's cache.
BLOCK = 2048


@dataclass(frozen=True, eq=False)
class _Part:
    """Gram matrices of the features of one sensor's errors, or of the priors' residuals.

    Attributes
    ----------
    linear
        Which free parameters the errors depend on, (l,).
    first, second
        The products that matter, as indices of free parameters, (p,) each.
    groups
        One of the error groups for each variance; empty for priors, whose weight is 1.
    straight
        Products of linear with all features by variance, (groups or 1, l + 1, l + 1 + p).
    strong
        Which of the products matter in products with each other too.
    curved
        Products of these by channel at the mode's noise, with that channel's index; -1 for priors.
    """

    linear: IntArray
    first: IntArray
    second: IntArray
    groups: IntArray
    straight: FloatArray
    strong: IntArray
    curved: tuple[tuple[int, FloatArray], ...]


@dataclass(frozen=True, eq=False)
class Surrogate:
    """A log density that costs the same for any number of observations.

    Attributes
    ----------
    posterior
        The exact one.
    centre
        The point expanded about, (d,).
    """

    posterior: Posterior
    centre: FloatArray
    _parts: tuple[_Part, ...]

    @classmethod
    def of(cls, mode: Mode) -> Surrogate:
        """Expand about a mode."""
        posterior = mode.linearisation.posterior
        width = np.sqrt(np.diag(mode.covariance))
        parts = [*_data_parts(mode, width), _prior_part(mode, width)]
        centre = np.concatenate((mode.z[posterior.free], mode.eta))
        return cls(posterior, centre, tuple(parts))

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the log density of points (n, d) up to a constant, (n,)."""
        parts = [self._log_density(points[i : i + BLOCK]) for i in range(0, len(points), BLOCK)]
        return np.concatenate(parts)

    def _log_density(self, points: FloatArray) -> FloatArray:
        posterior, f = self.posterior, len(self.posterior.free)
        # Features by rows: what is picked and multiplied then lies together in memory.
        step, eta = (self.centre[:f] - points[:, :f]).T.copy(), points[:, f:]
        variances = posterior.variances(eta)
        value = posterior.log_noise_prior(eta)
        value -= 0.5 * np.log(variances) @ posterior.noise_model.freedom
        for part in self._parts:
            count = len(part.linear) + 1
            feature = np.empty((count + len(part.first), len(points)))
            feature[: count - 1], feature[count - 1] = step[part.linear], 1.0
            np.multiply(-step[part.first], step[part.second], out=feature[count:])
            line, product = feature[:count], feature[count + part.strong]
            forms = np.einsum('cln,ln->nc', part.straight @ feature, line)
            if len(part.groups) > 0:
                forms /= variances[:, part.groups]
            value -= 0.5 * forms.sum(axis=1)
            for channel, gram in part.curved:
                form = np.einsum('pn,pn->n', gram @ product, product)
                if channel >= 0:
                    form *= np.exp(2.0 * (self.centre[f + channel] - eta[:, channel]))
                value -= 0.5 * form
        return np.where(posterior.inside(points), value, -np.inf)

    def log_density_error(self, points: FloatArray) -> float:
        """Return the largest difference from the exact log density, centred, over points (n, d).

        Only differences between points matter to a sampler, hence about their median.
        """
        difference = self.log_density(points) - self.posterior.log_density(points)
        return float(np.max(np.abs(difference - np.median(difference))))


def _data_parts(mode: Mode, width: FloatArray) -> list[_Part]:
    """Return the parts of the sensors."""
    posterior = mode.linearisation.posterior
    model, free, f = posterior.model, posterior.free, len(posterior.free)
    noise = posterior.noise_model
    pairs = bent_pairs(model, free)
    first, second = (np.searchsorted(free, [pair[side] for pair in pairs]) for side in (0, 1))

    def joined(rows: Rows, _: slice) -> FloatArray:
        errors = rows.target - model.predict(mode.z, rows)
        straight = model.jacobian(mode.z, rows)[:, :, free]
        bent = second_derivatives(model, mode.z, rows, pairs)
        return np.concatenate((straight, errors[:, :, None], bent), axis=2)

    grams = noise.gram(joined, f + 1 + len(pairs))
    variances = posterior.variances(mode.eta)
    parts = []
    for sensor in range(len(model.sensor_names)):
        # Without a part that rows share the error groups of a channel have one variance.
        alike: dict[tuple[int, float, float], list[int]] = {}
        for index, group in enumerate(noise.error_groups):
            if noise.channels[group.channel].sensor == sensor:
                frame_size = group.frame_size if group.channel in noise.framed else 0.0
                size = group.size if group.channel in noise.separable else 0.0
                alike.setdefault((group.channel, frame_size, size), []).append(index)
        merged = np.array([grams[groups].sum(axis=0) for groups in alike.values()])
        chief = np.array([groups[0] for groups in alike.values()])
        channels = noise.channel_of[chief].tolist()
        parts.append(_part(merged, variances[chief], channels, chief, first, second, width))
    return parts


def _prior_part(mode: Mode, width: FloatArray) -> _Part:
    """Return the part of the priors: their residuals to second order, by differences."""
    linearisation = mode.linearisation
    posterior = linearisation.posterior
    model, free, f = posterior.model, posterior.free, len(posterior.free)
    core = np.flatnonzero(free < model.core)
    first, second = (core[side] for side in np.triu_indices(len(core)))
    # Steps of a share of each parameter's width, at least of what differences resolve.
    h = np.maximum(width, 1e-4)
    steps = np.zeros((4, len(first), f))
    pair = np.arange(len(first))
    for corner, (a, b) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        steps[corner, pair, first] += a * h[first]
        steps[corner, pair, second] += b * h[second]
    x = model.natural(posterior.parameters(mode.z[free] + steps.reshape(-1, f)))
    residuals = [prior.residual(x) for prior in posterior.priors]
    corners = np.concatenate([np.zeros((len(x), 0)), *residuals], axis=1)
    corners = corners.reshape(4, len(first), corners.shape[1])
    bent = (corners[0] - corners[1] - corners[2] + corners[3]) / 4.0
    bent /= (h[first] * h[second])[:, None]
    bent[first == second] *= 0.5

    # The priors of an extension are linear: they are in the linear part alone.
    core_model = replace(model, extension=None)
    value, by_z = prior_rows(core_model, posterior.priors, mode.z[: model.core])
    features = np.zeros((len(value), f + 1 + len(first)))
    features[:, core] = -by_z[:, free[core]]
    features[:, f] = value
    features[:, f + 1 :] = -bent.T
    gram = features.T @ features
    gram[: f + 1, : f + 1] = linearisation.prior
    none = np.zeros(0, dtype=np.int64)
    return _part(gram[None], np.ones(1), [-1], none, first, second, width)


def _part(
    grams: FloatArray,
    variances: FloatArray,
    channels: Sequence[int],
    groups: IntArray,
    first: IntArray,
    second: IntArray,
    width: FloatArray,
) -> _Part:
    """Cut Gram matrices (g, f+1+p, f+1+p), one for each variance, to the features that matter.

    Features are the free parameters, the error and the products of ``first`` and ``second``;
    ``width`` has the standard deviations of the parameters, (f,).
    """
    f = len(width)
    weighted = grams / variances[:, None, None]
    size = np.einsum('gii->i', weighted)
    line = np.append(np.flatnonzero(size[:f] > 0.0), f)
    moved = np.sqrt(size[f + 1 :]) * width[first] * width[second]
    chosen = np.flatnonzero(moved > NEGLIGIBLE)
    strong = np.flatnonzero(moved[chosen] > NEGLIGIBLE_SQUARED)
    bent = f + 1 + chosen
    straight = grams[:, line][:, :, np.append(line, bent)]
    straight[:, :, len(line) :] *= 2.0
    curved: dict[int, FloatArray] = {}
    if len(strong) > 0:
        for channel, gram in zip(channels, weighted[:, bent[strong]][:, :, bent[strong]]):
            curved[channel] = curved.get(channel, 0.0) + gram
    products = tuple(curved.items())
    return _Part(line[:-1], first[chosen], second[chosen], groups, straight, strong, products)


def bent_pairs(model: Model, free: IntArray) -> list[tuple[int, int]]:
    """Return the pairs of free parameters, by model index, whose product moves a prediction."""
    inner = [i for i in range(1, model.joints - 1) if i in free]
    markers = [i for i in range(model.marker(0).start, model.core) if i in free]
    pairs = [*combinations_with_replacement(inner, 2), *product(inner, markers)]
    for sensor in range(len(model.sensor_names)):
        start = model.registration(sensor).start
        turns = [i for i in range(start + 3, start + 6) if i in free]
        pairs += combinations_with_replacement(turns, 2)
        pairs += [*product(inner, turns), *product(turns, markers)]
    return pairs


def second_derivatives(
    model: Model, z: FloatArray, rows: Rows, pairs: list[tuple[int, int]]
) -> FloatArray:
    """Return the factors of products of parameters in the prediction, (n, 3, p).

    Second derivatives, half of them on the diagonal.

    Those by two joints i <= j are axis_i × (axis_j × arm_j), the change of the velocity about
    joint j as joint i carries it along.
    """
    pose = model.inner_pose(z, rows)
    result = np.zeros((len(rows), 3, len(pairs)))
    start = model.marker(0).start
    spans = dict(rows.spans)
    turned = {sensor: _rotation_derivatives(z[model.registration(sensor)][3:]) for sensor in spans}
    for place, (i, j) in enumerate(pairs):
        half = 0.5 if i == j else 1.0
        if j < model.joints:
            bent = np.cross(pose.axes[:, i], pose.by_joints[:, :, j])
        elif i < model.joints and j >= start:
            bent = np.cross(pose.axes[:, i], _by_marker(model, pose.tool, rows, j))
        else:
            bent = None
        for sensor, span in spans.items():
            turn, by_turn, by_turns = turned[sensor]
            own = model.registration(sensor).start + 3
            if bent is not None:
                result[span, :, place] = half * bent[span] @ turn.T
            elif own <= i < own + 3 and own <= j < own + 3:
                arms = pose.points[span] - model.centroid[sensor]
                result[span, :, place] = half * arms @ by_turns[i - own, j - own].T
            elif own <= j < own + 3:
                result[span, :, place] = pose.by_joints[span, :, i] @ by_turn[j - own].T
            elif own <= i < own + 3:
                moved = _by_marker(model, pose.tool, rows, j)[span]
                result[span, :, place] = moved @ by_turn[i - own].T
    return result


def _by_marker(model: Model, tool: FloatArray, rows: Rows, index: int) -> FloatArray:
    """Return the derivative of the points by one coordinate of a marker, (n, 3)."""
    marker, axis = divmod(index - model.marker(0).start, 3)
    return tool[:, :3, axis] * (rows.marker == marker)[:, None]


def _rotation_derivatives(vector: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return exp(r), its first (3, 3, 3) and second (3, 3, 3, 3) derivatives, by differences."""
    h = 1e-4
    a = h * np.eye(3)
    b = a[:, None]
    turn = rotation_vector_to_matrix
    first = (turn(vector + a) - turn(vector - a)) / (2.0 * h)
    second = turn(vector + a + b) - turn(vector + a - b) - turn(vector - a + b)
    second = (second + turn(vector - a - b)) / (4.0 * h**2)
    return turn(vector), first, second
