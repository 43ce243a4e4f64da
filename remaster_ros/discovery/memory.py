"""Noise that remembers: what of the errors a sensor's reading shares with the readings before it.

The errors that a model leaves are taken as the sum of three independent parts: one of each row,
one that all rows of a pose share, and an Ornstein-Uhlenbeck process over the sensor's readings in
their order, whose correlation falls by e over a length. Three kinds of moments determine the
variances by non-negative least squares: the mean square of the errors; half that of the difference
of two rows of a pose; the mean product of two rows of different poses; the latter two by how many
readings the rows lie apart (variogram and covariogram, Cressie 1993, Statistics for Spatial Data).
Each has the weight of its relative error. Of a grid of lengths the one that leaves least is taken.

Unlike the wander of `effects.sensor_wander`, which has some knots over the session, this resolves
a memory of a few readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.optimize import nnls

from remaster_ros.calibration.noise import Channel
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

# Products of rows further apart in their sensor's order say little of a length that matters.
MOST_APART = 40
SHORTEST = 0.5
LENGTHS = 24
# Of the mean square: a difference of two rows of a pose is taken for no smaller.
LEAST = 1e-4
# To know a covariance by, to a few percent; and how many of them are held at once.
DRAWS = 2000
AT_ONCE = 250


@dataclass(frozen=True, eq=False)
class Memory:
    """The noise of n rows, some of whose sensors remember.

    Attributes
    ----------
    data
        The rows.
    own, shared, frame
        Standard deviation of each channel's part of a row, of a pose, and of a frame, m,
        (channels,).
    process
        Of the part that remembers, m per axis, (sensors,); 0 where a sensor has none.
    length
        Readings over which its correlation falls by e, (sensors,).
    """

    data: Residuals
    own: FloatArray
    shared: FloatArray
    frame: FloatArray
    process: FloatArray
    length: FloatArray

    @classmethod
    def of(cls, data: Residuals, solution: Solution, sensors: Sequence[int]) -> Memory:
        """Estimate the memory of some sensors from what a solution without a wander leaves."""
        model, noise = data.noise_model, solution.noise
        own, shared, frame = noise.sigma.copy(), noise.pose_sigma.copy(), noise.frame_sigma
        process, length = np.zeros(model.sensors), np.ones(model.sensors)
        errors = data.left(solution)
        if model.frames is not None:
            errors = np.einsum('nij,nj->ni', model.frames, errors)
        for sensor, span in data.rows.spans:
            if sensor in sensors:
                mine = [i for i, channel in enumerate(model.channels) if channel.sensor == sensor]
                channels = [model.channels[i] for i in mine]
                variances, length[sensor] = _fitted(
                    _Moments.of(errors[span], reading(data)[span], data.pose_of_row[span]),
                    channels,
                    frame[mine] ** 2,
                )
                parts = np.sqrt(variances)
                own[mine], shared[mine], process[sensor] = parts[:-1:2], parts[1:-1:2], parts[-1]
        return cls(data, own, shared, frame, process, length)

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw the errors of all rows, m, (n, 3, count)."""
        data, model = self.data, self.data.noise_model
        group, frame = data.rows.group_of_row, _frame_of_row(data)
        errors = rng.standard_normal((len(data), 3, count))
        of_pose = rng.standard_normal((int(group.max()) + 1, 3, count))
        of_frame = rng.standard_normal((int(frame.max()) + 1, 3, count))
        for channel, own, shared, framed in zip(
            model.channels, self.own, self.shared, self.frame, strict=True
        ):
            span = dict(data.rows.spans).get(channel.sensor, slice(0, 0))
            axes = slice(*channel.axes)
            errors[span, axes] *= own
            errors[span, axes] += shared * of_pose[group[span], axes]
            errors[span, axes] += framed * of_frame[frame[span], axes]
        if model.frames is not None:
            errors = np.einsum('nji,njc->nic', model.frames, errors)
        order_of = reading(data)
        for sensor, span in data.rows.spans:
            if self.process[sensor] > 0.0:
                order = order_of[span]
                fresh = rng.standard_normal((int(order.max()) + 1, 3, count))
                rho = np.exp(-1.0 / self.length[sensor])
                # Stationary from the first reading on.
                fresh[1:] *= np.sqrt(1.0 - rho**2)
                errors[span] += (
                    self.process[sensor]
                    * scipy.signal.lfilter([1.0], [1.0, -rho], fresh, 0)[order]
                )
        return errors


