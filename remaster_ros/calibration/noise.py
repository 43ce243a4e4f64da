"""Noise of the sensors: what is independent, what rows share, and the sums by which data enter.

The error of a row is independent per point and axis with standard deviation sigma, plus a part
that all rows of one sensor at one pose share, with standard deviation pose_sigma per axis. With
the error's group means m_g and sizes n_g, the likelihood of a sensor is::

    N(deviations from m_g | 0, sigma^2)  x  prod_g N(m_g | 0, pose_sigma^2 + sigma^2 / n_g)

So the data enter through one sum of squares about the group means, and one of the means for every
group size: the error groups. Where a sensor's noise along its line of sight differs from the one
across it, the two are channels with a sigma and a pose_sigma each, of dimension 1 and 2 instead
of 3.

Where a sensor has one row at every pose the two parts cannot be distinguished: sigma is then their
sum, and there is no pose_sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.types import FloatArray, IntArray

# No sensor of this kind resolves better than 0.1 µm; keeps noise-free (simulated) data proper.
RESOLUTION_M = 1e-7
# Rows whose features are held in memory at once while their Gram matrix is summed up.
GRAM_ROWS = 2_000


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations per axis of each channel, m, (..., channels).

    Attributes
    ----------
    sigma
        Of the part that is independent between rows.
    pose_sigma
        Of the part that the rows of one sensor at one pose share; 0 where the channel has none.
    """

    sigma: FloatArray
    pose_sigma: FloatArray


@dataclass(frozen=True)
class Channel:
    """Errors of one sensor that have one noise.

    Attributes
    ----------
    sensor
        Its index.
    direction
        'along' the line of sight, 'across' it, or '' for all axes alike.
    axes
        Which axes of the rows' frames these are: first and behind the last.
    """

    sensor: int
    direction: str
    axes: tuple[int, int]

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return self.axes[1] - self.axes[0]


