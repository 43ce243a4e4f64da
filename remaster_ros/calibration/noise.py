# SPDX-License-Identifier: Apache-2.0
"""Noise of the sensors: independent parts, parts common to rows, and the sums of squares of both.

The error of a row is independent per point and axis with standard deviation sigma, plus a part
that is common to all rows of one sensor at one pose, with standard deviation pose_sigma per axis.
With the error's group means m_g and sizes n_g, the likelihood of a sensor is::

  N(deviations from m_g | 0, sigma^2)  x  prod_g N(m_g | 0, pose_sigma^2 + sigma^2 / n_g)

So the data enter through one sum of squares about the group means, and one of the means for every
group size: the error groups. If a sensor's noise along its line of sight differs from the one
across it, the two are channels with a sigma and a pose_sigma each, of dimension 1 and 2 instead of
3.

If a sensor has one row at every pose the two parts cannot be distinguished: sigma is then their
sum, and there is no pose_sigma.

*Several markers.* The markers that a sensor has in one frame have a further common part, with
standard deviation frame_sigma per axis: from the sensor, and from the arm's repeatability. With M
markers in a frame its mean has the variance sigma^2 / M + frame_sigma^2, and a pose with m frames
enters by three kinds of errors, whose variances are::

  deviations from the frames' means           sigma^2
  those of the frames' means, times sqrt(M)   sigma^2 + M frame_sigma^2
  the pose's mean, times sqrt(m M)            sigma^2 + M frame_sigma^2 + m M pose_sigma^2

This is exact if the frames of a pose have equally many markers. If some markers were hidden in
some frames, M is the harmonic mean of their numbers and every frame has the same weight (the
analysis of unweighted means, Burdick and Graybill 1992, Confidence Intervals on Variance
Components): the sums then have these variances on average. Without frames of several markers M is
1, and there is no frame_sigma. If every pose has one frame only, frame_sigma contains pose_sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.noise_channels import Channel, ErrorGroup, error_groups
from remaster_ros.types import FloatArray, IntArray

# Resolution that no sensor of this kind exceeds; keeps the density of noise-free data proper.
RESOLUTION_M = 1e-7
# Median length of a standard normal vector in three dimensions.
MEDIAN_LENGTH = 1.5381722545
# Number of rows whose features are in memory at once for the sum of their Gram matrices.
GRAM_ROWS = 2_000
# Number of rows that are whitened at once: with a thousand columns they fit into a processor's
# cache.
WHITENED_ROWS = 64


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations per axis of the noise of each channel, m, (..., channels).

    In rad for channels of orientations.
    """

    sigma: FloatArray  # Part that is independent between rows
    # Part common to the rows of one sensor at one pose; 0 if the channel has none
    pose_sigma: FloatArray
    # Part common to the markers of one frame; 0 if the channel has none
    frame_sigma: FloatArray

    @property
    def total(self) -> FloatArray:
        """Standard deviation of the sum of all parts, m, (..., channels)."""
        total: FloatArray = np.sqrt(self.sigma**2 + self.pose_sigma**2 + self.frame_sigma**2)
        return total


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of n rows: channels of the sensors, and groups of errors with one variance each."""

    rows: Rows  # n rows, sorted by sensor and pose
    sensors: int  # Number of sensors, those without rows included
    # Channels of sensor 0, of sensor 1, …, last those of orientations, whose noise is in rad
    channels: tuple[Channel, ...]
    # Indices of the channels with a pose_sigma, and with a frame_sigma of their own, ascending
    separable: tuple[int, ...]
    framed: tuple[int, ...]
    error_groups: tuple[ErrorGroup, ...]  # Sums of squares by which the data enter
    # Rows of a matrix: the line of sight and two directions across it, in the coordinates of
    # `Rows.target`, one for all rows of a group, (n, 3, 3); None where no sensor needs them
    frames: FloatArray | None

    @classmethod
    def of(cls, rows: Rows, reference: FloatArray, split: Sequence[int] = ()) -> NoiseModel:
        """Noise model of n rows.

        ``reference``: T_R_N of every sensor, (sensors, 4, 4), where the lines of sight begin;
        ``split``: sensors with one noise along and another across their line of sight.
        """
        channels: list[Channel] = []
        for sensor in range(len(reference) + len(rows.turning)):
            if sensor in split:
                channels += [Channel(sensor, 'along', (0, 1)), Channel(sensor, 'across', (1, 3))]
            else:
                channels.append(Channel(sensor, '', (0, 3)))
        several = set(rows.group_sensor[rows.group_frames > 1].tolist())
        shared = set(rows.group_sensor[rows.group_size > rows.group_frames].tolist())
        return cls(
            rows,
            len(reference),
            tuple(channels),
            tuple(index for index, c in enumerate(channels) if c.sensor in several),
            tuple(index for index, c in enumerate(channels) if c.sensor in shared),
            error_groups(channels, rows),
            _frames(rows, reference) if len(split) > 0 else None,
        )

    @property
    def split(self) -> tuple[int, ...]:
        """Indices of the sensors with a separate noise along their line of sight, ascending.

        Orientations of sensor ``turning[i]`` have the index S + i, S being the number of sensors.
        """
        return tuple(channel.sensor for channel in self.channels if channel.direction == 'along')

    @property
    def of_points(self) -> NoiseModel:
        """Noise model of the positions only, with the first channels and error groups."""
        if not self.rows.turning:
            return self
        channels = tuple(channel for channel in self.channels if channel.sensor < self.sensors)
        rows = self.rows.of_points
        return replace(
            self,
            rows=rows,
            channels=channels,
            separable=tuple(index for index in self.separable if index < len(channels)),
            framed=tuple(index for index in self.framed if index < len(channels)),
            error_groups=tuple(
                channel for channel in self.error_groups if channel.channel < len(channels)
            ),
            frames=None if self.frames is None else self.frames[: len(rows)],
        )

    @cached_property
    def channel_of(self) -> IntArray:
        """Index of each error group's channel, (error groups,)."""
        return np.array([group.channel for group in self.error_groups])

    @cached_property
    def size_of(self) -> FloatArray:
        """Factor of pose_sigma² in the variance of each error group, (error groups,).

        For a group of poses' means: the frames of a pose times the harmonic mean of their
        rows, which is the number of its rows if frames are of one size. 0 for all other
        groups.
        """
        return np.array([group.size for group in self.error_groups])

    @cached_property
    def frame_size_of(self) -> FloatArray:
        """Factor of frame_sigma² in the variance of each error group, (error groups,).

        For groups of means of frames or poses: the harmonic mean of the numbers of rows of a
        pose's frames. 0 for groups of rows' deviations from the means of their frames.
        """
        return np.array([group.frame_size for group in self.error_groups])

    @cached_property
    def freedom(self) -> FloatArray:
        """Number of independent numbers in each error group, (error groups,)."""
        return np.array([group.freedom for group in self.error_groups], dtype=float)

    def variances(self, noise: Noise) -> FloatArray:
        """Variance of each error group, m², (..., error groups)."""
        of = self.channel_of
        variance_of_rows = (
            noise.sigma[..., of] ** 2 + self.frame_size_of * noise.frame_sigma[..., of] ** 2
        )
        variances: FloatArray = variance_of_rows + self.size_of * noise.pose_sigma[..., of] ** 2
        return variances

    @property
    def shares(self) -> list[int]:
        """Channels (indices) with a pose_sigma, then those with a frame_sigma.

        These are `separable` and `framed`. A channel with both is in the list twice.
        """
        return [*self.separable, *self.framed]

    def noise(self, sigma: FloatArray, shared: FloatArray) -> Noise:
        """Noise with standard deviations ``sigma`` of channels, ``shared`` of common parts.

        In m, of channels of orientations rad; (..., channels) and (..., s). ``shared``: in the
        order of `shares`, pose_sigma first, then frame_sigma; a channel without a common part
        has 0.
        """
        pose_sigma, frame_sigma = np.zeros_like(sigma), np.zeros_like(sigma)
        count = len(self.separable)
        pose_sigma[..., list(self.separable)] = shared[..., :count]
        frame_sigma[..., list(self.framed)] = shared[..., count:]
        return Noise(sigma, pose_sigma, frame_sigma)

    def shared(self, noise: Noise) -> FloatArray:
        """Common parts, in the order of `shares`, of a noise, m, (..., s)."""
        parts = noise.pose_sigma[..., self.separable], noise.frame_sigma[..., self.framed]
        return np.concatenate(parts, axis=-1)

    def of_sensors(self, sigma: FloatArray, pose_sigma: FloatArray) -> Noise:
        """Noise of each channel from one sigma and pose_sigma for each sensor, m, (sensors,) each.

        ``frame_sigma`` is 0.
        """
        sensor = [channel.sensor for channel in self.channels]
        return Noise(sigma[..., sensor], pose_sigma[..., sensor], np.zeros(len(sensor)))

    def sensor_noise(self, noise: Noise) -> Noise:
        """Noise of each sensor, root mean square over the axes, m, (..., sensors).

        After the sensors: the noise of the orientations of each sensor that measures orientations,
        rad.
        """
        share = np.zeros((len(self.channels), self.sensors + len(self.rows.turning)))
        for index, channel in enumerate(self.channels):
            share[index, channel.sensor] = channel.dimension / 3.0
        parts = noise.sigma, noise.pose_sigma, noise.frame_sigma
        return Noise(*(np.sqrt(part**2 @ share) for part in parts))

    def total_noise(self, noise: Noise) -> FloatArray:
        """Noise of each sensor, sum of all parts, m, (..., sensors, 2).

        Last axis: along the line of sight, and per axis across it; equal if the sensor has one
        channel.
        """
        total = noise.total
        result = np.empty((*total.shape[:-1], self.sensors, 2))
        for index, channel in enumerate(self.channels):
            if channel.sensor >= self.sensors:
                continue
            sides = {'along': [0], 'across': [1]}.get(channel.direction, [0, 1])
            result[..., channel.sensor, sides] = total[..., index, None]
        return result

    def sums_of_squares(self, errors: FloatArray) -> FloatArray:
        """Sum of squares in each error group, m², (..., error groups), of errors (..., n, 3).

        An error group has, of one channel, the deviations of rows from their frame's mean, those
        of frames' means from their pose's mean, or the poses' means; means are scaled so that
        they have the `variances`. rad² of orientations.
        """
        # The rows first, in memory too: each sum is over long rows.
        values = np.moveaxis(errors.reshape(-1, *errors.shape[-2:]), 0, -1)
        values = np.ascontiguousarray(values)
        if self.frames is not None:
            values = self.frames @ values
        values = self.rows.decorrelated(values)
        sums = np.zeros((len(self.error_groups), values.shape[2]))
        for index, part in self._parts(self.rows, values, 0):
            flat = part.reshape(-1, values.shape[2])
            sums[index] = np.einsum('nd,nd->d', flat, flat)
        for index, parts in self.contained.items():
            sums[index] -= sums[parts].sum(axis=0)
        # Cancellation may leave a value just below zero.
        return np.maximum(sums, 0.0).T.reshape(*errors.shape[:-2], -1)

    def gram(self, features: Callable[[Rows, slice], FloatArray], width: int) -> FloatArray:
        """Gram matrix of features in each error group, (error groups, width, width).

        ``features``: function from rows, and their slice among all rows, to vectors (rows, 3,
        width), as of `parts`; ``width``: number of features.
        """
        result = np.zeros((len(self.error_groups), width, width))
        for index, part in self.parts(features):
            result[index] += part.T @ part
        for index, contained_groups in self.contained.items():
            result[index] -= result[contained_groups].sum(axis=0)
        return result

    def parts(
        self, features: Callable[[Rows, slice], FloatArray]
    ) -> Iterator[tuple[int, FloatArray]]:
        """Yield (index of error group, columns C (r, width)), whose C'C sum up to its Gram matrix.

        A group comes several times. The sum of a group in `contained` also includes the Gram
        matrices of the groups listed there, which the caller subtracts, as `gram` does. Columns
        are decorrelated and in the axes of the channels, not divided by standard deviations.
        ``features``: function from rows, and their slice among all rows, to vectors (rows, 3,
        width) in the coordinates of `Rows.target`; called with about 2,000 rows (`GRAM_ROWS`) at
        a time to bound the memory, or with all at once if rows are correlated along the path.
        """
        # Rows that are correlated along the path are taken whole.
        most = len(self.rows) + 1 if self.rows.decorrelation else GRAM_ROWS
        for first, last in self.rows.blocks(most):
            rows = self.rows.of_groups(first, last)
            start = int(self.rows.group_start[first])
            span = slice(start, start + len(rows))
            values = features(rows, span)
            if self.frames is not None:
                values = self.frames[span] @ values
            values = rows.decorrelated(values)
            for index, part in self._parts(rows, values, first):
                yield index, part.reshape(-1, values.shape[2])

    def _parts(
        self, rows: Rows, values: FloatArray, first: int
    ) -> Iterator[tuple[int, FloatArray]]:
        """Yield (index of error group, its vectors): their squares add up to its sum of squares.

        For groups of kind 'frames' these are the frames' means, weighted, which contain the
        poses' means (`contained`). ``rows``: whole poses, the first being that with index
        ``first`` in all rows' groups; ``values``: vectors in the axes of the channels, (n, 3,
        ...).
        """
        shape = (-1, *(1,) * (values.ndim - 1))
        means = frames = values
        if rows.frame is not None:
            means = rows.frame_sum(values) / rows.frame_size.reshape(shape)
            frames = means * np.sqrt(rows.mean_frame_size[rows.group_of_frame]).reshape(shape)
        poses = rows.sum_of_frames(frames) / np.sqrt(rows.group_frames).reshape(shape)
        spans = dict(rows.spans)
        for index, group in enumerate(self.error_groups):
            channel = self.channels[group.channel]
            axes, span = slice(*channel.axes), spans.get(channel.sensor, slice(0, 0))
            groups = group.groups[(group.groups >= first) & (group.groups < first + len(poses))]
            if group.kind == 'poses':
                yield index, poses[groups - first, axes]
            elif group.kind == 'frames':
                yield index, frames[np.isin(rows.group_of_frame, groups - first), axes]
            elif rows.frame is not None:
                mean = np.repeat(means[:, axes], rows.frame_size, axis=0)
                yield index, values[span, axes] - mean[span]

    @cached_property
    def contained(self) -> dict[int, list[int]]:
        """Error groups of kind 'frames' -> error groups contained in their sums (indices).

        These are of kind 'poses' and are subtracted from the sums of squares.
        """
        return {
            index: [
                other
                for other, poses in enumerate(self.error_groups)
                if poses.kind == 'poses'
                # Where a pose has one frame, that has no deviation from the pose's mean.
                and poses.size > poses.frame_size
                and (poses.channel, poses.frame_size) == (group.channel, group.frame_size)
            ]
            for index, group in enumerate(self.error_groups)
            if group.kind == 'frames'
        }

    def whitened(
        self, values: NDArray[Any], noise: Noise, out: NDArray[Any] | None = None
    ) -> NDArray[Any]:
        """Vectors (n, 3, ...) in units of the noise: independent, with variance 1 in all rows.

        If a sensor's noise depends on the direction (`frames` is not None), their axes are the
        line of sight and two across it. ``out``: array of the same shape to write them to,
        which is returned; None for a new one.
        """
        white = np.empty_like(values) if out is None else out
        parts = self._of_groups(noise)
        # Rows that are correlated along the path are taken whole; of others some at a time, so
        # that what is between is in the processor's cache and in memory once.
        most = len(self.rows) + 1 if self.rows.decorrelation else WHITENED_ROWS
        for first, last in self.rows.blocks(most):
            rows = self.rows.of_groups(first, last)
            start = int(self.rows.group_start[first])
            span = slice(start, start + len(rows))
            flat = values[span].reshape(len(rows), 3, -1)
            if self.frames is not None:
                flat = self.frames[span].astype(values.dtype) @ flat
            white[span] = _whitened(
                rows, rows.decorrelated(flat), *(part[first:last] for part in parts)
            ).reshape(white[span].shape)
        return white

    def _of_groups(self, noise: Noise) -> FloatArray:
        """Sigma, pose_sigma and frame_sigma of each group of rows and axis, m, (3, groups, 3).

        First index: the three sigmas, in this order; groups: a sensor at one pose each, as in
        `Rows`, not error groups; last index: axes of the channels. In rad for orientations.
        """
        rows, parts = self.rows, np.ones((3, len(self.rows.group_size), 3))
        for index, channel in enumerate(self.channels):
            of_sensor, axes = rows.group_sensor == channel.sensor, slice(*channel.axes)
            for part, of_channel in zip(
                parts, (noise.sigma, noise.pose_sigma, noise.frame_sigma), strict=True
            ):
                part[of_sensor, axes] = of_channel[index]
        return parts


