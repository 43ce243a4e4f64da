"""The exact log density of parameters and noise given the data.

Noise model: the error of a row is independent per point and axis with standard deviation sigma,
plus a part that all rows of one sensor at one pose share, with standard deviation pose_sigma per
axis. With the error's group means m_g and sizes n_g, the likelihood of a sensor is::

    N(deviations from m_g | 0, sigma^2)  x  prod_g N(m_g | 0, pose_sigma^2 + sigma^2 / n_g)

So the data enter through one sum of squares about the group means, and one of the means for every
group size: the *cells*. Where a sensor's noise along its line of sight differs from the one across
it, the two are *channels* with a sigma and a pose_sigma each, of dimension 1 and 2 instead of 3.

Where a sensor has one row at every pose the two parts cannot be told apart: sigma is then their
sum, and there is no pose_sigma.

Priors: flat in log sigma, which is the paper's p(sigma^2) ∝ sigma^-2 d(sigma^2) (eq. 14), down to
the resolution no sensor passes (`RESOLUTION_M`); pose_sigma / sigma half-Cauchy with scale 1,
proper at zero and without a unit (Gelman 2006); registrations flat in the turn and shift of the
pinned coordinates of `model`; inner joint offsets flat; markers and base frames Gaussian where
something is known of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.priors import Prior
from remaster_ros.types import BoolArray, FloatArray, IntArray

# No sensor of this kind resolves better than 0.1 µm; keeps noise-free (simulated) data proper.
RESOLUTION_M = 1e-7
# Forward kinematics of one block of draws; larger blocks fall out of the processor's cache.
BLOCK_ROWS = 40_000


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
class Posterior:
    """What the optimization rows say about the free parameters and the noise.

    A point is a flat vector (d,): the free pinned parameters, then the noise coordinates eta:
    log sigma of every channel, and asinh(pose_sigma / sigma) >= 0 of the channels where it can be
    told apart. The latter is as good as linear near zero and as a logarithm far from it, so the
    posterior looks alike whether pose_sigma is nothing or nearly all; its prior is sech.

    Attributes
    ----------
    model, rows, priors
        What is fitted, to which rows, and what is known beforehand.
    free
        Indices of the parameters that are not held, (f,).
    reference
        Pinned parameters; those not in ``free`` keep these values, (size,).
    channels
        Those of sensor 0, of sensor 1, …
    separable
        Indices of the channels with a pose_sigma of their own, ascending.
    cells
        What the data enter by.
    frames
        Rows of a matrix: the line of sight and two directions across it, in the coordinates of
        `Rows.target`, one for all rows of a group, (n, 3, 3); None where no sensor needs them.
    """

    model: Model
    rows: Rows
    priors: tuple[Prior, ...]
    free: IntArray
    reference: FloatArray
    channels: tuple[Channel, ...]
    separable: tuple[int, ...]
    cells: tuple[ErrorGroup, ...]
    frames: FloatArray | None

    @classmethod
    def of(
        cls,
        model: Model,
        rows: Rows,
        priors: Sequence[Prior],
        free: IntArray,
        reference: FloatArray,
        split: Sequence[int] = (),
    ) -> Posterior:
        """Assemble; ``split`` are the sensors with a noise along and another across their sight.

        A channel of a sensor with several rows at some pose has a pose_sigma of its own.
        """
        channels: list[Channel] = []
        for sensor in range(len(model.sensor_names)):
            if sensor in split:
                channels += [Channel(sensor, 'along', (0, 1)), Channel(sensor, 'across', (1, 3))]
            else:
                channels.append(Channel(sensor, '', (0, 3)))
        several = set(rows.group_sensor[rows.group_size > 1].tolist())
        frames = _frames(model, rows) if len(split) > 0 else None
        return cls(
            model,
            rows,
            tuple(priors),
            free,
            reference,
            tuple(channels),
            tuple(index for index, c in enumerate(channels) if c.sensor in several),
            _cells(channels, rows),
            frames,
        )

    @property
    def size(self) -> int:
        """Length of a point."""
        return len(self.free) + len(self.channels) + len(self.separable)

    def parameters(self, points: FloatArray) -> FloatArray:
        """Return the full pinned parameters (..., size of the model) of points (..., d)."""
        z = np.broadcast_to(self.reference, (*points.shape[:-1], self.model.size)).copy()
        z[..., self.free] = points[..., : len(self.free)]
        return z

    def noise(self, eta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and pose_sigma of each channel, m, (..., channels) each.

        pose_sigma is zero for the channels where it cannot be told apart.
        """
        count = len(self.channels)
        sigma = np.exp(eta[..., :count])
        pose_sigma = np.zeros_like(sigma)
        separable = list(self.separable)
        pose_sigma[..., separable] = sigma[..., separable] * np.sinh(np.abs(eta[..., count:]))
        return sigma, pose_sigma

    def sensor_noise(self, eta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and pose_sigma of each sensor, root mean square over the axes, m."""
        share = np.zeros((len(self.channels), len(self.model.sensor_names)))
        for index, channel in enumerate(self.channels):
            share[index, channel.sensor] = channel.dimension / 3.0
        sigma, pose_sigma = self.noise(eta)
        return np.sqrt(sigma**2 @ share), np.sqrt(pose_sigma**2 @ share)

    def total_noise(self, eta: FloatArray) -> FloatArray:
        """Return the noise of each sensor, both its parts together, m, (..., sensors, 2).

        Along the line of sight, and per axis across it: alike where they were not told apart.
        """
        sigma, pose_sigma = self.noise(eta)
        total = np.hypot(sigma, pose_sigma)
        result = np.empty((*eta.shape[:-1], len(self.model.sensor_names), 2))
        for index, channel in enumerate(self.channels):
            sides = {'along': [0], 'across': [1]}.get(channel.direction, [0, 1])
            result[..., channel.sensor, sides] = total[..., index, None]
        return result

    def variances(self, eta: FloatArray) -> FloatArray:
        """Return the variance of each cell, m², (..., cells)."""
        sigma, pose_sigma = self.noise(eta)
        channel = [cell.channel for cell in self.cells]
        size = np.array([cell.size for cell in self.cells])
        return sigma[..., channel] ** 2 + size * pose_sigma[..., channel] ** 2

    @cached_property
    def freedom(self) -> FloatArray:
        """Number of independent errors in each cell, (cells,)."""
        return np.array([cell.freedom for cell in self.cells], dtype=float)

    def log_noise_prior(self, eta: FloatArray) -> FloatArray:
        """Return the log prior density of the noise coordinates (..., e), (...)."""
        count = len(self.channels)
        # A half-normal wall at the resolution instead of a jump: as good as one pseudo-reading.
        wall = 0.5 * np.sum((RESOLUTION_M * np.exp(-eta[..., :count])) ** 2, axis=-1)
        # The half-Cauchy of the ratio, times the derivative of the ratio by its coordinate.
        ratio = eta[..., count:]
        return -wall - np.sum(np.logaddexp(ratio, -ratio), axis=-1)

    def inside(self, points: FloatArray) -> BoolArray:
        """Tell where no pose_sigma is negative, (...), of points (..., d)."""
        ratios = points[..., len(self.free) + len(self.channels) :]
        return np.all(ratios >= 0.0, axis=-1)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the log posterior density up to a constant.

        Parameters
        ----------
        points
            (..., d).

        Returns
        -------
        ndarray
            (...).
        """
        flat = points.reshape(-1, points.shape[-1])
        block = max(1, BLOCK_ROWS // len(self.rows))
        parts = [self._log_density(flat[i : i + block]) for i in range(0, len(flat), block)]
        return np.concatenate(parts).reshape(points.shape[:-1])

    def _log_density(self, points: FloatArray) -> FloatArray:
        z = self.parameters(points)
        eta = points[..., len(self.free) :]
        errors = self.rows.target - self.model.predict(z, self.rows)
        variances = self.variances(eta)
        value = self.log_noise_prior(eta) - 0.5 * np.sum(
            self.freedom * np.log(variances) + self.sums_of_squares(errors) / variances, axis=-1
        )
        if self.priors:
            x = self.model.natural(z)
            for prior in self.priors:
                value -= 0.5 * np.sum(prior.residual(x) ** 2, axis=-1)
        if self.model.extension is not None:
            theta = self.model.theta(z)
            value -= 0.5 * np.sum((theta @ self.model.extension.prior_precision) * theta, axis=-1)
        return np.where(self.inside(points), value, -np.inf)

    def sums_of_squares(self, errors: FloatArray) -> FloatArray:
        """Return the sum of squares in each cell, m², (..., cells), of errors (..., n, 3)."""
        if self.frames is not None:
            errors = np.einsum('nij,...nj->...ni', self.frames, errors)
        means = self.rows.group_sum(errors, axis=-2)
        means = means**2 / self.rows.group_size[:, None]
        spans = dict(self.rows.spans)
        total = np.zeros((*errors.shape[:-2], len(self.channels)))
        sums = np.zeros((*errors.shape[:-2], len(self.cells)))
        for index, channel in enumerate(self.channels):
            axes = slice(*channel.axes)
            part = errors[..., spans[channel.sensor], axes]
            total[..., index] = np.einsum('...ni,...ni->...', part, part)
        for index, cell in enumerate(self.cells):
            if cell.size > 0:
                axes = slice(*self.channels[cell.channel].axes)
                sums[..., index] = means[..., cell.groups, axes].sum(axis=(-1, -2))
                total[..., cell.channel] -= sums[..., index]
        for index, cell in enumerate(self.cells):
            if cell.size == 0:
                # Cancellation may leave a hair below zero.
                sums[..., index] = np.maximum(total[..., cell.channel], 0.0)
        return sums

    def gram(self, features: Callable[[Rows], FloatArray], width: int) -> FloatArray:
        """Return the Gram matrix of features of the rows in each cell, (cells, width, width).

        Parameters
        ----------
        features
            Rows to features (rows, 3, width), vectors in the coordinates of `Rows.target`; called
            with some thousand rows at a time, so that memory does not grow with their number.
        width
            Number of features.
        """
        sensors = len(self.model.sensor_names)
        result = np.zeros((len(self.cells), width, width))
        total = np.zeros((len(self.channels), width, width))
        for first, last in self.rows.blocks(BLOCK_ROWS // 20):
            rows = self.rows.of_groups(first, last)
            values = features(rows)
            if self.frames is not None:
                start = self.rows.group_start[first]
                values = self.frames[start : start + len(rows)] @ values
            means = rows.group_sum(values, axis=0) / np.sqrt(rows.group_size)[:, None, None]
            for sensor in range(sensors):
                span = dict(rows.spans).get(sensor, slice(0, 0))
                for index, channel in enumerate(self.channels):
                    if channel.sensor == sensor:
                        part = values[span, slice(*channel.axes)].reshape(-1, width)
                        total[index] += part.T @ part
            for index, cell in enumerate(self.cells):
                if cell.size > 0:
                    inside = cell.groups[(cell.groups >= first) & (cell.groups < last)] - first
                    part = means[inside, slice(*self.channels[cell.channel].axes)]
                    part = part.reshape(-1, width)
                    result[index] += part.T @ part
        for index, cell in enumerate(self.cells):
            if cell.size > 0:
                total[cell.channel] -= result[index]
        for index, cell in enumerate(self.cells):
            if cell.size == 0:
                result[index] = total[cell.channel]
        return result


def _cells(channels: Sequence[Channel], rows: Rows) -> tuple[ErrorGroup, ...]:
    """Sort the groups of each channel by size; groups of one row have no deviations."""
    cells = []
    for index, channel in enumerate(channels):
        mine = np.flatnonzero(rows.group_sensor == channel.sensor)
        size = rows.group_size[mine]
        spare = int(np.sum(size - 1))
        if spare > 0:
            cells.append(ErrorGroup(index, 0, mine, channel.dimension * spare))
        for value in np.unique(size):
            groups = mine[size == value]
            cells.append(ErrorGroup(index, int(value), groups, channel.dimension * len(groups)))
    return tuple(cells)


def _frames(model: Model, rows: Rows) -> FloatArray:
    """Return the line of sight of each row's group, and two directions across it, (n, 3, 3)."""
    middle = rows.group_sum(rows.target, axis=0) / rows.group_size[:, None]
    sight = middle - model.reference[rows.group_sensor, :3, 3]
    sight /= np.maximum(np.linalg.norm(sight, axis=1), np.finfo(float).tiny)[:, None]
    # The base axis least along the line of sight gives a first direction across it.
    helper = np.eye(3)[np.argmin(np.abs(sight), axis=1)]
    first = np.cross(sight, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    frames = np.stack((sight, first, np.cross(sight, first)), axis=1)
    return frames[rows.group_of_row]