@dataclass(frozen=True, eq=False)
class ErrorGroup:
    """Errors of one channel that have one variance.

    Attributes
    ----------
    channel
        Its index.
    size
        Size n of the groups whose means these are, variance sigma² + n pose_sigma² (of √n times
        the mean); 0 for the deviations from the means of groups of any size, variance sigma².
    groups
        The groups, (g,).
    freedom
        Number of independent errors.
    """

    channel: int
    size: int
    groups: IntArray
    freedom: int


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Which errors of some rows have which variance.

    Attributes
    ----------
    rows
        n rows, sorted by sensor and pose.
    sensors
        Number of sensors, those without rows included.
    channels
        Those of sensor 0, of sensor 1, …
    separable
        Indices of the channels with a pose_sigma of their own, ascending.
    error_groups
        What the data enter by.
    frames
        Rows of a matrix: the line of sight and two directions across it, in the coordinates of
        `Rows.target`, one for all rows of a group, (n, 3, 3); None where no sensor needs them.
    """

    rows: Rows
    sensors: int
    channels: tuple[Channel, ...]
    separable: tuple[int, ...]
    error_groups: tuple[ErrorGroup, ...]
    frames: FloatArray | None

    @classmethod
    def of(cls, rows: Rows, reference: FloatArray, split: Sequence[int] = ()) -> NoiseModel:
        """Assemble.

        Parameters
        ----------
        rows
            n observations.
        reference
            T_R_N of every sensor, (sensors, 4, 4): where the lines of sight begin.
        split
            Sensors with one noise along and another across their line of sight.
        """
        channels: list[Channel] = []
        for sensor in range(len(reference)):
            if sensor in split:
                channels += [Channel(sensor, 'along', (0, 1)), Channel(sensor, 'across', (1, 3))]
            else:
                channels.append(Channel(sensor, '', (0, 3)))
        several = set(rows.group_sensor[rows.group_size > 1].tolist())
        return cls(
            rows,
            len(reference),
            tuple(channels),
            tuple(index for index, c in enumerate(channels) if c.sensor in several),
            _error_groups(channels, rows),
            _frames(rows, reference) if len(split) > 0 else None,
        )

    @property
    def split(self) -> tuple[int, ...]:
        """Sensors with a noise along their line of sight."""
        return tuple(channel.sensor for channel in self.channels if channel.direction == 'along')

    @cached_property
    def channel_of(self) -> IntArray:
        """Index of each error group's channel, (error groups,)."""
        return np.array([group.channel for group in self.error_groups])

    @cached_property
    def size_of(self) -> IntArray:
        """Size of each error group, (error groups,)."""
        return np.array([group.size for group in self.error_groups])

    @cached_property
    def freedom(self) -> FloatArray:
        """Number of independent errors in each error group, (error groups,)."""
        return np.array([group.freedom for group in self.error_groups], dtype=float)

    def variances(self, noise: Noise) -> FloatArray:
        """Return the variance of each error group, m², (..., error groups)."""
        of = self.channel_of
        return noise.sigma[..., of] ** 2 + self.size_of * noise.pose_sigma[..., of] ** 2

    def of_sensors(self, sigma: FloatArray, pose_sigma: FloatArray) -> Noise:
        """Return the noise with one sigma and pose_sigma for each sensor, m, (sensors,) each."""
        sensor = [channel.sensor for channel in self.channels]
        return Noise(sigma[..., sensor], pose_sigma[..., sensor])

    def sensor_noise(self, noise: Noise) -> Noise:
        """Return the noise of each sensor, root mean square over the axes, m, (..., sensors)."""
        share = np.zeros((len(self.channels), self.sensors))
        for index, channel in enumerate(self.channels):
            share[index, channel.sensor] = channel.dimension / 3.0
        return Noise(np.sqrt(noise.sigma**2 @ share), np.sqrt(noise.pose_sigma**2 @ share))

    def total_noise(self, noise: Noise) -> FloatArray:
        """Return the noise of each sensor, both its parts together, m, (..., sensors, 2).

        Along the line of sight, and per axis across it: equal where the sensor has one channel.
        """
        total = np.hypot(noise.sigma, noise.pose_sigma)
        result = np.empty((*total.shape[:-1], self.sensors, 2))
        for index, channel in enumerate(self.channels):
            sides = {'along': [0], 'across': [1]}.get(channel.direction, [0, 1])
            result[..., channel.sensor, sides] = total[..., index, None]
        return result

    def sums_of_squares(self, errors: FloatArray) -> FloatArray:
        """Return the sum of squares in each error group, m², of errors (..., n, 3)."""
        if self.frames is not None:
            errors = np.einsum('nij,...nj->...ni', self.frames, errors)
        means = self.rows.group_sum(errors, axis=-2)
        means = means**2 / self.rows.group_size[:, None]
        spans = dict(self.rows.spans)
        total = np.zeros((*errors.shape[:-2], len(self.channels)))
        sums = np.zeros((*errors.shape[:-2], len(self.error_groups)))
        for index, channel in enumerate(self.channels):
            part = errors[..., spans.get(channel.sensor, slice(0, 0)), slice(*channel.axes)]
            total[..., index] = np.einsum('...ni,...ni->...', part, part)
        for index, group in enumerate(self.error_groups):
            if group.size > 0:
                axes = slice(*self.channels[group.channel].axes)
                sums[..., index] = means[..., group.groups, axes].sum(axis=(-1, -2))
                total[..., group.channel] -= sums[..., index]
        for index, group in enumerate(self.error_groups):
            if group.size == 0:
                # Cancellation may leave a value just below zero.
                sums[..., index] = np.maximum(total[..., group.channel], 0.0)
        return sums

    def gram(self, features: Callable[[Rows, slice], FloatArray], width: int) -> FloatArray:
        """Return the Gram matrix of features in each error group, (error groups, width, width).

        Parameters
        ----------
        features
            Rows, and where they are among all rows, to features (rows, 3, width), vectors in the
            coordinates of `Rows.target`; called with some thousand rows at a time, so that memory
            does not grow with their number.
        width
            Number of features.
        """
        result = np.zeros((len(self.error_groups), width, width))
        total = np.zeros((len(self.channels), width, width))
        for first, last in self.rows.blocks(GRAM_ROWS):
            rows = self.rows.of_groups(first, last)
            start = int(self.rows.group_start[first])
            where = slice(start, start + len(rows))
            values = features(rows, where)
            if self.frames is not None:
                values = self.frames[where] @ values
            sums = rows.group_sum(values.reshape(len(rows), -1), axis=0).reshape(-1, 3, width)
            means = sums / np.sqrt(rows.group_size)[:, None, None]
            spans = dict(rows.spans)
            for index, channel in enumerate(self.channels):
                part = values[spans.get(channel.sensor, slice(0, 0)), slice(*channel.axes)]
                total[index] += _gram(part)
            for index, group in enumerate(self.error_groups):
                if group.size > 0:
                    inside = group.groups[(group.groups >= first) & (group.groups < last)] - first
                    result[index] += _gram(
                        means[inside, slice(*self.channels[group.channel].axes)]
                    )
        for index, group in enumerate(self.error_groups):
            if group.size > 0:
                total[group.channel] -= result[index]
        for index, group in enumerate(self.error_groups):
            if group.size == 0:
                result[index] = total[group.channel]
        return result

    def whitened(self, values: NDArray[Any], noise: Noise) -> NDArray[Any]:
        """Return vectors (n, 3, ...) in units of the noise: independent, variance 1 in all rows.

        Where a sensor's noise has directions they are returned in the rows' `frames`.
        """
        rows, kind = self.rows, values.dtype
        flat = values.reshape(len(rows), 3, -1)
        if self.frames is not None:
            flat = self.frames.astype(kind) @ flat
        sigma, pose_sigma = np.ones((2, len(rows.group_size), 3))
        for index, channel in enumerate(self.channels):
            mine = rows.group_sensor == channel.sensor
            sigma[mine, slice(*channel.axes)] = noise.sigma[index]
            pose_sigma[mine, slice(*channel.axes)] = noise.pose_sigma[index]
        size = rows.group_size[:, None]
        root = np.sqrt(sigma**2 + size * pose_sigma**2)
        # deviations / sigma + mean / root = values / sigma - mean (1 / sigma - 1 / root)
        less = ((1.0 / sigma - 1.0 / root) / size)[:, :, None].astype(kind)
        sums = rows.group_sum(flat.reshape(len(rows), -1), axis=0).reshape(len(less), 3, -1)
        common = sums * less
        scale = (1.0 / sigma)[rows.group_of_row][:, :, None].astype(kind)
        white = flat * scale - common[rows.group_of_row]
        return white.reshape(values.shape)