def draws_of(memory: Memory, maps: Sequence[tuple[FloatArray, Solution]]) -> list[FloatArray]:
    """Return what linear maps make of drawn errors, (c, DRAWS) each.

    Parameters
    ----------
    memory
        Of the errors.
    maps
        Each a map (c, 3 n) of errors that are whitened by the noise of the solution beside it.
    """
    # A fixed seed: the noise is what estimates are compared by, the same in all sessions.
    rng = np.random.default_rng(0)
    results: list[list[FloatArray]] = [[] for _ in maps]
    data = memory.data
    for _ in range(DRAWS // AT_ONCE):
        errors = memory.draw(AT_ONCE, rng)
        for (linear, solution), result in zip(maps, results, strict=True):
            white = data.noise_model.whitened(errors, solution.noise)
            result.append(linear @ white.reshape(3 * len(data), -1))
    return [np.concatenate(result, axis=1) for result in results]


def reading(data: Residuals) -> IntArray:
    """Return which reading of its sensor each row is, in the order of time, from 0, (n,).

    Counted over all rows of the session, those that are not worked on among them.
    """
    context = data.context
    order = np.zeros(len(context), dtype=np.int64)
    for sensor in range(len(context.sensor_names)):
        mine = context.seen_by(sensor)
        order[mine] = np.unique(context.progress[mine], return_inverse=True)[1]
    return order[data.rows.source]


@dataclass(frozen=True, eq=False)
class _Moments:
    """Moments of the errors of pairs of rows, by how far apart they are.

    Attributes
    ----------
    value
        For each axis, m², (kinds, 3): of a row with itself the mean square, of two of a pose half
        the mean square of their difference, of others their mean product.
    apart
        Readings between the two; 0 for a row with itself, (kinds,).
    same_pose
        Whether they are of one pose, (kinds,).
    count
        Pairs of each kind, (kinds,).
    """

    value: FloatArray
    apart: IntArray
    same_pose: IntArray
    count: IntArray

    @classmethod
    def of(cls, errors: FloatArray, order: IntArray, pose: IntArray) -> _Moments:
        by_time = np.argsort(order, kind='stable')
        errors, order, pose = errors[by_time], order[by_time], pose[by_time]
        sums = np.zeros((MOST_APART + 1, 2, 3))
        counts = np.zeros((MOST_APART + 1, 2), dtype=np.int64)
        sums[0, 1], counts[0, 1] = np.sum(errors**2, axis=0), len(errors)
        for step in range(1, min(MOST_APART + 1, len(errors))):
            apart = order[step:] - order[:-step]
            # Markers of one frame share errors that are not memory.
            near = (apart > 0) & (apart <= MOST_APART)
            same = (pose[step:] == pose[:-step]).astype(np.int64)[near]
            one, other = errors[step:][near], errors[:-step][near]
            values = np.where(same[:, None], 0.5 * (one - other) ** 2, one * other)
            np.add.at(sums, (apart[near], same), values)
            np.add.at(counts, (apart[near], same), 1)
        apart, same = np.nonzero(counts)
        count = counts[apart, same]
        return cls(sums[apart, same] / count[:, None], apart, same, count)


def _fitted(
    moments: _Moments, channels: Sequence[Channel], frame: FloatArray
) -> tuple[FloatArray, float]:
    """Return variances (own and pose's of each channel, the process's) and the length."""
    longest = max(2.0, float(moments.apart.max()))
    best: tuple[float, FloatArray, float] | None = None
    itself = moments.apart == 0
    together = moments.same_pose == 1
    for length in np.geomspace(SHORTEST, longest, LENGTHS):
        correlation = np.exp(-moments.apart / length)
        blocks, values = [], []
        for index, channel in enumerate(channels):
            value = moments.value[:, slice(*channel.axes)].mean(axis=1)
            # A mean product is as uncertain as the mean square, a variance in proportion.
            size = np.maximum(np.where(together, value, value[itself]), LEAST * value[itself])
            weight = np.sqrt(moments.count * channel.dimension) / size
            block = np.zeros((len(weight), 2 * len(channels) + 1))
            block[:, 2 * index] = together
            block[:, 2 * index + 1] = itself
            block[:, -1] = np.where(together & ~itself, 1.0 - correlation, correlation)
            blocks.append(block * weight[:, None])
            values.append((value - together * frame[index]) * weight)
        system, target = np.concatenate(blocks), np.concatenate(values)
        unit = np.max(np.abs(moments.value))
        variances, left = nnls(system * unit, target)
        if best is None or left < best[0]:
            best = float(left), variances * unit, float(length)
    assert best is not None
    return best[1], best[2]


def _frame_of_row(data: Residuals) -> IntArray:
    frame = data.rows.frame
    return np.arange(len(data)) if frame is None else frame