def _whitened(
    rows: Rows,
    flat: NDArray[Any],
    sigma: FloatArray,
    pose_sigma: FloatArray,
    frame_sigma: FloatArray,
) -> NDArray[Any]:
    """Vectors (n, 3, c) in units of the noise: independent, with variance 1.

    Errors common to a frame or a pose are taken account of. ``flat``: the vectors, in the axes
    of the channels, (n, 3, c), not changed; ``sigma, pose_sigma, frame_sigma``: by group
    (pose) of ``rows`` and axis, m, (groups, 3).
    """
    kind = flat.dtype
    size, count = rows.mean_frame_size[:, None], rows.group_frames[:, None]
    inner = np.sqrt(sigma**2 + size * frame_sigma**2)
    outer = np.sqrt(inner**2 + count * size * pose_sigma**2)
    # With M the size of a frame, w = sqrt(harmonic mean / M), means f of frames, p of poses:
    # (value - f) / sigma + w (f - p) / inner + w p / outer. A frame of one row is its value.
    of_frame = rows.group_of_frame
    ratio = np.sqrt(size[of_frame] / rows.frame_size[:, None])
    means = flat
    if rows.frame is not None:
        means = rows.frame_sum(flat) / rows.frame_size[:, None, None].astype(kind)
    of_poses = rows.sum_of_frames(means.reshape(len(of_frame), -1))
    of_poses = of_poses.reshape(len(size), 3, -1) / count[:, :, None].astype(kind)
    of_poses *= (1.0 / inner - 1.0 / outer)[:, :, None].astype(kind)
    white: NDArray[Any] = flat * (1.0 / sigma)[rows.group_of_row][:, :, None].astype(kind)
    if rows.frame is None:
        white -= of_poses[of_frame]
        return white
    less = (1.0 / sigma[of_frame] - ratio / inner[of_frame])[:, :, None].astype(kind) * means
    less += of_poses[of_frame] * ratio[:, :, None].astype(kind)
    white -= np.repeat(less, rows.frame_size, axis=0)
    return white


def _frames(rows: Rows, reference: FloatArray) -> FloatArray:
    """Line of sight of each row's group, and two directions across it, (n, 3, 3)."""
    middle = rows.group_sum(rows.measured) / rows.group_size[:, None]
    sensor = np.array([*range(len(reference)), *rows.turning])[rows.group_sensor]
    sight = middle - reference[sensor, :3, 3]
    sight /= np.maximum(np.linalg.norm(sight, axis=1), np.finfo(float).tiny)[:, None]
    # The base axis least along the line of sight gives a first direction across it.
    helper = np.eye(3)[np.argmin(np.abs(sight), axis=1)]
    first = np.cross(sight, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    frames = np.stack((sight, first, np.cross(sight, first)), axis=1)
    return frames[rows.group_of_row]