def _gram(vectors: FloatArray) -> FloatArray:
    flat = vectors.reshape(-1, vectors.shape[-1])
    return flat.T @ flat


def _error_groups(channels: Sequence[Channel], rows: Rows) -> tuple[ErrorGroup, ...]:
    """Sort the groups of each channel by size; groups of one row have no deviations."""
    found = []
    for index, channel in enumerate(channels):
        mine = np.flatnonzero(rows.group_sensor == channel.sensor)
        size = rows.group_size[mine]
        spare = int(np.sum(size - 1))
        if spare > 0:
            found.append(ErrorGroup(index, 0, mine, channel.dimension * spare))
        for value in np.unique(size):
            groups = mine[size == value]
            found.append(ErrorGroup(index, int(value), groups, channel.dimension * len(groups)))
    return tuple(found)


def _frames(rows: Rows, reference: FloatArray) -> FloatArray:
    """Return the line of sight of each row's group, and two directions across it, (n, 3, 3)."""
    middle = rows.group_sum(rows.target, axis=0) / rows.group_size[:, None]
    sight = middle - reference[rows.group_sensor, :3, 3]
    sight /= np.maximum(np.linalg.norm(sight, axis=1), np.finfo(float).tiny)[:, None]
    # The base axis least along the line of sight gives a first direction across it.
    helper = np.eye(3)[np.argmin(np.abs(sight), axis=1)]
    first = np.cross(sight, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    frames = np.stack((sight, first, np.cross(sight, first)), axis=1)
    return frames[rows.group_of_row]
