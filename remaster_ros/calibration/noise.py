# SPDX-License-Identifier: Apache-2.0
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

*Several markers.* The markers that a sensor has in one frame share a further part, with standard
deviation frame_sigma per axis: of the sensor, and of how well the arm repeats itself. With M
markers in a frame its mean has the variance sigma^2 / M + frame_sigma^2, and a pose with m frames
enters by three kinds of errors, whose variances are::

    deviations from the frames' means           sigma^2
    those of the frames' means, times sqrt(M)   sigma^2 + M frame_sigma^2
    the pose's mean, times sqrt(m M)            sigma^2 + M frame_sigma^2 + m M pose_sigma^2

This is exact where the frames of a pose have equally many markers. Where some were hidden in some
of them, M is the harmonic mean of their numbers and every frame has the same weight (the analysis
of unweighted means, Burdick and Graybill 1992, Confidence Intervals on Variance Components): the
sums then have these variances on average. Without frames of several markers M is 1, and nothing is
said of frame_sigma. Where every pose has one frame only, frame_sigma contains pose_sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.types import FloatArray, IntArray

# Which errors of some rows have one variance: channels of the sensors, and groups of errors.


@dataclass(frozen=True)
class Channel:
    """Errors of one sensor that have one noise."""

    sensor: int  # Its index
    direction: str  # 'along' the line of sight, 'across' it, or '' for all axes alike
    axes: tuple[int, int]  # Which axes of the rows' frames these are: first and behind the last

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return self.axes[1] - self.axes[0]


@dataclass(frozen=True, eq=False)
class ErrorGroup:
    """Errors of one channel that have one variance.

    The variance is sigma² + frame_size frame_sigma² + size pose_sigma².
    """

    channel: int  # Its index
    # 'rows' for the deviations from the means of the frames, 'frames' for those of the frames'
    # means from the mean of their pose, 'poses' for the poses' means
    kind: Literal['rows', 'frames', 'poses']
    frame_size: float  # Harmonic mean M of the rows of a pose's frames; 0 of 'rows'
    # m M for m frames in a pose, which is the number of its rows where the frames are of one size;
    # 0 but of 'poses'
    size: float
    # The rows' groups that these errors belong to, (g,): of 'frames' those with several
    groups: IntArray
    freedom: int  # Number of independent errors


def error_groups(channels: Sequence[Channel], rows: Rows) -> tuple[ErrorGroup, ...]:
    """Sort the groups of each channel by their frames; what has no independent error is none."""
    found = []
    for index, channel in enumerate(channels):
        mine = np.flatnonzero(rows.group_sensor == channel.sensor)
        frames, size = rows.group_frames[mine], rows.mean_frame_size[mine]

        def add(
            kind: Literal['rows', 'frames', 'poses'],
            frame_size: float,
            size: float,
            groups: IntArray,
            errors: int,
            channel: Channel = channel,
            index: int = index,
        ) -> None:
            if errors > 0:
                freedom = channel.dimension * errors
                found.append(ErrorGroup(index, kind, frame_size, size, groups, freedom))

        add('rows', 0.0, 0.0, mine, int(np.sum(rows.group_size[mine] - frames)))
        for value in np.unique(size).tolist():
            alike = mine[size == value]
            number = frames[size == value]
            add('frames', value, 0.0, alike[number > 1], int(np.sum(number - 1)))
            for count in np.unique(number).tolist():
                groups = alike[number == count]
                add('poses', value, count * value, groups, len(groups))
    return tuple(found)


