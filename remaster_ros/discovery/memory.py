"""Noise that remembers: what of the errors a sensor's reading shares with the readings before it.

The errors that a model leaves are taken as the sum of three independent parts: one of each row,
one that all rows of a pose share, and an Ornstein-Uhlenbeck process over the sensor's readings in
their order, whose correlation falls by e over a length. The mean products of the errors of two
rows, by how many readings they lie apart and whether they are of one pose, determine the variances
by non-negative least squares; of a grid of lengths the one that leaves least is taken.

Unlike the wander of `effects.sensor_wander`, which has some knots over the session, this resolves
a memory of a few readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.signal import lfilter

from remaster_ros.calibration.noise import Channel
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

# Products of rows further apart in their sensor's order say little of a length that matters.
MOST_APART = 40
SHORTEST = 0.5
LENGTHS = 24
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
                    _Products.of(errors[span], reading(data)[span], data.pose_of_row[span]),
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
                errors[span] += self.process[sensor] * lfilter([1.0], [1.0, -rho], fresh, 0)[order]
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
class _Products:
    """Mean products of the errors of pairs of rows, by how far apart they are.

    Attributes
    ----------
    value
        For each axis, m², (kinds, 3).
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
    def of(cls, errors: FloatArray, order: IntArray, pose: IntArray) -> _Products:
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
            np.add.at(sums, (apart[near], same), (errors[step:] * errors[:-step])[near])
            np.add.at(counts, (apart[near], same), 1)
        apart, same = np.nonzero(counts)
        count = counts[apart, same]
        return cls(sums[apart, same] / count[:, None], apart, same, count)


def _fitted(
    products: _Products, channels: Sequence[Channel], frame: FloatArray
) -> tuple[FloatArray, float]:
    """Return variances (own and pose's of each channel, the process's) and the length."""
    longest = max(2.0, float(products.apart.max()))
    best: tuple[float, FloatArray, float] | None = None
    itself = products.apart == 0
    for length in np.geomspace(SHORTEST, longest, LENGTHS):
        blocks, values = [], []
        for index, channel in enumerate(channels):
            weight = np.sqrt(products.count * channel.dimension)
            block = np.zeros((len(weight), 2 * len(channels) + 1))
            block[:, 2 * index] = itself
            block[:, 2 * index + 1] = products.same_pose
            block[:, -1] = np.exp(-products.apart / length)
            value = products.value[:, slice(*channel.axes)].mean(axis=1) - itself * frame[index]
            blocks.append(block * weight[:, None])
            values.append(value * weight)
        system, target = np.concatenate(blocks), np.concatenate(values)
        scale = float(np.max(np.abs(target))) or 1.0
        variances, left = nnls(system, target / scale)
        if best is None or left * scale < best[0]:
            best = left * scale, variances * scale, float(length)
    assert best is not None
    return best[1], best[2]


def _frame_of_row(data: Residuals) -> IntArray:
    frame = data.rows.frame
    return np.arange(len(data)) if frame is None else frame