# No sensor of this kind resolves better than 0.1 µm; keeps noise-free (simulated) data proper.
RESOLUTION_M = 1e-7
# Median length of a standard normal vector in three dimensions.
MEDIAN_LENGTH = 1.5381722545
# Rows whose features are held in memory at once while their Gram matrix is summed up.
GRAM_ROWS = 2_000


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations per axis of each channel, m, (..., channels)."""

    sigma: FloatArray  # Of the part that is independent between rows
    # Of the part that the rows of one sensor at one pose share; 0 where the channel has none
    pose_sigma: FloatArray
    # Of the part that the markers of one frame share; 0 where the channel has none
    frame_sigma: FloatArray

    @property
    def total(self) -> FloatArray:
        """Standard deviation of all parts together, m, (..., channels)."""
        total: FloatArray = np.sqrt(self.sigma**2 + self.pose_sigma**2 + self.frame_sigma**2)
        return total


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Which errors of some rows have which variance."""

    rows: Rows  # n rows, sorted by sensor and pose
    sensors: int  # Number of sensors, those without rows included
    # Those of sensor 0, of sensor 1, …, last those of orientations, whose noise is in rad
    channels: tuple[Channel, ...]
    # Indices of the channels with a pose_sigma, and with a frame_sigma of their own, ascending
    separable: tuple[int, ...]
    framed: tuple[int, ...]
    error_groups: tuple[ErrorGroup, ...]  # What the data enter by
    # Rows of a matrix: the line of sight and two directions across it, in the coordinates of
    # `Rows.target`, one for all rows of a group, (n, 3, 3); None where no sensor needs them
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
        """Sensors with a noise along their line of sight, orientations as `Rows.spans`."""
        return tuple(channel.sensor for channel in self.channels if channel.direction == 'along')

    @property
    def of_points(self) -> NoiseModel:
        """That of the positions alone, whose channels and error groups are the first of these."""
        if not self.rows.turning:
            return self
        channels = tuple(one for one in self.channels if one.sensor < self.sensors)
        rows = self.rows.of_points
        return replace(
            self,
            rows=rows,
            channels=channels,
            separable=tuple(index for index in self.separable if index < len(channels)),
            framed=tuple(index for index in self.framed if index < len(channels)),
            error_groups=tuple(one for one in self.error_groups if one.channel < len(channels)),
            frames=None if self.frames is None else self.frames[: len(rows)],
        )

    @cached_property
    def channel_of(self) -> IntArray:
        """Index of each error group's channel, (error groups,)."""
        return np.array([group.channel for group in self.error_groups])

    @cached_property
    def size_of(self) -> FloatArray:
        """Share of pose_sigma² in the variance of each error group, (error groups,)."""
        return np.array([group.size for group in self.error_groups])

    @cached_property
    def frame_size_of(self) -> FloatArray:
        """Share of frame_sigma² in the variance of each error group, (error groups,)."""
        return np.array([group.frame_size for group in self.error_groups])

    @cached_property
    def freedom(self) -> FloatArray:
        """Number of independent errors in each error group, (error groups,)."""
        return np.array([group.freedom for group in self.error_groups], dtype=float)

    def variances(self, noise: Noise) -> FloatArray:
        """Return the variance of each error group, m², (..., error groups)."""
        of = self.channel_of
        own = noise.sigma[..., of] ** 2 + self.frame_size_of * noise.frame_sigma[..., of] ** 2
        variances: FloatArray = own + self.size_of * noise.pose_sigma[..., of] ** 2
        return variances

    @property
    def shares(self) -> list[int]:
        """Channels of the parts that rows share: those `separable`, then those `framed`."""
        return [*self.separable, *self.framed]

    def noise(self, sigma: FloatArray, shared: FloatArray) -> Noise:
        """Return the noise with sigma of the channels and the parts `shares`, m, (..., s)."""
        pose_sigma, frame_sigma = np.zeros_like(sigma), np.zeros_like(sigma)
        count = len(self.separable)
        pose_sigma[..., list(self.separable)] = shared[..., :count]
        frame_sigma[..., list(self.framed)] = shared[..., count:]
        return Noise(sigma, pose_sigma, frame_sigma)

    def shared(self, noise: Noise) -> FloatArray:
        """Return the parts `shares` of a noise, m, (..., s)."""
        parts = noise.pose_sigma[..., self.separable], noise.frame_sigma[..., self.framed]
        return np.concatenate(parts, axis=-1)

    def of_sensors(self, sigma: FloatArray, pose_sigma: FloatArray) -> Noise:
        """Return the noise with one sigma and pose_sigma for each sensor, m, (sensors,) each."""
        sensor = [channel.sensor for channel in self.channels]
        return Noise(sigma[..., sensor], pose_sigma[..., sensor], np.zeros(len(sensor)))

    def sensor_noise(self, noise: Noise) -> Noise:
        """Return the noise of each sensor, root mean square over the axes, m, (..., sensors).

        Behind those the noise of the orientations of each sensor that measures them, rad.
        """
        share = np.zeros((len(self.channels), self.sensors + len(self.rows.turning)))
        for index, channel in enumerate(self.channels):
            share[index, channel.sensor] = channel.dimension / 3.0
        parts = noise.sigma, noise.pose_sigma, noise.frame_sigma
        return Noise(*(np.sqrt(part**2 @ share) for part in parts))

    def total_noise(self, noise: Noise) -> FloatArray:
        """Return the noise of each sensor, all its parts together, m, (..., sensors, 2).

        Along the line of sight, and per axis across it: equal where the sensor has one channel.
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
        """Return the sum of squares in each error group, m², of errors (..., n, 3)."""
        if self.frames is not None:
            errors = np.einsum('nij,...nj->...ni', self.frames, errors)
        values = self.rows.decorrelated(np.moveaxis(errors, (-2, -1), (0, 1)))
        sums = np.zeros((*errors.shape[:-2], len(self.error_groups)))
        for index, part in self._parts(self.rows, values, 0):
            sums[..., index] = np.einsum('ni...,ni...->...', part, part)
        for index, parts in self.contained.items():
            sums[..., index] -= sums[..., parts].sum(axis=-1)
        # Cancellation may leave a value just below zero.
        return np.maximum(sums, 0.0)

    def gram(self, features: Callable[[Rows, slice], FloatArray], width: int) -> FloatArray:
        """Return the Gram matrix of features in each error group, (error groups, width, width).

        Parameters
        ----------
        features
            As of `parts`.
        width
            Number of features.
        """
        result = np.zeros((len(self.error_groups), width, width))
        for index, part in self.parts(features):
            result[index] += part.T @ part
        for index, others in self.contained.items():
            result[index] -= result[others].sum(axis=0)
        return result

    def parts(
        self, features: Callable[[Rows, slice], FloatArray]
    ) -> Iterator[tuple[int, FloatArray]]:
        """Give error groups with columns whose products are those of features, (r, width).

        Each several times, less the products of what is `contained` in it.

        Parameters
        ----------
        features
            Rows, and where they are among all rows, to features (rows, 3, width), vectors in the
            coordinates of `Rows.target`; called with some thousand rows at a time, so that memory
            does not grow with their number.
        """
        # Rows that are correlated along the path are taken whole.
        most = len(self.rows) + 1 if self.rows.decorrelation else GRAM_ROWS
        for first, last in self.rows.blocks(most):
            rows = self.rows.of_groups(first, last)
            start = int(self.rows.group_start[first])
            where = slice(start, start + len(rows))
            values = features(rows, where)
            if self.frames is not None:
                values = self.frames[where] @ values
            values = rows.decorrelated(values)
            for index, part in self._parts(rows, values, first):
                yield index, part.reshape(-1, values.shape[2])

    def _parts(
        self, rows: Rows, values: FloatArray, first: int
    ) -> Iterator[tuple[int, FloatArray]]:
        """Return of each error group the vectors whose squares its sum is made of.

        Of 'frames' those of the means themselves, which contain the poses' means (`contained`).

        ``rows``: n of the rows, whole groups from the one with index ``first`` on; ``values``:
        vectors in the axes of the channels, (n, 3, ...).
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
        """Error groups of kind 'frames' -> those whose sums theirs contains at first."""
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

    def whitened(self, values: NDArray[Any], noise: Noise) -> NDArray[Any]:
        """Return vectors (n, 3, ...) in units of the noise: independent, variance 1 in all rows.

        Where a sensor's noise has directions they are returned in the rows' `frames`.
        """
        rows, kind = self.rows, values.dtype
        flat = values.reshape(len(rows), 3, -1)
        if self.frames is not None:
            flat = self.frames.astype(kind) @ flat
        flat = rows.decorrelated(flat)
        sigma, pose_sigma, frame_sigma = self._of_groups(noise)
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
        white = flat * (1.0 / sigma)[rows.group_of_row][:, :, None].astype(kind)
        if rows.frame is None:
            white -= of_poses[of_frame]
        else:
            less = (1.0 / sigma[of_frame] - ratio / inner[of_frame])[:, :, None].astype(
                kind
            ) * means
            less += of_poses[of_frame] * ratio[:, :, None].astype(kind)
            white -= np.repeat(less, rows.frame_size, axis=0)
        return white.reshape(values.shape)

    def _of_groups(self, noise: Noise) -> FloatArray:
        """Return sigma, pose_sigma and frame_sigma of each group and axis, m, (3, groups, 3)."""
        rows, parts = self.rows, np.ones((3, len(self.rows.group_size), 3))
        for index, channel in enumerate(self.channels):
            mine, axes = rows.group_sensor == channel.sensor, slice(*channel.axes)
            for part, of_channel in zip(
                parts, (noise.sigma, noise.pose_sigma, noise.frame_sigma), strict=True
            ):
                part[mine, axes] = of_channel[index]
        return parts


def _frames(rows: Rows, reference: FloatArray) -> FloatArray:
    """Return the line of sight of each row's group, and two directions across it, (n, 3, 3)."""
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
